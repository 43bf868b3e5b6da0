"""Small shared helpers: alternatives that take turns in one run, quantiles, lines of figures."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Timed:
    """Time that a piece of work took, on the wall and of this process's CPU, in s."""

    wall_s: float
    cpu_s: float


def timed(work: Callable[[], object]) -> Timed:
    """Do the work once and return what it took."""
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    work()
    return Timed(wall_s=time.perf_counter() - wall_s, cpu_s=time.process_time() - cpu_s)


def in_turns(cases: Mapping[str, Callable[[], _Result]], rounds: int) -> dict[str, list[_Result]]:
    """Run all cases once a round, each round beginning with another one; results by case.

    What the machine does meanwhile then meets all of them alike.
    """
    names = list(cases)
    found: dict[str, list[_Result]] = {name: [] for name in names}
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            found[name].append(cases[name]())
    return found


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float:
    """Return the median of the ratios of the rounds."""
    return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value that a share of all values do not exceed."""
    return float(np.quantile(values, share))


def repeats(full: int, effort: float, *, least: int = 1) -> int:
    """Return how often to do what is done ``full`` times at effort 1."""
    return max(least, round(full * effort))


def same(found: bool, what: str) -> None:
    """End the benchmark where two alternatives do not give the same."""
    if not found:
        raise SystemExit(f"the figures mean nothing: {what}")


def line(name: str, text: str) -> None:
    """Print one line of figures."""
    print(f"{name:<26} {text}", flush=True)
