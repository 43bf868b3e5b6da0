"""Axes of a simulated cell in a process of its own: they bring the object, and stop at a fault."""

import contextlib
from math import radians

import pytest

from cell.config.file import changed_config, load_config, parse_config
from cell.runtime.goals import IdentifyGoal, TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JobFailed
from pytest_tactile_cell.process import CellProcess
from tests.faults.scenarios.axes import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.hil.program import first
from tests.waiting import LIMIT_S, until

pytestmark = pytest.mark.real_time

CONFIG = """
self_zero: on_demand
tactile: {tare_frames: 15, sync_period_ms: 50.0, force_period_ms: 10}
gripper: {loop_rate_hz: 100.0, approach_speed_mm_s: 20.0, force_stale_ms: 300.0}
sequence:
  x_mm: [0, 0]
  y_mm: [0, 0]
  force_n: [4, 4]
  max_grasps: 1
  ramp: {kind: linear, rate_n_s: 6.0, hold_s: 0.3}
"""
"""Half the rate: other tests may take turns on the same processors."""
LABELS = ("box", "cylinder")
X_MM, ROTATION_DEG, ROLL_DEG = -2.0, 20.0, 30.0
"""Pose of the identification."""
FAR_X_MM, FAR_DEG = 4.0, 95.0
"""Pose that is 4 s away for the drive along x and 7 s for the one that turns."""
AXES = (X_AXIS | {"velocity": 1.5}, ROTATION_AXIS | {"velocity": 10.0}, WRIST | {"velocity": 30.0})
SILENT = r"axis x \(drive 11\)"
"""How the error names a drive 1 that is silent."""
NEAR_M, NEAR_RAD = 1e-4, radians(1.5)
FIRST = {"x_mm": X_MM, "rotation_deg": ROTATION_DEG, "roll_deg": ROLL_DEG}
FAR = {"x_mm": FAR_X_MM, "rotation_deg": FAR_DEG, "roll_deg": FAR_DEG}


def poses(*listed: dict[str, float]) -> dict[str, object]:
    return {"sequence.kind": "list", "sequence.poses": list(listed)}


def positions(cell: CellProcess) -> dict[str, float]:
    """True position of each axis in m or rad."""
    return {name: axis["position"] for name, axis in cell.ask(state=True)["axes"].items()}


def test_axes_bring_the_object_and_stop_when_a_drive_is_silent(free_machine, tmp_path) -> None:
    base = changed_config(
        parse_config(CONFIG, source="tests"),
        CHANGES
        | poses(FIRST)
        | {
            "positioner": {"kind": "axes", "axes": list(AXES)},
            "gripper.aperture_open_mm": 20.0,
            "recording.directory": str(tmp_path / "out"),
        },
    )
    model = tmp_path / "model.npz"
    with TactileCellPlugin(base) as plugin:
        for label in LABELS:
            plugin.result(plugin.start(TeachGoal(label=label, grasps=6)), LIMIT_S)
        plugin.save(model)
    with contextlib.ExitStack() as undo:
        cell = CellProcess(base)
        undo.callback(cell.end)
        first(cell.pid)
        config = changed_config(load_config(cell.config_path), poses(FIRST, FAR))
        assert config.positioner.can.heartbeat_loss_ms == 400.0
        plugin = undo.enter_context(TactileCellPlugin(config, model=model))
        answer = plugin.result(plugin.start(IdentifyGoal(present=LABELS[0])), LIMIT_S)
        # Few grasps have taught it: the name may be UNKNOWN, the likeliest object not another one.
        assert max(LABELS, key=lambda label: answer.probabilities[label]) == LABELS[0]
        found = positions(cell)
        assert found["x"] == pytest.approx(1e-3 * X_MM, abs=NEAR_M)
        assert found["rotation"] == pytest.approx(radians(ROTATION_DEG), abs=NEAR_RAD)
        assert found["roll"] == pytest.approx(radians(ROLL_DEG), abs=NEAR_RAD)

        job = plugin.start(TeachGoal(label=LABELS[0], grasps=2))
        until(
            lambda: (
                plugin.feedback(job).outcome.terminal
                or positions(cell)["x"] > 1e-3 * X_MM + 2.0 * NEAR_M
            )
        )
        cell.ask(inject="axis1.silence")
        with pytest.raises(JobFailed, match=SILENT):
            plugin.result(job, LIMIT_S)
        assert plugin.status().state == "ABORTED"
        # The drive that is silent stops by itself when it misses its host.
        until(lambda: not any(a["moving"] for a in cell.ask(state=True)["axes"].values()))
        stopped = positions(cell)
        assert stopped["x"] < 1e-3 * FAR_X_MM - NEAR_M
        assert stopped["rotation"] < radians(FAR_DEG) - NEAR_RAD
