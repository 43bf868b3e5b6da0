"""What crosses to the process of the force loop, and what that process does with it."""

import os
import pickle
import signal
import socket
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.errors import CellStopped, HostSilent
from cell.hand import server
from cell.hand.interface import HandStatistics, LatestValues
from cell.hand.messages import (
    EndRamp,
    HandFault,
    HandPeriod,
    HandReply,
    HandRequest,
    LiveUpdate,
    packed,
)
from cell.hand.server import HandServer, Outbox
from gripper.dynamixel.transactions import BusStatistics
from gripper.errors import BusTimeout, GraspStopped, ServoFault, ServoRejected, VerificationFailed
from gripper.force.ramp import ForceRamp
from gripper.force.timing import Distribution, LoopStatistics
from gripper.values.servo_checks import VerificationReport, VerificationRow
from gripper.values.state import GripperPhase
from tactile.errors import NodeEmergency
from tactile.source import FrameStatistics, TactileFrame
from tests.values import make_cycle, make_source_statistics

RAMP = ForceRamp.staircase((2.0, 4.0), 5.0, 0.2)


def statistics() -> HandStatistics:
    return HandStatistics(
        loop=LoopStatistics(cycles=9, lateness=Distribution(n=9, max_s=0.1)),
        servo_bus=BusStatistics(transactions=3),
        source=make_source_statistics(frames=FrameStatistics(complete=4)),
    )


def frame() -> TactileFrame:
    return TactileFrame(t_s=1.0, counter=3, status=0, counts=np.arange(408, dtype=np.uint16))


ANSWER = HandReply(
    number=3,
    value=VerificationReport(rows=()),
    error=None,
    phase=GripperPhase.HOLDING,
    statistics=statistics(),
)


def test_a_command_is_a_method_of_the_hand_and_no_other_one() -> None:
    for name in ("close", "tick", "request_stop", "end_ramp", "check_ramp", "_grip"):
        with pytest.raises(ValueError, match=f"'{name}' is not a command of the hand"):
            HandRequest(number=1, method=name)
    watched = [HandRequest(number=1, method=name).watched for name in ("grasp", "release", "tare")]
    assert watched == [True, True, False]


ERRORS = [
    ServoRejected(2, 5, "writing goal"),
    ServoFault(1, 32, "it has switched its torque off"),
    VerificationFailed(
        VerificationReport(
            rows=(VerificationRow(servo_id=1, item="x", expected="1", found="2", ok=False),)
        ),
        ["servo 1 x: expected 1, found 2"],
    ),
    NodeEmergency(0x8130, 0x11, "heartbeat lost", "unit 5"),
    GraspStopped("stopped on request"),
    CellStopped("stopped"),
    FileNotFoundError(2, "No such file", "/dev/nothing"),
    KeyError("x"),
]


def crossed(error: BaseException) -> BaseException:
    event = pickle.loads(packed(HandFault(error=error, phase=GripperPhase.OFF)))
    return event.error


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_arrives_as_what_it_is(error) -> None:
    got = crossed(error)
    assert type(got) is type(error)
    assert str(got) == str(error)
    assert vars(got) == vars(error)


def test_an_error_of_nobodys_tree_is_named_and_its_origin_kept() -> None:
    class Strange(Exception):
        pass

    try:
        raise Strange("odd")
    except Strange as error:
        got = crossed(error)
    assert type(got) is RuntimeError
    assert "Strange: odd" in str(got)
    assert "raise Strange" in got.__notes__[0]


# -- the process's side, in this process -----------------------------------------------------


