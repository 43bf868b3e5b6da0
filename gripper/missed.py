"""Periods without feedback: passed over, then the fingers stand still, then the bus is given up."""

from contextlib import suppress

from gripper.errors import BusCorrupt, BusTimeout, FingerSilent, GripperError
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.state import GripperPhase

_FREEZE_AT = 2
_ONE_SIDED_PERIODS = 3
_LEAST_PERIODS = 3


class MissedReads:
    """Counts the periods in a row in which an answer was missing.

    Parameters
    ----------
    servos, settings
        Of the gripper.
    """

    def __init__(self, servos: ServoGroup, settings: GripperSettings) -> None:
        self._servos = servos
        self._settings = settings
        self._since_s = 0.0
        self._in_row = 0
        self._one_sided = 0

    def answered(self) -> None:
        """Note that all servos have answered, or that nobody asked for a while."""
        self._in_row = self._one_sided = 0

    def missed(self, error: BusTimeout | BusCorrupt, asked_s: float, now_s: float) -> None:
        """Note that an answer was missing, its repetition too.

        Parameters
        ----------
        error
            What the bus says of it.
        asked_s, now_s
            Monotonic time before the request and now in s.

        Raises
        ------
        FingerSilent
            In the third period in a row in which one servo is silent and the other one is not.
        BusTimeout, BusCorrupt
            When nothing was heard for ``bus_loss_s``.
        """
        if self._in_row == 0:
            self._since_s = asked_s
        self._in_row += 1
        lost_s = now_s - self._since_s
        silent, living = self._servos.silent_and_living()
        self._one_sided = self._one_sided + 1 if silent and living else 0
        if self._one_sided >= _ONE_SIDED_PERIODS:
            raise FingerSilent(
                f"servo {silent[0]} is silent while servo {living[0]} answers: the living finger "
                f"stands still, the part may still be gripped or have been dropped. Servo "
                f"{silent[0]} may have lost its supply or be restarting: check both, and its cable "
                f"({error})"
            ) from error
        if self._in_row >= _LEAST_PERIODS and lost_s > self._settings.bus_loss_s:
            raise type(error)(
                f"the servo bus was lost for {lost_s:.3f} s (bus_loss_s is "
                f"{self._settings.bus_loss_s} s): a part may still be gripped; nothing more is "
                f"written, the servos' own watchdog acts. {error}"
            ) from error

    def keep_still(self, phase: GripperPhase) -> None:
        """Write once, in the second period in a row, that nothing goes on: no one pushes alone."""
        if self._in_row == _FREEZE_AT:
            with suppress(GripperError):
                if phase.moving:
                    self._servos.standstill.stand_still()
                else:
                    self._servos.standstill.calm()
