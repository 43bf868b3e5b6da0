"""The process of the force loop: both sides of its line, and what it asks of the system."""

import errno
import gc
import os
import pickle
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, repeat
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock

import numpy as np
import pytest

from cell.config.file import parse_config
from cell.config.model import CellConfig, LoopConfig
from cell.control.journal import loop_line
from cell.errors import CellStopped, HandLost, HostSilent
from cell.hand import client, real_time, server
from cell.hand.client import HandProcess, LoopProcess
from cell.hand.interface import LatestValues
from cell.hand.messages import (
    EndRamp,
    HandFault,
    HandPeriod,
    HandReply,
    HandRequest,
    LiveUpdate,
    Ready,
    packed,
)
from cell.hand.server import HandServer, Outbox
from gripper.errors import (
    BusTimeout,
    GraspStopped,
    LimitExceeded,
    ServoFault,
    ServoMissing,
    ServoRejected,
    VerificationFailed,
    fingers_left,
    note_fingers,
)
from gripper.force.ramp import ForceRamp
from gripper.force.timing import Distribution, LoopStatistics
from gripper.values.force_sensor import ForceSample
from gripper.values.servo_checks import VerificationReport, VerificationRow
from gripper.values.state import GripperPhase
from tactile.errors import HeartbeatLost, LinkFault
from tactile.source import TactileFrame
from tests.values import HAND_STATISTICS, make_cycle, raising

RAMP = ForceRamp.linear(3.0, 5.0)
SILENT = HandFault(error=HeartbeatLost("silent"), phase=GripperPhase.IDLE)


# -- Both ends in this process ---------------------------------------------------------------------


def frame() -> TactileFrame:
    return TactileFrame(t_s=1.0, counter=3, status=0, counts=np.arange(408, dtype=np.uint16))


class FakeHand:
    """A hand that does what it is told, in no time."""

    period_s = 0.001
    phase = GripperPhase.HOLDING
    statistics = HAND_STATISTICS
    measured = LatestValues()

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.grasped: list[Any] = [make_cycle(float(number)) for number in range(10)]
        """Periods of each grasp, what is called in it, or the error that ends it."""
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
        for event in self.grasped:
            if self.stopped:
                raise GraspStopped("stopped on request")
            if isinstance(event, Exception):
                raise event
            if callable(event):
                event()
            else:
                self.now_s = event.t_s
                watch(event, [frame()])
        return "outcome"

    press_pads_together = grasp

    def inspect(self) -> Any:
        raise ServoFault(2, "hot", bits=4)

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
        received = []
        while self.near.poll(0.0):
            try:
                received.append(self.near.recv())
            except EOFError:
                break
            self.outbox.flush()
        self.alive = sum(isinstance(event, LiveUpdate) for event in received)
        return [event for event in received if not isinstance(event, LiveUpdate)]

    def close(self) -> None:
        self.near.close()
        self.far.close()
        self.socket.close()


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    one = Line()
    monkeypatch.setattr(server.gc, "collect", lambda: one.hand.calls.append("collect"))
    yield one
    one.close()


class Loop(LoopProcess):
    """The client's end of a line; the server carries each request out as soon as it is sent."""

    made: ClassVar[list["Loop"]] = []

    def __init__(self, _config: CellConfig, *, partial: bool = False) -> None:
        self.partial = partial
        self.ready = Ready(notes=("a note",), missing=(), statistics=HAND_STATISTICS)
        self.lost: HandLost | None = None
        self._watchdog_ms, self._stopping, self._stop_fd = 100.0, threading.RLock(), -1
        self._process: Any = Mock(pid=4711, returncode=-9)
        self.line = Line()
        self._connection = self.line.near
        self.sent: list[Any] = []
        self.stops = 0
        self.made.append(self)

    def stop(self) -> None:
        self.stops += 1

    def send(self, message: Any) -> None:
        super().send(message)
        self.sent.append(message)
        self.line.server._receive(0.0)
        while self.line.server._requests:
            self.line.server._execute(self.line.server._requests.popleft())


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[HandProcess]:
    monkeypatch.setattr(Loop, "made", [])
    monkeypatch.setattr(client, "LoopProcess", Loop)
    # Here it would collect what all earlier tests have left.
    monkeypatch.setattr(server.gc, "collect", Mock())
    yield HandProcess(CellConfig())
    for made in Loop.made:
        made.line.close()


