"""The program against a simulated cell in another process: real time, pseudo-terminals."""

import contextlib
import signal
from collections.abc import Callable
from math import radians
from pathlib import Path
from typing import Any

import pytest

from cell.config.file import changed_config, load_config, parse_config
from cell.recording.reader import read_recording
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JobFailed
from gripper.errors import ServoFault
from pytest_tactile_cell.process import CellProcess
from tests.faults.campaign import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.hil.program import CONFIG, SEQUENCE, first, run
from tests.waiting import LIMIT_S, until

pytestmark = pytest.mark.real_time


@pytest.fixture
def simulator(free_machine: None, cell_process: Callable[..., CellProcess]) -> CellProcess:
    one = cell_process(parse_config(CONFIG + SEQUENCE, source="test"))
    first(one.pid)
    return one


def teaching(simulator: CellProcess, folder: Path) -> tuple[Any, ...]:
    """Return the command that teaches the box, with its files in a folder."""
    command = ("teach", "box", "-n", 50, "--config", simulator.config_path)
    return (*command, "-o", folder / "d.npz", "--out", folder / "out")


def test_ctrl_c_keeps_the_grip_and_the_recording_and_release_lets_go(simulator, tmp_path) -> None:
    def interrupt(client: Any) -> None:
        simulator.wait_for_grip(2.4)
        client.send_signal(signal.SIGINT)

    said = run(*teaching(simulator, tmp_path), code=1, meanwhile=interrupt)
    assert "the grip is kept until it is released on purpose. Recording so far: " in said
    assert "Traceback" not in said
    assert "Force loop: " in said
    (recording,) = (tmp_path / "out").glob("teach-*/recording.mcap")
    assert read_recording(recording).complete
    held_n = simulator.grip_n()
    assert held_n > 0.8

    said = run(*teaching(simulator, tmp_path), code=1)
    assert "a part may be in the grip; nothing was moved" in said
    assert "tactile-cell hand release" in said
    assert simulator.grip_n() == pytest.approx(held_n, abs=0.5)

    said = run("hand", "release", "--confirm", "--config", simulator.config_path)
    assert "the fingers are open" in said
    assert simulator.grip_n() == 0.0


def test_a_part_that_one_finger_holds_alone_is_let_go(simulator, tmp_path) -> None:
    config = ("--config", simulator.config_path)
    simulator.ask(inject="servo1.overload@contact+0.1s")
    said = run(*teaching(simulator, tmp_path), code=1)
    assert "Hardware Error Status 0x20: overload" in said
    assert "one of them silent or without torque; a part may still be gripped" in said
    assert "the grip is kept" not in said
    assert f"tactile-cell hand clear --config {simulator.config_path} --reboot" in said
    assert simulator.grip_n() > 0.5

    with TactileCellPlugin(simulator.config_path) as plugin:
        assert plugin.status().state == "ABORTED"
        assert "servo 1 has no torque (overload)" in str(plugin.status().fault)
        with pytest.raises(ServoFault, match="clear it with a reboot"):
            plugin.clear(LIMIT_S)
    assert simulator.grip_n() > 0.5

    said = run("doctor", *config, code=1)
    assert "fail servo torque: servo 1 has no torque (overload); servo 2 has its torque on" in said
    said = run("hand", "release", "--confirm", *config)
    assert "the finger of servo 2 is open, the other one was not moved: servo 1 has no" in said
    assert simulator.grip_n() < 0.2
    assert "after the reboot servo 1 has no torque" in run("hand", "clear", "--reboot", *config)
    run("doctor", *config)


