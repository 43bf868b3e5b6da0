"""Force on the fingers: a sample, and the interface of its sensor."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSample:
    """Normal force on both fingers, tared and calibrated."""

    t_s: float
    """Monotonic time of the measurement in s."""
    force_n: tuple[float, float]
    """Normal force on finger 0 and on finger 1 in N."""
    valid: bool = True
    """False when the value must not be used for control (saturated pad, too many bad taxels)."""
    at_least: bool = False
    """True if it is not valid because taxels are at full scale: the force is at least this one."""
    reason: str = ""
    """Why it is not valid, or empty."""
    centre_m: tuple[float, float] | None = None
    """Centre of the grip force in the grip frame in m, along the fingers and across them: the mean
    of both pads' centres; None if not known, or without a touch."""
    centre_noise_m: float = 0.0
    """Standard deviation of each coordinate of ``centre_m``, as ``noise_n`` is of the force."""
    lag_s: float = 0.02
    """Mean age of the force at ``t_s`` in s: filters, transmission."""
    noise_n: float = 0.3
    """Standard deviation of `grip_n` in N, in addition to that of the samples before it."""
    frame_s: float | None = None
    """Monotonic time in s of the scan of the newest whole frame, a second measurement; None if the
    samples come from frames."""
    frame_n: tuple[float, float] = (0.0, 0.0)
    """Normal force on finger 0 and on finger 1 in N in that frame alone."""
    by_current: bool = False
    """Whether the force follows from the servos' current, so that no sensor confirms it."""

    @property
    def measured_s(self) -> float:
        """Monotonic time in s to which the force belongs."""
        return self.t_s - self.lag_s

    @property
    def grip_n(self) -> float:
        """Grip force in N: the mean of both fingers, which are equal in equilibrium."""
        return 0.5 * (self.force_n[0] + self.force_n[1])


class ForceSensor(Protocol):
    """Source of force samples; called once every period of the force loop, must not block."""

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample, None while there is none; the caller judges its age."""
