"""The lines of a hand: one may be missing where that is allowed, and each is opened anew."""

from typing import Any

import pytest

from cell.hand.connections import MISSING, HandConnections
from gripper.errors import PortLost
from tactile.errors import BusNotOpened


class Line:
    """An end that counts how often it was closed; stands for a stream and for a bus."""

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1

    shutdown = close


class Openers:
    """Both openers, each of which can fail."""

    def __init__(self, *failing: str) -> None:
        self.failing = set(failing)
        self.made: list[Line] = []

    def servos(self) -> Any:
        return self._open("servos", PortLost("no port"))

    def can(self) -> Any:
        return self._open("can", BusNotOpened("no bus"))

    def _open(self, name: str, error: Exception) -> Line:
        if name in self.failing:
            raise error
        self.made.append(Line())
        return self.made[-1]


@pytest.mark.parametrize(("failing", "error"), [("servos", PortLost), ("can", BusNotOpened)])
def test_a_line_that_is_missing_is_refused_and_the_other_one_given_back(failing, error) -> None:
    openers = Openers(failing)
    with pytest.raises(error):
        HandConnections(openers.servos, openers.can)
    assert all(line.closed == 1 for line in openers.made)


def test_one_line_may_be_missing_where_that_is_allowed_but_not_both() -> None:
    openers = Openers("servos")
    lines = HandConnections(openers.servos, openers.can, partial=True)
    assert lines.notes == (f"{MISSING}no port",)
    for use in (lambda: lines.stream.write(b""), lambda: lines.stream.read(1, 0.0)):
        with pytest.raises(PortLost, match="no port"):
            use()
    openers.failing.clear()
    assert lines.reopen_servos() is openers.made[-1]
    assert (lines.notes, lines.servos_are_missing) == ((), False)

    openers = Openers("can")
    lines = HandConnections(openers.servos, openers.can, partial=True)
    assert lines.notes == (f"{MISSING}no bus",)
    with pytest.raises(BusNotOpened):
        lines.reopen_can()
    openers.failing.clear()
    assert lines.reopen_can() is openers.made[-1]
    assert lines.notes == ()
    lines.close()
    assert [line.closed for line in openers.made] == [1, 1]

    openers = Openers("servos", "can")
    with pytest.raises(PortLost, match="no port; no bus"):
        HandConnections(openers.servos, openers.can, partial=True)


def test_ends_of_somebody_else_are_not_closed() -> None:
    openers = Openers()
    stream, bus = openers.servos(), openers.can()
    lines = HandConnections(openers.servos, openers.can, stream=stream, can_bus=bus)
    assert (lines.stream, lines.can_bus) == (stream, bus)
    assert lines.reopen_servos() is not stream
    lines.close()
    assert [line.closed for line in openers.made] == [0, 0, 0]
