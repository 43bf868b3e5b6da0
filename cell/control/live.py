"""Live values of a cell: what was measured last, for hosts that show or forward it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripper.state import Cycle
from tactile.frames.codec import TactileFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveValues:
    """What was measured last; each value is None before the first motion.

    Attributes
    ----------
    force_n
        Grip force: the smaller force of both fingers in N.
    setpoint_n
        Force that is asked for in N; 0 while no force is controlled.
    opening_mm
        Opening between the fingers in mm.
    temperature_c
        Temperature of the warmest servo in degrees Celsius.
    counts : (n_taxels,) uint16
        Raw counts of the newest frame, read-only.
    frame_age_s
        Age of that frame in s.
    """

    force_n: float | None = None
    setpoint_n: float | None = None
    opening_mm: float | None = None
    temperature_c: float | None = None
    counts: NDArray[np.uint16] | None = None
    frame_age_s: float | None = None


def live_values(cycle: Cycle | None, frame: TactileFrame | None, now_s: float) -> LiveValues:
    """Return the values of the newest period of the loop and the newest frame."""
    if cycle is None:
        return LiveValues()
    return LiveValues(
        force_n=None if cycle.force is None else min(cycle.force.force_n),
        setpoint_n=cycle.setpoint_n,
        opening_mm=1e3 * cycle.state.aperture_m,
        temperature_c=cycle.state.temperature_c,
        counts=None if frame is None else frame.counts,
        frame_age_s=None if frame is None else max(0.0, now_s - frame.t_s),
    )
