"""Supervision of the flow of frames: one for each SYNC, few lost, none late, none double. Pure."""

from collections import deque

from tactile.errors import DuplicateNode, FrameTimeout
from tactile.source import COUNTER_MASK

_LAG_FRAMES = 250
"""Number of frames after which the earlier least lag is discarded, once or twice."""
_LATE_SYNCS = 3
"""Number of successive SYNCs with late frames that counts: after a stall frames catch up."""
_SURPLUS_SHARE = 1.5
_SURPLUS_LIMIT = 0.9
_SURPLUS_SUSPECT = 0.4
_DEFICIT_LIMIT = 1.0
"""Limits in bursts. A sustained rate of one and a half bursts for each SYNC is allowed (an adapter
that sometimes doubles messages, a late burst). Two bursts each time are two units. Without complete
frames at the same time half of that is the limit."""


class FrameFlow:
    """Supervision of unanswered SYNCs, lost frames, late frames and double messages.

    Parameters
    ----------
    timeout_periods
        Number of SYNCs without a complete frame that is a fault.
    max_loss_rate, window_frames
        Largest share of lost frames, and the number of last frames for it.
    late_periods
        Delay in periods, compared with before, that is a fault if it occurs three times.
    burst_messages
        Messages of one unit after each SYNC.
    """

    def __init__(
        self,
        name: str,
        *,
        timeout_periods: int,
        max_loss_rate: float,
        window_frames: int,
        late_periods: int,
        burst_messages: int,
    ) -> None:
        self._name = name
        self._timeout_periods = timeout_periods
        self._max_loss_rate = max_loss_rate
        self._window_frames = window_frames
        self._late_periods = late_periods
        self._burst_messages = burst_messages
        self._arrived: deque[bool] = deque(maxlen=window_frames)
        self._last_counter: int | None = None
        self._unanswered = 0
        self._ahead = 0
        """SYNCs sent, less the scans of the unit's counter since its first frame."""
        self._least: int | None = None
        self._least_before: int | None = None
        self._lag_frames = 0
        self._late_syncs = 0
        self._messages = 0
        self._surplus = 0.0

    @property
    def recent_loss_rate(self) -> float:
        """Share of frames lost in the window, 0 to 1."""
        return self._arrived.count(False) / len(self._arrived) if self._arrived else 0.0

    def before_sync(self) -> None:
        """Check the answers to the SYNCs so far; call it when the next SYNC is due.

        Raises FrameTimeout for too many SYNCs without an answer or with late ones, DuplicateNode
        for two answers.
        """
        n = self._weigh_messages()
        out = self._unanswered >= self._timeout_periods
        if self._surplus > (_SURPLUS_SUSPECT if out else _SURPLUS_LIMIT):
            raise DuplicateNode(
                f"{n} frame messages came after one SYNC, {self._name} sends "
                f"{self._burst_messages}: a second unit has the same node-ID, or the adapter "
                "doubles messages; leave one unit on the bus, then start the link again"
            )
        if out:
            raise FrameTimeout(
                f"no whole frame from {self._name} after {self._unanswered} SYNCs: check bus "
                "load, cable and the unit's mode, then start the link again"
            )
        self._check_late()
        self._unanswered += 1
        self._ahead += 1

    def messages(self, n: int) -> None:
        """Count received frame messages."""
        self._messages += n

    def on_frame(self, counter: int) -> None:
        """Add the counter of a complete frame; FrameTimeout if too many before it were lost."""
        self._unanswered = 0
        step = 1
        if self._last_counter is not None:
            step = (counter - self._last_counter) & COUNTER_MASK
            self._arrived.extend([False] * min(step - 1, self._window_frames))
        self._arrived.append(True)
        self._last_counter = counter
        self._ahead -= step
        lost_frames = self._arrived.count(False)
        if lost_frames > self._max_loss_rate * self._window_frames:
            raise FrameTimeout(
                f"{lost_frames} of the last {self._window_frames} frames from {self._name} were "
                f"lost, allowed are {self._max_loss_rate:.0%}: check bus load, cable and "
                "termination, then start the link again"
            )
        self._note_lag()

    @property
    def _late(self) -> int:
        """Number of SYNCs with outstanding frames, beyond the usual one."""
        before = self._least if self._least_before is None else self._least_before
        known = [least for least in (before, self._least) if least is not None]
        return max(0, self._ahead - min(known, default=0))

    def _check_late(self) -> None:
        if self._last_counter is None:
            return
        late = self._late
        self._late_syncs = self._late_syncs + 1 if late >= self._late_periods else 0
        if self._late_syncs >= _LATE_SYNCS:
            raise FrameTimeout(
                f"the frames of {self._name} come {late} periods later than before, allowed are "
                f"{self._late_periods - 1}: the adapter or the host delays messages, or SYNCs do "
                "not reach the unit; check both, then start the link again"
            )

    def _note_lag(self) -> None:
        self._lag_frames += 1
        if self._least is None or self._ahead < self._least:
            self._least = self._ahead
        if self._lag_frames >= _LAG_FRAMES:
            self._lag_frames, self._least_before, self._least = 0, self._least, None

    def _weigh_messages(self) -> int:
        n, self._messages = self._messages, 0
        surplus = self._surplus + n / self._burst_messages - _SURPLUS_SHARE
        # Late messages will arrive all at once.
        self._surplus = max(surplus, -_DEFICIT_LIMIT - _SURPLUS_SHARE * self._late)
        return n
