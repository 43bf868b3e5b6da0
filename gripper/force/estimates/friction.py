"""Friction of the gearing, from the current that closes the empty fingers."""

from collections import deque
from statistics import median

from gripper.force.loop import Moment
from gripper.mechanics.kinematics import MOST_FRICTION, Linkage, transmissions
from gripper.settings import GripperSettings

_AFTER_START_S = 0.06
"""Time in s from the start of free motion until its current is that of friction alone. [tuned]"""
_BEFORE_CONTACT_S = 0.05
"""Time in s before the end of free motion that is left out: the pads report a contact late.
[tuned]"""
_WINDOW_S = 0.4
"""Time in s of free motion that the friction is taken over. [tuned]"""
_LEAST_PERIODS = 12
"""Least periods of free motion that the friction is taken over: 0.06 s at 200 Hz. [tuned]"""
_LEAST_FRICTION = 0.5
"""Least friction that is found, as a share of the model's: below it something else drives.
[chosen]"""


class FrictionEstimate:
    """Friction of the gearing, from the current that closes the empty fingers on an approach.

    Torque constant and friction of a servo differ from the figures of its model; their ratio is
    what decides where in the friction band a drive is, and that is this current.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self._settings = settings
        self._linkage = linkage
        self._since_s: float | None = None
        self._shares: deque[tuple[float, float]] = deque()

    def push(self, moment: Moment, *, running: bool) -> None:
        """Add one period.

        Parameters
        ----------
        moment
            Feedback of the period.
        running
            True while all fingers close steadily and nothing touches.
        """
        now_s, state = moment.now_s, moment.state
        if not running:
            self._since_s = None
            return
        if self._since_s is None:
            self._since_s = now_s
        if now_s - self._since_s < _AFTER_START_S:
            return
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        share = sum(
            -servo.current_a * path.kt_nm_a / path.friction_nm
            for servo, path in zip(state.servos, paths, strict=True)
        ) / len(paths)
        self._shares.append((now_s, share))
        while self._shares[0][0] < now_s - _WINDOW_S - _BEFORE_CONTACT_S:
            self._shares.popleft()

    @property
    def measured(self) -> bool:
        """Whether the fingers have run freely for long enough."""
        return len(self._free_shares()) >= _LEAST_PERIODS

    def friction_share(self) -> float:
        """Return the friction as a share of the model's; 1 where too little was measured."""
        shares = self._free_shares()
        if len(shares) < _LEAST_PERIODS:
            return 1.0
        return min(max(median(shares), _LEAST_FRICTION), MOST_FRICTION)

    def _free_shares(self) -> list[float]:
        if not self._shares:
            return []
        last_s = self._shares[-1][0] - _BEFORE_CONTACT_S
        return [share for then_s, share in self._shares if then_s <= last_s]