class FakeHand:
    """A hand that does what it is told, in no time."""

    period_s = 0.001
    phase = GripperPhase.HOLDING
    statistics = statistics()
    measured = LatestValues()

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.cycles = 10
        self.stopped = False
        self.ended_at: list[float] = []
        self.now_s = 0.0
        self.tick_error: Exception | None = None

    def __getattr__(self, name: str) -> Any:
        return lambda *_args, **_options: self.calls.append(name)

    def request_stop(self) -> None:
        self.stopped = True

    def end_ramp(self) -> None:
        self.ended_at.append(self.now_s)

    def grasp(self, ramp: ForceRamp, watch: Any) -> str:
        del ramp
        self.stopped = False
        for number in range(self.cycles):
            if self.stopped:
                raise GraspStopped("stopped on request")
            self.now_s = float(number)
            watch(make_cycle(float(number)), [frame()])
        return "outcome"

    press_pads_together = grasp

    def inspect(self) -> Any:
        raise ServoFault(2, 4, "hot")

    def tick(self) -> None:
        self.calls.append("tick")
        self.latest = LatestValues(cycle=make_cycle(float(len(self.calls))), frame=frame())
        if self.tick_error is not None:
            raise self.tick_error


class Line:
    """Both ends of the connection, and the server at the far one."""

    def __init__(self, limit: int = 1000) -> None:
        self.socket, theirs = socket.socketpair()
        self.near = Connection(os.dup(self.socket.fileno()))
        self.far = Connection(theirs.detach())
        self.hand = FakeHand()
        self.alive = 0
        self.outbox = Outbox(self.far, limit=limit)
        self.server = HandServer(
            self.hand,  # type: ignore[arg-type]
            self.far,
            self.outbox,
            parent=os.getppid(),
        )

    def ask(self, **calls: Any) -> None:
        """Send a request for each method with its arguments."""
        for number, (method, arguments) in enumerate(calls.items(), start=1):
            self.near.send(HandRequest(number=number, method=method, arguments=arguments))

    def serve(self) -> list[Any]:
        """Serve until all requests are answered; return the events."""
        self.socket.shutdown(socket.SHUT_WR)
        self.server.serve()
        return self.events()

    def events(self) -> list[Any]:
        found = []
        while self.near.poll(0.0):
            try:
                found.append(self.near.recv())
            except EOFError:
                break
            self.outbox.flush()
        self.alive = sum(isinstance(event, LiveUpdate) for event in found)
        return [event for event in found if not isinstance(event, LiveUpdate)]

    def close(self) -> None:
        self.near.close()
        self.far.close()
        self.socket.close()


@pytest.fixture
def line() -> Iterator[Line]:
    one = Line()
    yield one
    one.close()


@pytest.mark.slow
def test_requests_are_answered_in_order_with_value_error_and_statistics(line) -> None:
    line.ask(grasp={"ramp": RAMP}, inspect={}, tare={"n_frames": 3})
    events = line.serve()
    assert [type(event) for event in events] == [HandPeriod] * 10 + [HandReply] * 3
    np.testing.assert_array_equal(events[0].frames[0].counts, frame().counts)
    grasped, inspected, tared = events[10:]
    assert (grasped.number, grasped.value, grasped.error) == (1, "outcome", None)
    assert grasped.statistics == statistics()
    fault = inspected.error
    assert isinstance(fault, ServoFault)
    assert fault.servo_id == 2
    assert (tared.number, tared.value, tared.error) == (3, None, None)
    assert [call for call in line.hand.calls if call != "tick"] == ["keep_grip", "tare"]


def test_a_program_that_takes_nothing_freezes_the_loop_and_is_told_what_is_lost() -> None:
    line = Line(limit=20)
    line.hand.cycles = 2000
    line.ask(grasp={"ramp": RAMP})
    events = line.serve()
    *periods, answer = events
    error = answer.error
    assert isinstance(error, HostSilent)
    assert "1 periods are lost" in str(error)
    assert answer.statistics.undelivered == 1
    assert 25 < len(periods) < 500
    assert [event.cycle.t_s for event in periods] == [float(n) for n in range(len(periods))]
    line.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grasp", "press_pads_together"])
