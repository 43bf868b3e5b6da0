"""What ends a sequence from outside: signals, the death of the parent, while somebody is asked."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from cell.control.positioner import PatientCaller
from cell.control.states import CellState
from cell.errors import CellStopped, PositionerError
from cell.interfaces.cli import terminal as asking
from cell.interfaces.cli.signals import stopping
from tests.cell.conftest import small_config
from tests.values import raising
from tests.waiting import LIMIT_S


def run(program: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, timeout=LIMIT_S, check=False
    )


@pytest.fixture
def hangup(request: pytest.FixtureRequest) -> Iterator[None]:
    """SIGHUP as in a terminal, or ignored as under nohup, wherever the tests were started."""
    before = signal.signal(signal.SIGHUP, request.param)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("hangup", [signal.SIG_DFL], indirect=True)
def test_the_death_of_the_parent_stops_once(monkeypatch) -> None:
    stopped, calls = threading.Event(), list[int]()

    def stop() -> None:
        calls.append(1)
        stopped.set()

    with stopping(stop):
        assert not stopped.wait(0.15)
        monkeypatch.setattr(os, "getppid", lambda: 1)
        assert stopped.wait(LIMIT_S)
    assert calls == [1]


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("hangup", [signal.SIG_IGN], indirect=True)
def test_a_program_under_nohup_outlives_terminal_and_parent(monkeypatch) -> None:
    calls: list[int] = []
    with stopping(lambda: calls.append(1)):
        monkeypatch.setattr(os, "getppid", lambda: 1)
        signal.raise_signal(signal.SIGHUP)
        assert "parent" not in [thread.name for thread in threading.enumerate()]
        assert calls == []
        signal.raise_signal(signal.SIGTERM)
        assert calls == [1]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize("hanging", ["time.sleep(60)", "sum(range(1 << 40))"])
def test_a_second_signal_leaves_little_time_to_close_files(hanging) -> None:
    program = f"""
import os, signal, time
from cell.interfaces.cli.signals import stopping
with stopping(lambda: None, end_within_s=0.05, left='; the grip is kept'):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        print('closing', flush=True)
        {hanging}
"""
    ended = run(program)
    assert (ended.returncode, ended.stdout) == (1, b"closing\n")
    assert b"error: interrupted; the grip is kept\n" in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(pytest.param(one, marks=pytest.mark.long) for one in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
def test_a_signal_while_the_program_ends_leaves_its_exit_code(number) -> None:
    program = f"""
import atexit, os, signal, sys
from cell.interfaces.cli import main
signal.signal(signal.SIGHUP, signal.SIG_DFL)
atexit.register(lambda: os.kill(os.getpid(), {number:d}))
sys.argv = ['tactile-cell', 'config', 'check', '/nowhere/cell.yaml']
main()
"""
    ended = run(program)
    assert ended.returncode == 2
    assert b"/nowhere/cell.yaml" in ended.stderr
    assert b"Traceback" not in ended.stderr


def test_an_interrupt_that_turns_into_another_error_is_an_interrupt() -> None:
    program = """
import signal, sys, types
from cell.interfaces.cli import main
# A shell that runs the tests in the background has them inherit SIGINT as ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
def run():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise ImportError('initialization failed')
sys.modules['cell.interfaces.cli.app'] = types.SimpleNamespace(main=run)
main()
"""
    ended = run(program)
    assert (ended.returncode, ended.stderr) == (1, b"error: interrupted\n")


def test_a_third_signal_does_not_cut_off_what_the_second_leaves_time_for() -> None:
    program = """
import os, signal, time
from cell.interfaces.cli.signals import stopping
try:
    with stopping(lambda: None, end_within_s=30.0):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            print('closed', flush=True)
except KeyboardInterrupt:
    os.kill(os.getpid(), signal.SIGINT)
    print('told', flush=True)
"""
    ended = run(program)
    assert (ended.returncode, ended.stdout) == (0, b"closed\ntold\n")


def test_a_stop_does_not_wait_for_whoever_moves_the_object(make_bench) -> None:
    answered = threading.Event()
    bench = make_bench(
        small_config(positioner__kind="operator"),
        ask=lambda _text: "" if answered.wait(LIMIT_S) else "q",
    )
    bench.controller.start()
    clock = bench.simulated.clock
    end_s = clock.monotonic() + 1.0
    clock.on_advance.append(
        lambda now_s: bench.controller.life.cancel() if end_s <= now_s < end_s + 0.01 else None
    )
    with pytest.raises(CellStopped, match="the fingers are open"):
        bench.controller.moves.present("ball")
    assert bench.controller.life.state is CellState.IDLE
    with pytest.raises(PositionerError, match="was abandoned and still runs"):
        bench.controller.moves.present("ball")
    answered.set()
    for thread in threading.enumerate():
        if thread.name == "positioner":
            thread.join(LIMIT_S)
    bench.controller.moves.present("ball")


def test_what_supervision_raises_comes_at_once_and_what_the_call_raises_too() -> None:
    caller = PatientCaller(time, 0.001)
    blocked = threading.Event()

    with pytest.raises(KeyboardInterrupt):
        caller.call(lambda: blocked.wait(LIMIT_S), raising(KeyboardInterrupt()))
    blocked.set()
    with pytest.raises(ZeroDivisionError):
        PatientCaller(time, 0.001).call(lambda: 1 // 0, lambda: None)
    assert PatientCaller(time, 0.001).call(lambda: 7, lambda: None) == 7


def test_an_answer_from_a_pipe_is_read_line_by_line(monkeypatch, capsys) -> None:
    out_of, into = os.pipe()
    os.write(into, b"done\nq\n")
    os.close(into)
    with os.fdopen(out_of) as pipe:
        monkeypatch.setattr(asking.sys, "stdin", pipe)
        monkeypatch.setattr(asking.sys, "__stdin__", pipe)
        assert [asking.ask("next? "), asking.ask("next? ")] == ["done", "q"]
        with pytest.raises(EOFError):
            asking.ask("next? ")
    assert capsys.readouterr().out == "next? " * 3
