"""Parts that a host has kept, through the plugin."""

from typing import Any

import pytest

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.positioner import Destination
from cell.errors import ConfigError
from cell.plugin.goals import GripGoal, IdentifyGoal, SortGoal
from cell.plugin.plugin import TactileCellPlugin
from cell.plugin.worker import JobFailed
from tests.cell.served import LIMIT_S, done, grip_n

HELD = ("COMPLETE", 17, False, True)


def standing(plugin: TactileCellPlugin) -> tuple[Any, ...]:
    status = plugin.status()
    return status.state, status.state_number, status.needs_reset, status.holding


@pytest.mark.slow
def test_a_part_is_gripped_without_a_name_and_survives_the_end_of_the_host(plugin) -> None:
    job = plugin.start({"task": "grip", "force_n": 3.0, "present": "box"})
    found = plugin.result(job, LIMIT_S)
    assert (found.held, found.same, found.reasons) == (True, True, ())
    assert found.force_n == pytest.approx(4.0, abs=0.7)
    assert found.opening_m == pytest.approx(9.0e-3, abs=0.5e-3)
    assert plugin.feedback(job).progress["held_with_n"] == 4.0
    plugin.cancel(job)  # changes nothing for a kept part
    plugin._cell.controller.life.cancel()
    plugin._cell.controller.life.tick()
    assert standing(plugin) == HELD
    plugin.close()
    assert grip_n(plugin) > 3.0


@pytest.mark.slow
def test_the_force_of_the_grasps_is_the_hosts(plugin: TactileCellPlugin) -> None:
    job = plugin.start(IdentifyGoal(present="box", force_n=3.5, seed=9))
    plugin.result(job, LIMIT_S)
    assert plugin.feedback(job).progress["force_n"] == 3.5
    with pytest.raises(ConfigError, match="force_n"):
        plugin.start({"task": "identify", "force_n": 0.0})
    with pytest.raises(JobFailed, match="the ramp asks for 50"):
        done(plugin, GripGoal(force_n=50.0))
    assert plugin.fault() is None


@pytest.mark.slow
def test_the_host_brings_named_parts_to_their_places(make_plugin: Any, taught: Any) -> None:
    brought: list[Destination] = []
    plugin = make_plugin(model=taught.result.model, places=brought.append)
    job = plugin.start(SortGoal(parts=3, feed=("ball", "box"), seed=10))
    answer = plugin.result(job, LIMIT_S)
    assert [(one.label, one.place) for one in brought] == [
        ("ball", "ball"),
        ("box", "box"),
        ("ball", "ball"),
    ]
    assert (answer.n_parts, answer.n_rejected, answer.n_missed) == (3, 0, 0)
    assert answer.places == {"ball": 2, "box": 1, "reject": 0}
    progress = plugin.feedback(job).progress
    assert (progress["task"], progress["parts"], progress["of"]) == ("sort", 3, 3)
    assert standing(plugin) == ("IDLE", 4, False, False)


@pytest.mark.slow
@pytest.mark.parametrize("aperture_open_mm", [10.4, 10.7])
def test_fingers_that_open_little_beyond_the_part_show_no_drift_of_the_zero(
    aperture_open_mm: float,
) -> None:
    config = changed_config(
        CellConfig(),
        {
            "self_zero": "on_demand",
            "gripper.aperture_open_mm": aperture_open_mm,
            "tactile.tare_frames": 15,
            "sequence.rotation_deg": [0.0, 0.0],
            "sequence.roll_deg": [0.0, 0.0],
        },
    )
    with TactileCellPlugin(config) as plugin:
        for _ in range(4):
            done(plugin, GripGoal(force_n=4.0, present="box"))
            plugin.release()
