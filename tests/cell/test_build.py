"""From a config to a cell: its devices, and what packages of others bring, under guard."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import nan
from pathlib import Path
from statistics import fmean
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from typer.testing import CliRunner

from cell import plugins
from cell.build import Cell, build_cell
from cell.config.file import changed_config, config_text, load_config, parse_config, schema_text
from cell.config.gripper import use_servo_models
from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig, layout_from_config, link_settings
from cell.control.plan import Pose
from cell.control.positioner import CallbackPositioner, OperatorPositioner, SimulatedPositioner
from cell.control.states import CellState
from cell.errors import CellError, ConfigError, PositionerError
from cell.files import PROGRAM
from cell.hand.connections import HandConnections
from cell.hand.local import LocalHand, sensor_settings
from cell.interfaces.cli.app import app
from cell.plugins import GROUPS, RECOGNIZERS, SENSORS, SERVO_MODELS
from cell.runtime import simulate
from cell.sensors.guard import GuardedSource
from cell.simulation import InProcessPlacer, simulator_settings
from gripper.dynamixel import models
from gripper.errors import ForceAboveCap, LimitExceeded, PortLost
from gripper.force.ramp import ForceRamp
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from pytest_tactile_cell.configs import simulated_config
from recognition.recognizers import RECOGNIZERS as BUILT_IN
from simulator.cell import SimulatedCell
from simulator.servo.gearing import data_sheet_drive
from simulator.settings import SimulatorSettings
from tactile.errors import (
    BusNotOpened,
    BusOff,
    FrameTimeout,
    LinkStateError,
    PluginFault,
    TactileError,
)
from tactile.layout import inner_pads, pinch_layout
from tactile.sensor.settings import SensorSettings
from tactile.source import (
    Arrivals,
    ForceMessage,
    FrameStatistics,
    PadZero,
    ScanStatus,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)
from tests import ROOT, blocks
from tests.cell.cells import call, quick_config, small_config
from tests.cell.commissioning.test_doctor import REAL
from tests.faults.campaign import CHANGES, X_AXIS
from tests.fuzz.harness import Clock
from tests.values import raising

RACK = {"kind": "rack_pinion", "pinion_radius_mm": 8.0, "offset_mm": 10.0}
SLOW_RACK = {"gripper__linkage": RACK, "gripper__approach_speed_mm_s": 5.0}


def positioner(bench: Any) -> Any:
    return bench.controller.moves.positioner


@pytest.mark.parametrize(
    "change",
    [
        {"gripper__servos": [{"id": 3}], **SLOW_RACK},
        # Friction of 11 N at each finger: no lower cap is sure to stop fingers that overcome it.
        SLOW_RACK | {"gripper__force_max_n": 25.0},
        {"gripper__servos": [{"id": 1, "direction": -1}, {"id": 2, "zero_pulse": 1800}]},
        {"tactile__node_id": 127, "tactile__serial_number": 4711},
        {"tactile__pad_gains": [1.25, 0.8]},
    ],
    ids=["one servo, rack", "two servos, rack", "mounts", "node", "gains"],
)
def test_cells_of_other_make_grasp_too(make_bench, change) -> None:
    bench = make_bench(quick_config(**change)).ready("box")
    record = bench.grasp(3.0)
    assert record.outcome.result is not GraspResult.NO_CONTACT
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=1.5)
    assert bench.grip_n == 0.0


@pytest.mark.parametrize(
    ("kind", "complaint", "given", "made"),
    [
        ("operator", "no terminal to ask at", {"ask": lambda _text: ""}, OperatorPositioner),
        ("callback", "must pass its mover", {"mover": lambda _pose: None}, CallbackPositioner),
    ],
)
def test_a_positioner_needs_who_moves(make_bench, kind, complaint, given, made) -> None:
    config = small_config(positioner__kind=kind)
    with pytest.raises(ConfigError, match=complaint):
        make_bench(config)
    assert isinstance(positioner(make_bench(config, **given)), made)


def test_a_socket_is_used_where_one_is_named(make_bench, tmp_path) -> None:
    made = positioner(make_bench(small_config(positioner__socket=str(tmp_path / "s"))))
    with pytest.raises(PositionerError, match="no simulated cell answers"):
        made.present("ball")


@pytest.mark.parametrize(
    ("change", "error", "name"),
    [
        ({}, BusNotOpened, "can-that-is-not-there"),
        ({"tactile__interface": "virtual"}, PortLost, "serial-that-is-not-there"),
    ],
)
def test_wrong_ports_are_named_and_nothing_stays_open(tmp_path, change, error, name) -> None:
    with pytest.raises(error, match=name):
        build_cell(small_config(**REAL | change, loop__own_process=False), folder=tmp_path, ask=str)
    assert list(tmp_path.iterdir()) == []


def paced(cell: Cell, real: Clock, real_s: float) -> None:
    """Let real time pass as the worker of a plugin does while no job runs."""
    for _ in range(round(real_s / 0.02)):
        real.now_s += 0.02
        cell.idle()


def test_a_paced_cell_lives_on_while_no_command_runs(make_bench) -> None:
    bench, real = make_bench().ready(), Clock()
    cell, clock = bench.cell, bench.simulated.clock
    began_s = clock.monotonic()
    cell.idle()
    cell.idle()
    assert clock.monotonic() - began_s < 0.02  # free: no time but that of the two looks
    assert cell.follow(real, 1.0) == 0.02
    began_s, real_s = clock.monotonic(), real.now_s
    cell.controller.grip(3.0, Pose())
    assert real.now_s - real_s == pytest.approx(clock.monotonic() - began_s, abs=0.02)
    began_s, ages_s = clock.monotonic(), []
    for _ in range(20):
        paced(cell, real, 0.06)
        ages_s.append(cell.controller.live.frame_age_s)
    assert clock.monotonic() - began_s == pytest.approx(1.2, abs=0.03)
    assert max(age_s for age_s in ages_s if age_s is not None) < 0.05
    assert None not in ages_s
    bench.inject("can.off")
    with pytest.raises(TactileError):
        paced(cell, real, 1.0)
    assert (cell.controller.life.state, bench.grip_n > 2.5) == (CellState.ABORTED, True)
    paced(cell, real, 0.2)
    real.now_s += 3600.0  # the machine was asleep: an hour is not caught up
    began_s = clock.monotonic()
    cell.idle()
    assert clock.monotonic() - began_s == pytest.approx(0.2, abs=0.03)
    assert cell.follow(real, 0.0) is None
    began_s = clock.monotonic()
    paced(cell, real, 0.5)
    assert clock.monotonic() - began_s < 0.1


# -- The simulated cell as the config describes it -------------------------------------------------


def test_servos_and_noise_are_as_the_config_says() -> None:
    keys = {"servos.gearing": "ideal", "servos.friction": [1.5, 1.0], "servos.kt": [0.8, 1.1]}
    keys |= {"noise_level": 0.5}
    changes = {"tactile.bitrate": 500_000} | {f"simulator.{key}": keys[key] for key in keys}
    settings = simulator_settings(changed_config(CellConfig(), changes))
    assert (settings.noise_level, settings.unit.bitrate) == (0.5, 500_000)
    with SimulatedCell(settings) as cell:
        first, second = cell.devices.mechanics.motors
    assert first.figures == data_sheet_drive(first.model)
    assert (first.friction_factor, second.friction_factor) == (1.5, 1.0)
    assert (first.kt_factor, second.kt_factor) == (0.8, 1.1)
    with SimulatedCell(simulator_settings(CellConfig())) as cell:
        drawn, other = cell.devices.mechanics.motors
    assert len({drawn.model.kt_nm_a, drawn.kt_nm_a, other.kt_nm_a}) == 3


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("simulator.objects", [{"label": "x", "shape": "blob"}], "simulator.objects: x: unkn"),
        ("simulator.objects", [{"label": "x", "shape": "mesh:file=none.stl"}], "objects: x: "),
        ("gripper.linkage", {"kind": "parallel_linkage", "offset_mm": -100.0}, "linkage"),
        ("simulator.faults", ["servo3.off"], "simulator: fault servo3.off: this cell has no"),
        (
            "tactile.calibration",
            {"counts": [1], "force_n": [0.05]},
            "is 1.2 N on a pad at rest under tactile.calibration, gripper.contact_force_n is 0.6 N",
        ),
    ],
)
def test_a_cell_that_cannot_be_is_a_config_error(key, value, complaint) -> None:
    with pytest.raises(ConfigError) as caught:
        simulator_settings(small_config(**{key: value}))
    assert complaint in str(caught.value)


def test_an_object_comes_to_rest_and_a_box_on_a_face() -> None:
    with SimulatedCell(simulator_settings(small_config())) as cell:
        placer = InProcessPlacer(cell)
        positioner = SimulatedPositioner(placer)
        with pytest.raises(PositionerError, match="no object was named"):
            positioner.move_to(Pose())
        for label in ("ball", "box"):
            positioner.present(label)
            positioner.present(None)  # the same one
            reached = positioner.move_to(Pose(x_m=1e-3, roll_rad=0.2))
            assert (cell.world.placed[0], reached.x_m) == (label, 1e-3)
        assert reached.roll_rad % (np.pi / 2) == pytest.approx(0.0, abs=1e-9)
        with pytest.raises(PositionerError, match="dice cannot be placed"):
            placer.place("dice", Pose())


# -- The simulated cell as a process: who may serve in a folder ------------------------------------


ANNOUNCED = {
    "servo_port": "servos",
    "can_interface": "slcan",
    "can_channel": "can",
    "axes_can_channel": "drives",
    "axes_ports": {"roll": "wrist"},
    "board_ports": ["board0", "board1"],
    "positioner_socket": "socket",
}
"""Ports of a simulated cell that is served."""


def test_a_folder_serves_one_simulated_cell_at_a_time(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "sim"
    served: list[Path] = []

    def serve_here() -> None:
        simulate.serve_simulated_cell(small_config(), folder=folder, announce=lambda _line: None)

    def serve(_settings: Any, announce: Any, *, folder: Path, **_options: Any) -> None:
        served.append(folder)
        announce(ANNOUNCED)
        if len(served) == 1:
            with pytest.raises(CellError, match="choose another folder with --out"):
                serve_here()

    monkeypatch.setattr(simulate, "serve", serve)
    serve_here()
    serve_here()
    assert served == [folder, folder]
    positioner = load_config(folder / "cell.yaml").positioner
    assert (positioner.kind, positioner.socket) == ("simulated", "socket")


def test_a_client_gets_the_axes_at_their_ports_and_more_patience(tmp_path, monkeypatch) -> None:
    config = changed_config(small_config(simulator__faults=["unit.stuck@9s"]), CHANGES)
    announced: list[dict[str, Any]] = []

    def serve(settings: SimulatorSettings, announce: Any, **_options: Any) -> None:
        assert list(settings.axes) == ["x", "rotation", "roll"]
        announce(ANNOUNCED)

    monkeypatch.setattr(simulate, "serve", serve)
    simulate.serve_simulated_cell(config, folder=tmp_path, announce=announced.append)
    client = load_config(Path(announced[0]["config"]))
    link = link_settings(client.tactile)
    assert (link.force_timeout_s, link.heartbeat_s) == (0.2, 0.4)
    positioner = client.positioner
    assert (positioner.kind, positioner.ports) == ("axes", ("slcan", "wrist"))
    assert (positioner.can.channel, positioner.socket) == ("drives", "socket")
    assert positioner.can.heartbeat_loss_ms == 400.0
    assert [axis.bus_loss_ms for axis in positioner.axes if axis.kind == "dynamixel"] == [400.0]
    assert client.brings_objects
    assert (client.gripper.port, client.simulator.faults, client.simulated) == ("servos", (), False)
    assert (client.tactile.interface, client.tactile.channel) == ("slcan", "can")
    assert client.tactile.tare_frames == config.tactile.tare_frames


def test_a_client_gets_the_boards_of_its_sensor_at_their_ports() -> None:
    config = simulate.client_config(load_config(ROOT / "config" / "flexitac.yaml"), ANNOUNCED)
    assert config.tactile.serial_ports == ("board0", "board1")
    assert not config.simulated


@pytest.mark.long
def test_a_person_without_hardware_moves_the_fingers_from_a_second_terminal(cell_process) -> None:
    cell = cell_process(small_config(gripper__aperture_open_mm=30.0))
    ask = ["simulate", "--out", str(Path(cell.positioner_socket).parent), "--ask"]
    for request, replied in (
        ("open finger 0", "finger 0 59.1 mm from the middle, finger 1 15.0 mm"),
        ("help", "disconnect servo N"),
        ("open finger 7", "`help` lists all commands"),
        ("press finger0.none", "there is no pad 'finger0.none'; there are finger0.inner"),
    ):
        ended = CliRunner().invoke(app, [*ask, request])
        assert replied in f"{ended.output} {ended.exception}"
    result = CliRunner().invoke(app, [*ask, "-"], input="dance\nclose\n")
    assert "'dance' is not a command" in result.stderr
    assert result.stdout.startswith("hands> hands> finger 0 0.0 mm from the middle")


# -- Other sensors than the control unit in whole cells, and the lines of a hand -------------------


FLEXITAC, USKIN = (load_config(ROOT / "config" / f"{name}.yaml") for name in ("flexitac", "uskin"))


OPERATED = {"gripper.port": "/dev/ttyUSB0", "positioner": {"kind": "operator"}}


TABLE = {"force_n": [1.0, 2.0]}
DRIVES = {"kind": "axes", "can": {"interface": "socketcan", "channel": "can0"}, "axes": [X_AXIS]}
REAL_CAN = {
    "gripper.port": "/dev/ttyUSB0",
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "positioner": DRIVES,
    **{f"sequence.{key}": [0.0, 0.0] for key in ("y_mm", "rotation_deg", "roll_deg")},
}


def on_ports(*ports: str) -> dict[str, Any]:
    return {"tactile.sensor.ports": [*ports]}


@pytest.mark.parametrize(
    ("boards", "changes", "named"),
    [
        (FLEXITAC, {"tactile.sensor.rows_along": True}, "pads of 12 rows along the finger and 32"),
        (
            *(FLEXITAC, on_ports("/dev/a", "/dev/a") | OPERATED),
            r"ports\[0\] and tactile.sensor.ports\[1\] are /dev/a",
        ),
        (FLEXITAC, on_ports("/dev/a", "simulated"), "for each or for none"),
        (FLEXITAC, on_ports("/dev/a", "/dev/b"), "must all be `simulated` or all"),
        (
            *(FLEXITAC, OPERATED | on_ports("/dev/a", "/dev/ttyUSB0")),
            r"tactile.sensor.ports\[1\] are /dev/ttyUSB0",
        ),
        (FLEXITAC, {"gripper.force_stale_ms": 20.0}, "the least is 25, 2.5 periods of the frames"),
        (FLEXITAC, {"tactile.calibration": TABLE | {"counts": [9.0, 5.0]}}, "above 0, together"),
        (FLEXITAC, {"tactile.calibration": TABLE | {"counts": [9.0]}}, "1 counts and 2 values"),
        (USKIN, {"tactile.layout": "flexitac_16x16"}, r"has pads of \[256, 256\] taxels"),
        (USKIN, REAL_CAN, r"identifiers of CANopen .* bus without CANopen nodes"),
    ],
)
def test_a_config_that_boards_cannot_have_is_refused(boards, changes, named) -> None:
    with pytest.raises(ConfigError, match=named):
        changed_config(boards, changes)


def test_boards_on_ports_and_on_a_bus_of_their_own_are_real_cells() -> None:
    apart = DRIVES | {"can": {"interface": "socketcan", "channel": "can1"}}
    assert not changed_config(USKIN, REAL_CAN | {"positioner": apart}).simulated
    config = changed_config(FLEXITAC, OPERATED | on_ports("/dev/a", "/dev/b"))
    assert not config.simulated
    assert config.tactile.place == "/dev/a, /dev/b"
    assert simulated_config(config).tactile.serial_ports == ("simulated", "simulated")


def test_each_approach_has_a_zero_of_its_own_while_z_drifts(make_bench) -> None:
    bench = make_bench(changed_config(USKIN, {"tactile.tare_frames": 30})).start()
    first = bench.controller.zeroing.taxels
    # 2,000 counts are 0.45 N on each taxel: no force could be measured by the first zero.
    day = bench.inject("uskin.drift=2000")
    for _ in range(10):
        bench.sleep(0.1)
        bench.life.tick()
    day.clear()
    day = bench.inject("uskin.drift=100")
    bench.controller.moves.present("box")
    bench.controller.grip(4.0, Pose())
    assert bench.controller.hand.phase is GripperPhase.HOLDING
    assert bench.grip_n == pytest.approx(4.0, abs=0.6)
    zero = bench.controller.zeroing.taxels
    assert (zero.offset_counts - first.offset_counts).min() > 1750
    assert zero.n_frames == 20
    bench.idle(3.0)
    assert bench.grip_n == pytest.approx(4.0, abs=0.9), "a drifting zero moves the fingers"
    day.clear()
    bench.inject("uskin.drift=1000")
    with pytest.raises(ForceAboveCap):
        bench.idle(10.0)
    bench.sleep(1.0)
    assert 3.0 < bench.grip_n < 5.0, "a false force lets the part go"


def test_friction_that_holds_a_force_is_no_frozen_sensor() -> None:
    usual = sensor_settings(TactileConfig(), CellConfig().friction_n)
    assert usual.force_step_n == SensorSettings().force_step_n
    # 3.6 N were seen where empty pads met.
    assert sensor_settings(TactileConfig(), 14.0).force_step_n > 4.0


NO_PORT, NO_BUS = PortLost("no port"), BusNotOpened("no bus")


@pytest.fixture
def openers() -> tuple[Mock, Mock]:
    """What opens the line of the servos, and the CAN bus."""
    return Mock(return_value=Mock(["close"])), Mock(return_value=Mock(["shutdown"]))


@pytest.mark.parametrize("error", [NO_PORT, NO_BUS], ids=str)
def test_a_line_that_is_missing_is_refused_and_the_other_one_given_back(openers, error) -> None:
    servos, can = openers
    (servos if error is NO_PORT else can).side_effect = error
    with pytest.raises(type(error)):
        HandConnections(servos, can)
    assert can.return_value.shutdown.call_count == servos.call_count == (error is NO_PORT)


def test_one_line_may_be_missing_where_that_is_allowed_but_not_both(openers) -> None:
    servos, can = openers
    servos.side_effect = NO_PORT
    lines = HandConnections(servos, can, partial=True)
    assert lines.missing == ("no port",)
    for use in (lambda: lines.stream.write(b""), lambda: lines.stream.read(1, 0.0)):
        with pytest.raises(PortLost, match="no port"):
            use()
    servos.side_effect = None
    assert lines.reopen_servos() is servos.return_value
    assert lines.missing == ()

    can.side_effect = NO_BUS
    lines = HandConnections(servos, can, partial=True)
    assert lines.missing == ("no bus",)
    with pytest.raises(BusNotOpened):
        lines.reopen_can()
    can.side_effect = None
    assert lines.reopen_can() is can.return_value
    assert lines.missing == ()
    lines.close()
    assert servos.return_value.close.call_count == can.return_value.shutdown.call_count == 1

    servos.side_effect, can.side_effect = NO_PORT, NO_BUS
    with pytest.raises(PortLost, match="no port; no bus"):
        HandConnections(servos, can, partial=True)


def test_a_clear_opens_a_port_that_turns_out_to_be_lost() -> None:
    hand = Mock()
    hand.gripper.clear_fault.side_effect = [PortLost("gone"), None]
    LocalHand.clear_fault(hand, reboot=False)
    hand.bus.port.use.assert_called_once_with(hand._lines.reopen_servos())


def test_a_start_opens_an_adapter_anew_that_was_exchanged_meanwhile() -> None:
    hand = Mock()
    hand.sensor.start.side_effect = [BusOff("gone"), "identity"]
    assert LocalHand.start_sensor(hand) == "identity"
    hand.stop_sensor.assert_called_once_with()


def test_ends_of_somebody_else_are_not_closed(openers) -> None:
    (servos, can), stream, bus = openers, Mock(), Mock()
    lines = HandConnections(servos, can, stream=stream, can_bus=bus)
    assert (lines.stream, lines.can_bus) == (stream, bus)
    assert lines.reopen_servos() is servos.return_value
    lines.close()
    for close in (stream.close, bus.shutdown, servos.return_value.close):
        close.assert_not_called()


# -- Plugins: what is built in, packages of others, names that clash, and modules that do not load -


Install = Callable[..., None]
MODULE = '''
from dataclasses import replace
from typing import Literal
from cell.config.sensor import SensorConfig
from gripper.dynamixel.models import XL330_M288

class Glove(SensorConfig):
    """A glove."""
    kind: Literal["glove"]
    fingers: int = 5

SERVO = replace(XL330_M288, name="XL330-M077", number=1190)
SAME = replace(XL330_M288, kt_nm_a=1.0)

def __getattr__(name):
    raise SystemExit("bye") if name == "EXITS" else AttributeError(name)
'''


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return what installs a package whose module is MODULE."""
    monkeypatch.syspath_prepend(str(tmp_path))
    known = dict(models._MODELS)

    def add(name: str = "some-plugins", **entries: dict[str, str]) -> None:
        module = name.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(MODULE)
        info = tmp_path / f"{module}-1.0.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0.0\n")
        lines = [
            line
            for group, points in entries.items()
            for line in (
                f"[tactile_cell.{group}]",
                *(f"{key} = {module}:{one}" for key, one in points.items()),
            )
        ]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        plugins._entries.cache_clear()

    yield add
    plugins._entries.cache_clear()
    models._MODELS.clear()
    models._MODELS.update(known)


