"""Estimate of the grip force: a model of the drive, and its difference from the sensor.

A Kalman filter with one state learns the difference, the bias. A sample is compared with the model
at the time of its measurement, so its delay has no effect.
"""

from math import hypot, inf, sqrt
from typing import Protocol

from gripper.errors import LimitExceeded
from gripper.force.estimates.history import History
from gripper.settings import ForceLoopSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.recent import FRAME_S

_IMPLAUSIBLE_S = 15 * FRAME_S
"""Longest allowed disagreement in s of sensor and model: 15 frames."""
_JUMP_N, _JUMP_SHARE, _JUMP_FRICTION_SHARE, _JUMP_SIGMAS = 0.8, 0.15, 0.17, 4.0
"""Sudden growth of the measured force that no drive makes: in N, as a share of the set-point and of
the friction, plus standard deviations of the noise of a sample. Friction that breaks makes an
eighth of it at most where the fingers do not give back force. [tuned]"""
_JUMP_S = 0.75 * FRAME_S
"""Least duration of the growth in s: two frames."""
_BREAKS_S = 3 * FRAME_S
"""Time in s after the first motion in which the model is as uncertain as its friction. [tuned]"""
_STICKS_SHARE = 0.6
"""Share of the friction that may hold more force than the model, just after it has fallen. Friction
differs from the model's by a third at most, at both edges. [assumed]"""
_BIAS_SIGMAS = 5.0
"""Standard deviations of the force by current by which sensor and current may disagree. [chosen]"""
_MOTION_S = FRAME_S
"""Time in s for which the motion of the fingers makes the model equally wrong: faster samples give
no further information."""


class Observer(Protocol):
    """Observer of a motion, see `gripper.force.estimates.contact_observer.ContactObserver`."""

    force_n: float
    lacking_n: float
    """Grip force in N, and the missing force of the drive compared with the model in N."""

    @property
    def doubt_n(self) -> float:
        """Standard deviation of the force in N."""


