"""Axes of a simulated cell in a process of its own: they bring the object, and stop at a fault."""

import contextlib
from math import radians

import pytest

from cell.config.file import changed_config, load_config, parse_config
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JobFailed
from pytest_tactile_cell.process import CellProcess
from tests.faults.campaign import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.hil.program import CONFIG, first
from tests.waiting import LIMIT_S, until

pytestmark = pytest.mark.real_time

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
