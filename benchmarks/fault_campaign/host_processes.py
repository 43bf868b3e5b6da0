"""The program and the simulated cell as processes, for the rows in real time."""

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
from typing import Any

from benchmarks.fault_campaign.row import Observed
from benchmarks.fault_campaign.scenario import campaign_config
from cell.build import build_cell
from cell.config import CellConfig
from cell.config_file import load_config
from cell.errors import CellError
from cell.pytest_plugin.process import CellProcess
from cell.recording import read_recording
from gripper.errors import GripperError

LIMIT_S = 30.0
"""Patience of everything that is waited for in s."""
GRIPPED_N = 1.0
"""Force in N at which a part counts as gripped."""
KEPT_N = 0.6
"""Force in N with which a part counts as still held."""
_ATTEMPTS = 5
_PRIORITY = 60
"""Of the simulated cell: above the force loop, whose devices answer whatever the host does."""
_PROGRAM = (sys.executable, "-P", "-c", "from cell.cli import main; main()")
_MIDDLE = "import subprocess, sys; subprocess.Popen(sys.argv[1:], start_new_session=True).wait()"
_HOST = """
import sys
from cell.plugin import TactileCellPlugin
plugin = TactileCellPlugin(sys.argv[1])
plugin.start({"task": "teach", "label": "box", "grasps": 50})
sys.stdin.readline()
raise RuntimeError("the host's own error")
"""
"""A host program that ends by an error of its own while a job runs, and closes nothing."""


@cache
def simulator() -> CellProcess:
    """Return the simulated cell of all rows: its process ends with this one."""
    config = campaign_config(
        gripper__loop_rate_hz=100.0,
        gripper__approach_speed_mm_s=30.0,
        gripper__watchdog_ms=500.0,
        gripper__force_stale_ms=400.0,
        gripper__bus_loss_ms=500.0,
        tactile__sync_period_ms=50.0,
        sequence__x_mm=[0, 0],
        sequence__y_mm=[0, 0],
        sequence__force_n=[4, 5],
    )
    process = CellProcess(config)
    _hurry(process.pid)
    atexit.register(process.end)
    return process


def _hurry(pid: int) -> None:
    """Let all threads of a process go before others, where the machine permits it."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(_PRIORITY))


def client_config() -> CellConfig:
    return load_config(simulator().config_path)


def let_go() -> None:
    """Bring the cell back to open fingers, as an operator would; a busy machine may need more."""
    for attempt in range(_ATTEMPTS):
        cell = build_cell(client_config())
        try:
            cell.controller.release_held()
            return
        except GripperError:
            if attempt + 1 == _ATTEMPTS:
                raise
        finally:
            cell.close()


@dataclass(kw_only=True)
class Client:
    """The program with a part in its grip, in a process and session of its own.

    Attributes
    ----------
    process
        What was started: the program, or its parent.
    pid
        The program.
    folder
        Where its recording is.
    """

    process: "subprocess.Popen[bytes]"
    pid: int
    folder: Path

    def recording(self) -> Any:
        """Read what it recorded."""
        (path,) = self.folder.glob("out/teach-*/recording.mcap")
        return read_recording(path)


@contextlib.contextmanager
def gripping(*, middle: bool = False, host: bool = False) -> Iterator[Client]:
    """Start a client that teaches, and wait until it presses; afterwards the part is let go.

    It is the program, below another process where ``middle``, or else a host program.
    """
    cell = simulator()
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
            command = [sys.executable, "-P", "-c", _HOST, str(cell.config_path)]
        process = subprocess.Popen(
            [sys.executable, "-c", _MIDDLE, *command] if middle else command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        pid = process.pid
        try:
            _wait_for_grip(process)
            pid = child_of(process.pid) if middle else process.pid
            yield Client(process=process, pid=pid, folder=folder)
        finally:
            for group in {process.pid, pid}:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(group, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdin, process.stderr):
                if pipe is not None:
                    pipe.close()
            let_go()


def _wait_for_grip(process: "subprocess.Popen[bytes]") -> None:
    end_s = time.monotonic() + LIMIT_S
    while simulator().grip_n() < GRIPPED_N:
        if process.poll() is not None or time.monotonic() > end_s:
            process.kill()
            assert process.stderr is not None
            raise CellError(f"nothing was gripped: {process.stderr.read().decode()[-300:]}")
        threading.Event().wait(0.02)


def child_of(pid: int) -> int:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii")
    return int(text.split()[0])


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def wait_for_end(pid: int) -> float:
    """Wait until a process has ended and return the monotonic time of it in s."""
    end_s = time.monotonic() + LIMIT_S
    while _alive(pid):
        if time.monotonic() > end_s:
            raise CellError(f"process {pid} does not end")
        threading.Event().wait(0.005)
    return time.monotonic()


def held_by(client: Client, began_s: float, told: str) -> Observed:
    """Say whether a client has held: part gripped, recording closed, the reason in it."""
    grip_n = simulator().grip_n()
    recording = client.recording()
    held = [event for event in recording.events if event["kind"] == "held"]
    whole = recording.complete and bool(held) and grip_n > KEPT_N
    return Observed(
        reaction="HOLD" if whole else "LOST",
        detected_after_s=held[0]["t_s"] - began_s if held else None,
        outcome=f"{told}; the grip is kept ({grip_n:.1f} N), the recording is closed",
    )
