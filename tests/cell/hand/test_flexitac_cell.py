"""A whole cell on two simulated FlexiTac boards: grasps, faults, and what its config refuses."""

from contextlib import closing
from pathlib import Path

import pytest

from cell.build import build_cell
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.data.dataset import read_grasps
from cell.errors import ConfigError
from cell.jobs.collection import grasps_of
from pytest_tactile_cell.configs import simulated_config

PRESET = load_config(Path(__file__).parents[3] / "config" / "flexitac.yaml")


@pytest.mark.parametrize("profile", ["12x32", "16x32", "16x16"])
def test_a_cell_grasps_and_records_on_boards_of_each_profile(profile, tmp_path) -> None:
    config = changed_config(
        PRESET,
        {
            "tactile.sensor.profile": profile,
            "tactile.layout": f"flexitac_{profile}",
            "tactile.tare_frames": 30,
        },
    )
    cell = build_cell(config, folder=tmp_path)
    with closing(cell):
        cell.controller.start()
        (grasp,) = grasps_of(cell.controller, config.sequence, ["ball"], 1)
        assert grasp.force_n[-1] > 3.0
        health = cell.health()["tactile"]
        assert health["complete"] > 60
        assert (health["torn"], health["force_received"], health["void_frames"]) == (0, 0, 0)
    (kept,) = read_grasps(tmp_path / "recording.mcap")
    assert (kept.counts == grasp.counts).all()


def test_a_cell_on_boards_finds_its_self_zero_by_closing_empty_fingers() -> None:
    config = changed_config(PRESET, {"self_zero": "always", "tactile.tare_frames": 30})
    cell = build_cell(config)
    with closing(cell):
        cell.controller.start()
        assert cell.controller.life.fault is None
        zero = cell.controller.zeros.newest
        assert abs(1e3 * zero.opening_m) < 0.5


REAL = {"gripper.port": "/dev/ttyUSB0", "positioner": {"kind": "operator"}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tactile.layout": "paper"}, "layout paper does not fit two boards of 12 x 32"),
        ({"tactile.sensor.profile": "16x32"}, "two inner pads of 32 rows along the finger and 16"),
        ({"tactile.sensor.rows_along": True}, "two inner pads of 12 rows along the finger and 32"),
        ({"tactile.sensor.ports": ["/dev/a", "/dev/a"]}, "name different ports"),
        ({"tactile.sensor.ports": ["/dev/a", "simulated"]}, "name different ports"),
        ({"tactile.sensor.ports": ["/dev/a", "/dev/b"]}, "must both be `simulated` or both"),
        (REAL | {"tactile.sensor.ports": ["/dev/a", "/dev/ttyUSB0"]}, "need separate ports"),
        ({"gripper.force_stale_ms": 20.0}, "the least is 25, 2.5 periods of the frames"),
        (
            {"tactile.calibration": {"kind": "table", "counts": [9.0, 5.0], "force_n": [1.0, 2.0]}},
            "rise from above 0, together",
        ),
        (
            {"tactile.calibration": {"kind": "table", "counts": [9.0], "force_n": [1.0, 2.0]}},
            "1 counts and 2 values",
        ),
    ],
)
def test_a_config_that_boards_cannot_have_is_refused(changes, named) -> None:
    with pytest.raises(ConfigError, match=named):
        changed_config(PRESET, changes)


def test_a_real_cell_on_boards_needs_no_can_channel() -> None:
    config: CellConfig = changed_config(
        PRESET, REAL | {"tactile.sensor.ports": ["/dev/a", "/dev/b"]}
    )
    assert not config.simulated
    assert config.tactile.place == "/dev/a, /dev/b"
    assert simulated_config(config).tactile.serial_ports == ("simulated", "simulated")