def test_what_is_built_in_loads_and_no_table_beside_has_other_names() -> None:
    for group in GROUPS:
        examined = list(group.examine())
        assert examined
        for one in examined:
            assert (one.problem, one.package) == ("", PROGRAM)
            assert group.built_in(one.name)
    assert set(SERVO_MODELS) == set(models.MODELS)
    assert {name: RECOGNIZERS.entry(name).value for name in RECOGNIZERS} == BUILT_IN


def test_a_sensor_of_another_package_has_a_section_of_its_own(installed: Install) -> None:
    installed(sensors={"glove": "Glove"})
    text = "tactile:\n  sensor: {kind: glove, fingers: 4}\ngripper: {port: /dev/a}\n"
    config = parse_config(text + "positioner: {kind: operator}\n", source="cell.yaml")
    assert config.tactile.sensor.model_dump() == {"kind": "glove", "fingers": 4}
    assert parse_config(config_text(config), source="again") == config
    assert "fingers" in schema_text()
    with pytest.raises(ConfigError, match=r"cell.yaml:2:25: tactile.sensor.finger: .*mean fingers"):
        parse_config(text.replace("fingers", "finger"), source="cell.yaml")
    with pytest.raises(
        ConfigError, match=r"sensor glove cannot be simulated: set real ports in tactile\.sensor"
    ):
        config.tactile.sensor.simulated()


