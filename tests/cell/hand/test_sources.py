"""Other sensors than the control unit in whole cells, and the lines of a hand."""

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from cell.build import build_cell
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig
from cell.control.plan import Pose
from cell.errors import ConfigError
from cell.hand.connections import MISSING, HandConnections
from cell.hand.local import sensor_settings
from cell.recording.dataset import read_grasps
from gripper.errors import PortLost
from gripper.values.state import GripperPhase
from pytest_tactile_cell.configs import simulated_config
from pytest_tactile_cell.virtual import grasps_of
from tactile.errors import BusNotOpened
from tactile.sensor.settings import SensorSettings
from tests.faults.campaign import X_AXIS
from tests.marks import LONG

FLEXITAC, USKIN = (
    load_config(Path(__file__).parents[3] / "config" / f"{name}.yaml")
    for name in ("flexitac", "uskin")
)


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["12x32", *(LONG(name) for name in ("16x32", "16x16"))])
def test_a_cell_grasps_and_records_on_boards_of_each_profile(profile, tmp_path) -> None:
    config = changed_config(
        FLEXITAC,
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


@pytest.mark.long
def test_a_cell_on_boards_finds_its_self_zero_by_closing_empty_fingers() -> None:
    config = changed_config(FLEXITAC, {"self_zero": "always", "tactile.tare_frames": 30})
    cell = build_cell(config)
    with closing(cell):
        cell.controller.start()
        assert cell.controller.life.fault is None
        zero = cell.controller.zeros.newest
        assert abs(1e3 * zero.opening_m) < 0.5


REAL = {"gripper.port": "/dev/ttyUSB0", "positioner": {"kind": "operator"}}


TABLE = {"kind": "table", "force_n": [1.0, 2.0]}
REPEATED = [{"start": start, "taxels": [*range(start, start + 16)]} for start in (0x201, 0x210)]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tactile.layout": "paper"}, "layout paper does not fit two boards of 12 x 32"),
        ({"tactile.sensor.profile": "16x32"}, "two inner pads of 32 rows along the finger and 16"),
        ({"tactile.sensor.rows_along": True}, "two inner pads of 12 rows along the finger and 32"),
        (
            {"tactile.sensor.ports": ["/dev/a"] * 2} | REAL,
            r"ports\[0\] and tactile.sensor.ports\[1\] are /dev/a",
        ),
        ({"tactile.sensor.ports": ["/dev/a", "simulated"]}, "for each or for none"),
        ({"tactile.sensor.ports": ["/dev/a", "/dev/b"]}, "must all be `simulated` or all"),
        (
            REAL | {"tactile.sensor.ports": ["/dev/a", "/dev/ttyUSB0"]},
            r"tactile.sensor.ports\[1\] are /dev/ttyUSB0",
        ),
        ({"gripper.force_stale_ms": 20.0}, "the least is 25, 2.5 periods of the frames"),
        ({"tactile.calibration": TABLE | {"counts": [9.0, 5.0]}}, "rise from above 0, together"),
        ({"tactile.calibration": TABLE | {"counts": [9.0]}}, "1 counts and 2 values"),
    ],
)
def test_a_config_that_flexitac_boards_cannot_have_is_refused(changes, named) -> None:
    with pytest.raises(ConfigError, match=named):
        changed_config(FLEXITAC, changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tactile.layout": "flexitac_16x16"}, r"has pads of \[256, 256\] taxels"),
        ({"tactile.sensor.boards": REPEATED}, "repeat"),
    ],
)
def test_a_config_that_uskin_boards_cannot_have_is_refused(changes, named) -> None:
    with pytest.raises(ConfigError, match=named):
        changed_config(USKIN, changes)


def test_a_real_cell_on_boards_needs_no_can_channel() -> None:
    config: CellConfig = changed_config(
        FLEXITAC, REAL | {"tactile.sensor.ports": ["/dev/a", "/dev/b"]}
    )
    assert not config.simulated
    assert config.tactile.place == "/dev/a, /dev/b"
    assert simulated_config(config).tactile.serial_ports == ("simulated", "simulated")