@pytest.fixture
def loop(hand: HandProcess) -> Loop:
    return Loop.made[-1]


def nothing(_cycle: Any, _frames: Any) -> None:
    pass


# -- The client ------------------------------------------------------------------------------------


def test_periods_reach_the_watch_and_value_or_error_is_that_of_the_hand(loop, hand) -> None:
    seen: list[Any] = []
    outcome = hand.grasp(RAMP, lambda cycle, _frames: seen.append((cycle.phase, hand.phase)))
    assert (outcome, seen) == ("outcome", [(GripperPhase.RAMPING, GripperPhase.RAMPING)] * 10)
    assert hand.phase is GripperPhase.HOLDING
    assert (loop.sent[0].method, loop.sent[0].arguments) == ("grasp", {"ramp": RAMP})
    assert (hand.notes, hand.statistics.loop.cycles) == (("a note",), 5)
    with pytest.raises(ServoFault, match="hot") as fault:
        hand.inspect()
    assert fault.value.servo_id == 2
    assert hand.tare(3) is None


def test_what_the_process_measures_is_shown_in_a_motion_and_between_two(loop, hand) -> None:
    assert hand.latest == LatestValues()
    far, cycle = loop.line.hand, make_cycle()
    force = ForceSample(t_s=2.0, force_n=(3.0, 3.1))
    # A sample that must not be used does not take the place of the last good one.
    spoilt = replace(force, t_s=3.0, valid=False)
    far.grasped = [replace(cycle, force=one) for one in (force, spoilt)]
    hand.grasp(RAMP, nothing)
    assert (hand.latest.cycle, hand.latest.force) == (far.grasped[1], force)
    loop.line.server._supervise()
    hand.tick()
    assert hand.latest.cycle == far.latest.cycle
    assert not hand.latest.frame.counts.flags.writeable


def test_the_end_of_a_ramp_names_the_grasp_that_it_is_meant_for(loop, hand) -> None:
    hand.start()
    loop.line.hand.grasped = [make_cycle()] * 2
    hand.grasp(RAMP, lambda _cycle, _frames: hand.end_ramp())
    assert loop.sent[2:] == [EndRamp(number=2), EndRamp(number=2)]
    assert loop.stops == 0


def test_a_ramp_beyond_a_limit_is_refused_without_asking_the_process(hand) -> None:
    hand.check_ramp(RAMP)
    with pytest.raises(LimitExceeded, match="at most 13"):
        hand.check_ramp(ForceRamp.linear(14.9, 5.0))


def test_what_the_watch_raises_stops_the_command_and_comes_with_where_the_fingers_are(
    loop, hand
) -> None:
    watch = Mock(side_effect=OSError("the disk is full"))
    stopped = GraspStopped("stopped on request")
    note_fingers(stopped, "stopped while letting go")
    loop.line.hand.grasped = [make_cycle(), make_cycle(), stopped]
    with pytest.raises(OSError, match="disk is full") as caught:
        hand.grasp(RAMP, watch)
    assert fingers_left(caught.value) == "the fingers stopped while letting go"
    assert (watch.call_count, loop.stops, loop.lost) == (1, 1, None)


def test_a_fault_between_commands_comes_with_the_next_tick_or_command(loop, hand) -> None:
    hand.tick()
    for call in (hand.tick, hand.start_sensor):
        loop.line.outbox.post(SILENT)
        with pytest.raises(HeartbeatLost):
            call()
    assert loop.sent == []
    assert hand.phase is GripperPhase.IDLE


def test_a_fault_that_nobody_asked_for_does_not_spoil_the_end(loop, hand) -> None:
    assert hand.shutdown() == ""
    loop.line.outbox.post(SILENT)
    assert hand.shutdown() == "silent"
    assert [request.method for request in loop.sent] == ["shutdown"] * 2