def test_the_end_of_a_ramp_counts_for_its_own_grasp_only(line, name) -> None:
    line.hand.cycles = 3
    line.near.send(EndRamp(number=1))
    line.near.send(HandRequest(number=1, method="tare", arguments={"n_frames": 3}))
    line.near.send(HandRequest(number=2, method=name, arguments={"ramp": RAMP}))
    line.near.send(EndRamp(number=1))
    line.near.send(EndRamp(number=2))
    # One message is taken in each period; a command that comes during a grasp waits for its end.
    line.near.send(HandRequest(number=3, method="grasp", arguments={"ramp": RAMP}))
    line.near.send(EndRamp(number=2))
    events = line.serve()
    assert [event.number for event in events if isinstance(event, HandReply)] == [1, 2, 3]
    assert [type(event) for event in events[1:5]] == [HandPeriod] * 3 + [HandReply]
    assert line.hand.ended_at == [1.0]


@pytest.mark.slow
def test_between_commands_the_process_ticks_and_tells_once_what_it_found(line) -> None:
    line.hand.tick_error = BusTimeout("cable out")
    line.server._supervise()
    line.server._supervise()
    (event,) = line.events()
    assert isinstance(event.error, BusTimeout)
    assert line.hand.calls == ["tick", "keep_grip"]
    line.hand.tick_error = None
    line.ask(start={})
    line.serve()
    line.server._supervise()
    assert line.hand.calls[-1] == "tick"


@pytest.mark.parametrize("cause", ["sigterm", "program", "parent"])
def test_the_end_freezes_keeps_and_says_why(line, cause, monkeypatch) -> None:
    monkeypatch.setattr(server, "_PROGRAM_ENDS_S", 0.0)
    line.hand.cycles = 50
    reader, writer = os.pipe()
    if cause == "sigterm":
        line.server.terminate(signal.SIGTERM, None)
    elif cause == "program":
        os.write(writer, b"s")
        os.close(writer)
        line.server.listen(reader)
    else:
        line.server._parent = -1
    line.server._execute(HandRequest(number=1, method="grasp", arguments={"ramp": RAMP}))
    line.server.serve()
    line.server.end()
    *periods, answer, last = line.events()
    assert len(periods) == 1
    assert isinstance(answer.error, GraspStopped)
    assert type(last.error).__name__ == "HandLost"
    assert ("SIGTERM" if cause == "sigterm" else "program is gone") in str(last.error)
    assert line.hand.calls[-2:] == ["shutdown", "close"]


@pytest.mark.slow
def test_sigterm_leaves_the_program_time_to_end_the_cell_in_order(line, monkeypatch) -> None:
    monkeypatch.setattr(server, "_PROGRAM_ENDS_S", 1e6)
    line.server.terminate(signal.SIGTERM, None)
    line.ask(tare={"n_frames": 3}, keep_grip={})
    answers = line.serve()
    line.server.end()
    assert [type(event) for event in (*answers, *line.events())] == [HandReply, HandReply]
    assert line.hand.calls[-2:] == ["shutdown", "close"]


def test_a_message_that_finds_nobody_is_given_up_at_once(line) -> None:
    line.near.close()
    line.socket.close()
    line.outbox.post(ANSWER)
    begin_s = time.monotonic()
    line.outbox.drain(5.0)
    assert line.outbox.broken
    assert time.monotonic() - begin_s < 4.0
    line.server.serve()


def test_between_commands_the_process_sends_what_the_supervision_measures(
    line, monkeypatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=lambda: now_s))
    sent: list[bytes] = []
    for _ in range(200):
        now_s += 0.005
        line.server._supervise()
        while line.near.poll(0.0):
            sent.append(line.near.recv_bytes())
    assert 40 <= len(sent) <= 51
    assert len({pickle.loads(data).latest.cycle.t_s for data in sent}) == len(sent)
    assert max(map(len, sent)) < 4000


def test_between_commands_the_process_says_now_and_then_that_it_is_there(line, monkeypatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=lambda: now_s))
    line.hand.tick_error = BusTimeout("cable out")
    for _ in range(20):
        now_s += 0.2
        line.server._supervise()
    line.events()
    assert line.alive == 7
    # To a program that takes nothing it says nothing more: the socket is for what matters.
    for _ in range(100_000):
        now_s += 1.0
        line.server._supervise()
        if not line.outbox.empty:
            break
    line.server._supervise()
    assert len(line.outbox._waiting) == 1
