"""Fingers that close faster, and farther, than is possible on a part."""

from math import inf

from gripper.force.estimates.grip import Grip
from gripper.force.estimates.stiffness import KNOWN_N
from gripper.force.loop import Moment
from gripper.force.supervision.pad_samples import HELD_SHARE, PadSamples
from gripper.values.force_sensor import ForceSample

_RUNAWAY_RESERVE = 2.0
"""Largest closing speed of a ramp on the part, in multiples of that by its stiffness. [tuned]"""
_RUNAWAY_N = 1.0
"""Increase of the load in N that a known stiffness predicts for the travel of the fingers, above
which the travel alone shows that the part is gone. [tuned]"""
_BLIND_N, _BLIND_SHARE = 6.0, 0.05
"""Growth of the force in N that the stiffness predicts for a travel, and the share of it below
which the pads do not measure the load of the fingers. [tuned]"""
STEADY_S = 0.3
"""Time in s of a hold until force and fingers rest, with any part. [tuned]"""


class Runaway:
    """Detector of fingers that run ahead of their force.

    On a soft part they run far when friction breaks, and its stiffness is uncertain before the
    force has grown: then the pads decide, by a sample after the start. Later, and in a steady hold,
    the travel is enough.

    Parameters
    ----------
    grip, pads
        What is known of the grip, and its newest samples.
    """

    def __init__(self, grip: Grip, pads: PadSamples) -> None:
        self._grip = grip
        self._pads = pads
        self._began: tuple[float, float, float] | None = None
        self._ahead: tuple[float, float] | None = None
        self._steady_s = 0.0

    def found(self, moment: Moment, stiffness_n_m: float | None) -> bool:
        """Add one period; return whether the fingers run unlike on any part.

        ``stiffness_n_m``: of the part in N/m, None while not known.
        """
        state, sample, settings = moment.state, moment.sample, self._grip.settings
        rate_n_s, recent = self._grip.rate_n_s, self._pads.recent
        self._steady_s = 0.0 if rate_n_s != 0.0 else self._steady_s + moment.dt_s
        if stiffness_n_m is None and rate_n_s != 0.0:
            return False
        wanted_m_s = 0.0 if stiffness_n_m is None else max(0.0, rate_n_s / stiffness_n_m)
        closing_m_s = -state.aperture_velocity_m_s
        if closing_m_s <= settings.runaway_speed_m_s + _RUNAWAY_RESERVE * wanted_m_s:
            self._began = self._ahead = None
            return False
        force_n = recent.grip_n if recent else 0.0
        if self._began is None:
            self._began = moment.now_s, state.aperture_m, force_n
            self._ahead = state.aperture_m, force_n
        began_s, began_m, began_n = self._began
        travel_m = began_m - state.aperture_m
        if sample is not None and sample.valid:
            late_n = [one.grip_n for one in recent if one.measured_s >= began_s]
            if late_n:
                mean_n = sum(late_n) / len(late_n)
                if mean_n > max(self._pads.empty_n, HELD_SHARE * began_n):
                    self._began = moment.now_s, state.aperture_m, force_n
                    return self._blind(moment, sample, stiffness_n_m)
                return travel_m >= settings.runaway_travel_m
        yields_m = inf if stiffness_n_m is None else _RUNAWAY_N / stiffness_n_m
        known = self._steady_s > STEADY_S or began_n > KNOWN_N
        return known and travel_m >= max(settings.runaway_travel_m, yields_m)

    def _blind(self, moment: Moment, sample: ForceSample, stiffness_n_m: float | None) -> bool:
        """Return whether fingers that run ahead meet nothing although the pads are loaded.

        The force does not grow with their travel. One finger alone may be a drifting encoder.
        """
        if stiffness_n_m is None or self._ahead is None:
            return False
        settings, linkage = self._grip.settings, self._grip.linkage
        began_m, began_n = self._ahead
        travel_m = began_m - self._grip.apertures.at(sample.measured_s)
        promised_n = stiffness_n_m * travel_m
        least_m_s = 0.5 * settings.runaway_speed_m_s / len(moment.state.servos)
        together = all(
            -servo.velocity_rad_s * linkage.opening_per_rad_m(servo.angle_rad) > least_m_s
            for servo in moment.state.servos
        )
        return (
            together
            and travel_m >= settings.runaway_travel_m
            and promised_n >= _BLIND_N
            and self._pads.recent.grip_n - began_n < _BLIND_SHARE * promised_n
        )
