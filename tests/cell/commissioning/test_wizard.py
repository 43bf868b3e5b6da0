"""The wizard: what each step finds, writes and refuses; nothing moves unseen; its engine."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from math import asin, radians, sin
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.commissioning.bench import Bench
from cell.commissioning.engine import (
    CONFIG_NAME,
    RECORD_NAME,
    RESUME,
    Dialog,
    Engine,
    Step,
    StepFailed,
    WizardAborted,
)
from cell.commissioning.findings import STORE_NAME, Finding, Notes, ProposedChange, Verdict
from cell.commissioning.fingers import FINGERS, KINDS, fit_linkages
from cell.commissioning.first_force import FIRST_FORCE
from cell.commissioning.pads import (
    LAW,
    PADS_AT_REST,
    PADS_PRESSED,
    fit_table,
    judge_law,
    judge_rest,
    table_parts,
)
from cell.commissioning.servos import SERVOS, backup_file, read_backup, restore
from cell.commissioning.unit import UNIT
from cell.commissioning.walk import all_steps
from cell.config.file import changed_config, config_text, load_config
from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig
from cell.control.zeroing import stored_zeros
from cell.errors import CellError, ConfigError
from cell.files import COMMISSIONING, SERVO_BACKUP, SERVO_BENCH, write_json
from cell.interfaces.cli.app import app
from cell.simulation import simulator_settings
from gripper.dynamixel.models import XM430_W350
from gripper.errors import GripperError, PortLost
from gripper.servos.goal_limits import GoalWriter
from gripper.settings import largest_setpoint_n
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.devices import SimulatedDrive
from simulator.servo.faults import WireFaults
from simulator.servo.mechanics import RackLinkage, ServoMount
from simulator.settings import SimulatedServoSettings
from simulator.world.pads import SensorLaw
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tactile.layout import PadMount, inner_pads, paper_layout, pinch_layout
from tactile.sensor.calibration import TableCalibration
from tactile.sensor.settings import SensorSettings
from tests.cell.commissioning.conftest import KNOWN, MakeStand, Stand
from tests.cell.commissioning.hands import Person, Script, SimulatedLines
from tests.marks import LONG
from tests.tactile.conftest import counts_of

PORT = "/dev/ttyUSB0"


@pytest.fixture
def new(make_stand: MakeStand) -> Stand:
    """A cell with two servos from the box: both have ID 1."""
    stand = make_stand("servo1.factory", "servo2.factory")
    stand.cell.clock.sleep(1.0)  # they have booted
    return stand


def eeproms(stand: Stand) -> list[bytes]:
    return [bytes(s.registers.data[:64]) for s in stand.cell.devices.servo_bus.servos]


def test_factory_new_servos_are_numbered_one_at_a_time(new, tmp_path) -> None:
    exchanged = {"servo_id": 1, "registers": {"model_number": 1020}}
    write_json(backup_file(tmp_path, 1), SERVO_BACKUP, exchanged, error=CellError)
    notes = new.passes(SERVOS)
    assert (tmp_path / "backup-servo1.1.json").exists()
    script = new.person.script
    assert script.asked == ["servos.connect_one", "servos.connect_next"]
    assert "servo 2: id was 1, is now 2" in notes.corrected
    assert "servo 1: baud_rate was 57600 bit/s, is now 1000000 bit/s" in notes.corrected
    assert len(notes.corrected) == 7  # operating_mode and return_delay_time of both
    # What the hands of the first run have set right stays on the list of a second one.
    assert new.passes(SERVOS).corrected == notes.corrected
    for name, values in {
        "id": [1, 2],
        "baud_rate": [3, 3],
        "operating_mode": [5, 5],
        "return_delay_time": [0, 0],
    }.items():
        assert new.registers(name) == values, name
    writes = {(w.what, w.before, w.after) for w in script.writes}
    assert ("id (7)", "1", "2") in writes
    assert ("baud_rate (8)", "57600 bit/s", "1000000 bit/s") in writes
    for number in (1, 2):
        backup = json.loads((tmp_path / f"backup-servo{number}.json").read_text())
        assert (backup["registers"]["id"], backup["registers"]["baud_rate"]) == (1, 1)
        assert backup["registers"]["return_delay_time"] == 250


@pytest.mark.parametrize("number", [1, 18, 39])
def test_one_answer_that_comes_twice_changes_no_backup(
    stand, tmp_path, monkeypatch, number
) -> None:
    once, answers = WireFaults.answer, count(1)

    def twice(self: WireFaults, *answer: Any) -> list[tuple[float, bytes]]:
        return once(self, *answer) + [(5e-4, answer[1])] * (next(answers) == number)

    monkeypatch.setattr(WireFaults, "answer", twice)
    stand.passes(SERVOS)
    kept = read_backup(backup_file(tmp_path, 1))
    assert (kept["return_delay_time"], kept["shutdown"]) == (0, XM430_W350.shutdown_raw)


@pytest.mark.parametrize(
    ("name", "values", "wanted", "text"),
    [
        # Servos that confirm no write, or not each.
        ("status_return_level", (0, 0), [2, 2], ("servo 2", "status_return_level (68)", "0", "2")),
        ("status_return_level", (1, 1), [2, 2], ("servo 1", "status_return_level (68)", "1", "2")),
        # The fastest baud rate.
        (
            *("baud_rate", (3, 7), [3, 3]),
            ("servo 2 at 4500000 bit/s", "baud_rate (8)", "4500000 bit/s", "1000000 bit/s"),
        ),
        ("homing_offset", (100, 0), [0, 0], ("servo 1", "homing_offset (20)", "100", "0")),
        ("drive_mode", (0, 1), [0, 0], ("servo 2", "drive_mode (10)", "1", "0")),
    ],
)
def test_wrong_registers_are_shown_set_and_read_back(stand, name, values, wanted, text) -> None:
    for servo, value in zip(stand.cell.devices.servo_bus.servos, values, strict=True):
        servo.registers.put(name, value)
    stand.passes(SERVOS)
    assert stand.registers(name) == wanted
    rows = [(w.where, w.what, w.before, w.after) for w in stand.person.script.writes]
    assert text in rows
    assert [what for _, what, *_ in rows].count(text[1]) == len(values) - values.count(wanted[0])


def test_a_later_run_keeps_the_bench_of_the_same_servo_and_a_smaller_opening(tmp_path) -> None:
    result = {"model": "XM430-W350", "values": {"rising_a_nm": 0.6}}
    write_json(file := tmp_path / "1.json", SERVO_BENCH, result, error=CellError)
    servos = [{"id": number, "measured": str(file)} for number in (1, 3)]
    edited = {"gripper.servos": servos, "gripper.aperture_open_mm": 12.0}
    bench = Bench(tmp_path, base=changed_config(CellConfig(), edited))
    bench.settings = dict(KNOWN)
    assert [servo.measured for servo in bench.gripper().servos] == [str(file), ""]
    assert bench.gripper().aperture_open_mm == 12.0  # of the widest one, 14 mm


def test_a_second_servo_that_is_not_there_after_all_is_not_waited_for(new) -> None:
    stand = new.run(SERVOS, servos__connect_next="none")
    assert [servo["id"] for servo in stand.settings["gripper.servos"]] == [1]


def test_restore_brings_back_all_but_the_address(new, tmp_path) -> None:
    before = eeproms(new)
    new.run(SERVOS)
    assert f"`tactile-cell commission {tmp_path} --restore`" in new.person.script.writes[-1].undo
    lines = restore(new.bench, script := Script(), PORT)
    assert f"`tactile-cell commission {tmp_path} --redo servos`" in script.writes[-1].undo
    assert [data[:7] + data[9:] for data in eeproms(new)] == [d[:7] + d[9:] for d in before]
    assert (new.registers("id"), new.registers("baud_rate")) == ([1, 2], [3, 3])
    assert len(lines) == 2
    writes = {(w.what, w.before, w.after) for w in script.writes}
    assert ("return_delay_time (9)", "0", "250") in writes
    # Restored servos are left alone, and are brought up again from there.
    assert restore(new.bench, Script(), PORT) == ("all servos are as they were found",)
    new.passes(SERVOS)
    with pytest.raises(CellError, match="no backup"):
        restore(Bench(tmp_path / "other", new.lines), Script(), PORT)


def test_nothing_is_restored_where_a_servo_is_not_there(new) -> None:
    new.passes(SERVOS)
    before = eeproms(new)
    new.person.does("disconnect servo 2")()
    with pytest.raises(GripperError, match="servo 2"):
        restore(new.bench, Script(), PORT)
    assert eeproms(new) == before


def test_no_line_is_opened_for_a_backup_of_another_servo(stand, tmp_path) -> None:
    for number in (1, 2):
        content = {"servo_id": 1, "registers": {"model_number": 1020, "homing_offset": 0}}
        write_json(backup_file(tmp_path, number), SERVO_BACKUP, content, error=CellError)
    with pytest.raises(CellError, match=r"backup-servo2\.json is of servo 1, nothing was written"):
        restore(stand.bench, Script(), PORT)
    assert stand.lines.opened == []


def test_torque_that_holds_a_part_is_not_switched_off_unasked(make_stand) -> None:
    stand = make_stand("servo1.wrong=homing_offset:100")
    for servo in stand.cell.devices.servo_bus.servos:
        servo.set_torque(on=True)
    with pytest.raises(WizardAborted):
        stand.run(SERVOS, leave_at=["approve"])
    assert "it may hold a part" in stand.person.script.said[-1]
    assert stand.torques == [1, 1]
    stand.run(SERVOS)
    assert stand.torques == [0, 0]


# -- First force of the wizard: empty, watchdog, 1 N, the cap; nothing moves before it was shown ---


@pytest.fixture
def quiet(make_stand: MakeStand) -> Stand:
    """A cell of less noise than usual."""
    return make_stand(noise_level=0.3)


def test_a_sound_cell_makes_its_first_grasp_once_a_block_was_taken_out(quiet) -> None:
    """Where empty pads meet, their load is spread: the messages leave out a part of it."""
    stand, bench = quiet, quiet.bench
    stand.run(FIRST_FORCE, first_force__empty=stand.person.does("block 12", "half"))
    bench.values["pads_law"] = {"factor": 1.0}  # the pads were checked with weights
    most_n = {"first_force__most": lambda: None}
    finding = stand.passes(FIRST_FORCE, "the pads show 0.00 and 0.00 N after a new zero", **most_n)
    most = next(q for q in stand.person.script.questions if q.key == "first_force.most")
    assert 4.0 < most.default < most.limits[1] <= largest_setpoint_n(15.0)
    (first, last) = finding.values["asked_held_peak_n"]
    assert first[:2] == pytest.approx([1.0, 1.0], abs=0.1)
    assert last == pytest.approx(3 * [most.default], rel=0.1)
    assert stand.torques == [0, 0]
    assert len(stand.person.script.writes) == 4
    assert abs(finding.values["meet_mm"]) < 1.0
    # What it measures of the servos is kept for the cell.
    folder = bench.folder / bench.config.recording.directory
    drives = stored_zeros(bench.config, folder, new_hand=False).stored_drives({1: 0, 2: 0})
    assert set(drives) == {1, 2}
    assert all(drive.measured and drive.load_sd < 0.1 for drive in drives.values())


@pytest.mark.parametrize("watchdog_ms", [LONG(100.0), 500.0])
def test_the_self_test_of_the_watchdog_closes_no_further_than_was_shown(quiet, watchdog_ms) -> None:
    quiet.knows(gripper__watchdog_ms=watchdog_ms)
    opened_m = []
    quiet.cell.clock.on_advance.append(
        lambda _: opened_m.append(quiet.cell.devices.mechanics.aperture_m)
    )
    with pytest.raises(WizardAborted):
        quiet.run(FIRST_FORCE, leave_at=["first_force.part"])
    announced = re.fullmatch(r"at most (\S+) mm less.*", quiet.person.script.writes[1].after)
    assert 0.0142 - min(opened_m) < 1e-3 * float(announced[1]) < 0.01


@pytest.mark.long
def test_a_person_who_leaves_with_the_part_held_finds_it_held_and_lets_go_next_time(quiet) -> None:
    with pytest.raises(WizardAborted, match=r"^left\. The fingers keep their grip: take hold"):
        quiet.run(FIRST_FORCE, leave_at=["first_force.release"])
    assert quiet.torques == [1, 1]
    assert min(quiet.cell.world.contact_force_n()) > 0.5
    quiet.passes(FIRST_FORCE)
    assert quiet.person.script.asked[0] == "fingers.held"


@pytest.mark.parametrize("error", [WizardAborted("left at the page"), KeyboardInterrupt()])
@pytest.mark.parametrize(
    ("asked", "look", "kept"),
    [
        ("first_force.empty", 1, False),
        ("first_force.empty", 3, True),
        ("first_force.part", 3, True),
    ],
    ids=["while they open", "in the self-test of the watchdog", "while they grasp"],
)
def test_a_person_stops_a_motion_while_it_runs(quiet, asked, look, kept, error) -> None:
    looks = 0

    def stop() -> None:
        nonlocal looks
        looks += quiet.person.script.asked[-1] == asked
        if looks == look:
            raise error

    left = str(error) or f"left. {RESUME}"
    says = rf"^{left}. The fingers keep their grip" if kept else str(error)
    with pytest.raises(WizardAborted if kept else type(error), match=says or None):
        quiet.run(FIRST_FORCE, moment=stop)
    stood_m = quiet.cell.devices.mechanics.aperture_m
    quiet.cell.clock.sleep(1.0)
    # Without torque fingers of little friction run on by a millimetre.
    assert quiet.cell.devices.mechanics.aperture_m == pytest.approx(stood_m, abs=1.5e-3)
    assert quiet.person.script.asked[-1] == asked
    # Fingers that close may touch a part: they stand where they are until a person lets it go.
    assert quiet.torques == [kept, kept]


def test_a_fault_while_the_part_is_held_says_so(quiet) -> None:
    quiet.ends(
        FAIL, FIRST_FORCE, "the adapter", "The fingers keep their grip: take hold of the part",
        first_force__release=lambda: quiet.cell.inject("can.unplugged"),
    )  # fmt: skip
    assert min(quiet.cell.world.contact_force_n()) > 0.5


def test_fingers_that_find_no_part_fail_the_step(quiet) -> None:
    named = "The fingers hold nothing (no_contact)"
    quiet.ends(FAIL, FIRST_FORCE, named, first_force__part=lambda: None)
    assert quiet.torques == [0, 0]


# -- What is wrong with a cell: the step that finds it names it, moves nothing, sets nothing -------


REST, FORCE = PADS_AT_REST, FIRST_FORCE
WARN, FAIL = Verdict.WARN, Verdict.FAIL


@pytest.mark.parametrize(
    ("step", "fault", "status", "named"),
    [
        (SERVOS, "servo2.supply=6", FAIL, "servo 2 has 6.0 V, a XM430-W350 takes 9.5 to 16.0 V"),
        (SERVOS, "servo2.wrong=model_number:1060", FAIL, "servo 2 is XL430-W250"),
        (SERVOS, "servo2.wrong=model_number:1200", FAIL, "need different supplies"),
        (SERVOS, "servo2.error=8", FAIL, "servo 2 reports"),
        (SERVOS, "servos.delayed=0.016", FAIL, "latency timer"),
        (SERVOS, "servos.off", FAIL, "no servo answers at any baud rate: check the supply"),
        (UNIT, "unit.second_node", FAIL, "more came from"),
        (UNIT, "unit.off", FAIL, "No CAN traffic and no reply on can0"),
        (UNIT, "unit.wrong=revision:0x00020001", FAIL, "not that of this software: major revision"),
        (UNIT, "unit.wrong=vendor:99", FAIL, "node 5 is another device: vendor 0x63"),
        (UNIT, "can.unplugged", FAIL, "adapter is unplugged"),
        (UNIT, "unit.heartbeat_off", FAIL, "did not become operational"),
        (UNIT, {"layout": inner_pads("odd", 5, 4, 3e-3)}, FAIL, "layout is unknown (hash "),
        (UNIT, {"unit": ControlUnitSettings(bitrate=125_000)}, FAIL, "too long for a grip"),
        (REST, "taxels.stuck_at=3:0", WARN, "1 taxel is dead: finger0.inner row 0 column 3"),
        (REST, "taxels.stuck_at=80-81:777", WARN, "2 taxels are stuck: finger1.inner row 0"),
        (REST, "taxels.saturated=0", FAIL, "100% of the taxels of pad finger0.inner are bad"),
        (REST, "taxels.offset=900", FAIL, "No zero can be taken"),
        (REST, "unit.stuck", FAIL, "The counts hardly change at rest"),
        (
            *(FORCE, "can.lose_next=6@contact, servos.loss=0.02", WARN),
            "The line of the pads loses messages; The servos' line loses answers",
        ),
        (FORCE, "servo1.watchdog_off", FAIL, "watchdog is not proven to stop the motors: servo 1"),
        (FORCE, "taxels.stuck_at=20-60:3000", FAIL, "taxels of pad finger0.inner are bad"),
        (FORCE, "servo2.turned", FAIL, "on its own side"),
    ],
)
def test_what_is_wrong_is_named(make_stand, step, fault, status, named) -> None:
    """The step moves and sets nothing; a fault may also be other hardware, or two faults."""
    hardware = fault if isinstance(fault, dict) else {}
    stand = make_stand(**({"noise_level": 0.3} if step is FORCE else hardware))
    stand.knows(gripper__pads_meet=step is not FORCE)  # the last and longest of its motions
    for one in [] if hardware else fault.split(", "):
        stand.cell.inject(one)
    finding = stand.ends(status, step, *named.split("; "))
    assert stand.torques == [0, 0]
    assert status is WARN or not finding.settings


@pytest.mark.parametrize(
    ("step", "faults"), [(SERVOS, ["servo1.factory"]), (FINGERS, []), (UNIT, []), (FORCE, [])]
)
def test_nothing_is_written_or_moved_that_is_refused(make_stand, step, faults, tmp_path) -> None:
    stand = make_stand(*faults)
    stand.cell.clock.sleep(1.0)  # the servos have booted

    def state() -> Any:
        eeproms = [bytes(s.registers.data[:64]) for s in stand.cell.devices.servo_bus.servos]
        unit = stand.cell.unit.number(0x1017)
        return eeproms, unit, stand.torques, stand.cell.devices.mechanics.aperture_m

    before = state()
    with pytest.raises(WizardAborted):
        stand.run(step, leave_at=["approve"])
    *same, aperture_m = state()
    assert (*same,) == before[:-1]
    assert step is FINGERS or aperture_m == before[-1]  # those are moved by hand
    assert not list(tmp_path.glob("backup*"))


# -- The control unit: what is found on a bus ------------------------------------------------------


def test_a_unit_is_found_and_set_up_and_named(make_stand: MakeStand) -> None:
    stand = make_stand(unit=ControlUnitSettings(node_id=17, serial_number=4711))
    finding, script = stand.passes(UNIT), stand.person.script
    assert finding.settings == {
        "tactile.interface": "socketcan",
        "tactile.channel": "can0",
        "tactile.bitrate": 1_000_000,
        "tactile.node_id": 17,
        "tactile.serial_number": 4711,
        "tactile.layout": "pinch",
        "tactile.board_serial_numbers": None,
        "tactile.mounting": [],
    }
    assert not script.asked
    assert [write.where for write in script.writes] == ["control unit, node 17"] * 6
    assert "13 x 6" not in script.text
    assert "force messages" in finding.lines[-1]


def test_a_unit_that_has_a_heartbeat_is_found_by_listening_alone(stand) -> None:
    stand.cell.clock.sleep(0.1)  # it has booted
    first, second = (stand.run(UNIT) for _ in range(2))
    assert "found by asking each node-ID" in first.lines[0]
    assert "found by listening" in second.lines[0]


@pytest.mark.parametrize("bitrate", [500_000, 250_000])
def test_another_bit_rate_is_found_and_the_period_fits_it(make_stand, bitrate) -> None:
    finding = make_stand(unit=ControlUnitSettings(bitrate=bitrate)).passes(UNIT)
    assert finding.settings["tactile.bitrate"] == bitrate
    assert f"{bitrate:,} bit/s" in finding.lines[0]
    assert ("tactile.sync_period_ms" in finding.settings) == (bitrate == 250_000)


def test_an_adapter_without_some_bit_rate_is_asked_for_the_others(make_stand: MakeStand) -> None:
    stand = make_stand(unit=ControlUnitSettings(bitrate=500_000))
    opened, rates = stand.lines.open_can, [500_000]

    def open_can(interface: str, channel: str, bitrate: int) -> CanBus:
        if bitrate not in rates:
            raise BusNotOpened(f"invalid bit rate {bitrate}")
        return opened(interface, channel, bitrate)

    stand.lines.open_can = open_can
    assert stand.run(UNIT).settings["tactile.bitrate"] == 500_000
    rates.clear()
    assert stand.run(UNIT).lines == ["invalid bit rate 1000000"]


def test_a_drive_on_the_same_bus_is_not_taken_for_the_unit(stand) -> None:
    mount = DriveMount(node_id=3, increments=1e6, start=0.0, low_switch=-0.1, high_switch=0.1)
    stand.cell.devices.can.add(SimulatedDrive(mount))
    finding = stand.passes(UNIT, "Beside it, node 3 is another device")
    assert finding.settings["tactile.node_id"] == 5


def test_the_interface_is_asked_for_only_where_there_are_several(stand) -> None:
    stand.bench.settings = {"gripper.port": "/dev/ttyUSB0"}
    stand.lines.ports += ("/dev/ttyACM0", "/dev/ttyACM1")
    finding = stand.run(UNIT, unit__interface="slcan /dev/ttyACM1")
    assert finding.settings["tactile.channel"] == "/dev/ttyACM1"
    stand.lines.ports = stand.lines.ports[:1]
    stand.ends(FAIL, UNIT, "No CAN interface was found")


def test_the_interfaces_of_the_system_have_the_bit_rate_that_is_set(stand, monkeypatch) -> None:
    kind = {"info_kind": "can", "info_data": {"bittiming": {"bitrate": 500_000}}}
    links = [{}, {"ifname": "lo", "link_type": "loopback"}]
    links.append({"ifname": "can7", "link_type": "can", "linkinfo": kind})
    shown = SimpleNamespace(stdout=json.dumps(links))
    monkeypatch.setattr("cell.commissioning.unit.subprocess.run", lambda *_command, **_how: shown)
    stand.bench.settings = {"gripper.port": "/dev/ttyUSB0"}
    (why,) = stand.run(UNIT).lines
    assert "No CAN traffic and no reply on can7 (socketcan) at 500,000 bit/s" in why
    assert "set the rate of the unit with `ip link set can7`" in why


# -- Fingers of badly mounted servos: linkage, directions and zeros by hand, the first motion ------


BLOCKS_M = (0.010, 0.030)


def on_parallel(size_m: float, link_m: float, closed_rad: float = 0.0) -> float:
    """Return the angle of links on a block."""
    return asin(size_m / 2 / link_m + sin(closed_rad)) - closed_rad


PARALLEL = [on_parallel(m, 0.03) for m in BLOCKS_M]
ASKEW = [on_parallel(m, 0.04, radians(35)) for m in BLOCKS_M]


@pytest.mark.parametrize(
    ("angles_rad", "sizes_m", "best"),
    [
        (PARALLEL, BLOCKS_M, "parallel"),
        ([m / 2 / 0.01 for m in BLOCKS_M], BLOCKS_M, "pinion"),
        (ASKEW, BLOCKS_M, "swinging"),
        # Long links hardly turn, and one block fits every kind: the person decides.
        ([on_parallel(m, 0.06) for m in BLOCKS_M], BLOCKS_M, None),
        (PARALLEL[1:], BLOCKS_M[1:], None),
    ],
)
def test_each_kind_of_linkage_is_found_where_the_measurements_tell_them_apart(
    angles_rad, sizes_m, best
) -> None:
    fits, kind = fit_linkages([[angle, angle] for angle in angles_rad], sizes_m)
    assert kind == best
    assert list(fits) == [*KINDS][: 1 + len(sizes_m)]
    fit = fits[best or "parallel"]
    assert fit.linkage.aperture_m([fit.closed_rad] * 2) == pytest.approx(0.0, abs=1e-6)
    on_block_rad = fit.closed_rad + angles_rad[0]
    assert fit.linkage.aperture_m([on_block_rad] * 2) == pytest.approx(sizes_m[0], abs=1e-6)


def with_servos_set_up(make_stand: MakeStand, *faults: str) -> Stand:
    stand = make_stand(*faults, aperture_m=0.03)
    for servo in stand.cell.devices.servo_bus.servos:
        servo.registers.put("operating_mode", 5)
    return stand


@pytest.fixture
def ready(make_stand: MakeStand) -> Stand:
    return with_servos_set_up(make_stand)


def test_one_servo_with_a_pinion(make_stand) -> None:
    stand = make_stand(
        servos=(SimulatedServoSettings(servo_id=1, mount=ServoMount(direction=-1)),),
        linkage=RackLinkage(pinion_radius_m=0.02),
    )
    servos = stand.run(SERVOS, servos__count="1").settings
    stand.bench.settings = {**stand.bench.settings, **servos}
    notes = stand.passes(FINGERS, fingers__kind="pinion")
    assert "fingers.open_second" not in stand.person.script.asked
    assert notes.settings["gripper.servos"][0]["direction"] == -1
    linkage = notes.settings["gripper.linkage"]
    assert linkage["kind"] == "rack_pinion"
    assert linkage["pinion_radius_mm"] == pytest.approx(20.0, rel=0.02)


def test_directions_zero_and_linkage_of_badly_mounted_servos(make_stand) -> None:
    stand = with_servos_set_up(make_stand, "servo2.turned", "servo1.horn=164")
    second_first = {"Open one finger": ("open 1", ""), "open the other": ("open 0", "")}
    notes = stand.passes(FINGERS, practice=second_first)
    first, second = notes.settings["gripper.servos"]
    assert (first["id"], first["direction"]) == (2, -1)
    assert (second["id"], second["direction"]) == (1, 1)
    assert second["zero_pulse"] == pytest.approx(2048 + 164, abs=2)
    assert first["zero_pulse"] == pytest.approx(2048, abs=2)
    linkage = notes.settings["gripper.linkage"]
    assert linkage["kind"] == "parallel_linkage"
    assert linkage["link_mm"] == pytest.approx(60.0, rel=0.02)
    assert notes.values["residual_mm"] < 0.3
    inverted, mounted = notes.corrected
    assert inverted == "servo 2 turns the other way: its direction was +1, is now -1"
    assert "servo 1: its horn sits +14.4 deg off: its zero was 2048 pulses, is now 221" in mounted
    assert "opened by" in "\n".join(notes.lines)
    assert stand.torques == [0, 0]
    assert stand.person.script.watched


def test_a_wrong_linkage_and_opening_of_the_config_are_named(ready) -> None:
    wrong = {
        "gripper.linkage": {"kind": "rack_pinion", "pinion_radius_mm": 40.0},
        "gripper.aperture_open_mm": 150.0,
        "gripper.contact_timeout_s": 11.0,
    }
    ready.bench.base = changed_config(ready.bench.base, wrong)
    ready.bench.settings = {k: v for k, v in ready.bench.settings.items() if "aperture" not in k}
    linkage, opening = ready.passes(FINGERS).corrected
    assert "the linkage was rack_pinion, pinion_radius_mm 40" in linkage
    assert "is now parallel_linkage, link_mm 60." in linkage
    assert opening.startswith("gripper.aperture_open_mm was 150, is now 11")


@pytest.mark.parametrize("tight", ["close", LONG("open")])
def test_a_first_motion_begins_with_room_on_both_sides(ready, tight) -> None:
    does = ready.person.does
    ready.passes(FINGERS, fingers__free=[does("empty", tight), does("half")])
    assert ready.person.script.asked.count("fingers.free") == 2


@pytest.mark.long
def test_stiff_servos_pass_the_first_motion(ready) -> None:
    for motor in ready.cell.devices.mechanics.motors:
        motor.friction_factor = 2.0  # 3.3 times the catalogue for servo 2, 4.1 are plausible
    ready.passes(FINGERS)


def pinched(ready: Stand) -> None:
    ready.cell.devices.mechanics.motors[1].friction_factor = 22.0


def drifting(ready: Stand) -> None:
    ready.cell.inject("servo1.drift=-0.2")


@pytest.mark.parametrize(
    ("key", "reply", "named"),
    [
        # Both move from half way.
        ("close", "half", "servo 1 by 50.4 deg, servo 2 by 29.5"),
        ("open_second", "", r"moved by \d pulses, at least"),
        # Something was between the pads when they were to touch.
        ("close", "block 20", r"finger 0 by 4\.[6-9] deg, finger 1 by 4\.[6-9] deg"),
        LONG("free", pinched, r"finger 1 \(servo 2\): did not move"),
        ("free", drifting, r"finger 0 \(servo 1\): closed instead of opening"),
        ("opened", "no", "what the servos report and what the fingers do differ"),
    ],
)
def test_fingers_that_move_otherwise_fail_the_step_and_are_limp(ready, key, reply, named) -> None:
    answers = {f"fingers.{key}": ready.person.does(reply) if reply else lambda: None}
    if reply == "half":
        answers["fingers.open_first"] = ready.person.does("close", "open 0")
    if key == "free":
        answers["fingers.free"] = lambda: (ready.person.does("empty", "half")(), reply(ready))
    notes = ready.run(FINGERS, **(answers if key != "opened" else {"fingers.opened": reply}))
    assert notes.status is Verdict.FAIL
    assert re.search(named, notes.lines[-1])
    assert notes.settings == {}
    assert ready.torques == [0, 0]
    moved = key in ("free", "opened")
    assert bool(ready.person.script.writes) == moved
    if not moved:
        ready.passes(FINGERS)


def test_no_linkage_is_proposed_where_the_measurements_do_not_tell(ready) -> None:
    with pytest.raises(AssertionError, match="no reply"):
        ready.run(FINGERS, practice={"How do the fingers move": ("", "")})
    (question,) = [
        question for question in ready.person.script.questions if question.key == "fingers.kind"
    ]
    assert question.default is None
    assert list(question.choices) == list(KINDS)
    for kind, text in question.choices.items():
        assert text.endswith(KINDS[kind].partition("\n")[2])


def test_a_thickness_that_was_typed_wrong_is_found(ready) -> None:
    replies: dict[str, Any] = {
        "fingers.on_block2": ready.person.does("block 30"),
        "fingers.kind": "parallel",
    }
    ready.ends(FAIL, FINGERS, "was a thickness typed wrong", fingers__block2=50.0, **replies)
    assert "fingers.free" not in ready.person.script.asked
    # A smaller error warns.
    named = "the residual is above 0.5 mm: measure the blocks again"
    ready.ends(WARN, FINGERS, named, fingers__block2=33.0, **replies)


@pytest.mark.parametrize("second_mm", [0.0, 10.0], ids=["none", "the first one again"])
def test_one_block_is_enough_and_worth_a_word(ready, second_mm) -> None:
    notes = ready.ends(WARN, FINGERS, fingers__block2=second_mm)
    assert notes.settings["gripper.linkage"]["link_mm"] == pytest.approx(60.0, rel=0.05)


def test_leaving_at_each_question_leaves_no_torque(ready) -> None:
    ready.run(FINGERS)
    for place in [*ready.person.script.asked, "approve"]:
        with pytest.raises(WizardAborted):
            ready.run(FINGERS, leave_at=[place])
        assert ready.torques == [0, 0], place


def test_an_interruption_of_the_first_motion_leaves_the_fingers_limp(ready, monkeypatch) -> None:
    write, seen = GoalWriter.write, []

    def interrupted(writer: GoalWriter, goals: Any, state: Any) -> None:
        seen.append(ready.torques)
        if len(seen) > 20:
            raise KeyboardInterrupt
        write(writer, goals, state)

    monkeypatch.setattr(GoalWriter, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ready.run(FINGERS)
    assert seen[-1] == [1, 1]
    assert ready.torques == [0, 0]


# -- Pads at rest, and pressed by a fingertip: what is wrong is named and set ----------------------


PRESSED = PADS_PRESSED


@pytest.mark.parametrize("layout", [pinch_layout(), paper_layout()])
def test_sound_pads_pass_without_a_word_at_rest_and_pressed(make_stand, layout) -> None:
    stand = make_stand(layout=layout)
    stand.knows(tactile__layout=layout.name)
    finding = stand.passes(PADS_AT_REST)
    assert len(finding.lines) == 1
    assert finding.settings == {"tactile.board_serial_numbers": [1, 2]}
    assert stand.passes(PRESSED).settings == {"tactile.mounting": []}
    assert stand.person.script.asked == ["pads_pressed.press"] * layout.n_pads


def test_boards_that_cannot_be_told_apart_are_a_word_to_the_operator(make_stand) -> None:
    stand = make_stand(unit=ControlUnitSettings(boards=(0, 0)))
    finding = stand.ends(WARN, PADS_AT_REST, "press each pad after every work")
    assert finding.settings == {"tactile.board_serial_numbers": None}


TURNED = [PadMount(pad=p, sent_as=p, rows_mirrored=True, columns_mirrored=True) for p in (0, 1)]
EXCHANGED = [PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0)]
BOTH = [replace(pad, rows_mirrored=True, columns_mirrored=True) for pad in EXCHANGED]
ROWS = [PadMount(pad=1, sent_as=1, rows_mirrored=True)]
COLUMNS = [PadMount(pad=0, sent_as=0, columns_mirrored=True)]


@pytest.mark.parametrize(
    ("mounts", "named"),
    [
        (EXCHANGED, "finger0.inner in that of finger1.inner, finger1.inner in"),
        (BOTH, "finger0.inner in that of finger1.inner, finger1.inner in"),
        (TURNED[:1], "finger0.inner is turned by 180 degrees"),
        (ROWS, "The rows of finger1.inner run the other way"),
        (COLUMNS, "The columns of finger0.inner run the other way"),
    ],
)
def test_pads_that_sit_otherwise_are_found_named_and_set(make_stand, mounts, named) -> None:
    finding = make_stand(mounts=mounts).ends(WARN, PRESSED, named)
    assert [PadMount(**mount) for mount in finding.settings["tactile.mounting"]] == mounts


def test_a_dead_pad_is_named_and_fails_the_step(stand) -> None:
    replies = [stand.person.does("lift"), "skip", None]
    finding = stand.ends(FAIL, PRESSED, "finger0.inner was not found", pads_pressed__press=replies)
    assert "No pad shows a fingertip" in stand.person.script.text
    assert finding.settings == {}


def test_the_wrong_pad_or_its_middle_is_asked_for_again(stand) -> None:
    wrong = [stand.person.does(f"press finger{number}.inner") for number in (0, 1)]
    stand.passes(PRESSED, pads_pressed__press=[None, *wrong, None])
    assert stand.person.script.asked == ["pads_pressed.press"] * 4
    assert "The patch is where finger0.inner was found" in stand.person.script.text
    assert "in the middle of the pad" in stand.person.script.text


@pytest.mark.parametrize(
    ("noises", "force_per_count_n", "status", "named"),
    [
        ((20.0, 20.0), 1e-4, Verdict.PASS, ""),
        ((10.0, 60.0), 1e-4, Verdict.WARN, "finger1.inner is noisy: "),
        ((10.0, 60.0), 2e-3, Verdict.FAIL, "The force of finger1.inner at rest varies by 0."),
    ],
)
def test_pads_of_much_noise_are_named(noises, force_per_count_n, status, named) -> None:
    layout, generator = pinch_layout(), np.random.default_rng(0)
    frames = generator.normal(250.0, np.repeat(noises, 78), (30, 156)).astype(np.uint16)
    law, notes = TableCalibration((1.0,), (force_per_count_n,), layout.adc_max), Notes()
    judge_rest(layout, law, frames, notes, limits=SensorSettings(), contact_force_n=0.3)
    assert notes.status is status, notes.lines
    assert named in "\n".join(notes.lines)


# -- The law from counts to newtons: loads on both pads, and the factor that is set ----------------


LOADS_N = (2.0, 5.0, 8.0)


@pytest.mark.parametrize("measured", [1.0, 0.8, LONG(1.25)])
def test_the_law_of_the_foam_is_right_or_named_and_set_right(make_stand, measured) -> None:
    stand = make_stand(f"taxels.force_gain={measured}", layout=paper_layout())
    stand.knows(tactile__layout="paper", tactile__tare_frames=60)
    finding = stand.run(LAW)
    if measured == 1.0:
        assert (finding.status, finding.settings) == (Verdict.PASS, {})
        assert finding.values["factor"] == pytest.approx(1.0, abs=0.05)
        return
    assert finding.status is Verdict.WARN
    assert "The law was 2" in finding.lines[-1]
    gain, other = finding.settings["tactile.pad_gains"]
    assert gain == other == pytest.approx(1.0 / measured, rel=0.06)
    assert finding.corrected == [finding.lines[-1]]
    assert f"pad_gains are {gain:.3g} times those of before" in finding.lines[-1]


def test_a_table_that_is_wrong_by_a_factor_stays_with_gains_of_the_pads(make_stand) -> None:
    stand = make_stand(law=SensorLaw(nodes=((0.0, 0.0012 * 4095), (0.0, 4095.0))))
    law = {"counts": [1000.0], "force_n": [1.0]}
    stand.knows(tactile__tare_frames=60, tactile__calibration=law)
    finding = stand.ends(WARN, LAW)
    assert finding.settings["tactile.pad_gains"] == pytest.approx([1.2, 1.2], rel=0.05)
    assert "tactile.calibration" not in finding.settings


def test_without_a_scale_the_forces_are_unchecked(make_stand: MakeStand) -> None:
    make_stand().ends(WARN, LAW, "not checked", pads_law__with="skip")


@pytest.mark.parametrize(
    ("loads", "named"),
    [
        ([[(1.0, 1.0), (3.0, 0.4), (6.0, 6.0)]] * 2, "do not fit one law"),
        ([[(1.0, 2.0), (3.0, 3.0), (6.0, 3.6)]] * 2, "do not fit one law"),
        ([[(1.0, 0.0), (3.0, 0.0)]] * 2, "the middle of each pad: the pads show no force"),
    ],
)
def test_loads_that_are_no_law_fail(loads, named: str) -> None:
    with pytest.raises(StepFailed, match=named):
        judge_law(TactileConfig(), loads, notes := Notes())
    assert not notes.settings


def test_pads_that_differ_are_a_word_to_the_operator() -> None:
    stand, other = [[(n, factor * n) for n in LOADS_N] for factor in (1.1, 0.92)]
    judge_law(TactileConfig(), [stand, other], finding := Notes())
    assert finding.status is Verdict.WARN
    assert "The pads differ: factor 0.91 on finger 0, 1.09 on finger 1" in finding.lines[1]
    assert finding.settings["tactile.pad_gains"] == pytest.approx([0.9255, 1.1065], abs=0.001)


TRUE = TableCalibration((16.0, 32.0, 64.0, 128.0), (0.05, 0.12, 0.31, 0.9), 255)
"""Law of pads whose taxels are less sensitive the more they are pressed."""


def pressed(force_n: float, n_taxels: int) -> tuple[float, ...]:
    """Return a load as a wrong straight law shows it, spread unevenly over taxels."""
    share = np.linspace(1.0, 2.0, n_taxels)
    counts = np.zeros(384)
    counts[:n_taxels] = counts_of(TRUE, force_n * share / share.sum())
    return force_n, 0.01 * float(counts.sum()), *table_parts(counts, 255)


def test_loads_that_bend_make_a_table() -> None:
    loads = [[pressed(force_n, n) for force_n, n in ((2.0, 4), (5.0, 25), (8.0, 9))]] * 2
    tactile = TactileConfig.model_validate(
        {"layout": "flexitac_12x32", "calibration": {"counts": (1,), "force_n": (0.01,)}}
    )
    judge_law(tactile, loads, finding := Notes(), 255)
    law = finding.settings["tactile.calibration"]
    table = TableCalibration(tuple(law["counts"]), tuple(law["force_n"]), 255)
    counts = np.array([40.0, 80.0, 110.0])
    assert table.force_n(counts) == pytest.approx(TRUE.force_n(counts), rel=0.15)
    assert finding.values["table_residual_n"] < 0.1
    # The same loads under the table are right.
    levers = [[(load[0], load[0], *load[2:]) for load in finger] for finger in loads]
    judge_law(tactile, levers, again := Notes(), 255)
    assert not again.settings


def test_a_table_needs_loads_that_rise_with_the_counts() -> None:
    with pytest.raises(ValueError, match="show no counts"):
        fit_table([1.0, 2.0], [[0.0] * 9] * 2, 255)


# -- The engine of the wizard: left at any moment and taken up again, redone, finished; its record -


Run = Callable[[Bench, Dialog, Notes], None]

REAL = {"gripper.port": "/dev/ttyUSB0", "tactile.interface": "socketcan", "tactile.channel": "can0"}


@dataclass
class Asking:
    """The run of a step that asks one question."""

    key: str
    settings: dict[str, Any] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=lambda: [Verdict.PASS])
    seen: list[dict[str, Any]] = field(default_factory=list)

    def __call__(self, bench: Bench, dialog: Dialog, notes: Notes) -> None:
        self.seen.append(dict(bench.settings))
        answer = dialog.choose(f"{self.key}.q", "?", {"yes": "yes"}, "yes")
        verdict = self.verdicts.pop(0) if len(self.verdicts) > 1 else self.verdicts[0]
        notes.findings.append(Finding(text=f"{self.key}: {answer}", verdict=verdict))
        notes.values["answer"] = answer
        notes.settings |= self.settings
        if self.settings:
            notes.fact(f"{self.key} was wrong", corrected=True)


def step(key: str, run: Run | None = None, needs: tuple[str, ...] = (), **asking: Any) -> Step:
    """Return a step that asks, or does something else."""
    run = run or Asking(key, **asking)
    return Step(run, key, "a step", needs)


def steps() -> list[Step]:
    return [
        step("ports", settings=REAL),
        step("servos", needs=("ports",), settings={"gripper.baud_rate": 2000000}),
        step("unit", needs=("ports",)),
        step("force", needs=("servos", "unit")),
    ]


def test_leaving_keeps_what_was_found_and_the_next_run_goes_on_there(tmp_path: Path) -> None:
    first, base = Script(leave_at=["unit.q"]), CellConfig(name="glass")
    with pytest.raises(WizardAborted):
        Engine(steps(), Bench(tmp_path, base=base)).run(first)
    assert first.asked == ["ports.q", "servos.q", "unit.q"]
    assert list(json.loads((tmp_path / STORE_NAME).read_text())["steps"]) == ["ports", "servos"]
    assert not (tmp_path / CONFIG_NAME).exists()

    again, walk = Script(), steps()
    files = Engine(walk, Bench(tmp_path)).run(again)
    assert again.asked == ["unit.q", "force.q"]
    assert walk[2].run.seen == [{**REAL, "gripper.baud_rate": 2000000}]
    assert tmp_path / CONFIG_NAME in files
    config = load_config(tmp_path / CONFIG_NAME)
    assert (config.gripper.port, config.gripper.baud_rate) == ("/dev/ttyUSB0", 2000000)
    assert config.name == "glass"
    assert Engine(steps(), Bench(tmp_path)).run(third := Script())
    assert third.asked == []


def test_redo_forgets_a_step_and_all_that_need_it_and_what_they_corrected(tmp_path: Path) -> None:
    engine = Engine(steps(), Bench(tmp_path))
    engine.run(Script())
    assert engine.corrected == ["ports was wrong", "servos was wrong"]
    assert engine.affected("servos") == ("servos", "force")
    engine.redo("servos")
    assert (list(engine.notes), engine.corrected) == (["ports", "unit"], ["ports was wrong"])
    # Who leaves now continues with it.
    Engine(steps(), Bench(tmp_path)).run(script := Script())
    assert script.asked == ["servos.q", "force.q"]
    with pytest.raises(CellError, match="the steps are ports, servos, unit, force"):
        engine.redo("wheels")


def test_a_failed_step_runs_again_or_is_left(tmp_path: Path) -> None:
    ports = step("ports", settings=REAL, verdicts=[Verdict.FAIL, Verdict.FAIL, Verdict.WARN])
    failed = Script(leave_at=["ports.again"])
    with pytest.raises(WizardAborted):
        Engine([ports], Bench(tmp_path / "new")).run(failed)
    assert failed.asked == ["ports.q", "ports.again"]
    engine = Engine([ports], Bench(tmp_path / "new"))
    assert engine.notes["ports"].status is Verdict.FAIL
    engine.run(script := Script())
    assert script.asked == ["ports.q", "ports.again", "ports.q"]
    assert engine.notes["ports"].status is Verdict.WARN


def test_a_line_that_is_lost_fails_the_step_which_keeps_what_it_has_found(tmp_path: Path) -> None:
    def lost(_bench: Bench, _dialog: Dialog, notes: Notes) -> None:
        notes.fact("the port opens")
        notes.values["force_n"] = 1.0
        notes.settings |= REAL
        raise PortLost("the cable is out")

    script = Script(leave_at=["ports.again"])
    with pytest.raises(WizardAborted):
        Engine([step("ports", lost)], Bench(tmp_path)).run(script)
    finding = script.findings["ports"]
    assert finding.lines == ["the port opens", "the cable is out"]
    assert (finding.values, finding.settings) == ({"force_n": 1.0}, {})


@pytest.mark.parametrize("text", ["", "{}", "[1]", None])
def test_a_damaged_store_is_named_and_kept(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / STORE_NAME
    write_json(path, COMMISSIONING, {"steps": 3, "approved": []}, error=CellError)
    path.write_text(text := path.read_text() if text is None else text)
    with pytest.raises(CellError, match="move it away"):
        Engine(steps(), Bench(tmp_path))
    assert path.read_text() == text


def test_steps_stand_behind_those_they_need() -> None:
    keys = [one.key for one in all_steps()]
    for number, one in enumerate(all_steps()):
        assert set(one.needs) <= set(keys[:number])


@pytest.mark.slow
def test_the_command_goes_on_where_it_was_left_and_writes_config_and_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.interfaces.cli.commands.commission.all_steps", steps)
    command = ["commission", str(tmp_path), "--servo-port", "/dev/ttyUSB0", "--can", "socketcan:c"]
    left = CliRunner().invoke(app, command, input="\nq\n")
    assert (left.exit_code, (tmp_path / CONFIG_NAME).exists()) == (1, False)
    assert left.output.count(RESUME) == 1
    done = CliRunner().invoke(app, command, input="\n\n\n\n")
    assert done.exit_code == 0, done.output
    assert f"{tmp_path}/{RECORD_NAME}" in done.stdout
    assert load_config(tmp_path / CONFIG_NAME).gripper.baud_rate == 2000000
    elsewhere = CliRunner().invoke(app, [*command[:3], "/dev/ttyUSB7"], input="q\n")
    assert "steps to repeat: ports, servos, unit, force" in elsewhere.output
    assert len(Engine(steps(), Bench(tmp_path)).notes) == 4  # none is forgotten
    (other := tmp_path / "other.yaml").write_text("name: other\ngripper: {port: simulated}\n")
    refused = CliRunner().invoke(app, [*command, "--config", str(other)])
    assert refused.exit_code == 1
    assert "leave out --config" in " ".join(str(refused.exception or refused.output).split())


@pytest.mark.slow
def test_what_users_wrote_into_the_config_stays(tmp_path: Path) -> None:
    Engine(steps(), Bench(tmp_path)).run(Script())
    path = tmp_path / CONFIG_NAME
    config = load_config(path)
    assert config.positioner.kind == "operator"
    changes = {"gripper.force_max_n": 20.0, "name": "cell 7", "gripper.baud_rate": 4000000}
    path.write_text(written := config_text(changed_config(config, changes)) + "# signed\n")
    again = Engine(steps(), Bench(tmp_path))
    again.redo("servos")
    again.run(Script())
    assert path.with_name("tactile-cell.1.yaml").read_text() == written
    config_after = load_config(path)
    assert (config_after.gripper.force_max_n, config_after.name) == (20.0, "cell 7")
    # What a step has found is as it was found.
    assert config_after.gripper.baud_rate == 2000000


def test_sections_are_there_before_the_config_is_whole(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.settings = {"gripper.port": "/dev/ttyUSB0", "gripper.slip.drop_n": 0.5}
    assert bench.gripper(baud_rate=2000000).slip.drop_n == 0.5
    assert bench.tactile(node_id=9).node_id == 9
    with pytest.raises(ConfigError, match="must all be"):
        _ = bench.config
    with pytest.raises(ConfigError, match="baud_rate"):
        bench.gripper(baud_rate=3)


WRITE = ProposedChange(
    where="servo 1", what="ID (7)", before="1", after="2", undo="write the old one back"
)


def test_the_record_has_steps_values_writes_and_a_place_to_sign(tmp_path: Path) -> None:
    def write(bench: Bench, dialog: Dialog, notes: Notes) -> None:
        dialog.approve([WRITE])
        servo = {"model": "XM430-W350", "firmware": 52}
        notes.values |= {"servos": [servo, servo], "zeros": list(range(50))}
        Asking("servos", settings=REAL)(bench, dialog, notes)

    engine = Engine([step("servos", write), step("unit")], Bench(tmp_path))
    for place in ("servos.q", "unit.q"):
        with pytest.raises(WizardAborted):
            engine.run(Script(leave_at=[place]))
    assert engine.record().count("not done") == 1
    page = engine.run(Script())[-1].read_text("utf-8")
    # Approved twice: the step was left after the first time.
    assert page.count("servo 1: ID (7): 1 -> 2; undo: write the old one back") == 2
    assert "## Errors found and corrected\n\n- servos was wrong" in page
    assert '- servos: [{"model": "XM430-W350", "firmware": 52}, {' in page
    assert '- gripper.port: "/dev/ttyUSB0"' in page
    assert "zeros" not in page
    assert page.endswith("signature:\n")


# -- The whole wizard on simulated cells in virtual time: from the box to the first force ----------


CONFIGS = Path(__file__).parents[3] / "config"


@pytest.mark.long
@pytest.mark.parametrize(
    ("preset", "sensor"),
    [("rh-p12-rn", "flexitac"), ("open-parallel-gripper", "uskin"), ("rh-p12-rn", "unit")],
)
def test_a_gripper_preset_is_brought_up_from_the_box(preset, sensor, tmp_path, monkeypatch) -> None:
    # A gripper preset with the pads of another preset, or those of the default cell.
    pads = CellConfig() if sensor == "unit" else load_config(CONFIGS / f"{sensor}.yaml")
    base = load_config(CONFIGS / f"{preset}.yaml").model_copy(update={"tactile": pads.tactile})
    # Boards have exchanged pads and another law than the preset.
    boards = sensor != "unit"
    settings = replace(
        simulator_settings(base),
        faults=("servo1.factory", *["taxels.force_gain=0.7"] * boards),
        mounts=tuple(EXCHANGED) if sensor == "uskin" else (),
        aperture_m=0.016,
    )
    given = {"gripper.port": "/dev/ttyUSB0"}
    ports: tuple[str, ...] = ("/dev/ttyUSB0",)
    if sensor == "flexitac":
        ports = (*ports, "/dev/ttyACM1", "/dev/ttyACM0")
        by_path = "/dev/serial/by-path/usb-0:{}".format
        monkeypatch.setattr("cell.commissioning.unit.lasting_name", lambda port: by_path(port[-1]))
    else:
        given |= {"tactile.interface": "socketcan", "tactile.channel": "can0"}
    with SimulatedCell(settings) as cell:
        person = Person(cell, {r"With which force may it be": ("", "")})
        bench = Bench(tmp_path, SimulatedLines(cell, ports), given=given, base=base)
        Engine(all_steps(), bench).run(person.script)
        (servo,) = cell.devices.servo_bus.servos
        assert servo.registers.get("torque_enable") == 0
    findings = person.script.findings
    assert {key: one.lines for key, one in findings.items() if one.status is Verdict.FAIL} == {}
    config = load_config(tmp_path / CONFIG_NAME)
    (wanted,), (now,) = base.gripper.servos, config.gripper.servos
    assert (now.model, now.direction) == (wanted.model, wanted.direction)
    if boards:
        said = "\n".join(line for one in findings.values() for line in one.lines)
        assert [PadMount(**mount.model_dump()) for mount in config.tactile.mounting] == EXCHANGED
    if sensor == "flexitac":
        assert "named by their USB sockets: leave them" in said
        assert config.tactile.serial_ports == (by_path(1), by_path(0))
    # The median: a push on the ramp may pass the held force for some periods.
    asked_n, held_n, _ = findings["first_force"].values["asked_held_peak_n"][-1]
    pressed_n = [force_n for force_n in person.pressed_n if force_n > 0.5 * asked_n]
    assert median(pressed_n) == pytest.approx(held_n, abs=1.0)


@pytest.mark.long
def test_the_tutorial_shows_what_is_printed() -> None:
    """A cell of wrong hardware, from the box to the first force."""
    from docs.tools.transcript import TRANSCRIPT, transcript

    _, stored = TRANSCRIPT.read_text("utf-8").split("\n", 1)
    assert transcript().split() == stored.split()