class ForceEstimate:
    """Grip force by the drive, and its difference from the sensor; the modes of control move it.

    Parameters
    ----------
    tuning
        Settings of the force loop.
    force_n
        Grip force at the start in N.
    now_s
        Monotonic time in s.
    """

    def __init__(self, tuning: ForceLoopSettings, *, force_n: float, now_s: float) -> None:
        self.model_n = force_n
        """Modelled grip force in N."""
        self.bias_n = 0.0
        """Learnt difference between sensor and model in N."""
        self.sample_s = now_s
        """Time in s of the newest sample used."""
        self._tuning = tuning
        self._doubt_n2 = tuning.start_doubt_n**2
        self._broke_s, self._broke_n = -inf, 0.0
        self._history = History()
        self._history.add(now_s, force_n)
        self._implausible_since_s: float | None = None
        self._jumped_s: float | None = None

    @property
    def force_n(self) -> float:
        """Grip force in N."""
        return self.model_n + self.bias_n

    @property
    def doubt_n(self) -> float:
        """Standard deviation of the bias in N."""
        return sqrt(self._doubt_n2)

    def move(self, now_s: float, model_n: float, *, doubt_n: float = 0.0) -> None:
        """Set the present modelled force in N; ``doubt_n`` is the doubt that the motion adds."""
        self._doubt_n2 += doubt_n**2
        if doubt_n > 0.0:
            self._broke_s, self._broke_n = now_s, doubt_n
        self.model_n = model_n
        self._history.add(now_s, model_n)

    def correct(self, shift_n: float, bias_n: float) -> None:
        """Shift the modelled force in N, present and past, and set the bias that belongs to it."""
        self._history.shift(shift_n)
        self.model_n += shift_n
        self.bias_n = bias_n

    def follow(self, now_s: float, sample: ForceSample, observer: Observer) -> None:
        """Take over the results of an observer of the motion.

        Parameters
        ----------
        now_s, sample
            Monotonic time in s, and the newest sample, which the observer has used.
        """
        self._history.shift(self.bias_n + observer.lacking_n)
        self.bias_n, self._doubt_n2 = -observer.lacking_n, observer.doubt_n**2
        self.move(now_s, observer.force_n + observer.lacking_n)
        self.sample_s = sample.t_s

    def unexplained_n(self, sample: ForceSample) -> float:
        """Return the excess in N of a sample over the model at the time of its measurement."""
        return sample.grip_n - self._history.at(sample.measured_s)

    def learn(self, sample: ForceSample, *, drift_n_rs: float, motion_n: float) -> None:
        """Correct the bias by a new sample; its doubt grows with time and falls with a sample.

        Parameters
        ----------
        sample
            Valid sample, newer than all before.
        drift_n_rs
            Random walk of the bias, in N per root of a second.
        motion_n
            Error of the model by the present motion of the fingers in N.
        """
        step_s = sample.t_s - self.sample_s
        self._doubt_n2 += drift_n_rs**2 * step_s
        noise_n2 = sample.noise_n**2 + motion_n**2 * _MOTION_S / step_s
        gain = self._doubt_n2 / (self._doubt_n2 + noise_n2)
        self._doubt_n2 *= 1.0 - gain
        self.sample_s = sample.t_s
        self.bias_n += gain * (self.unexplained_n(sample) - self.bias_n)

    def jumps(
        self,
        sample: ForceSample,
        jump_n: float,
        setpoint_n: float,
        friction_n: float,
        *,
        fell: bool = False,
        moved_n: float = 0.0,
    ) -> bool:
        """Return whether a sample shows a large jump of the force that no drive made.

        Control that follows it would release a part although its force has not changed.

        Parameters
        ----------
        sample
            Newest valid force sample; the same sample may come again.
        jump_n
            Its excess in N over the force that the drive explains.
        setpoint_n
            Set-point of the grip force in N.
        friction_n
            Half the width of the friction band as grip force.
        fell
            Whether the modelled force has just fallen: friction may still hold more.
        moved_n
            Growth in N since the sample that moving fingers add if the part is twice as stiff.

        Raises
        ------
        LimitExceeded
            When the jump lasts.
        """
        least_n = max(_JUMP_N, _JUMP_SHARE * setpoint_n, _JUMP_FRICTION_SHARE * friction_n)
        broke = sample.measured_s - self._broke_s < _BREAKS_S
        least_n += _JUMP_SIGMAS * hypot(sample.noise_n, self._broke_n if broke else 0.0)
        least_n += moved_n
        if fell:
            least_n += _STICKS_SHARE * friction_n
        if jump_n <= least_n:
            self._jumped_s = None
            return False
        if self._jumped_s is None:
            self._jumped_s = sample.t_s
        if sample.t_s - self._jumped_s >= _JUMP_S:
            raise LimitExceeded(
                f"the pads report {jump_n:.2f} N more than before on a part that is pressed as "
                f"before, {least_n:.2f} N are allowed: their zero has jumped, or something pushes "
                f"the fingers together. The goals are frozen and the grip kept: check the pads, "
                f"then clear the fault and release"
            )
        return True

    def check(
        self, now_s: float, sample: ForceSample, friction_n: float, current_doubt_n: float
    ) -> None:
        """Raise LimitExceeded when the bias has been larger than plausible for some time.

        In this case the sensor does not measure the force of the current. The force lies anywhere
        in the friction band, of half the width ``friction_n``; ``current_doubt_n`` is the standard
        deviation in N of its middle.
        """
        limit_n = self._tuning.bias_max_n + friction_n + _BIAS_SIGMAS * current_doubt_n
        if abs(self.bias_n) <= limit_n:
            self._implausible_since_s = None
        elif self._implausible_since_s is None:
            self._implausible_since_s = now_s
        elif now_s - self._implausible_since_s > _IMPLAUSIBLE_S:
            raise LimitExceeded(
                f"force sensor and servo current disagree by {self.bias_n:.2f} N, more than "
                f"{limit_n:.2f} N: the sensor reads {sample.grip_n:.2f} N where the current makes "
                f"{self.model_n:.2f} N. Check the pads, the tare and the torque figures"
            )
