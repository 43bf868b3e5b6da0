"""Properties over bad input: damage for good bytes, and a limit of time.

Each property meets some dozens of inputs of Hypothesis, nearly the same in every run (constants of
modules that other tests have loaded are among them); a campaign (`make campaign`) gives it as many
new ones as TACTILE_CELL_INPUTS says.
"""

import functools
import gc
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from random import SystemRandom
from time import process_time
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, example, given, settings, strategies as st

from recognition.grasp import Grasp, PadArray
from tests.recognition.conftest import OBJECTS, make_grasps
from tests.values import make_pads

INPUTS = int(os.environ.get("TACTILE_CELL_INPUTS", "0"))
"""New inputs that each property meets in a campaign; 0 for the few of every run."""

Damage = tuple[int, int, bytes | int]
"""Place and size of a piece, and what is there instead: other bytes, or a copy from a place."""
_PIECES = (b"\0\0\0\0", b"\x7f", b"\xff\xff\xfd\0", b"\n", b'"', b"-", b":", b"[")
"""Bytes that mean something to one of the parsers."""
_PLACES = st.integers(0, 1 << 16)


def damages(*, at_most: int = 4) -> st.SearchStrategy[list[Damage]]:
    """Return a strategy for lists of damages."""
    sizes = st.integers(0, 8) | st.integers(0, 200)
    new = st.binary(max_size=8) | st.sampled_from(_PIECES) | _PLACES
    return st.lists(st.tuples(_PLACES, sizes, new), max_size=at_most)


def spoilt(data: bytes, damages: Iterable[Damage]) -> bytes:
    """Return the bytes with pieces overwritten, put in, lost, doubled or moved."""
    out = data
    for place, size, new in damages:
        at = place % (len(out) + 1)
        piece = out[new % (len(out) + 1) :][:size] if isinstance(new, int) else new
        out = out[:at] + piece + out[at + size :]
    return out


def disturbed(messages: Sequence[bytes], damages: Iterable[Damage]) -> list[bytes]:
    """Return the messages with some of them spoilt, lost, doubled or moved, and others put in."""
    out = list(messages)
    for place, size, new in damages:
        at = place % (len(out) + 1)
        if isinstance(new, int):
            out[at : at + size] = out[new % (len(out) + 1) :][:size]
        else:
            out[at : at + 1] = [spoilt(one, [(size, 1, new)]) for one in out[at : at + 1]] or [new]
    return out


def pieces(data: bytes, size: int) -> list[bytes]:
    """Cut bytes as a driver hands them out."""
    return [data[at : at + size] for at in range(0, len(data), size)]


def seed_of_run(usual: int) -> int:
    """Return the seed of a random walk: the usual one, or in a campaign one that is new."""
    return SystemRandom().randrange(1 << 32) if INPUTS else usual


def bad_input(
    *,
    examples: int = 60,
    limit_s: float = 0.5,
    sound: Mapping[str, Any] | None = None,
    **inputs: st.SearchStrategy[Any],
) -> Any:
    """Make a property of a function that returns what became of its input, in a few words.

    It fails if any input breaks an assertion or takes more than ``limit_s`` s of processor time,
    and if the same became of all inputs: then they prove nothing. Fixtures are made once for all
    inputs.

    Parameters
    ----------
    examples
        Inputs of a run that is no campaign.
    limit_s
        Processor time for one input in s.
    sound
        An input that is taken, where chance alone may give none.
    inputs
        The strategy of Hypothesis for each input.
    """
    chosen = settings(
        max_examples=INPUTS or examples,
        derandomize=not INPUTS,
        deadline=None,
        phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )

    def decorate(test: Callable[..., str]) -> Callable[..., None]:
        outcomes: Counter[str] = Counter()

        @functools.wraps(test)
        def once(**values: Any) -> None:
            started_s = process_time()
            outcomes[test(**values)] += 1
            assert process_time() - started_s < limit_s

        taken = once if sound is None else example(**sound)(once)
        given_inputs = chosen(given(**inputs)(taken))

        @functools.wraps(given_inputs)
        def check(**fixtures: Any) -> None:
            logging.disable(logging.CRITICAL)  # libraries log each damage, pytest keeps it all
            gc.disable()  # to walk all objects of a test run takes longer than an input
            try:
                given_inputs(**fixtures)
            finally:
                gc.enable()
                logging.disable(logging.NOTSET)
            assert len(outcomes) > 1, f"the same became of all inputs: {dict(outcomes)}"

        return check

    return decorate


@dataclass
class Clock:
    """Time that passes in waiting only."""

    now_s: float = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.now_s += seconds


@functools.cache
def good_grasps() -> tuple[Grasp, ...]:
    """Return twelve grasps of two objects, six frames each, by two pads of 8 x 5 taxels."""
    both = [replace(OBJECTS[2], label="ball"), replace(OBJECTS[1], label="box")]
    pads = make_pads(shapes=((8, 5), (8, 5)), adc_max=255)
    made = make_grasps(6, seed=3, pads=pads, objects=both, n_before=1, n_ramp=5, noise_counts=4.0)
    more = {"force_n": np.linspace(0.0, 8.0, 6), "source": "made"}
    return tuple(
        replace(grasp, **more, start_ms=1_700_000_000_000 + i) for i, grasp in enumerate(made)
    )


def same_grasps(
    ours: Sequence[Grasp], others: Sequence[Grasp], *, but: Sequence[str] = (), atol: float = 0.0
) -> bool:
    """Return whether grasps are equal in every field ``but`` some; NaN equals NaN."""

    def same(one: Any, other: Any) -> bool:
        if isinstance(one, float | np.ndarray):
            return np.shape(one) == np.shape(other) and np.allclose(
                one, other, rtol=0.0, atol=atol, equal_nan=True
            )
        return bool(one.same_as(other) if isinstance(one, PadArray) else one == other)

    names = [field.name for field in fields(Grasp) if field.name not in but]
    return len(ours) == len(others) and all(
        same(getattr(a, name), getattr(b, name))
        for a, b in zip(ours, others, strict=True)
        for name in names
    )
