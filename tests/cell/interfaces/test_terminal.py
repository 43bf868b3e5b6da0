"""The terminal: the wizard's questions, and what ends a sequence from outside."""

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from cell.commissioning.engine import WizardAborted, leave
from cell.commissioning.findings import ProposedChange
from cell.control.positioner import PatientCaller
from cell.control.states import CellState
from cell.errors import (
    CellError,
    CellStopped,
    ModelError,
    PartInGrip,
    PositionerError,
    RecordingError,
)
from cell.interfaces.cli import session, terminal as asking
from cell.interfaces.cli.app import app
from cell.interfaces.cli.commands.commission import TerminalDialog
from cell.interfaces.cli.session import running_cell
from cell.interfaces.cli.signals import stopping
from tests.cell.cells import REAL, small_config
from tests.waiting import LIMIT_S

CHOICES = {"a": "the first\n  | |", "b": "the second [x]"}
WRITE = ProposedChange(where="servo 1", what="id (7)", before="1", after="2", undo="by --restore")


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., TerminalDialog]:
    def type_in(*lines: str) -> TerminalDialog:
        text = io.StringIO("".join(f"{line}\n" for line in lines))
        monkeypatch.setattr(sys, "stdin", text)
        return TerminalDialog()

    return type_in


@pytest.mark.parametrize(
    ("lines", "answer"), [(["2"], "b"), (["b"], "b"), ([""], "a"), (["7", "x", "1"], "a")]
)
def test_choices_are_taken_by_number_name_or_enter(typed, lines, answer, capsys) -> None:
    assert typed(*lines).choose("q", "Which?", CHOICES, "a") == answer
    assert "  1  the first (Enter)\n  | |\n  2  the second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lines", "default", "answer"),
    [(["10,5"], None, 10.5), (["", "0", "nan", "ten", "99"], None, 99.0), ([""], 7.0, 7.0)],
)
def test_a_number_has_a_range_and_may_have_a_default(typed, lines, default, answer) -> None:
    assert typed(*lines).number("q", "?", (1, 100, "mm"), default) == answer


def test_a_refused_restore_names_the_command_that_asks_again(tmp_path, monkeypatch) -> None:
    restore = "cell.interfaces.cli.commands.commission.restore_servos"
    monkeypatch.setattr(restore, lambda *_bench, **_begin: leave("refused"))
    options = ["--restore", "--servo-port", "/dev/ttyUSB0"]
    ended = CliRunner().invoke(app, ["commission", str(tmp_path), *options])
    assert ended.exit_code == 1
    assert "left: nothing was written; the same command shows the changes again" in ended.stderr


def test_a_watched_value_does_not_hold_up_a_pipe(typed) -> None:
    typed("").confirm("q", "Move it.", watch=lambda: "1 deg")


@pytest.mark.parametrize("lines", [["q"], []])
def test_q_and_the_end_of_input_leave(typed, lines) -> None:
    with pytest.raises(WizardAborted, match="the same command continues with this step"):
        typed(*lines).choose("q", "?", CHOICES)


def test_writes_are_shown_and_refused_unless_yes_is_typed(typed, capsys) -> None:
    zero = replace(WRITE, what="drive_mode (10)", before="0", after="4")
    typed("", "maybe", "y").approve([WRITE, zero])
    text = capsys.readouterr().out
    assert "servo 1: id (7): 1 -> 2" in text
    assert "servo 1: drive_mode (10): 0 -> 4" in text
    assert text.count("undo: by --restore") == 1
    for refusal in ("n", "q"):
        with pytest.raises(WizardAborted):
            typed(refusal).approve([WRITE])


# -- What ends a sequence from outside -------------------------------------------------------------


def run(program: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, timeout=LIMIT_S, check=False
    )


def test_the_death_of_the_parent_stops_once(monkeypatch, undo) -> None:
    # As in a terminal, wherever the tests were started.
    undo.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, signal.SIG_DFL))
    stopped, calls = threading.Event(), list[int]()

    def stop() -> None:
        calls.append(1)
        stopped.set()

    with stopping(stop):
        assert not stopped.wait(0.15)
        monkeypatch.setattr(os, "getppid", lambda: 1)
        assert stopped.wait(LIMIT_S)
    assert calls == [1]


def test_a_program_under_nohup_outlives_terminal_and_parent(monkeypatch, undo) -> None:
    undo.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, signal.SIG_IGN))
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
def test_a_signal_while_the_program_ends_leaves_its_exit_code() -> None:
    program = """
import atexit, os, signal, sys
from cell.interfaces.cli import main
signal.signal(signal.SIGHUP, signal.SIG_DFL)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    atexit.register(os.kill, os.getpid(), number)
sys.argv = ['tactile-cell', 'nonsense']
main()
"""
    ended = run(program)
    assert ended.returncode == 2
    assert b"No such command" in ended.stderr
    assert b"Traceback" not in ended.stderr


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


def test_what_a_call_returns_or_raises_comes_back_from_its_thread() -> None:
    caller = PatientCaller(time, 0.001)
    with pytest.raises(ZeroDivisionError):
        caller.call(lambda: 1 // 0, lambda: None)
    assert caller.call(lambda: 7, lambda: None) == 7


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


# -- The cell of a command: what is left when its recording ends early -----------------------------


@pytest.mark.parametrize(
    ("in_the_job", "at_the_end", "told"),
    [
        (None, [RecordingError], ""),
        (None, [ModelError], "ModelError"),
        (None, [ModelError, RecordingError], "RecordingError"),
        (RecordingError, [], "RecordingError"),
        (ModelError, [RecordingError], "ModelError"),  # the first error of a job ends it
        (PartInGrip, [], "PartInGrip"),
    ],
)
def test_a_job_ends_early_unless_its_recording_alone_fails_at_the_end(
    tmp_path, monkeypatch, in_the_job, at_the_end, told
) -> None:
    def fail(errors: list[type[Exception]]) -> None:
        if errors:
            try:
                fail(errors[:-1])
            finally:
                raise errors[-1](errors[-1].__name__)

    plugin = Mock(recording_path="r.mcap")
    plugin.close = lambda: fail(at_the_end)
    plugin.cell.health.return_value = {}
    plugin.cell.controller.hand.notes, plugin.cell.realtime = (), False
    plugin.cell.controller.zeroing.note = ""
    plugin.status.return_value = Mock(state="IDLE")
    monkeypatch.setattr(session, "TactileCellPlugin", lambda *_arguments, **_options: plugin)
    ended, file = "", tmp_path / "a cell.yaml"
    try:
        with running_cell(small_config(**REAL), "run", tmp_path, config_file=file, json_file=None):
            if in_the_job is not None:
                raise in_the_job(in_the_job.__name__)
    except CellError as error:
        ended, left, release = str(error).split("\n")
        kept = "nothing was moved" if in_the_job is PartInGrip else "the grip is kept"
        assert left == f"{kept}; recording so far: r.mcap"
        assert release.endswith(f"t: tactile-cell hand release --config '{file}' --confirm")
    assert ended == told
