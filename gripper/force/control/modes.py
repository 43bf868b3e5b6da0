"""Modes of the control of a grip, and the table of their transitions."""

from collections.abc import Callable

from gripper.force.control.band_mode import BandMode
from gripper.force.control.motion_mode import MotionMode
from gripper.force.control.period import Mode, Period
from gripper.force.estimates.contact_observer import LOG_STIFFNESS_SD
from gripper.force.estimates.grip import Grip
from gripper.mechanics.kinematics import driving_n

_CORRECTED_N = {False: 0.05, True: 0.1}
"""Error of a hold in N, beside the uncertainty of the force, that a motion corrects, up and down
(True): foam creeps, and the way down costs twice the friction. [tuned]"""
_PAUSE_S = 0.05
"""Least time in s between two of these motions. [tuned]"""

_TRIAL_MEAN_S = 0.02
"""Time constant in s of the force by which a finger is held while the other one is measured.
[chosen]"""


class WaitMode(Mode):
    """Mode of control that waits without a usable sample.

    There is no new sample, or the samples show a part as gone and no other measurement confirms it
    yet. The crest of the square wave must not stay meanwhile.
    """

    def __init__(self, grip: Grip) -> None:
        self._grip = grip

    def step(self, period: Period) -> float:
        """Return the driving force in N of one period."""
        return min(self._grip.drive_n, self._grip.quiet_n)


class TrialMode(Mode):
    """Mode of control while one finger is measured: its goal moves, nothing is corrected.

    The drive is only a limit then.
    """

    def __init__(self, grip: Grip) -> None:
        self._grip = grip

    def step(self, period: Period) -> float:
        """Return the driving force in N of one period."""
        grip, estimate, sample = self._grip, self._grip.estimate, period.moment.sample
        if sample is not None and sample.valid and sample.t_s > estimate.sample_s:
            share = min(1.0, (sample.t_s - estimate.sample_s) / _TRIAL_MEAN_S)
            estimate.correct(share * (sample.grip_n - estimate.force_n) + estimate.bias_n, 0.0)
            estimate.sample_s = sample.t_s
        grip.quiet_n = driving_n(period.state, period.paths)
        return period.drive_max_n


class GripModes:
    """The modes of one grip; in each period the table selects the mode for the drive.

    Parameters
    ----------
    grip
        What is known and asked of the grip.
    now_s
        Monotonic time in s.
    pad_n_m, pad_log_sd
        As for `MotionMode`.
    """

    def __init__(
        self, grip: Grip, now_s: float, pad_n_m: float, pad_log_sd: float = LOG_STIFFNESS_SD
    ) -> None:
        self.grip = grip
        self.band = BandMode(grip, now_s)
        self.motion = MotionMode(grip, now_s, pad_n_m, pad_log_sd)
        self._modes: dict[type[Mode], Mode] = {
            BandMode: self.band,
            MotionMode: self.motion,
            WaitMode: WaitMode(grip),
            TrialMode: TrialMode(grip),
        }
        self.active: Mode = self.band
        """The mode that made the last drive."""

    def step(self, period: Period) -> float:
        """Change the mode by the table, and return the driving force in N."""
        while (target := self._due(period)) is not None:
            before, self.active = self.active, target
            before.exit(period)
            target.enter(period, before)
        return self.active.step(period)

    def _due(self, period: Period) -> Mode | None:
        """Return the mode that follows now; None if the active one continues."""
        for source, condition, target in TRANSITIONS:
            if isinstance(self.active, source) and condition(self, period):
                return self._modes[target]
        return None


def _ended(modes: GripModes, period: Period) -> bool:
    """Whether a motion has arrived, or can no longer continue."""
    falls = period.rises_n < 0.0
    return modes.motion.over or falls or not (period.quick and period.usable)


def _rises(modes: GripModes, period: Period) -> bool:
    """Whether the set-point rises, and the fingers may follow a plan."""
    return _may_move(period) and period.rises_n > 0.0


def _strays(modes: GripModes, period: Period) -> bool:
    """Whether the force of a hold is wrong by more than it is uncertain."""
    estimate = modes.grip.estimate
    setpoint_n, force_n, now_s = period.setpoint_n, estimate.force_n, period.moment.now_s
    if not (_may_move(period) and period.rises_n == 0.0 and setpoint_n == period.end_n):
        return False
    if now_s - modes.motion.ended_s < _PAUSE_S:
        return False
    falls = setpoint_n < force_n
    error_n = abs(setpoint_n - force_n)
    return (period.may_open or not falls) and error_n > _CORRECTED_N[falls] + estimate.doubt_n


def _tried(modes: GripModes) -> bool:
    """Whether one finger is measured."""
    return modes.grip.moving is not None


def _may_move(period: Period) -> bool:
    """Whether a planned motion may begin."""
    return period.may_plan and period.moment.dt_s > 0.0


TRANSITIONS: tuple[tuple[type[Mode], Callable[[GripModes, Period], bool], type[Mode]], ...] = (
    (TrialMode, lambda modes, _: not _tried(modes), BandMode),
    (BandMode, lambda modes, _: _tried(modes), TrialMode),
    (WaitMode, lambda modes, _: _tried(modes), BandMode),
    (MotionMode, lambda modes, period: _tried(modes) or _ended(modes, period), BandMode),
    (BandMode, lambda _, period: not period.usable, WaitMode),
    (WaitMode, lambda _, period: period.usable, BandMode),
    (BandMode, _rises, MotionMode),
    (BandMode, _strays, MotionMode),
)
"""Mode, condition of its end, and next mode. In each period the rows are tried in this order until
no row applies; no mode uses another mode's state."""
