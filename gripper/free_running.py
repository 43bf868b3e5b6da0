"""Friction of the gearing, measured on each approach: the current that closes the empty fingers."""

from collections import deque
from collections.abc import Sequence
from statistics import median

from gripper.kinematics import Transmission
from gripper.state import GripperState

_AFTER_START_S = 0.12
_BEFORE_CONTACT_S = 0.08
_WINDOW_S = 0.4
_LEAST_PERIODS = 20
_LOW_SHARE, _HIGH_SHARE = 0.5, 1.6


class FreeRunning:
    """Collects what the servos draw while nothing but friction holds against them.

    Torque constant and friction of a servo differ from the figures of its model; their ratio is
    what decides where in the friction band a drive is, and that is this current.
    """

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._ratios: deque[tuple[float, float]] = deque()

    def push(
        self, now_s: float, state: GripperState, paths: Sequence[Transmission], *, running: bool
    ) -> None:
        """Take one period.

        Parameters
        ----------
        now_s
            Monotonic time in s.
        state, paths
            Feedback, and the transmission of each servo.
        running
            True while all fingers close steadily and nothing touches.
        """
        if not running:
            self._since_s = None
            return
        if self._since_s is None:
            self._since_s = now_s
        if now_s - self._since_s < _AFTER_START_S:
            return
        share = sum(
            -servo.current_a * path.kt_nm_a / path.friction_nm
            for servo, path in zip(state.servos, paths, strict=True)
        ) / len(paths)
        self._ratios.append((now_s, share))
        while self._ratios[0][0] < now_s - _WINDOW_S - _BEFORE_CONTACT_S:
            self._ratios.popleft()

    def friction_share(self) -> float:
        """Return the friction found as a share of the model's; 1 where too little was seen."""
        if not self._ratios:
            return 1.0
        last_s = self._ratios[-1][0] - _BEFORE_CONTACT_S
        shares = [share for then_s, share in self._ratios if then_s <= last_s]
        if len(shares) < _LEAST_PERIODS:
            return 1.0
        return min(max(median(shares), _LOW_SHARE), _HIGH_SHARE)