def test_a_lost_process_is_told_until_another_has_read_the_servos(loop, hand, monkeypatch) -> None:
    loop.line.hand.grasped = [make_cycle(), loop.line.far.close]
    with pytest.raises(HandLost, match=r"\(pid 4711\) was ended by SIGKILL; a part may still be"):
        hand.grasp(RAMP, nothing)
    assert hand.phase is GripperPhase.HELD_AFTER_FAULT
    for call in (hand.tick, hand.keep_grip, hand.start):
        with pytest.raises(HandLost, match="SIGKILL"):
            call()
    hand.stop_sensor()
    assert hand.shutdown() == ""
    monkeypatch.setattr(FakeHand, "phase", GripperPhase.OFF)
    monkeypatch.setattr(FakeHand, "clear_fault", raising(BusTimeout("silent")), raising=False)
    with pytest.raises(BusTimeout):
        hand.clear_fault(reboot=False)
    assert hand.shutdown() == ""
    assert hand.phase is GripperPhase.HELD_AFTER_FAULT, "nobody has read the servos"
    monkeypatch.delattr(FakeHand, "clear_fault")
    hand.clear_fault(reboot=False)
    assert hand.phase is GripperPhase.OFF
    _, again = Loop.made
    assert [request.method for request in again.sent] == ["clear_fault", "shutdown", "clear_fault"]
    assert (loop.partial, again.partial) == (False, True), "to let go needs no sensor"
    hand.start()


def test_a_process_that_says_that_it_ends_is_lost(loop, hand) -> None:
    loop.line.outbox.post(HandFault(error=HandLost("told to end"), phase=GripperPhase.IDLE))
    with pytest.raises(HandLost, match="told to end"):
        hand.tick()
    assert loop.line.near.closed
    assert hand.phase is GripperPhase.IDLE


@pytest.mark.parametrize("again", [False, True])
def test_a_signal_while_waiting_stops_first_and_a_second_ends_at_once(loop, hand, again) -> None:
    signals = [KeyboardInterrupt()] * (1 + again)
    polls = chain([False, True], signals, repeat(True))  # the first is that of a tick
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop.line.near, "poll", Mock(side_effect=polls))
        with pytest.raises(KeyboardInterrupt):
            hand.grasp(RAMP, nothing)
    assert loop.stops == 1
    assert loop.waiting() is again


def test_an_interruption_within_a_message_ends_the_process(loop, hand, monkeypatch) -> None:
    monkeypatch.setattr(loop.line.near, "recv", raising(SystemExit()))
    with pytest.raises(SystemExit):
        hand.grasp(RAMP, nothing)
    with pytest.raises(HandLost, match="cut by an interruption"):
        hand.tick()


def test_a_process_that_says_nothing_between_commands_is_lost(loop, hand, monkeypatch) -> None:
    now_s = time.monotonic()
    monkeypatch.setattr(client, "time", SimpleNamespace(monotonic=lambda: now_s))
    # The program was busy for long, or both were paused.
    now_s += 60.0
    hand.tick()
    loop.line.outbox.post(LiveUpdate(latest=LatestValues()))
    for step_s in (2.0, 2.0, 2.0):
        now_s += step_s
        hand.tick()
    now_s += 1.5
    loop._process.wait.side_effect = [subprocess.TimeoutExpired("loop", 5.0), -9]
    with pytest.raises(HandLost, match=r"nothing for 5\.5 s"):
        hand.tick()
    calls = [name for name, *_ in loop._process.method_calls]
    assert calls == ["kill", "wait", "kill", "wait"], "it hangs: it is killed at once"
    hand.clear_fault(reboot=False)
    hand.tick()


@pytest.mark.slow
def test_ctrl_c_while_the_process_comes_up_is_the_programs_business(monkeypatch, tmp_path) -> None:
    """Its ports do not exist: it lives to say so."""
    start = subprocess.Popen

    def start_and_interrupt(*arguments: Any, **options: Any) -> Any:
        process = start(*arguments, **options)
        for number in (signal.SIGINT, signal.SIGHUP):
            process.send_signal(number)
        return process

    monkeypatch.setattr(client.subprocess, "Popen", start_and_interrupt)
    line = f"{{interface: slcan, channel: {tmp_path}/can}}"
    text = f"gripper: {{port: {tmp_path}/servos}}\ntactile: {line}"
    with pytest.raises(LinkFault, match="cannot be opened"):
        HandProcess(parse_config(f"{text}\npositioner: {{kind: operator}}", source="test"))


