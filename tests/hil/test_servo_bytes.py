"""Bytes of the servo line changed between two processes: a result or a typed fault."""

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from cell.build import Cell, build_cell
from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.errors import HandLost
from cell.pytest_plugin.process import CellProcess
from gripper.errors import BusCorrupt, BusTimeout, GripperError, PortLost
from gripper.state import GraspResult, GripperPhase
from tests.hil.damage import first, relay_on

pytestmark = pytest.mark.real_time

CONFIG = """
tactile: {tare_frames: 15, sync_period_ms: 50.0, force_period_ms: 10}
gripper:
  loop_rate_hz: 100.0
  approach_speed_mm_s: 20.0
  bus_loss_ms: 500.0
  force_stale_ms: 500.0
  watchdog_ms: 1000.0
sequence: {x_mm: [0, 0], y_mm: [0, 0], force_n: [3, 5], max_grasps: 1}
"""
STEP = GraspStep(pose=Pose(), force_n=4.0)
PRECISION_N = 0.6
"""Force in N that bytes spoilt now and then may cost on a busy machine."""
SPOILT = ("flip 0.02", "drop 0.02", "repeat 0.05", "cut 0.02")


@dataclass
class Line:
    """A simulated cell, the relay on its servo line, and a config that goes by the relay."""

    simulator: CellProcess
    relay: Any
    config: CellConfig


@pytest.fixture
def line(
    cell_process: Callable[[CellConfig], CellProcess],
    free_machine: None,
) -> Iterator[Line]:
    simulator = cell_process(parse_config(CONFIG, source="test"))
    first(simulator.pid)
    with relay_on("servos", simulator.servo_port) as relay:
        config = load_config(simulator.config_path)
        yield Line(simulator, relay, changed_config(config, {"gripper.port": relay.port}))


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
            line.relay.order(spoilt)
            record = cell.controller.grasp(STEP, label="box")
            outcome = record.outcome
            if outcome.result is not GraspResult.FORCE_REACHED:
                # Spoilt bytes may cost precision, beside what a busy machine costs.
                assert outcome.result is GraspResult.FORCE_NOT_REACHED, spoilt
                assert abs(outcome.final_force_n - STEP.force_n) < PRECISION_N, spoilt
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
        line.relay.order("delay 0.0005")
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
        while line.simulator.grip_n() < 1.5 and time.monotonic() < end_s:
            threading.Event().wait(0.01)
        line.relay.order(order)

    threading.Thread(target=wait, daemon=True).start()


def check_fault(line: Line, cell: Cell) -> None:
    assert cell.controller.state is CellState.ABORTED
    assert cell.controller.hand.phase is GripperPhase.HELD_AFTER_FAULT
    threading.Event().wait(1.0)
    assert line.simulator.grip_n() > 0.5
