"""Watches that frames keep coming: one for each SYNC, few lost. Pure: no clock, no bus."""

from collections import deque

from tactile.errors import FrameTimeout

_COUNTER_MASK = 0xFFFF


class FrameFlow:
    """Counts SYNCs without an answer and frames lost in a window.

    Parameters
    ----------
    name
        The unit in messages.
    timeout_periods
        So many SYNCs without a whole frame are a fault.
    max_loss_rate, window_frames
        A larger share of frames lost among the last so many is a fault.
    """

    def __init__(
        self, name: str, *, timeout_periods: int, max_loss_rate: float, window_frames: int
    ) -> None:
        self._name = name
        self._timeout_periods = timeout_periods
        self._max_loss_rate = max_loss_rate
        self._window_frames = window_frames
        self._arrived: deque[bool] = deque(maxlen=window_frames)
        self._last_counter: int | None = None
        self._unanswered = 0

    @property
    def recent_loss_rate(self) -> float:
        """Share of frames lost in the window, 0 to 1."""
        return self._arrived.count(False) / len(self._arrived) if self._arrived else 0.0

    def before_sync(self) -> None:
        """Tell that the next SYNC is due; FrameTimeout if too many had no answer."""
        if self._unanswered >= self._timeout_periods:
            raise FrameTimeout(
                f"no whole frame from {self._name} after {self._unanswered} SYNCs: check bus "
                "load, cable and the unit's mode, then start the link again"
            )
        self._unanswered += 1

    def answered(self) -> None:
        """Tell that the unit has answered a SYNC with something whole."""
        self._unanswered = 0

    def on_frame(self, counter: int) -> None:
        """Take the counter of a whole frame; FrameTimeout if too many before it were lost."""
        self._unanswered = 0
        if self._last_counter is not None:
            lost = ((counter - self._last_counter) & _COUNTER_MASK) - 1
            self._arrived.extend([False] * min(lost, self._window_frames))
        self._arrived.append(True)
        self._last_counter = counter
        lost_frames = self._arrived.count(False)
        if lost_frames > self._max_loss_rate * self._window_frames:
            raise FrameTimeout(
                f"{lost_frames} of the last {self._window_frames} frames from {self._name} were "
                f"lost, allowed are {self._max_loss_rate:.0%}: check bus load, cable and "
                "termination, then start the link again"
            )