def test_an_unknown_kind_lists_what_is_installed_and_the_next_step() -> None:
    wanted = r"no sensor 'glove' is installed; installed are control_unit, flexitac, uskin. Install"
    with pytest.raises(ConfigError, match=wanted + ".*`tactile-cell doctor --plugins`"):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "glove"}})
    with pytest.raises(ConfigError, match="no servo model 'XM' is installed; installed are RH-P12"):
        changed_config(CellConfig(), {"gripper.servos": [{"id": 1, "model": "XM"}]})
    with pytest.raises(ConfigError, match="a section with kind, one of control_unit, flexitac"):
        changed_config(CellConfig(), {"tactile.sensor": {}})


def test_a_name_of_two_packages_is_refused(installed: Install) -> None:
    installed(sensors={"uskin": "Glove"})
    with pytest.raises(ConfigError, match=r"'uskin' is in .*some-plugins 1.0.0.*: uninstall one"):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "uskin"}})
    assert "uskin" not in SENSORS.usable()


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("Missing", "AttributeError"),
        ("EXITS", "SystemExit: bye"),
        ("SERVO", "TypeError: some_plugins:SERVO is not a SensorConfig"),
    ],
)
def test_what_does_not_load_is_named(
    installed: Install, tmp_path: Path, entry: str, problem: str
) -> None:
    installed(sensors={"broken": entry}, recognizers={"fine": "Glove", "gone": "Missing"})
    (config := tmp_path / "cell.yaml").write_text(
        "gripper: {port: simulated}\nrecognition: {recognizer: gone}\n"
    )
    with pytest.raises(
        ConfigError, match=r"cell.yaml: recognition.recognizer: .*'gone' .*does not load: "
    ):
        call("config", "check", config)
    with pytest.raises(CellError, match=r"2 of \d+ plugins do not load"):
        call("doctor", "--plugins")
    (one,) = (plugin for plugin in SENSORS.examine() if plugin.problem)
    assert (one.name, one.package) == ("broken", "some-plugins 1.0.0")
    assert problem in one.problem
    # What does not load is in the way of nothing else.
    assert "fine" in RECOGNIZERS
    assert CellConfig().tactile.sensor.kind == "control_unit"
    with pytest.raises(ConfigError, match=r"broken' of some-plugins 1.0.0 does not load: "):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "broken"}})


