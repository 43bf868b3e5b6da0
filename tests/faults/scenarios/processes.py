"""Faults between processes: signals, and the end of a parent or host.

All but `signal_in_the_ramp` run the program and the simulated cell as processes, in real time.
"""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from cell.build import build_cell
from cell.config.file import load_config, parse_config
from cell.errors import CellError
from cell.interfaces.cli import main
from cell.interfaces.cli.session import running_cell
from cell.recording.reader import read_recording
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from pytest_tactile_cell.process import CellProcess
from tests.cell.conftest import once
from tests.faults.campaign import FaultRow, Observed, campaign_config
from tests.hil.program import CONFIG, SEQUENCE, first
from tests.waiting import LIMIT_S

_GRIPPED_N = 1.0
"""Force in N at which a part counts as gripped."""
_KEPT_N = 0.6
"""Force in N with which a part counts as still held."""
_INTERRUPTED = 1
"""Exit code after one signal or several, also where closing took too long and was cut off."""
_PROGRAM = (
    sys.executable,
    "-P",
    "-c",
    "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL);"
    f"from {main.__module__} import main; main()",
)
"""The program with its own answer to SIGHUP: it inherits that of these tests, which may ignore it,
as under nohup, and then outlives its parent on purpose."""
_MIDDLE = "import subprocess, sys; subprocess.Popen(sys.argv[1:], start_new_session=True).wait()"
_HOST = f"""
import sys
from {TactileCellPlugin.__module__} import TactileCellPlugin
plugin = TactileCellPlugin(sys.argv[1])
plugin.start(dict(task="teach", label="box", grasps=50))
sys.stdin.readline()
raise RuntimeError("the host's own error")
"""
"""A host program that ends by an error of its own while a job runs, and closes nothing. Its main
module, which stands without `if __name__ == "__main__"`, is not run in the process of the loop."""

# -- 33: signals -----------------------------------------------------------------------------


def signal_in_the_ramp(row: FaultRow) -> Observed:
    """Send this process the signal of the row while a command presses a part, in virtual time."""
    with tempfile.TemporaryDirectory() as name, _hangup_not_ignored():
        sent_s: list[float] = []
        try:
            config = campaign_config(row.changes)
            with running_cell(
                *(config, "run", Path(name)), config_file=None, json_file=None
            ) as cell:
                simulated = cell.plugin.cell.simulated
                heard = threading.Event()
                interrupt = cell.plugin.cell.controller.life.cancel

                def cancel(*reason: str) -> None:
                    interrupt(*reason)
                    heard.set()

                cell.plugin.cell.controller.life.cancel = cancel  # type: ignore[method-assign]

                def send() -> None:
                    os.kill(os.getpid(), signal.Signals[row.variant])
                    # The main thread takes the signal; virtual time waits for it.
                    heard.wait(10.0)

                sent_s = once(
                    simulated.clock,
                    lambda: min(simulated.world.contact_force_n()) > _GRIPPED_N,
                    send,
                )
                cell.run(TeachGoal(label="ball", grasps=1, train=False))
        except CellError as error:
            message = str(error).partition(" Recording so far")[0]
            recording = read_recording(next(Path(name).glob("*/recording.mcap")))
            held = [event for event in recording.events if event["kind"] == "held"]
            grip_n = min(simulated.world.contact_force_n())
            whole = recording.complete and held and grip_n > _KEPT_N
            return Observed(
                "HOLD" if whole else "LOST",
                held[0]["t_s"] - sent_s[0] if held else None,
                f"{message} ({grip_n:.1f} N); the recording is closed, exit code 1",
            )
    return Observed("NOTHING", None, "it went on")


