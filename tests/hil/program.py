"""The program in a process of its own, as users start it, with a config for a busy machine."""

import subprocess
import sys

LIMIT_S = 60.0
"""Patience in s with a program."""
PROGRAM = (sys.executable, "-c", "from cell.interfaces.cli import main; main()")
CONFIG = """
tactile: {tare_frames: 15, sync_period_ms: 30.0, force_period_ms: 10}
gripper:
  loop_rate_hz: 100.0
  approach_speed_mm_s: 20.0
  force_stale_ms: 300.0
  watchdog_ms: 500.0
"""
"""Half the rate and some patience: other tests may take turns on the same processor."""


def start(*arguments: object) -> subprocess.Popen[str]:
    """Start the program with its output in pipes."""
    return subprocess.Popen(
        [*PROGRAM, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Wait for a program; return its exit code and what it said, each on one line."""
    out, err = process.communicate(timeout=LIMIT_S)
    return process.returncode, " ".join(out.split()), " ".join(err.split())
