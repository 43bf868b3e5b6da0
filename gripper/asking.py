"""Asking servos: checked answers, and asking again where one is lost."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from gripper.errors import BusCorrupt, BusTimeout, LimitExceeded, ServoRejected
from gripper.line import NoAnswerError, ServoLine
from gripper.packet_handler import Instruction
from gripper.packets import StatusPacket

BROADCAST_ID = 0xFE
"""ID that all servos listen to."""
HIGHEST_ID = 252
"""Highest ID of a servo."""
_CRC_REFUSED = 3
_PATIENT_REPETITIONS = 3
_PILED_UP = 3


class Asking:
    """Requests on a line, repeated as long as there is time; see `gripper.bus.ServoBus`.

    Parameters
    ----------
    line
        To the servos.
    period_s
        Period of the loop in s, within which `ask_all` ends while `hurried`.
    """

    def __init__(self, line: ServoLine, period_s: float) -> None:
        self._line = line
        self._period_s = period_s
        self._hurried = False

    @contextmanager
    def hurried(self) -> Iterator[None]:
        """Within the block no request waits longer than a period of the loop may take."""
        before, self._hurried = self._hurried, True
        try:
            yield
        finally:
            self._hurried = before

    def ask(
        self, servo_id: int, instruction: Instruction, params: bytes, size: int, action: str
    ) -> StatusPacket:
        """Send a request and return the checked answer; once more when it is lost."""
        check_id(servo_id)
        with self._line.transaction(quiet=not self._hurried):
            try:
                if self._line.suspect:
                    # There is no time to wait: answers come in order, and a ping shows where.
                    self._line.clear(servo_id, None)
                status = self._line.request(servo_id, instruction, params, size)
                if status.error == _CRC_REFUSED:
                    raise NoAnswerError(damaged=True)
            except NoAnswerError as failure:
                again = self._repeat(servo_id, instruction, params, size, None)
                if again is None:
                    raise given_up(failure, action, servo_id) from None
                status = again
        check_error(status, action)
        return status

    def ask_all(
        self, ids: Sequence[int], params: bytes, size: int, action: str
    ) -> dict[int, StatusPacket]:
        """Ask several servos for the same block at once; who does not answer is asked alone.

        The answers are in the order in which the servos were asked.
        """
        for servo_id in ids:
            check_id(servo_id)
        if self._hurried:
            ids = sorted(ids, key=self._misses)
        # Where nobody answers for some periods, requests must not pile up before a slow machine.
        all_silent = min(self._misses(servo_id) for servo_id in ids) >= _PILED_UP
        with self._line.transaction(quiet=not self._hurried or all_silent):
            deadline_s = self._line.clock.monotonic() + self._period_s
            found, failure = self._chain(ids, params, size)
            for servo_id in ids:
                if servo_id in found:
                    continue
                again = self._repeat(servo_id, Instruction.READ, params, size, deadline_s)
                if again is None:
                    raise given_up(failure or NoAnswerError(False), action, servo_id) from None
                found[servo_id] = again
            for servo_id in ids:
                check_error(found[servo_id], action)
        return {servo_id: found[servo_id] for servo_id in ids}

    def _repeat(
        self,
        servo_id: int,
        instruction: Instruction,
        params: bytes,
        size: int,
        deadline_s: float | None,
    ) -> StatusPacket | None:
        """Ask again behind a ping, several times where there is time; None without an answer."""
        patient = not self._hurried
        for _ in range(_PATIENT_REPETITIONS if patient else 1):
            try:
                self._line.clear(servo_id, None if patient else deadline_s, patient=patient)
                self._line.count(retries=1)
                status = self._line.request(servo_id, instruction, params, size, patient=patient)
            except NoAnswerError:
                continue
            if status.error != _CRC_REFUSED:
                return status
        self._line.give_up()
        return None

    def _chain(
        self, ids: Sequence[int], params: bytes, size: int
    ) -> tuple[dict[int, StatusPacket], NoAnswerError | None]:
        """Send a sync read and collect the answers; a servo is silent after a missing one."""
        self._line.send(BROADCAST_ID, Instruction.SYNC_READ, params + bytes(ids))
        found: dict[int, StatusPacket] = {}
        for servo_id in ids:
            try:
                status = self._line.receive(servo_id, size)
                if status.error == _CRC_REFUSED:
                    # The request arrived damaged, as an answer may: it is asked for again.
                    raise NoAnswerError(damaged=True)
                found[servo_id] = status
            except NoAnswerError as failure:
                return found, failure
        return found, None

    def _misses(self, servo_id: int) -> int:
        return self._line.misses.get(servo_id, 0)


def check_id(servo_id: int) -> None:
    """Raise LimitExceeded where no servo can have an ID."""
    if not 0 <= servo_id <= HIGHEST_ID:
        raise LimitExceeded(f"servo ID {servo_id} is not from 0 to {HIGHEST_ID}")


def check_error(status: StatusPacket, action: str) -> None:
    """Raise ServoRejected where a servo has refused what was asked of it."""
    if status.error:
        raise ServoRejected(status.servo_id, status.error, action)


def given_up(failure: NoAnswerError, action: str, servo_id: int) -> BusTimeout | BusCorrupt:
    """Return the error that says why a servo is no longer asked."""
    if failure.damaged:
        return BusCorrupt(
            f"{action}: the answers of servo {servo_id} arrive damaged, twice in a row: check "
            f"cable, termination and that no two servos share the ID"
        )
    return BusTimeout(
        f"{action}: no answer of servo {servo_id}, twice in a row: check its supply, cable, ID "
        f"and baud rate"
    )
