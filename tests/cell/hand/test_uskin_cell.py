"""A whole cell on two simulated uSkin boards: grasps, its zero before each, its own bus."""

from contextlib import closing
from pathlib import Path

import pytest

from cell.build import build_cell
from cell.config.file import changed_config, load_config
from cell.control.plan import Pose
from cell.errors import ConfigError
from gripper.values.state import GripperPhase

PRESET = load_config(Path(__file__).parents[3] / "config" / "uskin.yaml")


def test_each_approach_has_a_zero_of_its_own_while_z_drifts() -> None:
    config = changed_config(PRESET, {"tactile.tare_frames": 30})
    cell = build_cell(config)
    clock, world = cell.simulated.clock, cell.simulated.devices.physical
    with closing(cell):
        cell.controller.start()
        first = cell.controller.zeroing.taxels
        for _ in range(2):
            # 2,000 counts are 0.45 N on each taxel: no force could be measured by the first zero.
            day = cell.simulated.inject("uskin.drift=2000")
            for _ in range(10):
                clock.sleep(0.1)
                cell.controller.life.tick()
            day.clear()
            slow = cell.simulated.inject("uskin.drift=100")
            cell.controller.moves.present("box")
            cell.controller.grip(4.0, Pose())
            assert cell.controller.hand.phase is GripperPhase.HOLDING
            assert min(world.contact_force_n()) == pytest.approx(4.0, abs=0.6)
            cell.controller.release()
            slow.clear()
        zero = cell.controller.zeroing.taxels
        moved = zero.offset_counts - first.offset_counts
        assert moved.min() > 3500
        assert zero.n_frames == 20


DRIVES = {
    "kind": "axes",
    "can": {"interface": "socketcan", "channel": "can0"},
    "axes": [
        {"kind": "cia402", "moves": "x", "node_id": 11, "increments": 1000.0}
        | {"low": -10.0, "high": 10.0, "velocity": 20.0, "acceleration": 200.0}
        | {"homing": "none"}
    ],
}
REAL = {
    "gripper.port": "/dev/ttyUSB0",
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "sequence.x_mm": [-2.0, 2.0],
    "sequence.y_mm": [0.0, 0.0],
    "sequence.rotation_deg": [0.0, 0.0],
    "sequence.roll_deg": [0.0, 0.0],
    "positioner": DRIVES,
}


SHARED = [
    {"start": 0x201, "taxels": [*range(0x710, 0x720)]},
    {"start": 0x202, "taxels": [*range(0x71F, 0x72F)]},
]


def test_a_bus_that_is_shared_with_canopen_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"identifiers of CANopen .* bus without CANopen nodes"):
        changed_config(PRESET, REAL)
    apart = DRIVES | {"can": {"interface": "socketcan", "channel": "can1"}}
    assert not changed_config(PRESET, REAL | {"positioner": apart}).simulated


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tactile.layout": "flexitac_16x16"}, r"has pads of \[256, 256\] taxels, the boards have"),
        ({"tactile.sensor.boards": SHARED}, "identifiers of the boards repeat"),
        ({"gripper.force_stale_ms": 20.0}, "the least is 25, 2.5 periods of the frames"),
    ],
)
def test_a_config_that_boards_cannot_have_is_refused(changes, named) -> None:
    with pytest.raises(ConfigError, match=named):
        changed_config(PRESET, changes)