def test_doctor_lists_each_plugin_with_its_package(installed: Install) -> None:
    installed(sensors={"glove": "Glove"})
    lines = [line.split() for line in call("doctor", "--plugins").splitlines()]
    assert ["sensors", "glove", "some-plugins", "1.0.0", "loads"] in lines
    assert ["sensors", "uskin", *PROGRAM.split(), "loads"] in lines
    assert len(lines) == sum(len(list(group)) for group in GROUPS)


def test_a_servo_of_another_package_is_known_to_the_gripper(installed: Install) -> None:
    installed(servo_models={"XL330-M077": "SERVO", "XL330-again": "SAME"})
    changes = {"servos": [{"id": n, "model": "XL330-M077"} for n in (1, 2)], "current_max_a": 1.0}
    assert changed_config(CellConfig().gripper, changes).servos[0].model == "XL330-M077"
    assert models.model_name(1190) == "XL330-M077"
    with pytest.raises(LimitExceeded, match="XL330-M288 with number 1200 exists with other"):
        use_servo_models(["XL330-again"])


# -- The template package of docs/how-to/add.md; `.ci/wheel-test` types what that page prints ------


def test_the_layout_on_the_page_has_the_pads_of_the_sensor() -> None:
    (block,) = (
        one for one in blocks("how-to/add.md", "yaml") if one.startswith("tactile:\n  layout:")
    )
    here = block.replace("  sensor: {kind: dfrobot}\n", "")  # the package is not installed here
    layout = layout_from_config(parse_config(here, source="page").tactile)
    assert here != block
    assert layout.name == "dfrobot_6x6"
    assert layout.layout_hash == inner_pads("x", 6, 6, 3e-3, adc_max=4095).layout_hash


