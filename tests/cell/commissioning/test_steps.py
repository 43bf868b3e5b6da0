"""Steps servos, control unit, first force: what is new, wrong or refused; nothing moves unseen."""

import json
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import WizardAborted
from cell.commissioning.findings import Notes, Verdict
from cell.commissioning.fingers import FINGERS
from cell.commissioning.first_force import FIRST_FORCE
from cell.commissioning.pads import PADS_AT_REST
from cell.commissioning.servos import SERVOS, backup_file, restore
from cell.commissioning.unit import UNIT
from cell.control.self_zero import stored_zeros
from cell.errors import CellError
from cell.formats import SERVO_BACKUP, write_json
from gripper.errors import GripperError
from gripper.settings import largest_setpoint_n
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.devices import SimulatedDrive
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tactile.layout import inner_pads, pinch_layout
from tests.cell.commissioning.conftest import MakeStand, Stand
from tests.cell.commissioning.hands import Script
from tests.marks import LONG

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
    notes = new.passes(SERVOS)
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
def test_wrong_registers_are_shown_then_set_and_read_back(
    stand, name, values, wanted, text
) -> None:
    for servo, value in zip(stand.cell.devices.servo_bus.servos, values, strict=True):
        servo.registers.put(name, value)
    stand.passes(SERVOS)
    assert stand.registers(name) == wanted
    rows = [(w.where, w.what, w.before, w.after) for w in stand.person.script.writes]
    assert text in rows
    assert [what for _, what, *_ in rows].count(text[1]) == len(values) - values.count(wanted[0])


@pytest.mark.parametrize("rate", [1, 3])
def test_servos_in_protocol_1_are_named_with_the_register(stand, rate: int) -> None:
    for servo in stand.cell.devices.servo_bus.servos:
        servo.registers.put("protocol_type", 1)
        servo.registers.put("baud_rate", rate)
    finding = stand.run(SERVOS)
    assert any("Protocol 1.0 come from servo 1, 2" in line for line in finding.lines)


def test_a_second_servo_that_is_not_there_after_all_is_not_waited_for(new) -> None:
    stand = new.run(SERVOS, servos__connect_next="none")
    assert [servo["id"] for servo in stand.settings["gripper.servos"]] == [1]


def test_restore_brings_back_all_but_the_address(new, tmp_path) -> None:
    before = eeproms(new)
    new.run(SERVOS)
    lines = restore(new.bench, script := Script(), PORT)
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
    return make_stand(noise=NoiseModel(level=0.3))


@pytest.fixture(scope="module")
def grasped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stand, Notes]]:
    """A cell after its first grasp, whose pads were checked with weights, and what was found."""
    noise = NoiseModel(level=0.3)
    settings = SimulatorSettings(layout=pinch_layout(), aperture_m=0.014, noise=noise)
    with SimulatedCell(settings) as cell:
        stand = Stand(cell, tmp_path_factory.mktemp("grasped"))
        stand.bench.values["pads_law"] = {"factor": 1.0}
        yield stand, stand.run(FIRST_FORCE, first_force__most=lambda: None)


def test_a_sound_cell_makes_its_first_grasp_within_the_force_asked(grasped) -> None:
    stand, finding = grasped
    assert finding.status is Verdict.PASS, finding.lines
    most = next(q for q in stand.person.script.questions if q.key == "first_force.most")
    assert 4.0 < most.default < most.limits[1] <= largest_setpoint_n(15.0)
    (first, last) = finding.values["asked_held_peak_n"]
    assert first[:2] == pytest.approx([1.0, 1.0], abs=0.1)
    assert last == pytest.approx(3 * [most.default], rel=0.1)
    assert any("the pads show 0.00 and 0.00 N after a new zero" in line for line in finding.lines)
    assert stand.torques == [0, 0]
    assert len(stand.person.script.writes) == 4
    assert abs(finding.values["meet_mm"]) < 1.0


def test_what_it_measures_of_the_servos_is_kept_for_the_cell(grasped) -> None:
    bench = grasped[0].bench
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
    with pytest.raises(WizardAborted, match="keep their grip: take hold of the part"):
        quiet.run(FIRST_FORCE, leave_at=["first_force.release"])
    assert quiet.torques == [1, 1]
    assert min(quiet.cell.world.contact_force_n()) > 0.5
    finding = quiet.run(FIRST_FORCE)
    assert quiet.person.script.asked[2] == "fingers.held"
    assert finding.status is Verdict.PASS, finding.lines


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

    says = rf"^{str(error) or 'left'}. The fingers keep their grip" if kept else str(error)
    with pytest.raises(WizardAborted if kept else type(error), match=says or None):
        quiet.run(FIRST_FORCE, moment=stop)
    stood_m = quiet.cell.devices.mechanics.aperture_m
    quiet.cell.clock.sleep(1.0)
    # Without torque fingers of little friction run on by a millimetre.
    assert quiet.cell.devices.mechanics.aperture_m == pytest.approx(stood_m, abs=1.5e-3)
    assert quiet.person.script.asked[-1] == asked
    # Fingers that close may touch a part: they stand where they are until a person lets it go.
    assert quiet.torques == [kept, kept]


def test_fingers_that_find_no_part_fail_the_step(quiet) -> None:
    finding = quiet.run(FIRST_FORCE, first_force__part=lambda: None)
    assert finding.status is Verdict.FAIL
    assert "The fingers hold nothing (no_contact)" in finding.lines[-1]
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
        (REST, "unit.stuck", FAIL, "The counts do not change at rest"),
        (
            *(FORCE, "can.loss=0.0003, servos.loss=0.02", WARN),
            "The line of the pads loses messages, The servos' line loses answers",
        ),
        (FORCE, "servo1.watchdog_off", FAIL, "watchdog is not proven to stop the motors: servo 1"),
        (FORCE, "taxels.stuck_at=20-60:3000", FAIL, "taxels of pad finger0.inner are bad"),
        (FORCE, "servo2.turned", FAIL, "on its own side"),
    ],
)
def test_what_is_wrong_is_named(make_stand, step, fault, status, named) -> None:
    """The step moves and sets nothing; a fault may also be other hardware, or two faults."""
    hardware = fault if isinstance(fault, dict) else {}
    stand = make_stand(**({"noise": NoiseModel(level=0.3)} if step is FORCE else hardware))
    stand.knows(gripper__pads_meet=step is not FORCE)  # the last and longest of its motions
    for one in [] if hardware else fault.split(", "):
        stand.cell.inject(one)
    finding = stand.run(step)
    text = "\n".join(finding.lines)
    assert (finding.status, [one for one in named.split(", ") if one not in text]) == (status, [])
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
    assert [write.where for write in script.writes] == ["control unit, node 17"] * 5
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
    finding = stand.passes(UNIT)
    assert finding.settings["tactile.node_id"] == 5
    assert "Beside it, node 3 is another device" in "\n".join(finding.lines)


def test_the_interface_is_asked_for_only_where_there_are_several(stand) -> None:
    stand.bench.settings = {"gripper.port": "/dev/ttyUSB0"}
    stand.lines.ports += ("/dev/ttyACM0", "/dev/ttyACM1")
    finding = stand.run(UNIT, unit__interface="slcan /dev/ttyACM1")
    assert finding.settings["tactile.channel"] == "/dev/ttyACM1"
    stand.lines.ports = stand.lines.ports[:1]
    finding = stand.run(UNIT)
    assert finding.status is Verdict.FAIL
    assert "No CAN interface was found" in finding.lines[0]


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
