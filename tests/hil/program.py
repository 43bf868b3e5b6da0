"""The program in a process of its own, as users start it, with a config for a busy machine."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.waiting import LIMIT_S, until

PROGRAM = (sys.executable, "-c", "from cell.interfaces.cli import main; main()")
CONFIG = """
self_zero: on_demand
tactile: {tare_frames: 15, sync_period_ms: 30.0, force_period_ms: 10}
gripper:
  loop_rate_hz: 100.0
  approach_speed_mm_s: 20.0
  force_stale_ms: 300.0
  watchdog_ms: 500.0
"""
"""Half the rate and some patience: other tests may take turns on the same processor."""
SEQUENCE = "sequence: {x_mm: [0, 0], y_mm: [0, 0], force_n: [3, 5], max_grasps: 1}\n"


def first(pid: int) -> None:
    """Let a process go before others, where permitted: real hardware waits for nobody."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(40))


def hurry(pid: int) -> None:
    """Let a process go before others, where the machine permits it: it has deadlines of 3 ms."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, -10)


def child_of(pid: int) -> int:
    """Return the only child of a process; any of its threads may have started it."""
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    (found,) = (int(child) for one in threads for child in one.read_text("ascii").split())
    return found


def ended(pid: int) -> bool:
    """Whether a process has ended; its parent need not know."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def done(cell: Any, lease: int, job: int) -> int:
    """Wait for a job over XML-RPC and return how it ended."""
    assert job > 0, job
    until(lambda: cell.alive(lease) or cell.job_state(job) >= 4)
    return cell.job_state(job)


def start(*arguments: object) -> subprocess.Popen[str]:
    """Start the program with its output in pipes."""
    process = subprocess.Popen(
        [*PROGRAM, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    hurry(process.pid)
    return process


@contextlib.contextmanager
def running(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Start the program and end it with the block, whatever happens."""
    process = start(*arguments)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def end(process: subprocess.Popen[str], code: int = 0) -> str:
    """Wait for the end with an exit code; return on one line what was said, errors at last."""
    out, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == code, err
    return " ".join(f"{out} {err}".split())


def run(*arguments: object, code: int = 0) -> str:
    """Run the program to its end; see `end`."""
    with running(*arguments) as process:
        return end(process, code)
