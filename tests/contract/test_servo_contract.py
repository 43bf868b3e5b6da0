"""What a DYNAMIXEL X servo does on its line, simulated or real (ROBOTIS e-Manual, Protocol 2.0)."""

from dataclasses import replace
from typing import Any

import pytest

from gripper.dynamixel.control_table import (
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    FIRMWARE_VERSION,
    GOAL_CURRENT,
    LED,
    MODEL_NUMBER,
    MOVING_THRESHOLD,
    PRESENT_CURRENT,
    PRESENT_POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    TORQUE_ENABLE,
    WATCHDOG_TRIPPED_RAW,
    RegisterBlock,
)
from gripper.dynamixel.models import MODELS
from gripper.errors import BusTimeout, ServoRejected

READ, WRITE = 0x02, 0x03
UNKNOWN_INSTRUCTION = 0x77
RESULT_INSTRUCTION, RESULT_CRC, RESULT_RANGE = 2, 3, 4
RESULT_LENGTH, RESULT_LIMIT, RESULT_ACCESS = 5, 6, 7
LED_ON = b"\x41\x00\x01"
"""Address 65 and the value 1."""


def error_of(answer: bytes | None) -> int:
    """Error number of a status packet, without the Alert bit."""
    assert answer is not None
    assert answer[:4] == b"\xff\xff\xfd\x00"
    assert answer[7] == 0x55
    return answer[8] & 0x7F


def refusal(servos: Any, register: Any, raw: int) -> int:
    """Error number with which a write is refused."""
    with pytest.raises(ServoRejected) as caught:
        servos.bus.write(servos.one, register, raw)
    return caught.value.code


def test_ping_tells_model_and_firmware_as_the_registers_do(servos: Any) -> None:
    for servo_id in servos.ids:
        found = servos.bus.ping(servo_id)
        assert found.model_number in {model.number for model in MODELS.values()}
        assert found.model_number == servos.bus.read(servo_id, MODEL_NUMBER)
        assert found.firmware == servos.bus.read(servo_id, FIRMWARE_VERSION)


def test_nobody_answers_for_an_absent_servo(servos: Any) -> None:
    with pytest.raises(BusTimeout, match=str(servos.nobody)):
        servos.bus.ping(servos.nobody)
    servos.bus.ping(servos.one)


def test_what_is_written_is_read_back(servos: Any) -> None:
    with servos.restoring(LED, PROFILE_VELOCITY):
        for raw in (0, 1):
            servos.bus.write(servos.one, LED, raw)
            assert servos.bus.read(servos.one, LED) == raw
        for raw in (1, 255, 256, 32767):
            servos.bus.write(servos.one, PROFILE_VELOCITY, raw)
            assert servos.bus.read(servos.one, PROFILE_VELOCITY) == raw


def test_a_sync_read_tells_what_single_reads_tell(servos: Any) -> None:
    with servos.restoring(PROFILE_ACCELERATION, PROFILE_VELOCITY):
        for servo_id in servos.ids:
            servos.bus.write(servo_id, PROFILE_VELOCITY, 100 + servo_id)
        found = servos.bus.sync_read(
            servos.ids, RegisterBlock(PROFILE_ACCELERATION, PROFILE_VELOCITY)
        )
        assert list(found) == list(servos.ids)
        for servo_id in servos.ids:
            assert found[servo_id]["profile_velocity"] == 100 + servo_id


def test_present_values_are_plausible_at_rest(servos: Any) -> None:
    found = servos.bus.sync_read(
        servos.ids, RegisterBlock.between(PRESENT_CURRENT, PRESENT_POSITION)
    )
    for values in found.values():
        assert abs(values["present_current"]) < 20
        assert abs(values["present_velocity"]) < 5


def test_a_sync_read_with_an_absent_servo_gives_nothing(servos: Any) -> None:
    with pytest.raises(BusTimeout, match=str(servos.nobody)):
        servos.bus.sync_read((servos.nobody, servos.one), RegisterBlock(LED))
    assert servos.bus.sync_read((servos.one,), RegisterBlock(LED))


def test_a_sync_write_reaches_all(servos: Any) -> None:
    with servos.restoring(PROFILE_ACCELERATION, PROFILE_VELOCITY):
        wanted = {servo_id: (servo_id, 200 + servo_id) for servo_id in servos.ids}
        servos.bus.sync_write(wanted, RegisterBlock(PROFILE_ACCELERATION, PROFILE_VELOCITY))
        for servo_id, (acceleration, velocity) in wanted.items():
            assert servos.bus.read(servo_id, PROFILE_ACCELERATION) == acceleration
            assert servos.bus.read(servo_id, PROFILE_VELOCITY) == velocity