# -- Sensors of a cell: the guard of a source that another package brings, and the age of samples --


LAYOUT = pinch_layout()
N = LAYOUT.n_taxels
START_S, NOW_S = 10.0, 20.0
ZERO = PadZero(offset_counts=np.zeros(N), touch_counts=3.0, bad=np.zeros(N, dtype=bool))
FRAME = TactileFrame(t_s=15.0, begun_s=14.98, counter=1, status=0, counts=np.ones(N, dtype="u2"))
FORCE = ForceMessage(
    t_s=15.0, counter=1, status=ScanStatus.ZEROED, force_n=(1.0, 1.1), centre_taxels=(0.0, 0.5)
)


@pytest.fixture
def source() -> Mock:
    """A frame source whose methods do what the test wants."""
    return Mock(
        layout=LAYOUT,
        statistics=SourceStatistics(frames=FrameStatistics(complete=7)),
        start=Mock(return_value=SourceIdentity(name="fake")),
        poll=Mock(return_value=Arrivals((FRAME,), (FORCE,))),
    )


@pytest.fixture
def clock() -> Clock:
    clock = Clock()
    clock.now_s = START_S
    return clock


@pytest.fixture
def guard(source: Mock, clock: Clock) -> GuardedSource:
    """The guard of a source that has started."""
    guard = guarded(lambda: source, clock)
    assert guard.start().name == "fake"
    clock.now_s = NOW_S
    return guard


