"""Faults of the process that commands a cell: signals, and its end by an error."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from cell.config.file import parse_config
from cell.errors import CellError
from cell.interfaces.cli.session import running_cell
from cell.recording.reader import read_recording
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from pytest_tactile_cell.process import CellProcess
from tests.cell.conftest import once
from tests.faults.campaign import FaultRow, Observed, campaign_config
from tests.hil.program import CONFIG, SEQUENCE, child_of, ended, first
from tests.waiting import LIMIT_S, until

_GRIPPED_N = 1.0
"""Force in N at which a part counts as gripped."""
_KEPT_N = 0.6
"""Force in N with which a part counts as still held."""
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


def host_ends_by_an_error(_row: FaultRow) -> Observed:
    """End a host program; the process of its force loop is left, and ends by itself.

    Host and simulated cell are processes, in real time.
    """
    with contextlib.ExitStack() as undo:
        cell = CellProcess(parse_config(CONFIG + SEQUENCE, source="campaign"))
        undo.callback(cell.end)
        first(cell.pid)
        program = Path(undo.enter_context(tempfile.TemporaryDirectory()), "host.py")
        program.write_text(_HOST)
        command = [sys.executable, "-P", str(program), str(cell.config_path)]
        pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        host = undo.enter_context(subprocess.Popen(command, **pipes))
        undo.callback(host.kill)
        cell.wait_for_grip(_GRIPPED_N, timeout_s=LIMIT_S)
        loop = child_of(host.pid)
        os.kill(loop, signal.SIGINT)  # the business of the program, as Ctrl-C goes to both
        threading.Event().wait(0.1)
        if ended(loop):
            return Observed("LOST", None, "the process of the force loop ends by SIGINT")
        host.communicate(timeout=LIMIT_S)
        began_s = time.monotonic()
        until(lambda: ended(loop))
        after_s, grip_n = time.monotonic() - began_s, cell.grip_n()
        return Observed(
            "HOLD" if grip_n > _KEPT_N else "LOST",
            after_s,
            "nothing was closed; the process of the force loop freezes the goals and ends; the "
            f"grip is kept ({grip_n:.1f} N)",
        )
