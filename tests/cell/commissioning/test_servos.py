"""Servos that are new or set otherwise: numbered, backed up, set, read back, and brought back."""

import json

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import WizardAborted
from cell.commissioning.servos import SERVOS, backup_file, restore
from cell.errors import CellError
from cell.formats import SERVO_BACKUP, write_json
from gripper.errors import GripperError
from tests.cell.commissioning.conftest import MakeStand, Stand
from tests.cell.commissioning.hands import Script

STEP = SERVOS
PORT = "/dev/ttyUSB0"


@pytest.fixture
def new(make_stand: MakeStand) -> Stand:
    """A cell with two servos from the box: both have ID 1."""
    stand = make_stand("servo1.factory", "servo2.factory")
    stand.cell.clock.sleep(1.0)  # they have booted
    return stand


def eeproms(stand: Stand) -> list[bytes]:
    return [bytes(s.registers.data[:64]) for s in stand.cell.devices.servo_bus.servos]


@pytest.mark.slow
def test_factory_new_servos_are_numbered_one_at_a_time(new, tmp_path) -> None:
    notes = new.passes(STEP)
    script = new.person.script
    assert script.asked == ["servos.connect_one", "servos.connect_next"]
    assert "servo 2: id was 1, is now 2" in notes.corrected
    assert "servo 1: baud_rate was 57600 bit/s, is now 1000000 bit/s" in notes.corrected
    assert len(notes.corrected) == 7  # operating_mode and return_delay_time of both
    # What the hands of the first run have set right stays on the list of a second one.
    assert new.passes(STEP).corrected == notes.corrected
    for name, values in {
        "id": [1, 2],
        "baud_rate": [3, 3],
        "operating_mode": [5, 5],
        "return_delay_time": [0, 0],
    }.items():
        assert new.registers(name) == values, name
    shown = {(w.what, w.before, w.after) for w in script.writes}
    assert ("id (7)", "1", "2") in shown
    assert ("baud_rate (8)", "57600 bit/s", "1000000 bit/s") in shown
    for number in (1, 2):
        backup = json.loads((tmp_path / f"backup-servo{number}.json").read_text())
        assert (backup["registers"]["id"], backup["registers"]["baud_rate"]) == (1, 1)
        assert backup["registers"]["return_delay_time"] == 250


@pytest.mark.parametrize(
    ("name", "values", "wanted", "shown"),
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
    stand, name, values, wanted, shown
) -> None:
    for servo, value in zip(stand.cell.devices.servo_bus.servos, values, strict=True):
        servo.registers.put(name, value)
    stand.passes(STEP)
    assert stand.registers(name) == wanted
    rows = [(w.where, w.what, w.before, w.after) for w in stand.person.script.writes]
    assert shown in rows
    assert [what for _, what, *_ in rows].count(shown[1]) == len(values) - values.count(wanted[0])


@pytest.mark.parametrize("rate", [1, 3])
def test_servos_in_protocol_1_are_named_with_the_register(stand, rate: int) -> None:
    for servo in stand.cell.devices.servo_bus.servos:
        servo.registers.put("protocol_type", 1)
        servo.registers.put("baud_rate", rate)
    finding = stand.run(STEP)
    assert any("Protocol 1.0 come from servo 1, 2" in line for line in finding.lines)


def test_a_second_servo_that_is_not_there_after_all_is_not_waited_for(new) -> None:
    stand = new.run(STEP, servos__connect_next="none")
    assert [servo["id"] for servo in stand.settings["gripper.servos"]] == [1]


@pytest.mark.slow
def test_restore_brings_back_all_but_the_address(new, tmp_path) -> None:
    before = eeproms(new)
    new.run(STEP)
    lines = restore(new.bench, script := Script(), PORT)
    assert [data[:7] + data[9:] for data in eeproms(new)] == [d[:7] + d[9:] for d in before]
    assert (new.registers("id"), new.registers("baud_rate")) == ([1, 2], [3, 3])
    assert len(lines) == 2
    shown = {(w.what, w.before, w.after) for w in script.writes}
    assert ("return_delay_time (9)", "0", "250") in shown
    # Restored servos are left alone, and are brought up again from there.
    assert restore(new.bench, Script(), PORT) == ("all servos are as they were found",)
    new.passes(STEP)
    with pytest.raises(CellError, match="no backup"):
        restore(Bench(tmp_path / "other", new.lines), Script(), PORT)


def test_nothing_is_restored_where_a_servo_is_not_there(new) -> None:
    new.passes(STEP)
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


@pytest.mark.slow
def test_torque_that_holds_a_part_is_not_switched_off_unasked(make_stand) -> None:
    stand = make_stand("servo1.wrong=homing_offset:100")
    for servo in stand.cell.devices.servo_bus.servos:
        servo.set_torque(on=True)
    with pytest.raises(WizardAborted):
        stand.run(STEP, leave_at=["approve"])
    assert "it may hold a part" in stand.person.script.said[-1]
    assert stand.torques == [1, 1]
    stand.run(STEP)
    assert stand.torques == [0, 0]