def test_a_part_is_let_go_without_the_can_adapter_and_found_without_that_of_the_servos(
    simulator, tmp_path
) -> None:
    """The two lines one after the other: each is enough for what it carries."""
    config = ("--config", simulator.config_path)
    release = f"tactile-cell hand release --config {simulator.config_path} --confirm"
    unplugged = simulator.inject("can.unplugged@contact+0.3s")
    assert release in run(*teaching(simulator, tmp_path), code=1)
    held_n = simulator.grip_n()
    assert held_n > 0.5

    said = run("doctor", *config, code=1)
    assert "warn servo torque: servo 1 has its torque on; servo 2 has its torque on" in said
    assert f"a part may be in the grip: release it with `{release}`" in said
    assert "fail control unit: CAN interface" in said
    said = run("hand", "clear", *config)
    assert "NOTE: CAN interface" in said
    assert release in said

    unplugged.clear()
    simulator.inject("servos.unplugged")
    said = run("doctor", *config, code=1)
    assert "fail servo torque: cannot open serial port" in said
    assert "it is unknown whether a part is held" in said
    assert "warn pads' force: about " in said
    assert "a part may be held" in said
    assert "cannot open serial port" in run("hand", "release", "--confirm", *config, code=1)
    assert simulator.grip_n() == pytest.approx(held_n, abs=0.5)

    simulator.ask(clear="servos.unplugged")
    simulator.inject("can.unplugged")
    assert "the fingers are open" in run("hand", "release", "--confirm", *config)
    assert simulator.grip_n() == 0.0


# -- Axes of a simulated cell: they bring the object, and stop at a fault --------------------------


FIRST = {"x_mm": -2.0, "rotation_deg": 20.0, "roll_deg": 30.0}
FAR = {"x_mm": 4.0, "rotation_deg": 95.0, "roll_deg": 95.0}
"""Pose that is 4 s away for the drive along x and 7 s for the one that turns."""
AXES = (X_AXIS | {"velocity": 1.5}, ROTATION_AXIS | {"velocity": 10.0}, WRIST | {"velocity": 30.0})
NEAR_M, NEAR_RAD = 1e-4, radians(1.5)


def positions(cell: CellProcess) -> dict[str, float]:
    """True position of each axis in m or rad."""
    return {name: axis["position"] for name, axis in cell.ask(state=True)["axes"].items()}


def test_axes_bring_the_object_and_stop_when_a_drive_is_silent(free_machine) -> None:
    config = changed_config(
        parse_config(CONFIG, source="tests"),
        CHANGES
        | {
            "positioner": {"kind": "axes", "axes": list(AXES)},
            "gripper.aperture_open_mm": 20.0,
            "sequence.kind": "list",
            "sequence.poses": [FIRST, FAR],
        },
    )
    with contextlib.ExitStack() as undo:
        cell = CellProcess(config)
        undo.callback(cell.end)
        first(cell.pid)
        plugin = undo.enter_context(TactileCellPlugin(load_config(cell.config_path)))
        plugin.result(plugin.start(TeachGoal(label="box", grasps=1, train=False)), LIMIT_S)
        reached = positions(cell)
        assert reached["x"] == pytest.approx(1e-3 * FIRST["x_mm"], abs=NEAR_M)
        for part in ("rotation", "roll"):
            assert reached[part] == pytest.approx(radians(FIRST[f"{part}_deg"]), abs=NEAR_RAD)

        job = plugin.start(TeachGoal(label="box", grasps=2, train=False))
        until(
            lambda: (
                plugin.feedback(job).outcome.terminal
                or positions(cell)["x"] > reached["x"] + 2.0 * NEAR_M
            )
        )
        cell.ask(inject="axis1.silence")
        with pytest.raises(JobFailed, match=r"axis x \(drive 11\)"):
            plugin.result(job, LIMIT_S)
        assert plugin.status().state == "ABORTED"
        # The drive that is silent stops by itself when it misses its host.
        until(lambda: not any(a["moving"] for a in cell.ask(state=True)["axes"].values()))
        stopped = positions(cell)
        assert stopped["x"] < 1e-3 * FAR["x_mm"] - NEAR_M
        assert stopped["rotation"] < radians(FAR["rotation_deg"]) - NEAR_RAD
