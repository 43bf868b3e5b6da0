"""Runs a fuzz target: many damaged inputs, what became of them, and what must never happen."""

import random
import resource
import signal
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol

BY_CHANCE = "passed a 16-bit checksum by chance"
"""Outcome of an input that is damaged, yet has the right CRC: one in 65536 must, none can tell."""

_KEPT = 10
_WARM_UP = 200
_CRC_CODES = 1 << 16


class Broken(Exception):
    """An invariant does not hold for an input."""


class Hangs(BaseException):
    """An input took more processor time than its limit."""


class Trial(Protocol):
    """One parser under test; ``close()``, where it has one, gives back what it opened."""

    def generate(self, rng: random.Random) -> Any:
        """Return one input."""
        ...

    def check(self, item: Any) -> str:
        """Feed it and return what became of it; Broken, or any other exception, is a defect."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A parser, how it is tried and its limits.

    Attributes
    ----------
    name, parser
        Short name, and what is called.
    inputs
        What is fed, for the table.
    make
        Prepares a trial.
    limit_s
        Processor time in s that one input may take.
    growth_mb
        How much the memory of the process may grow in MB.
    crc_tests
        Checksums of 16 bits that one input may meet at most, 0 where nothing hangs on one.
    """

    name: str
    parser: str
    inputs: str
    make: Callable[[], Trial]
    limit_s: float = 0.5
    growth_mb: float = 64.0
    crc_tests: int = 0


@dataclass(slots=True, kw_only=True)
class Result:
    """What a target did."""

    name: str
    inputs: int = 0
    wall_s: float = 0.0
    slowest_s: float = 0.0
    growth_mb: float = 0.0
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    n_failures: int = 0

    def fail(self, text: str) -> None:
        """Note a defect; the first ones are kept with their inputs."""
        self.n_failures += 1
        if len(self.failures) < _KEPT and not any(text[:60] == old[:60] for old in self.failures):
            self.failures.append(text)


def run(target: Target, *, count: int, seconds: float, seed: int) -> Result:
    """Feed ``count`` inputs, or as many as fit into ``seconds``; the same seed gives the same."""
    result = Result(name=target.name)
    trial = target.make()
    rng = random.Random(f"{target.name}:{seed}")
    usual = signal.signal(signal.SIGVTALRM, _hangs)
    start_s = time.perf_counter()
    warm_kb = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            while result.inputs < count and time.perf_counter() - start_s < seconds:
                _feed(target, trial, rng, result)
                if result.inputs == _WARM_UP:
                    warm_kb = _peak_kb()
    finally:
        signal.signal(signal.SIGVTALRM, usual)
        getattr(trial, "close", lambda: None)()
    result.wall_s = time.perf_counter() - start_s
    if warm_kb:
        result.growth_mb = (_peak_kb() - warm_kb) / 1024
        if result.growth_mb > target.growth_mb:
            result.fail(f"memory grew by {result.growth_mb:.0f} MB")
    expected = target.crc_tests * result.inputs / _CRC_CODES
    if result.outcomes[BY_CHANCE] > expected + 5 * expected**0.5 + (2 if target.crc_tests else 0):
        result.fail(
            f"{result.outcomes[BY_CHANCE]} wrong checksums accepted; {expected:.1f} by chance"
        )
    return result


def _feed(target: Target, trial: Trial, rng: random.Random, result: Result) -> None:
    item = trial.generate(rng)
    begin_s = time.process_time()
    signal.setitimer(signal.ITIMER_VIRTUAL, target.limit_s)
    try:
        outcome = trial.check(item)
    except (Exception, Hangs) as error:
        outcome = "DEFECT"
        shown = repr(item)
        result.fail(f"{type(error).__name__}: {str(error)[:300]} <- {shown[:2000]}")
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    result.slowest_s = max(result.slowest_s, time.process_time() - begin_s)
    result.inputs += 1
    result.outcomes[outcome] += 1


def _hangs(_signal: int, _frame: FrameType | None) -> None:
    raise Hangs


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