def guarded(make: Callable[[], Any], clock: Clock) -> GuardedSource:
    return GuardedSource(make, name="sensor fake of fake 1.0", layout=LAYOUT, clock=clock)


def frames(*times_s: float) -> Arrivals:
    return Arrivals(tuple(replace(FRAME, t_s=t_s, begun_s=None) for t_s in times_s))


def test_sound_values_come_through(guard: GuardedSource, source: Mock) -> None:
    arrivals = guard.poll()
    assert arrivals == Arrivals((FRAME,), (FORCE,))
    assert not arrivals.frames[0].counts.flags.writeable
    assert guard.statistics.frames.complete == 7
    source.poll = lambda: frames(15.1, 15.1, 15.2)
    assert len(guard.poll().frames) == 3
    source.poll = Arrivals
    assert guard.poll() == Arrivals()
    guard.set_zero(ZERO)
    source.set_zero.assert_called_once_with(ZERO)


def changed(**values: Any) -> Arrivals:
    return Arrivals((replace(FRAME, **values),))


def force(**values: Any) -> Arrivals:
    return Arrivals((), (replace(FORCE, **values),))


WIDE = np.full(N, 4096, dtype=np.uint16)


@pytest.mark.parametrize(
    ("then", "named"),
    [
        (lambda: 1 / 0, "ZeroDivisionError: division by zero. Update that package, or"),
        (lambda: exec("raise SystemExit(3)"), "SystemExit: 3"),
        (lambda: changed(counts=np.ones(3, np.uint16)), r"counts is uint16 \(3,\), must be uint16"),
        (lambda: changed(counts=np.ones(N)), r"counts is float64 \(156,\), must be uint16 \(156,"),
        (lambda: changed(counts=WIDE), "largest of counts is 4096, must be a number from 0 to 409"),
        (lambda: changed(extra=np.ones((3, 2), np.uint16)), r"extra is uint16 \(3, 2\), must be"),
        (lambda: changed(extra=np.ones(N, np.uint16).reshape(N, 1, 1)), r"extra is .* \(156, 1\)"),
        (lambda: changed(t_s=nan), "t_s of a frame is nan, must be a number from 10.0 to 20.0"),
        (lambda: changed(t_s=9.9), "t_s of a frame is 9.9, must be a number from 10.0 to 20.0"),
        (lambda: frames(15.2, 15.1), "t_s of a frame is 15.1, must be a number from 15.2 to 20.0"),
        (lambda: changed(begun_s=15.1), "begun_s is 15.1, must be a number from 14.0 to 15.0"),
        (lambda: changed(counter=65536), "counter of a frame is 65536, must be a number from 0 to"),
        (lambda: changed(status=None), "status of a frame is None, must"),
        (lambda: force(counter=16), "counter of a force message is 16, must be a number from 0 to"),
        (lambda: changed(counter=1.0), "counter of a frame is 1.0, must"),
        (lambda: force(status="x"), "status of a force message is 'x', must"),
        (lambda: force(centre_taxels=("a", 0.0)), "a value of a force message is 'a', must"),
        (lambda: force(force_n=(1.0, nan)), "a value of a force message is nan, must"),
        (lambda: force(force_n=(1e300, 1.0)), "a value of a force message is 1e.300, must"),
    ],
)  # fmt: skip
def test_what_it_must_not_do_is_a_fault_of_each_call_until_the_next_start(
    guard: GuardedSource, source: Mock, clock: Clock, then: Any, named: str
) -> None:
    sound, source.poll = source.poll, then
    with pytest.raises(PluginFault, match=f"the code of sensor fake of fake 1.0 failed: .*{named}"):
        guard.poll()
    source.poll = sound
    for use in (guard.poll, lambda: guard.set_zero(ZERO)):
        with pytest.raises(PluginFault, match=named):
            use()
    source.set_zero.assert_not_called()
    clock.now_s = START_S
    guard.start()
    clock.now_s = NOW_S
    assert guard.poll().frames


