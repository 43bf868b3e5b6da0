"""Bytes of the servo line changed between two processes: a result or a typed fault."""

import contextlib
import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.build import Cell, build_cell
from cell.config import CellConfig
from cell.config_file import load_config
from cell.errors import HandLost
from cell.pose import Pose
from cell.sequence import GraspStep
from cell.states import CellState
from gripper.errors import BusCorrupt, BusTimeout, GripperError, PortLost
from gripper.gripper import GraspResult, GripperPhase

pytestmark = pytest.mark.hil

PROGRAM = [sys.executable, "-c", "from cell.cli import main; main()"]
RELAY = Path(__file__).parent / "servo_relay.py"
CONFIG = """
tactile: {tare_frames: 15, sync_period_ms: 50.0}
gripper:
  loop_rate_hz: 100.0
  approach_speed_mm_s: 20.0
  bus_loss_ms: 500.0
  force_stale_ms: 500.0
  watchdog_ms: 1000.0
sequence: {x_mm: [0, 0], y_mm: [0, 0], force_n: [3, 5], max_grasps: 1}
"""
STEP = GraspStep(pose=Pose(), force_n=4.0)
SPOILT = ("flip 0.02", "drop 0.02", "repeat 0.05", "cut 0.02")


def first(pid: int) -> None:
    """Let a process go before others, where permitted: real servos wait for nobody."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(40))


def started(*command: object) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [str(part) for part in command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    first(process.pid)
    return process


class Line:
    """A simulated cell, and the relay on its servo line; each in a process of its own."""

    def __init__(self, folder: Path) -> None:
        (folder / "sim.yaml").write_text(CONFIG)
        self.simulator = started(
            *(*PROGRAM, "simulate", "--config", folder / "sim.yaml", "--out", folder / "sim")
        )
        assert self.simulator.stdout is not None
        self.hello = json.loads(self.simulator.stdout.readline())
        self.relay = started(sys.executable, RELAY, self.hello["servo_port"], 7)
        config = load_config(Path(self.hello["config"]))
        gripper = config.gripper.model_copy(update={"port": self.said()})
        self.config: CellConfig = config.model_copy(update={"gripper": gripper})

    def said(self) -> str:
        assert self.relay.stdout is not None
        return self.relay.stdout.readline().strip()

    def order(self, text: str) -> None:
        assert self.relay.stdin is not None
        self.relay.stdin.write(text + "\n")
        if text != "hang_up":
            assert self.said() == "yes"
        else:
            self.relay.wait(5.0)

    def ask(self, **request: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(10.0)
            client.connect(self.hello["positioner_socket"])
            client.sendall(json.dumps(request).encode() + b"\n")
            with client.makefile("rb") as lines:
                reply: dict[str, Any] = json.loads(lines.readline())
        return reply

    def grip_n(self) -> float:
        return float(min(self.ask(state=True)["contact_force_n"]))

    def close(self) -> None:
        for process in (self.relay, self.simulator):
            if process.poll() is None:
                process.kill()
            process.communicate()


@pytest.fixture
def line(tmp_path: Path, free_machine: None) -> Iterator[Line]:
    with contextlib.closing(Line(tmp_path)) as one:
        yield one


@contextlib.contextmanager
def cell_on(line: Line) -> Iterator[Cell]:
    cell = build_cell(line.config)
    try:
        cell.controller.start()
        cell.controller.present("box")
        yield cell
    finally:
        with contextlib.suppress(HandLost, GripperError):
            cell.close()


def check_values(cycles: Any) -> None:
    """Every value that was used is one that a servo can have sent: none leaps, none is odd."""
    steps_m = [
        abs(after.state.aperture_m - before.state.aperture_m) / max(1e-3, after.t_s - before.t_s)
        for before, after in itertools.pairwise(cycles)
    ]
    assert max(steps_m) < 0.25
    for cycle in cycles:
        for servo in cycle.state.servos:
            assert 20.0 <= servo.temperature_c <= 45.0
            assert 11.0 <= servo.voltage_v <= 13.0
            assert abs(servo.current_a) < 1.0
            assert not servo.alert


def test_now_and_then_a_bad_byte_costs_nothing_and_all_bad_bytes_are_a_fault(line: Line) -> None:
    with cell_on(line) as cell:
        for spoilt in SPOILT:
            line.order(spoilt)
            record = cell.controller.grasp(STEP, label="box")
            assert record.outcome.result is GraspResult.FORCE_REACHED, spoilt
            check_values(record.cycles)
        bus = cell.controller.hand.statistics.servo_bus
        assert bus.retries > 0
        assert bus.corrupt + bus.timeouts > 0
        spoil_when_gripped(line, "flip 1.0")
        with pytest.raises((BusCorrupt, BusTimeout)):
            cell.controller.grasp(STEP, label="box")
        check_fault(line, cell)


def test_an_adapter_that_hangs_up_in_a_grasp_is_told_and_the_grip_kept(line: Line) -> None:
    with cell_on(line) as cell:
        line.order("delay 0.0005")
        assert cell.controller.grasp(STEP).outcome.result is GraspResult.FORCE_REACHED
        spoil_when_gripped(line, "hang_up")
        with pytest.raises((PortLost, BusTimeout)) as fault:
            cell.controller.grasp(STEP)
        assert "may still be gripped" in str(fault.value)
        check_fault(line, cell)


def spoil_when_gripped(line: Line, order: str) -> None:
    """Give the order from another thread as soon as the object is gripped with 1.5 N."""

    def wait() -> None:
        end_s = time.monotonic() + 20.0
        while line.grip_n() < 1.5 and time.monotonic() < end_s:
            threading.Event().wait(0.01)
        line.order(order)

    threading.Thread(target=wait, daemon=True).start()


def check_fault(line: Line, cell: Cell) -> None:
    assert cell.controller.state is CellState.ABORTED
    assert cell.controller.hand.phase is GripperPhase.HELD_AFTER_FAULT
    threading.Event().wait(1.0)
    assert line.grip_n() > 0.5
