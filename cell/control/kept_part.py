"""The part that is kept in the grip: its force, and whether it is still the same part."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle
from cell.control.part import Verification
from cell.control.states import Event
from cell.control.watch import MotionWatch
from cell.control.zeroing import BORNE_SHARE
from cell.hand.interface import Hand

HELD_LOOK_S = 0.1
"""Time in s over which a held part is measured: 5 frames at 50 Hz."""
_HELD_SHARE = 0.5
"""Share of the holding force below which nothing is held; noise is far below half of it."""
_OPENING_M = 0.5e-3
"""Change of the opening in m at the same force that shows another or a turned part. Settling foam
and the resolution of the servos change it by 0.1 mm (simulated cell)."""
_LIKENESS = 0.95
"""Least similarity of two footprints: cosine of the angle between the taxels' counts, corrected for
noise. In the simulated cell the same part has at least 0.99 (45 measurements of 15 parts, zero of
five frames; 0.97 with twice the noise). Five parts in another pose have at most 0.94 (210
pairs)."""
_LOSS_DECIDED_S = 0.5
"""Time in s within which the supervision of a hold decides whether a part is lost."""


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
    squares = [float(part.footprint @ part.footprint) - part.noise for part in (first, second)]
    if min(squares) <= 0.0:
        return 0.0
    return float(first.footprint @ second.footprint) / math.sqrt(squares[0] * squares[1])


@dataclass
class KeptPart:
    """Holds a part with the carry force, and measures it."""

    hand: Hand
    life: CellLifecycle
    journal: Journal
    watch: MotionWatch
    wanted_force_n: float
    """``carry_force_n`` of the config, but at most the force of a grip without a name."""
    _zero: NDArray[np.float64] = field(init=False)
    _then: HeldPart = field(init=False)

    @property
    def force_n(self) -> float:
        """Force in N of a carry, as far as the servos bear it."""
        return min(self.wanted_force_n, BORNE_SHARE * self.hand.largest_ramp_n)

    def hold(self) -> None:
        """Hold the part with the carry force."""
        self.hand.hold_at(self.force_n, 0.0, self.watch.motion)

    def measure(self, zero: NDArray[np.float64]) -> None:
        """Hold the part, and measure it for later comparisons.

        ``zero``: counts of the open fingers, (n_taxels,) float64.
        """
        self._zero = zero
        self._then = self._measure()

    def verify(self) -> Verification:
        """Measure whether the part in the grip is still the kept one; it stays there.

        Raises
        ------
        CellStateError
            If no part is kept.
        CellStopped
            If it was cancelled: the part is then HELD, without force control.
        gripper.errors.PartLost, gripper.errors.PartSlipped
            If the part is gone or slips; this is a fault at any time of a carry.
        """
        with self.life.executing(Event.VERIFY):
            check = compared(self._measure(), self._then)
            if not check.held:
                # A part that has just gone may need longer than the measurement to count as lost.
                self.hand.hold_at(self.force_n, _LOSS_DECIDED_S, self.watch.motion)
                check = compared(self._measure(), self._then)
            self.life.keep(since="answer")
        self.journal.note("verify", "; ".join(check.reasons) or "the same part")
        return check

    def _measure(self) -> HeldPart:
        self.hold()
        collector, watch = self.watch.collecting()
        while not collector.n_frames:  # a gap that is too long is a fault of the sensor
            self.hand.hold_at(self.force_n, HELD_LOOK_S, watch)
        forces_n = [cycle.force.grip_n for cycle in collector.cycles if cycle.force is not None]
        openings_m = [cycle.state.aperture_m for cycle in collector.cycles]
        return HeldPart(
            force_n=float(np.mean(forces_n)),
            opening_m=float(np.mean(openings_m)),
            footprint=collector.counts.mean(axis=0) - self._zero,
            noise=float(collector.counts.var(axis=0).sum()) / max(collector.n_frames - 1, 1),
        )
