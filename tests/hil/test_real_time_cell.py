"""The force loop and the program in processes of their own, over pseudo-terminals, in real time."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell.build import Cell, build_cell
from cell.config.file import load_config, parse_config
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.errors import CellStopped, HandLost
from cell.hand.client import HandProcess
from cell.recording.reader import read_recording
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from pytest_tactile_cell.process import CellProcess
from tests.hil.program import CONFIG, SEQUENCE, first, gone, run
from tests.waiting import until

pytestmark = pytest.mark.real_time

STEP = GraspStep(pose=Pose(), force_n=6.0)


@pytest.fixture(scope="module")
def simulator(free_machine: None) -> Iterator[CellProcess]:
    one = CellProcess(parse_config(CONFIG + SEQUENCE, source="test"))
    first(one.pid)
    yield one
    one.end()


@pytest.fixture
def make_cell(simulator: CellProcess, tmp_path: Path) -> Iterator[Callable[[], Cell]]:
    """Return the maker of a cell with its loop in a process; what it holds is let go at last."""
    cells: list[Cell] = []

    def make() -> Cell:
        folder = tmp_path / f"run{len(cells)}"
        folder.mkdir()
        cells.append(build_cell(load_config(simulator.config_path), folder=folder))
        return cells[-1]

    yield make
    for cell in cells:
        with contextlib.suppress(HandLost):
            cell.close()
    with contextlib.closing(HandProcess(load_config(simulator.config_path))) as hand:
        hand.start()
        if hand.phase is not GripperPhase.OFF:
            hand.release()
        hand.shutdown()


def test_a_job_a_stop_and_the_release(make_cell, simulator) -> None:
    cell = make_cell()
    controller, hand = cell.controller, cell.controller.hand
    assert isinstance(hand, HandProcess)
    pid = hand._loop.pid
    controller.start()
    controller.moves.present("box")
    record = controller.grasp(GraspStep(pose=Pose(), force_n=3.0), label="box")
    assert record.outcome.result is GraspResult.FORCE_REACHED
    assert record.grasp.n_frames > 20
    assert not record.grasp.counts.flags.writeable
    assert len(record.cycles) > 60

    told_s: list[float] = []

    def cancel() -> None:
        until(lambda: simulator.grip_n() > 2.4)
        told_s.append(time.monotonic())
        controller.life.cancel()

    thread = threading.Thread(target=cancel)
    thread.start()
    with pytest.raises(CellStopped, match="grip is kept"):
        controller.grasp(STEP)
    thread.join()
    assert time.monotonic() - told_s[0] < 0.2
    assert controller.life.state is CellState.HELD
    assert controller.life.holding
    # The program sleeps: the loop ticks by itself, beyond the servos' watchdog of 0.5 s.
    threading.Event().wait(0.8)
    controller.life.tick()
    assert simulator.grip_n() > 0.8
    controller.release()
    assert simulator.grip_n() == 0.0

    recording = cell.recording_path
    cell.close()
    assert gone(pid)
    loop = cell.health()["loop"]
    assert loop["cycles"] > 100
    late = loop["lateness"]
    assert 0.0 < late["p50_s"] <= late["p99_s"] <= late["max_s"]
    assert 5e-4 < loop["transaction"]["p50_s"] < 0.01
    assert 1e-3 < loop["sensor_age"]["max_s"] < 0.3
    assert loop["undelivered"] == 0
    stored = read_recording(recording)
    assert stored.complete
    assert (len(stored.grasps), len(stored.statistics)) == (1, 3)
    assert stored.statistics[-1]["cycles"] == loop["cycles"]


def test_a_loop_that_hangs_is_lost_and_sigterm_keeps_the_grip(make_cell, simulator) -> None:
    cell = make_cell()
    controller, hand = cell.controller, cell.controller.hand
    controller.start()
    controller.moves.present("box")
    controller.grip(5.0, Pose())
    os.kill(hand._loop.pid, signal.SIGTERM)
    with pytest.raises(HandLost, match=r"asked to end \(SIGTERM\); a held part stays held"):
        until(controller.life.tick)
    assert simulator.grip_n() > 0.8
    controller.life.clear()
    controller.life.reset()
    controller.release_held()

    hand._silence_s = 0.5
    os.kill(stopped := hand._loop.pid, signal.SIGSTOP)
    begin_s = time.monotonic()
    with pytest.raises(HandLost, match=r"has sent nothing for 0\.5 s"):
        hand.release()
    assert time.monotonic() - begin_s < 8.0
    assert gone(stopped)


# -- The program against a simulated cell of its own -----------------------------------------------


@pytest.mark.usefixtures("free_machine")
def test_a_part_is_let_go_without_the_can_adapter_and_found_without_that_of_the_servos(
    cell_process, tmp_path
) -> None:
    """The two lines one after the other: each is enough for what it carries."""
    held = SEQUENCE.replace("max_grasps: 1", "max_grasps: 1, ramp: {hold_s: 3.0}")
    new_cell = cell_process(parse_config(CONFIG + held, source="test"))
    first(new_cell.pid)
    config = ("--config", new_cell.config_path)
    release = f"tactile-cell hand release --config {new_cell.config_path} --confirm"
    unplugged = new_cell.inject("can.unplugged@contact+1.0s")
    files = ("-o", tmp_path / "d.npz", "--out", tmp_path / "out")
    said = run("teach", "box", "-n", 50, *files, *config, code=1)
    assert release in said
    assert "Force loop: " in said
    held_n = new_cell.grip_n()
    assert held_n > 0.5

    said = run("doctor", *config, code=1)
    assert "warn servo torque: servo 1 has its torque on; servo 2 has its torque on" in said
    assert f"a part may be in the grip: release it with `{release}`" in said
    assert "fail control unit: CAN interface" in said
    said = run("hand", "clear", *config)
    assert "NOTE: CAN interface" in said
    assert release in said

    unplugged.clear()
    new_cell.inject("servos.unplugged")
    said = run("doctor", *config, code=1)
    assert "fail servo torque: cannot open serial port" in said
    assert "it is unknown whether a part is held" in said
    assert "warn pads' force: about " in said
    assert "a part may be held" in said
    assert "cannot open serial port" in run("hand", "release", "--confirm", *config, code=1)
    assert new_cell.grip_n() == pytest.approx(held_n, abs=0.5)

    new_cell.ask(clear="servos.unplugged")
    new_cell.inject("can.unplugged")
    assert "the fingers are open" in run("hand", "release", "--confirm", *config)
    assert new_cell.grip_n() == 0.0
