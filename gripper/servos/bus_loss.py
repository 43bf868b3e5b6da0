"""Loss of the servo bus: periods without feedback, in a row and among the last ones."""

from collections import deque
from contextlib import suppress
from math import ceil

from gripper.errors import BusCorrupt, BusTimeout, BusUnreliable, FingerSilent, GripperError
from gripper.servos.group import Servos
from gripper.values.state import GripperPhase

_FREEZE_AT = 2
"""Period without feedback, counted in a row, in which the stop goals are written. [chosen]"""
_ONE_SIDED_PERIODS = 3
"""Periods in a row with one silent and one answering servo that are a fault. [chosen]"""
_LEAST_LOST_PERIODS = 3
"""Periods in a row without feedback before the bus can count as lost: a pause alone is no loss.
[chosen]"""


class BusLossMonitor:
    """Counter of the periods without feedback, in a row and among the last ones.

    A first lost answer is tolerated. In the second period in a row the stop goals are written;
    fingers on their way without a part get no current. After ``bus_loss_s`` the bus counts as lost.
    Single lost periods are allowed up to a share of ``feedback_loss_max_share``.

    Parameters
    ----------
    servos
        The servos of the gripper.
    """

    def __init__(self, servos: Servos) -> None:
        self._servos = servos
        self._settings = settings = servos.settings
        self._since_s = 0.0
        self._in_row = 0
        self._one_sided = 0
        # One loss of the bus just below its limit, with the period of its detection, does not
        # exceed the share.
        longest_loss = ceil(settings.bus_loss_s / settings.period_s) + 1
        self._most_lost = max(_LEAST_LOST_PERIODS, longest_loss)
        window = ceil(self._most_lost / settings.feedback_loss_max_share)
        self._recent: deque[bool] = deque(maxlen=window)

    def start_counting(self) -> None:
        """Restart the count of periods in a row: the servos were not read for a while."""
        self._in_row = self._one_sided = 0

    def wait_longer(self, late_s: float) -> None:
        """Extend the limit of a loss by a time in s without requests to the servos."""
        self._since_s += late_s

    def answered(self) -> None:
        """Count a period with feedback."""
        self.start_counting()
        self._recent.append(False)

    def missed(self, error: BusTimeout | BusCorrupt, asked_s: float, now_s: float) -> None:
        """Count a period with a lost answer and a lost repetition.

        Parameters
        ----------
        error
            The error of the bus.
        asked_s, now_s
            Monotonic time before the request and now in s.

        Raises
        ------
        FingerSilent
            In the third period in a row with one silent and one answering servo.
        BusTimeout, BusCorrupt
            When nothing was received for ``bus_loss_s``.
        BusUnreliable
            When too many of the last periods had no feedback.
        """
        self._recent.append(True)
        if self._in_row == 0:
            self._since_s = asked_s
        self._in_row += 1
        lost_s = now_s - self._since_s
        silent, living = self._servos.silent_and_living()
        self._one_sided = self._one_sided + 1 if silent and living else 0
        if self._one_sided >= _ONE_SIDED_PERIODS:
            raise FingerSilent(
                f"servo {silent[0]} is silent while servo {living[0]} answers: the other finger "
                f"stands still, the part may still be gripped or have been dropped. Support the "
                f"part, check supply and cable of servo {silent[0]}, then clear with a reboot "
                f"({error})"
            ) from error
        if self._in_row >= _LEAST_LOST_PERIODS and lost_s > self._settings.bus_loss_s:
            self._recent.clear()  # of a bus that was mended later they say nothing
            raise type(error)(
                f"the servo bus was lost for {lost_s:.3f} s (bus_loss_s is "
                f"{self._settings.bus_loss_s} s): a part may still be gripped; the last goals "
                f"stay, or the servos' own watchdog acts. {error}"
            ) from error
        # A lasting loss is a loss of the bus; the share is checked at the start of the next one.
        if self._in_row == 1 and (lost := sum(self._recent)) > self._most_lost:
            periods = self._recent.maxlen
            self._recent.clear()
            raise BusUnreliable(
                f"{lost} of the last {periods} periods had no feedback of the servos, "
                f"feedback_loss_max_share is {self._settings.feedback_loss_max_share:.0%}: the "
                f"goals are frozen, the grip is kept; check cable, ground, termination and that "
                f"nothing else sends on the servo line, then clear the fault. Last: {error}"
            ) from error

    def stop_fingers(self, phase: GripperPhase) -> None:
        """Write the stop goals once, in the second period in a row: no finger pushes alone."""
        if self._in_row == _FREEZE_AT:
            with suppress(GripperError):
                if phase.moving:
                    # Nobody reads the positions: with current an encoder that errs drives its
                    # finger. A part that is let go still needs the current.
                    self._servos.hold_position(float(phase is GripperPhase.RELEASING))
                else:
                    self._servos.freeze(supervised=True)
