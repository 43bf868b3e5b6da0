"""Current of a servo's winding, and the voltage of its supply, by the registers of its feedback.

The 330 size measures and limits the current of the supply: duty times winding current. Near
0 A a count of it is many counts of the winding's current. So the winding's comes from the duty:
(duty V - k_e w) / R. Present Current over the duty is a second measurement.
"""

from collections import deque
from math import copysign
from statistics import median

from gripper.dynamixel.models import ServoModel

_LEAST_READINGS, _MOST_READINGS = 20, 40
"""Readings of the voltage for a median, and those that are kept: single ones are off by 0.5 to 0.8
V while a servo holds (logs of Rhoban/bam, revision af22604)."""
_LEAST_DUTY = 0.2
"""Duty below which Present Current over the duty is too inexact."""


class Supply:
    """Voltage of the supply of one servo, without the noise of single readings."""

    def __init__(self) -> None:
        self._readings_v: deque[float] = deque(maxlen=_MOST_READINGS)

    def steady_v(self, voltage_v: float, *, under_torque: bool) -> float:
        """Add a reading in V and return the voltage; without torque a reading is exact.

        Until there are enough readings it is the highest one, which makes the goal currents small.
        """
        if not under_torque:
            self._readings_v.extend([voltage_v] * _MOST_READINGS)
        self._readings_v.append(voltage_v)
        few = len(self._readings_v) < _LEAST_READINGS
        return max(self._readings_v) if few else median(self._readings_v)


def winding_a(
    model: ServoModel, present_a: float, duty: float, supply_v: float, speed_rad_s: float
) -> tuple[float, float | None]:
    """Return the current in A of a winding, and the same by Present Current alone.

    The second one is None where the duty is too small for it. All signs are in one direction.

    Parameters
    ----------
    present_a
        Present Current in A.
    duty
        Present PWM as a share of the whole supply.
    supply_v, speed_rad_s
        Voltage of the supply in V, and speed of the output in rad/s.
    """
    if not model.supply_current:
        return present_a, present_a
    # A servo without torque has no duty, and no current either.
    motor_v = duty * supply_v - model.back_emf_v_s * speed_rad_s if duty else 0.0
    by_register = abs(duty) > _LEAST_DUTY
    return motor_v / model.winding_ohm, copysign(present_a / duty, duty) if by_register else None
