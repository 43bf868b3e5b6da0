"""The start: who is there, what the servos are set to, and whether the link keeps up."""

import pytest

from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.models import XL330_M288, XM430_W350
from gripper.errors import (
    AnswersOff,
    BusCorrupt,
    LimitExceeded,
    LinkTooSlow,
    VerificationFailed,
)
from gripper.force.ramp import ForceRamp
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.state import GripperPhase
from simulator.servo.faults import Chatter, WireFaults

PING_BYTES = 14
"""Answer to a ping: Model Number and Firmware Version in a status packet."""
SENTENCE = b"$GPGGA,092751.000,5321.6802,N,00630.3371,W,1,8,1.03,61.7,M\r\n"
PATTERNS = {
    "dense": Chatter(data=b"\xa5", every_s=0.0003),
    "40 bytes each 10 ms": Chatter(data=bytes(range(0x80, 0xA8)), every_s=0.01),
    "a sentence each 30 ms": Chatter(data=SENTENCE, every_s=0.03),
}


def test_a_servo_with_another_id_is_named_in_the_table(cell) -> None:
    cell.servos[1].registers.data[7] = 5
    with pytest.raises(VerificationFailed, match=r"other IDs that answer: 5 \(XM430-W350\)") as bad:
        cell.gripper.start()
    (row,) = bad.value.report.failed
    assert (row.servo_id, row.item, row.expected) == (2, "ping", "an answer at 1000000 baud")
    assert not cell.servos[0].torque_on


@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS)
def test_a_start_on_a_line_of_another_device_names_what_was_heard(cell, pattern) -> None:
    cell.device.faults.silent.update({1, 2})
    cell.device.faults.chatter = pattern
    with pytest.raises(BusCorrupt, match=r"the servo line did not become quiet.* no packet"):
        cell.gripper.start()
    assert cell.clock.monotonic() < 2.0


@pytest.mark.parametrize(
    ("name", "raw"),
    [
        ("model_number", 1200),
        ("secondary_id", 2),
        ("min_voltage_limit", 60),
        ("pwm_limit", 100),
        ("shutdown", 0),
        ("current_limit", 100),
        ("drive_mode", 1),
    ],
)
def test_a_changed_eeprom_register_is_shown_expected_against_found(cell, name, raw) -> None:
    for servo in cell.servos:
        servo.registers.put(name, raw)
    with pytest.raises(VerificationFailed, match=rf"servo 2 {name}.*found {raw}") as bad:
        cell.gripper.start()
    failed = [(row.servo_id, row.item, row.actual) for row in bad.value.report.failed]
    assert failed == [(1, name, str(raw)), (2, name, str(raw))]
    assert cell.torques == [0, 0]


@pytest.mark.parametrize("raw", [253, 254, 255])
def test_a_second_id_that_no_servo_listens_to_is_none(cell, raw: int) -> None:
    cell.servos[1].registers.put("secondary_id", raw)
    assert cell.gripper.start().ok


def in_protocol_1(cell, servo_id: int) -> None:
    cell.servos[1].registers.put("protocol_type", 1)
    cell.servos[1].registers.data[7] = servo_id


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (lambda cell: setattr(cell.device, "baudrate", 57600), "check supply, cable, baud rate"),
        (lambda cell: in_protocol_1(cell, 1), r"1\.0 come from servo 1: .*\(register 13\) to 2"),
        (lambda cell: in_protocol_1(cell, 2), r"1\.0 come from servo 2: .*\(register 13\) to 2"),
    ],
)
def test_what_does_not_answer_gets_a_hint(cell, change, hint: str) -> None:
    change(cell)
    before_s = cell.clock.monotonic()
    with pytest.raises(VerificationFailed, match=hint):
        cell.gripper.start()
    assert cell.clock.monotonic() - before_s < 2.0


def test_what_may_be_corrected_is_a_setting(make_cell) -> None:
    cell = make_cell(corrected_registers=frozenset({"status_return_level"}))
    with pytest.raises(VerificationFailed, match=r"operating_mode: expected 5, found 3"):
        cell.gripper.start()
    with pytest.raises(LimitExceeded, match="drive_mode"):
        GripperSettings(
            servos=(ServoSettings(servo_id=1),), corrected_registers=frozenset({"drive_mode"})
        )