@pytest.mark.parametrize("moment", ["while it closes", "after it has closed"])
def test_a_stop_never_writes_into_a_descriptor_that_another_file_has(monkeypatch, moment) -> None:
    """The number of a closed descriptor is given to the next file that is opened."""
    (reader, writer), (other_reader, other) = os.pipe(), os.pipe()
    loop = LoopProcess.__new__(LoopProcess)
    loop._stopping = threading.RLock()
    loop._stop_fd = writer
    loop._connection = SimpleNamespace(closed=False, close=lambda: None)  # type: ignore[assignment]
    loop._process = SimpleNamespace(wait=lambda _timeout_s: 0)  # type: ignore[assignment]
    os_close = os.close

    def close_and_reuse(number: int) -> None:
        os_close(number)
        if number == writer:
            os.dup2(other, number)
            if moment == "while it closes":
                loop.stop()  # as a signal handler does, or another thread

    with monkeypatch.context() as reused:
        reused.setattr(client.os, "close", close_and_reuse)
        loop.close()
    loop.stop()
    loop.close()
    os.set_blocking(other_reader, False)
    with pytest.raises(BlockingIOError):
        os.read(other_reader, 1)
    for number in (reader, writer, other_reader, other):
        os.close(number)


# -- What the process of the force loop asks of the system, granted and refused --------------------


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Catch what would change this process, and undo the size of new threads' stacks."""
    calls: list[Any] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *a: calls.append(a[1:]))
    monkeypatch.setattr(os, "sched_setaffinity", lambda *a: calls.append(a[1]))
    monkeypatch.setattr(real_time, "lock_memory", lambda: calls.append("lock"))
    before = threading.stack_size()
    yield calls
    threading.stack_size(before)


refuse = raising(PermissionError(errno.EPERM, "Operation not permitted"))


def test_what_is_configured_is_asked_for_and_nothing_else(asked) -> None:
    assert real_time.enter_real_time(LoopConfig(priority=0, lock_memory=False)) == ()
    assert asked == []
    assert real_time.enter_real_time(LoopConfig(cpu=0, priority=42)) == ()
    assert asked == [{0}, "lock", (os.SCHED_FIFO, os.sched_param(42))]


@pytest.mark.usefixtures("asked")
def test_what_is_refused_is_noted_with_its_meaning_and_remedy(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(real_time, "lock_memory", refuse)
    notes = real_time.enter_real_time(LoopConfig(cpu=1000))
    assert len(notes) == 3
    assert "was not bound to processor 1000 (Operation not permitted): correct loop.cpu" in notes[0]
    assert "paging may delay it" in notes[1]
    assert "without real-time priority" in notes[2]
    assert "ulimit -r" in notes[2]


def test_memory_that_may_not_be_locked_is_an_error(monkeypatch) -> None:
    real_time.ctypes.set_errno(errno.ENOMEM)
    lock = Mock(return_value=-1)
    monkeypatch.setattr(real_time.ctypes, "CDLL", Mock(return_value=Mock(mlockall=lock)))
    with pytest.raises(OSError, match="Cannot allocate memory"):
        real_time.lock_memory()
    lock.assert_called_once_with(3)


def test_garbage_is_collected_between_jobs_only(monkeypatch) -> None:
    monkeypatch.setattr(gc, "collect", lambda: None)
    try:
        real_time.stop_collecting()
        assert not gc.isenabled()
    finally:
        gc.enable()
        gc.unfreeze()


def test_one_line_says_whether_the_loop_was_on_time() -> None:
    counts = {"cycles": 12_345, "overruns": 3, "late": 2, "missed_reads": 1}
    statistics = LoopStatistics(**counts, lateness=Distribution(n=9, max_s=1.25e-3))
    assert loop_line(statistics, 0.005) == (
        "Force loop: of 12,345 periods of 5 ms 5 were late, by up to 1.2 ms, 1 without an answer "
        "of the servos."
    )
    assert loop_line(LoopStatistics(cycles=9), 0.005) == "Force loop: on time."
    assert loop_line(LoopStatistics(), 0.005) == "Force loop: no figures."


@pytest.mark.parametrize(("priority", "granted"), [(0, True), (49, True), (49, False)])
def test_a_simulated_device_gets_priority_where_granted_and_gives_it_back(
    monkeypatch, priority, granted
) -> None:
    calls: list[Any] = []
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda *a: calls.append(a[1:]) if granted else refuse()
    )
    with real_time.raised_priority(priority):
        calls.append("served")
    fifo = (os.SCHED_FIFO, os.sched_param(49))
    assert calls == ([fifo, "served", before] if granted and priority else ["served"])