def test_a_damaged_packet_is_refused_or_ignored_and_never_carried_out(servos: Any) -> None:
    with servos.restoring(LED):
        servos.bus.write(servos.one, LED, 0)
        for damage in (0x0001, 0x8000, 0xFFFF):
            answer = servos.exchange(WRITE, LED_ON, damage=damage)
            if answer is not None:
                assert error_of(answer) == RESULT_CRC
            assert servos.bus.read(servos.one, LED) == 0
        assert error_of(servos.exchange(WRITE, LED_ON)) == 0
        assert servos.bus.read(servos.one, LED) == 1


def test_stuffed_parameters_are_understood(servos: Any) -> None:
    # A read of 00FD bytes from address FFFF: its parameters FF FF FD 00 travel as FF FF FD FD 00.
    # A servo that did not remove the stuffing would read from elsewhere, or stay silent.
    answer = servos.exchange(READ, b"\xff\xff\xfd\xfd\x00")
    assert error_of(answer) != 0
    assert servos.bus.read(servos.one, MODEL_NUMBER)


def test_an_unknown_instruction_is_refused(servos: Any) -> None:
    assert error_of(servos.exchange(UNKNOWN_INSTRUCTION, b"")) == RESULT_INSTRUCTION


def test_values_out_of_range_are_refused_and_change_nothing(servos: Any) -> None:
    with servos.restoring(LED):
        servos.bus.write(servos.one, LED, 0)
        assert refusal(servos, LED, 2) == RESULT_RANGE
        assert servos.bus.read(servos.one, LED) == 0


def test_goals_beyond_a_limit_of_the_servo_are_refused(servos: Any) -> None:
    limit = servos.bus.read(servos.one, CURRENT_LIMIT)
    before = servos.bus.read(servos.one, GOAL_CURRENT)
    assert refusal(servos, GOAL_CURRENT, limit + 1) == RESULT_LIMIT
    assert servos.bus.read(servos.one, GOAL_CURRENT) == before


def test_read_only_items_are_refused(servos: Any) -> None:
    assert refusal(servos, replace(PRESENT_POSITION, writable=True), 0) == RESULT_ACCESS


def test_a_value_shorter_than_its_item_is_refused(servos: Any) -> None:
    before = servos.bus.read(servos.one, PROFILE_VELOCITY)
    assert refusal(servos, replace(PROFILE_VELOCITY, size=1), 1) == RESULT_LENGTH
    assert servos.bus.read(servos.one, PROFILE_VELOCITY) == before


def test_the_watchdog_of_a_servo_without_torque_does_not_trip(servos: Any) -> None:
    with servos.restoring(BUS_WATCHDOG):
        servos.bus.write(servos.one, BUS_WATCHDOG, 5)
        servos.clock.sleep(0.3)
        assert servos.bus.read(servos.one, BUS_WATCHDOG) == 5


def test_the_watchdog_trips_with_torque_and_refuses_goals_until_it_is_cleared(
    moving_servos: Any,
) -> None:
    servos = moving_servos
    goal = servos.bus.read(servos.one, GOAL_CURRENT)
    servos.bus.write(servos.one, TORQUE_ENABLE, 1)
    servos.bus.write(servos.one, BUS_WATCHDOG, 5)
    servos.clock.sleep(0.3)
    assert servos.bus.read(servos.one, BUS_WATCHDOG) == WATCHDOG_TRIPPED_RAW
    assert refusal(servos, GOAL_CURRENT, goal) == RESULT_RANGE
    servos.bus.write(servos.one, BUS_WATCHDOG, 0)
    servos.bus.write(servos.one, GOAL_CURRENT, goal)
    assert servos.bus.read(servos.one, BUS_WATCHDOG) == 0


def test_eeprom_is_writable_without_torque_only(moving_servos: Any) -> None:
    servos = moving_servos
    before = servos.bus.read(servos.one, MOVING_THRESHOLD)
    servos.bus.write(servos.one, MOVING_THRESHOLD, before)
    servos.bus.write(servos.one, TORQUE_ENABLE, 1)
    assert refusal(servos, MOVING_THRESHOLD, before) == RESULT_ACCESS
    servos.bus.write(servos.one, TORQUE_ENABLE, 0)
    servos.bus.write(servos.one, MOVING_THRESHOLD, before)
