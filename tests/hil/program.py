"""The program in a process of its own, as users start it, with a config for a busy machine."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from tests.waiting import LIMIT_S

PROGRAM = (sys.executable, "-c", "from cell.interfaces.cli import main; main()")
CONFIG = """
self_zero: on_demand
tactile: {tare_frames: 15, sync_period_ms: 30.0, force_period_ms: 10}
gripper:
  {loop_rate_hz: 100.0, approach_speed_mm_s: 20.0, force_stale_ms: 300.0, watchdog_ms: 500.0}
simulator: {servos: {gearing: typical}}
"""
"""Half the rate and some patience: other tests may take turns on the same processor. Equal servos:
what is measured here are processes, not the force of a first grasp."""
SEQUENCE = "sequence: {x_mm: [0, 0], y_mm: [0, 0], force_n: [3, 5], max_grasps: 1}\n"


def first(pid: int) -> None:
    """Let a process go before others, where permitted: real hardware waits for nobody."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(40))


def child_of(pid: int) -> int:
    """Return the only child of a process; any of its threads may have started it."""
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    (children,) = (int(child) for one in threads for child in one.read_text("ascii").split())
    return children


def ended(pid: int) -> bool:
    """Whether a process has ended; its parent need not know."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def gone(pid: int) -> bool:
    """Whether a process is gone and was waited for."""
    return not Path(f"/proc/{pid}").exists()


def run(*arguments: object, code: int = 0) -> str:
    """Run the program to its end with an exit code; return on one line what was said."""
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*PROGRAM, *map(str, arguments)], text=True, **pipes) as process:
        try:
            with contextlib.suppress(PermissionError):  # it has deadlines of 3 ms
                os.setpriority(os.PRIO_PROCESS, process.pid, -10)
            out, err = process.communicate(timeout=LIMIT_S)
        finally:
            process.kill()
    assert process.returncode == code, err
    return " ".join(f"{out} {err}".split())
