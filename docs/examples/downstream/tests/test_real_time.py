"""The whole program in real time, against the station's cell simulated in another process."""

import os
import subprocess
import sys

import pytest

TACTILE_CELL = [sys.executable, "-P", "-c", "from cell.interfaces.cli import main; main()"]
UNHURRIED = {
    "gripper.loop_rate_hz": 100.0,
    "tactile.sync_period_ms": 40.0,
    "tactile.force_period_ms": 20,
    "gripper.force_stale_ms": 400.0,
    "gripper.watchdog_ms": 1000.0,
}
"""Simulator, program and test take turns on the processors of this machine."""


@pytest.fixture(autouse=True)
def free_machine():
    """Skip where other programs use up the processors: then no real time can be judged."""
    load, processors = os.getloadavg()[0], os.cpu_count() or 1
    if load > processors + 0.5:
        pytest.skip(f"load {load:.1f} on {processors} processors leaves no real time to test in")


def tactile_cell(*arguments):
    """Run the program; return it when it has ended."""
    command = [*TACTILE_CELL, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)


def test_the_system_check_finds_all_devices(cell_process):
    done = tactile_cell("doctor", "--config", cell_process(changes=UNHURRIED).config_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "fail" not in done.stdout


def test_a_part_is_grasped_over_the_ports_and_let_go(cell_process, tmp_path):
    cell = cell_process(changes=UNHURRIED)
    taught = tactile_cell(
        *("teach", "dowel", "-n", 1, "-o", tmp_path / "parts.npz"),
        *("--config", cell.config_path, "--out", tmp_path),
    )
    assert taught.returncode == 0, taught.stdout + taught.stderr
    assert (tmp_path / "parts.npz").stat().st_size > 0
    assert cell.ask(state=True)["placed"] == "dowel"
    assert cell.grip_n() == 0.0
