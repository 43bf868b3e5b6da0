"""Live values of a cell: its present measurements, for hosts that show or supervise it."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cell.hand.interface import LatestValues
from gripper.values.force_sensor import ForceSample
from gripper.values.state import Cycle
from tactile.source import TactileFrame

FRESH_S = 0.5
"""Age in s beyond which a value counts as not measured. Frames come every 0.02 s, periods of the
loop every 0.005 s, and a busy machine may delay the program by some tenths of a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveValues:
    """The present measurements: in a motion, in a carry, and between two jobs.

    A value is None before the first motion, after a fault or a shutdown, and when it is older than
    `FRESH_S`. Ages are those at the call, by the cell's own clock. In virtual time this clock and
    the fingers stand still between two commands, so values and ages do not change. With
    `tactile-cell serve` the clock follows real time.
    """

    force_n: float | None = None
    """Grip force in N: the mean of both fingers, as the force loop controls it."""
    force_age_s: float | None = None
    """Age of the newest valid force in s, even if the force is too old to be shown."""
    setpoint_n: float | None = None
    """Force set-point in N; 0 while no force is controlled."""
    opening_mm: float | None = None
    """Opening between the fingers in mm."""
    temperature_c: float | None = None
    """Temperature of the warmest servo in degrees Celsius."""
    counts: NDArray[np.uint16] | None = None
    """(n_taxels,) uint16: raw counts of the newest frame, read-only."""
    frame_age_s: float | None = None
    """Age of the newest frame in s, even if the frame is too old to be shown."""


_Value = TypeVar("_Value", Cycle, ForceSample, TactileFrame)


def live_values(latest: LatestValues, now_s: float) -> LiveValues:
    """Return the values of a hand at a monotonic time in s."""

    def age_s(one: ForceSample | TactileFrame | None) -> float | None:
        return None if one is None else max(0.0, now_s - one.t_s)

    def fresh(one: _Value | None) -> _Value | None:
        return None if one is None or now_s - one.t_s > FRESH_S else one

    cycle, force, frame = fresh(latest.cycle), fresh(latest.force), fresh(latest.frame)
    return LiveValues(
        force_n=None if force is None else force.grip_n,
        force_age_s=age_s(latest.force),
        setpoint_n=None if cycle is None else cycle.setpoint_n,
        opening_mm=None if cycle is None else 1e3 * cycle.state.aperture_m,
        temperature_c=None if cycle is None else cycle.state.temperature_c,
        counts=None if frame is None else frame.counts,
        frame_age_s=age_s(latest.frame),
    )
