"""What the gripper asks of a force sensor; who measures it is not its business."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSample:
    """Normal force on both fingers, tared and calibrated.

    Attributes
    ----------
    t_s
        Monotonic time of the measurement in s.
    force_n
        Normal force on finger 0 and on finger 1 in N.
    valid
        False when the sensor says that the value must not be used for control (saturated pad,
        too many bad taxels).
    reason
        Why it is not valid; empty where it is.
    centre_m
        Centre of the force on each finger's pad in m, along the finger and across it; None where
        the sensor does not tell, or nothing touches.
    """

    t_s: float
    force_n: tuple[float, float]
    valid: bool = True
    reason: str = ""
    centre_m: tuple[tuple[float, float], tuple[float, float]] | None = None

    @property
    def grip_n(self) -> float:
        """Grip force in N: the mean of both fingers, which are equal in equilibrium."""
        return 0.5 * (self.force_n[0] + self.force_n[1])


class ForceSensor(Protocol):
    """Source of force samples; called once every period of the force loop, must not block."""

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample, None while there is none; the caller judges its age."""
        ...