# -- What crosses to that process, and what it does with it ----------------------------------------


REPORT = VerificationReport(
    rows=(VerificationRow(servo_id=1, item="x", expected="1", actual="2", ok=False),)
)
ERRORS = [
    ServoRejected(2, 5, "writing goal"),
    ServoFault(1, "it has switched its torque off", bits=32),
    VerificationFailed(REPORT),
    ServoMissing(REPORT, "give the servo its ID"),
    GraspStopped("stopped on request"),
    CellStopped("stopped"),
    FileNotFoundError(2, "No such file", "/dev/nothing"),
    KeyError("x"),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
]


def crossed(error: BaseException) -> BaseException:
    return pickle.loads(packed(HandFault(error=error, phase=GripperPhase.OFF))).error


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

    class BoardSilent(LinkFault):  # of a sensor plugin: it keeps its fault number
        pass

    assert type(got := crossed(BoardSilent("no bytes", threading.Lock()))) is LinkFault
    assert "BoardSilent: ('no bytes', <unlocked" in str(got)
    assert "unlocked" in str(crossed(ValueError(threading.Lock())))


# -- The server ------------------------------------------------------------------------------------


def test_requests_are_answered_in_order_and_garbage_is_collected_behind_each(line) -> None:
    line.ask(grasp={"ramp": RAMP}, inspect={}, tare={"n_frames": 3})
    events = line.serve()
    assert [type(event) for event in events] == [HandPeriod] * 10 + [HandReply] * 3
    np.testing.assert_array_equal(events[0].frames[0].counts, frame().counts)
    assert [event.number for event in events[10:]] == [1, 2, 3]
    calls = [call for call in line.hand.calls if call != "tick"]
    assert calls == ["collect", "keep_grip", "collect", "tare", "collect"]


def test_a_program_that_takes_nothing_freezes_the_loop_and_is_told_what_is_lost() -> None:
    line = Line(limit=20)
    line.hand.grasped = [make_cycle(float(number)) for number in range(2000)]
    line.ask(grasp={"ramp": RAMP})
    *periods, answer = line.serve()
    error = answer.error
    assert isinstance(error, HostSilent)
    assert "1 periods are lost" in str(error)
    assert answer.statistics.undelivered == 1
    assert 25 < len(periods) < 500
    assert [event.cycle.t_s for event in periods] == [float(n) for n in range(len(periods))]
    line.close()


@pytest.mark.parametrize("name", ["grasp", "press_pads_together"])
def test_the_end_of_a_ramp_counts_for_its_own_grasp_only(line, name) -> None:
    del line.hand.grasped[3:]
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
    reader, writer = os.pipe()
    if cause == "sigterm":
        line.server.terminate(signal.SIGTERM, None)
    elif cause == "program":
        os.write(writer, b"s")
        os.close(writer)
        with monkeypatch.context() as patch:
            patch.setattr(line.hand, "request_stop", stop := Mock())
            line.server.listen(reader)
        assert stop.call_count == 2, "the byte stops a command, and so does the end of the program"
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
    line.outbox.post(SILENT)
    begin_s = time.monotonic()
    line.outbox.drain(5.0)
    assert line.outbox.broken
    assert time.monotonic() - begin_s < 4.0
    line.server.serve()


def test_between_commands_the_process_sends_what_supervision_measures(line, monkeypatch) -> None:
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
