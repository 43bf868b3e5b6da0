"""Bytes of both lines changed between two processes, and the simulator stopped or killed."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from cell.build import Cell, build_cell
from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.data.recording_reader import read_recording
from cell.errors import HandLost
from cell.pytest_plugin.process import CellProcess, CellProcessError
from gripper.errors import BusCorrupt, BusTimeout, GripperError, PortLost
from tactile.errors import BusDisturbed, BusOff, FrameTimeout, HeartbeatLost, TactileError
from tests.hil.damage import first, relay_on

pytestmark = pytest.mark.real_time

CONFIG = """
tactile: {tare_frames: 15, sync_period_ms: 30.0, force_period_ms: 10}
gripper: {loop_rate_hz: 100.0, approach_speed_mm_s: 20.0, bus_loss_ms: 500.0, watchdog_ms: 1000.0}
sequence:
  x_mm: [0, 0]
  y_mm: [0, 0]
  force_n: [3, 5]
  ramp: {kind: linear, rate_n_s: 2.0, hold_s: 3.0}
"""
STEP = GraspStep(pose=Pose(), force_n=4.0)
GRIPPED_N = 1.0
BOUND_S = 1.0
"""From the meddling to the product's answer; its limits are 90 ms for CAN, 500 ms for servos."""
KEYS = {"can": "tactile.channel", "servos": "gripper.port"}
LOST = (FrameTimeout, HeartbeatLost, BusDisturbed)


@pytest.fixture(scope="module")
def processes(free_machine: None) -> Iterator[list[CellProcess]]:
    """All simulated cells that were started, the last one perhaps still there."""
    started: list[CellProcess] = []
    yield started
    for process in started:
        process.end()


@pytest.fixture
def simulator(processes: list[CellProcess]) -> Iterator[CellProcess]:
    """One simulated cell for all tests, and a new one where the last was killed."""
    if not processes or not processes[-1].running:
        processes.append(CellProcess(parse_config(CONFIG, source="test")))
        first(processes[-1].pid)
    yield processes[-1]
    if processes[-1].running:
        let_go(processes[-1])


@dataclass
class Meddled:
    """What a grasp ended with, and when."""

    error: BaseException
    after_s: float
    cell: Cell


def config_on(simulator: CellProcess, line: str, port: str) -> CellConfig:
    return changed_config(load_config(simulator.config_path), {KEYS[line]: port})


@contextlib.contextmanager
def meddled(
    simulator: CellProcess, config: CellConfig, folder: Path, act: Callable[[], None]
) -> Iterator[Meddled]:
    """Grasp, and act once the part is gripped; the grasp must end with an error of the product."""
    acted_s: list[float] = []

    def wait_and_act() -> None:
        end_s = time.monotonic() + 10.0
        while time.monotonic() < end_s:
            with contextlib.suppress(CellProcessError):
                if simulator.grip_n() > GRIPPED_N:
                    act()
                    acted_s.append(time.monotonic())
                    return
            threading.Event().wait(0.02)

    cell = build_cell(config, folder=folder)
    try:
        cell.controller.start()
        cell.controller.present("box")
        helper = threading.Thread(target=wait_and_act)
        helper.start()
        with pytest.raises((GripperError, TactileError)) as caught:
            cell.controller.grasp(STEP, label="box")
        ended_s = time.monotonic()
        helper.join()
        assert acted_s, f"nothing was gripped: {caught.value}"
        yield Meddled(caught.value, ended_s - acted_s[0], cell)
    finally:
        with contextlib.suppress(HandLost, GripperError):
            cell.close()


def check_held(found: Meddled, folder: Path) -> None:
    """Latched and named, the part kept, the recording whole."""
    controller = found.cell.controller
    assert found.after_s < BOUND_S
    assert controller.state is CellState.ABORTED
    assert controller.holding
    assert controller.fault is not None
    assert type(found.error).__name__ in controller.fault
    with contextlib.suppress(HandLost, GripperError):
        found.cell.close()
    recording = read_recording(folder / "recording.mcap")
    assert recording.complete
    assert len(recording.frames) > 5
    assert any(event["kind"] == "fault" for event in recording.events)


def let_go(simulator: CellProcess) -> None:
    cell = build_cell(load_config(simulator.config_path))
    try:
        cell.controller.release_held()
    finally:
        cell.close()


@pytest.mark.parametrize(
    ("line", "order", "faults"),
    [
        ("can", "flip 1", LOST),
        ("can", "drop 1", LOST),
        ("can", "delay 0.3", LOST),
        ("can", "hang_up", (BusOff,)),
        ("servos", "flip 1", (BusCorrupt, BusTimeout)),
        ("servos", "hang_up", (PortLost, BusTimeout)),
    ],
)
def test_changed_bytes_of_a_line_end_in_a_fault_that_names_them(
    simulator: CellProcess,
    tmp_path: Path,
    line: str,
    order: str,
    faults: tuple[type[Exception], ...],
) -> None:
    port = simulator.can_channel if line == "can" else simulator.servo_port
    with relay_on(line, port) as relay:
        config = config_on(simulator, line, relay.port)
        with meddled(simulator, config, tmp_path, lambda: relay.order(order)) as found:
            assert isinstance(found.error, faults), found.error
            kept_n = simulator.grip_n()
            assert kept_n > 0.6 * GRIPPED_N
            threading.Event().wait(0.3)
            # Servos that nobody reaches keep the goal of the ramp, which the force still nears.
            most_n = kept_n + 0.4 if line == "can" else STEP.force_n
            assert kept_n - 0.4 < simulator.grip_n() < most_n
            check_held(found, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_simulator_that_is_stopped_or_killed_in_the_ramp_is_a_fault_with_the_grip_kept(
    simulator: CellProcess, tmp_path: Path, number: signal.Signals
) -> None:
    def stop() -> None:
        os.kill(simulator.pid, signal.SIGSTOP)

    act = simulator.kill if number is signal.SIGKILL else stop
    with meddled(simulator, load_config(simulator.config_path), tmp_path, act) as found:
        assert isinstance(found.error, (*LOST, BusOff, PortLost, BusTimeout)), found.error
        if number is signal.SIGSTOP:
            os.kill(simulator.pid, signal.SIGCONT)
            assert simulator.grip_n() > 0.6 * GRIPPED_N
        check_held(found, tmp_path)