@contextlib.contextmanager
def _hangup_not_ignored() -> Iterator[None]:
    """Take SIGHUP as a program in a terminal does, also where these tests ignore it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def second_signal(_row: FaultRow) -> Observed:
    with _gripping() as client:
        client.process.send_signal(signal.SIGINT)
        client.process.send_signal(signal.SIGTERM)
        began_s = time.monotonic()
        ended_s = _wait_for_end(client.pid)
        grip_n = _simulator().grip_n()
        code = client.process.wait()
        kept = grip_n > _KEPT_N and code == _INTERRUPTED
        return Observed(
            "HOLD" if kept else "LOST",
            ended_s - began_s,
            f"exit code {code}; the grip is kept ({grip_n:.1f} N)",
        )


def parent_dies(_row: FaultRow) -> Observed:
    with _gripping(middle=True) as client:
        client.process.kill()
        began_s = time.monotonic()
        _wait_for_end(client.pid)
        grip_n = _simulator().grip_n()
        (path,) = client.folder.glob("out/teach-*/recording.mcap")
        recording = read_recording(path)
        held = [event for event in recording.events if event["kind"] == "held"]
        whole = recording.complete and bool(held) and grip_n > _KEPT_N
        return Observed(
            "HOLD" if whole else "LOST",
            held[0]["t_s"] - began_s if held else None,
            f"the orphan stops its sequence and ends; the grip is kept ({grip_n:.1f} N), "
            "the recording is closed",
        )


def host_ends_by_an_error(_row: FaultRow) -> Observed:
    """End a host program; the process of its force loop is left, and ends by itself."""
    with _gripping(host=True) as client:
        loop = _child_of(client.pid)
        os.kill(loop, signal.SIGINT)  # the business of the program, as Ctrl-C goes to both
        threading.Event().wait(0.1)
        if not _alive(loop):
            return Observed("LOST", None, "the process of the force loop ends by SIGINT")
        client.process.stdin.close()
        began_s = _wait_for_end(client.pid)
        after_s = _wait_for_end(loop) - began_s
        grip_n = _simulator().grip_n()
        return Observed(
            "HOLD" if grip_n > _KEPT_N else "LOST",
            after_s,
            "nothing was closed; the process of the force loop freezes the goals and ends; the "
            f"grip is kept ({grip_n:.1f} N)",
        )


# -- The processes ---------------------------------------------------------------------------


@cache
def _simulator() -> CellProcess:
    """Return the simulated cell of all rows: its process ends with this one."""
    process = CellProcess(parse_config(CONFIG + SEQUENCE, source="campaign"))
    first(process.pid)
    atexit.register(process.end)
    return process


@dataclass(kw_only=True)
class _Client:
    """The program with a part in its grip, in a process and session of its own."""

    process: "subprocess.Popen[bytes]"
    """What was started: the program, or its parent."""
    pid: int
    """The program."""
    folder: Path
    """Where its recording is."""


@contextlib.contextmanager
def _gripping(*, middle: bool = False, host: bool = False) -> Iterator[_Client]:
    """Start a client that teaches, and wait until it presses; afterwards the part is let go.

    It is the program, below another process where ``middle``, or else a host program.
    """
    cell = _simulator()
    if cell.grip_n() > 0.0:
        raise CellError("the part of the row before is still gripped")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            *_PROGRAM,
            *("teach", "box", "-n", "50", "-c", str(cell.config_path)),
            *("-o", str(folder / "d.npz"), "--out", str(folder / "out")),
        ]
        if host:
            program = folder / "host.py"
            program.write_text(_HOST)
            command = [sys.executable, "-P", str(program), str(cell.config_path)]
        process = subprocess.Popen(
            [sys.executable, "-c", _MIDDLE, *command] if middle else command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        pid = process.pid
        try:
            cell.wait_for_grip(_GRIPPED_N, timeout_s=LIMIT_S)
            pid = _child_of(process.pid) if middle else process.pid
            yield _Client(process=process, pid=pid, folder=folder)
        finally:
            for group in {process.pid, pid}:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(group, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdin, process.stderr):
                if pipe is not None:
                    pipe.close()
            _let_go()


def _let_go() -> None:
    """Bring the cell back to open fingers, as an operator would."""
    with contextlib.closing(build_cell(load_config(_simulator().config_path))) as cell:
        cell.controller.release_held()


def _child_of(pid: int) -> int:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii")
    return int(text.split()[0])


def _wait_for_end(pid: int) -> float:
    """Wait until a process has ended and return the monotonic time of it in s."""
    end_s = time.monotonic() + LIMIT_S
    while _alive(pid):
        if time.monotonic() > end_s:
            raise CellError(f"process {pid} does not end")
        threading.Event().wait(0.005)
    return time.monotonic()


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