@pytest.mark.parametrize("level", [0, 1])
def test_servos_that_confirm_no_write_are_told_to_before_anything_else(cell, level: int) -> None:
    for servo in cell.servos:
        servo.registers.put("status_return_level", level)
    assert cell.gripper.start().ok
    assert cell.register(1, "status_return_level") == 2


@pytest.mark.parametrize("level", [0, 1])
def test_a_level_that_may_not_be_corrected_is_named_with_its_register(make_cell, level) -> None:
    cell = make_cell(corrected_registers=frozenset({"operating_mode", "return_delay_time"}))
    cell.servos[1].registers.put("status_return_level", level)
    with pytest.raises(AnswersOff, match=r"servo 2, although it answers pings: .*\(register 68\)"):
        cell.gripper.start()
    assert [str(one) for one in cell.gripper.conditions()] == [
        "servo 1 has no torque",
        "servo 2 has no torque"
        if level
        else "servo 2 answers pings only: its Status Return Level (register 68) is 0; a start or a "
        "release sets it to 2",
    ]


@pytest.mark.parametrize("model", [XM430_W350, XL330_M288])
def test_gains_and_slope_that_the_goals_count_on_are_put_right(make_cell, model) -> None:
    cell = make_cell(model=model, current_max_a=0.35)
    wanted = dict(zip(("d", "i", "p"), model.position_gains, strict=True))
    registers = {f"position_{name}_gain": gain for name, gain in wanted.items()}
    if model is XL330_M288:
        registers["pwm_slope"] = 140
    for name, raw in registers.items():
        cell.bus.write(1, REGISTERS[name], raw + 7)
    report = cell.gripper.start()
    assert {name: cell.register(0, name) for name in registers} == registers
    rewritten = {row.item for row in report.rows if row.corrected and row.servo_id == 1}
    assert rewritten >= {"operating_mode"} | ({*registers} & {"pwm_slope"})


def test_an_overload_that_is_only_reported_is_a_note_and_keeps_the_grip(cell) -> None:
    for servo in cell.servos:
        servo.registers.put("shutdown", 20)
    cell.hold_part(ForceRamp.linear(2.0, rate_n_s=5.0))
    cell.gripper.hold(0.5, cell.once(cell.servos[0].plant.overload, in_s=0.1))
    assert cell.gripper.phase is GripperPhase.HOLDING
    (note,) = cell.gripper.drives.read().notes
    assert note == (
        "servo 1: an overload is only reported: the cell's limit of heat alone protects it"
    )


@pytest.mark.parametrize(
    ("delay_s", "remedy"),
    [(0.016, r"latency timer.*raise the baud rate\. Nothing"), (0.004, r"loop_rate_hz to 1\d\d\.")],
)
def test_an_adapter_with_much_latency_is_refused_with_the_remedy(cell, delay_s, remedy) -> None:
    cell.device.faults.delay_s = delay_s
    with pytest.raises(LinkTooSlow, match=remedy):
        cell.gripper.start()


def test_a_latency_of_2_ms_only_makes_the_time_outs_longer(cell) -> None:
    cell.device.faults.delay_s = 0.002
    cell.hold_part(ForceRamp.linear(4.0, rate_n_s=5.0))
    assert cell.gripper.statistics.missed_reads == 0


@pytest.mark.parametrize("how", ["late", "lost"])
def test_a_machine_that_is_too_busy_is_refused(cell, how) -> None:
    class Busy(WireFaults):
        answers = 0

        def answer(self, servo_id: int, packet: bytes) -> list[tuple[float, bytes]]:
            """Return each third answer to a ping late, or not at all."""
            self.answers += len(packet) == PING_BYTES
            third = self.answers % 3 == 0 and len(packet) == PING_BYTES
            self.delay_s = 0.02 if third and how == "late" else 0.0
            return [] if third and how == "lost" else super().answer(servo_id, packet)

    cell.device.faults = Busy()
    with pytest.raises(LinkTooSlow, match="too busy"):
        cell.gripper.start()