@pytest.mark.slow
def test_each_approach_has_a_zero_of_its_own_while_z_drifts() -> None:
    config = changed_config(USKIN, {"tactile.tare_frames": 30})
    cell = build_cell(config)
    clock, world = cell.simulated.clock, cell.simulated.devices.world
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


DRIVES = {"kind": "axes", "can": {"interface": "socketcan", "channel": "can0"}, "axes": [X_AXIS]}
REAL_CAN = {
    "gripper.port": "/dev/ttyUSB0",
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "positioner": DRIVES,
    **{f"sequence.{key}": [0.0, 0.0] for key in ("y_mm", "rotation_deg", "roll_deg")},
}


def test_a_bus_that_is_shared_with_canopen_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"identifiers of CANopen .* bus without CANopen nodes"):
        changed_config(USKIN, REAL_CAN)
    apart = DRIVES | {"can": {"interface": "socketcan", "channel": "can1"}}
    assert not changed_config(USKIN, REAL_CAN | {"positioner": apart}).simulated


def test_friction_that_holds_a_force_is_no_frozen_sensor() -> None:
    usual = sensor_settings(TactileConfig(), CellConfig().friction_n)
    assert usual.force_step_n == SensorSettings().force_step_n
    # 3.6 N were seen where empty pads met.
    assert sensor_settings(TactileConfig(), 14.0).force_step_n > 4.0


class Line:
    """An end that counts how often it was closed; stands for a stream and for a bus."""

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1

    shutdown = close


class Openers:
    """Both openers, each of which can fail."""

    def __init__(self, *failing: str) -> None:
        self.failing = set(failing)
        self.made: list[Line] = []

    def servos(self) -> Any:
        return self._open("servos", PortLost("no port"))

    def can(self) -> Any:
        return self._open("can", BusNotOpened("no bus"))

    def _open(self, name: str, error: Exception) -> Line:
        if name in self.failing:
            raise error
        self.made.append(Line())
        return self.made[-1]


@pytest.mark.parametrize(("failing", "error"), [("servos", PortLost), ("can", BusNotOpened)])
def test_a_line_that_is_missing_is_refused_and_the_other_one_given_back(failing, error) -> None:
    openers = Openers(failing)
    with pytest.raises(error):
        HandConnections(openers.servos, openers.can)
    assert all(line.closed == 1 for line in openers.made)


def test_one_line_may_be_missing_where_that_is_allowed_but_not_both() -> None:
    openers = Openers("servos")
    lines = HandConnections(openers.servos, openers.can, partial=True)
    assert lines.notes == (f"{MISSING}no port",)
    for use in (lambda: lines.stream.write(b""), lambda: lines.stream.read(1, 0.0)):
        with pytest.raises(PortLost, match="no port"):
            use()
    openers.failing.clear()
    assert lines.reopen_servos() is openers.made[-1]
    assert (lines.notes, lines.servos_are_missing) == ((), False)

    openers = Openers("can")
    lines = HandConnections(openers.servos, openers.can, partial=True)
    assert lines.notes == (f"{MISSING}no bus",)
    with pytest.raises(BusNotOpened):
        lines.reopen_can()
    openers.failing.clear()
    assert lines.reopen_can() is openers.made[-1]
    assert lines.notes == ()
    lines.close()
    assert [line.closed for line in openers.made] == [1, 1]

    openers = Openers("servos", "can")
    with pytest.raises(PortLost, match="no port; no bus"):
        HandConnections(openers.servos, openers.can, partial=True)


def test_ends_of_somebody_else_are_not_closed() -> None:
    openers = Openers()
    stream, bus = openers.servos(), openers.can()
    lines = HandConnections(openers.servos, openers.can, stream=stream, can_bus=bus)
    assert (lines.stream, lines.can_bus) == (stream, bus)
    assert lines.reopen_servos() is not stream
    lines.close()
    assert [line.closed for line in openers.made] == [0, 0, 0]