def test_a_time_that_does_not_advance_is_a_fault(guard: GuardedSource) -> None:
    assert guard.poll().frames
    with pytest.raises(PluginFault, match=r"t_s of a frame is 15.0, must be a number from 15\.0+2"):
        guard.poll()


def test_a_force_message_older_than_the_last_is_a_fault(guard: GuardedSource, source: Mock) -> None:
    source.poll = lambda: force(t_s=15.0)
    assert guard.poll().forces
    assert guard.poll().forces
    source.poll = lambda: force(t_s=14.9)
    with pytest.raises(PluginFault, match=r"t_s of a force message is 14\.9, must"):
        guard.poll()


@pytest.mark.parametrize(
    "statistics", [None, SourceStatistics(frames=FrameStatistics(), recent_loss_rate=nan)]
)
def test_wrong_statistics_are_a_fault(guard: GuardedSource, source: Mock, statistics: Any) -> None:
    source.statistics = statistics
    with pytest.raises(PluginFault, match="recent_loss_rate"):
        guard.poll()
    assert guard.statistics.recent_loss_rate == 0.0


def test_its_own_faults_stay_what_they_are(guard: GuardedSource, source: Mock) -> None:
    source.poll = raising(LinkStateError("start it first"))
    with pytest.raises(LinkStateError):
        guard.poll()
    source.poll = raising(FrameTimeout("silent"))
    for _ in range(2):
        with pytest.raises(FrameTimeout, match="silent"):
            guard.poll()
        source.poll = Arrivals


