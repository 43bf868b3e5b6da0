"""A part kept in the grip: when it is kept, and whether it is still the same part."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from cell.control.part import Verification
from cell.control.plan import GraspStep
from cell.control.records import GraspCollector, GraspRecord
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN

HELD_LOOK_S = 0.1
"""Time in s over which a held part is measured: 5 frames at 50 Hz."""
_HELD_SHARE = 0.5
"""Share of the holding force below which nothing is held; noise is far below half of it."""
_OPENING_M = 0.5e-3
"""Change of the opening in m at the same force that shows another or a turned part. Settling foam
and the resolution of the servos change it by 0.1 mm (simulated cell)."""
_LIKENESS = 0.95
"""Least similarity of two footprints: cosine of the angle between the taxels' counts, corrected for
noise. In the simulated cell the same part has at least 0.99 (45 measurements of 15 parts; 0.97 with
twice the noise). Five parts in another pose have at most 0.94 (210 pairs)."""
_OPEN_FRAMES = 5
"""Number of first frames of a grasp, before the first touch; their mean is the zero."""


class Keep(StrEnum):
    """When an identification keeps the part in the grip."""

    NEVER = "never"
    WHEN_NAMED = "when_named"
    ALWAYS = "always"

    def keeps(self, label: str) -> bool:
        """Return whether a part with this answer stays in the grip."""
        return self is Keep.ALWAYS or (self is Keep.WHEN_NAMED and label != UNKNOWN)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartDecision:
    """Decision about a part that is held while its grasp is classified."""

    keep: bool = False
    """Whether it stays in the grip for the host."""
    further: GraspStep | None = None
    """Step whose force is the end of a further ramp in the same grip; None for no further ramp."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """Computes the answer to a grasp, and decides what to do with its part."""

    start_answer: Callable[[GraspRecord], None]
    """Called at the end of a ramp. If the force loop has its own process, the answer is computed
    during the motion that follows."""
    decide: Callable[[], PartDecision]
    """Waits for the answer and decides; called while the part is held."""
    holds: bool
    """Whether the part is held until the decision; else it is released while it is classified."""
    keeps: bool
    """Whether it may be kept; it is then measured for a later comparison."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeldPart:
    """Measurement of a part that is held with the carry force."""

    force_n: float
    """Grip force in N, mean over the measurement."""
    opening_m: float
    """Opening between the pads in m."""
    footprint: NDArray[np.float64]
    """(n_taxels,) float64: mean counts above those of the open fingers."""
    noise: float = 0.0
    """Sum over the taxels of the variance of the mean, in counts squared."""


def measure_held_part(collector: GraspCollector, zero: NDArray[np.float64]) -> HeldPart:
    """Return the measurement of a held part from the collected periods.

    ``zero``: counts of the open fingers, (n_taxels,) float64.
    """
    forces_n = [cycle.force.grip_n for cycle in collector.cycles if cycle.force is not None]
    openings_m = [cycle.state.aperture_m for cycle in collector.cycles]
    return HeldPart(
        force_n=float(np.mean(forces_n)),
        opening_m=float(np.mean(openings_m)),
        footprint=collector.counts.mean(axis=0) - zero,
        noise=float(collector.counts.var(axis=0).sum()) / max(collector.n_frames - 1, 1),
    )


def open_counts(grasp: Grasp) -> NDArray[np.float64]:
    """Return the counts of the open fingers, (n_taxels,): the mean of a grasp's first frames."""
    first: NDArray[np.float64] = grasp.counts[:_OPEN_FRAMES].mean(axis=0)
    return first


def compared(now: HeldPart, then: HeldPart) -> Verification:
    """Return whether a held part, measured now, is still the kept one."""
    least_n = _HELD_SHARE * then.force_n
    held = now.force_n >= least_n
    reasons: list[str] = []
    if not held:
        reasons.append(
            f"the grip force is {now.force_n:.2f} N; a held part needs at least {least_n:.2f} N"
        )
    moved_m = abs(now.opening_m - then.opening_m)
    if held and moved_m > _OPENING_M:
        reasons.append(
            f"the opening is {1e3 * now.opening_m:.2f} mm and was {1e3 * then.opening_m:.2f} mm; "
            f"a difference of {1e3 * _OPENING_M:g} mm is allowed"
        )
    likeness = _likeness(now, then)
    if held and likeness < _LIKENESS:
        reasons.append(
            f"the similarity to the kept footprint is {likeness:.2f}; it must be at least "
            f"{_LIKENESS:g}"
        )
    return Verification(
        held=held,
        same=not reasons if held else None,
        force_n=now.force_n,
        opening_m=now.opening_m,
        reasons=tuple(reasons),
    )


def _likeness(first: HeldPart, second: HeldPart) -> float:
    squares = [float(one.footprint @ one.footprint) - one.noise for one in (first, second)]
    if min(squares) <= 0.0:
        return 0.0
    return float(first.footprint @ second.footprint) / math.sqrt(squares[0] * squares[1])


def spliced(approach: Grasp, further: Grasp, from_n: float) -> Grasp:
    """Return a grasp made of the first approach and a further ramp in the same grip.

    A recogniser compares each taxel with its rest before the touch, but a further ramp begins with
    a loaded part. The frames of the first ramp below ``from_n``, the set-point in N at which the
    further ramp begins, are therefore put before it.
    """
    n = int(np.argmax(np.asarray(approach.force_n) >= from_n))
    gap_s = float(np.median(np.diff(further.t_s))) if further.n_frames > 1 else 0.0
    later_s = float(approach.t_s[n - 1]) + gap_s if n else 0.0
    return Grasp(
        pads=further.pads,
        counts=np.concatenate([approach.counts[:n], further.counts]),
        t_s=np.concatenate([approach.t_s[:n], further.t_s + later_s]),
        aperture_m=np.concatenate([approach.aperture_m[:n], further.aperture_m]),
        force_n=np.concatenate([approach.force_n[:n], further.force_n]),
        label=further.label,
        source=further.source,
        start_ms=further.start_ms,
        command=further.command,
    )