def test_creation_and_start_are_guarded(guard: GuardedSource, source: Mock, clock: Clock) -> None:
    with pytest.raises(PluginFault, match="ZeroDivisionError"):
        guarded(lambda: 1 / 0, clock)
    source.start = lambda: None
    with pytest.raises(PluginFault, match="start returned None, must be a SourceIdentity"):
        guard.start()


def test_a_stop_that_fails_hinders_no_clean_up(guard: GuardedSource, source: Mock) -> None:
    source.stop = Mock(side_effect=ZeroDivisionError)
    guard.stop()
    guard.start()
    assert source.stop.call_count == 2


# -- Age of force samples of frames and of messages, by the true force of the simulated world ------


CONFIGS = Path(__file__).parents[2] / "config"
WITHIN_S = 0.003
"""A ramp of 20 N/s changes the force by 0.06 N in this time. With FlexiTac frames that were 4 ms
older than their time one part in five got no name."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flexitac", "papers-ramp"])
def test_a_sample_is_as_old_as_it_says(make_bench, name: str) -> None:
    config = load_config(CONFIGS / f"{name}.yaml").model_copy(update={"self_zero": "on_demand"})
    bench = make_bench(config)
    clock, world, hand = bench.simulated.clock, bench.simulated.world, bench.controller.hand
    true, samples = list[tuple[float, float]](), dict[float, float]()
    clock.on_advance.append(lambda now_s: true.append((now_s, fmean(world.contact_force_n()))))

    def see(cycle, _frames) -> None:
        if cycle.setpoint_n > 0.0 and cycle.force is not None:
            samples[cycle.force.measured_s] = cycle.force.grip_n

    bench.controller.start()
    for _ in range(4):
        bench.simulated.place("ball")
        hand.grasp(ForceRamp.linear(6.0, 20.0), see)
        hand.release(see)
    t_s, force_n = np.array(true).T
    measured_s, measured_n = np.array(sorted(samples.items())).T
    ages_s = np.arange(-0.012, 0.0125, 0.0005)

    def misfit(age_s: float) -> float:
        expected_n = np.interp(measured_s - age_s, t_s, force_n)
        return float(np.polyfit(expected_n, measured_n, 1, full=True)[1][0])

    age_s = min(ages_s, key=misfit)
    assert abs(age_s) <= WITHIN_S
