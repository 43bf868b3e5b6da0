"""A second client written by others (dynamixel-python, module dxl2) talks to the simulated servos.

It knows the fast bulk read, the bulk write, the registered write and the backup, which rustypot
does not. Its own stuffing of what it sends is broken, and it refuses every answer with the Alert
bit. Its encoder and its checksum are a second opinion on the byte vectors too.
"""

import time
from collections.abc import Iterator
from typing import Any

import pytest
from dxl2 import v2 as dxl2

from gripper.dynamixel.models import XM430_W350

TIMEOUT_S = 10.0
"""Patience in s with an answer: other tests run beside this one."""


@pytest.fixture
def driver(serve: Any) -> Any:
    return serve(settings={"operating_mode": 5})


@pytest.fixture
def client(driver: Any) -> Iterator[dxl2.MotorBus]:
    bus = dxl2.MotorBus(driver.endpoint.path, 1_000_000, TIMEOUT_S)
    bus.connect()
    yield bus
    bus.disconnect()


def registers(driver: Any, servo_id: int) -> Any:
    return driver.bench.servos[servo_id - 1].core.registers


def present(driver: Any, servo_id: int) -> int:
    position: int = driver.bench.servos[servo_id - 1].core.position.present_raw()
    return position


def good(response: Any) -> Any:
    assert response.ok, response
    return response.data


def until_answered(client: dxl2.MotorBus, servo_id: int) -> None:
    """Wait for the end of a restart."""
    deadline_s = time.monotonic() + 5.0
    while not client.ping(servo_id).ok:
        assert time.monotonic() < deadline_s, "the servo did not come back"


def test_ping_one_and_all(client: dxl2.MotorBus) -> None:
    identity = {"model_number": XM430_W350.number, "firmware_version": 48}
    assert good(client.ping(2)) == identity
    client.conn.serial.timeout = 1.0
    assert good(client.broadcast_ping()) == {1: identity, 2: identity}
    assert client.ping(9).timeout


def test_reading_and_writing(driver: Any, client: dxl2.MotorBus) -> None:
    assert good(client.read(1, 132, 4, True)) == present(driver, 1)
    good(client.write(1, 116, 4, 2100, True))
    good(client.write(1, 102, 2, -77, True))
    assert registers(driver, 1).get("goal_position") == 2100
    assert good(client.read(1, 102, 2, True)) == -77


@pytest.mark.parametrize(
    ("address", "size", "value", "error"), [(102, 2, 1194, 6), (132, 1, 0, 7), (98, 1, -2, 4)]
)
def test_refusals_arrive_as_their_number(
    client: dxl2.MotorBus, address: int, size: int, value: int, error: int
) -> None:
    response = client.write(1, address, size, value, True)
    assert (response.error, response.valid) == (error, True)


def test_a_registered_write_waits_for_its_action(driver: Any, client: dxl2.MotorBus) -> None:
    before = registers(driver, 1).get("goal_position")
    good(client.reg_write(1, 116, 4, before + 20, True))
    assert good(client.read(1, 69, 1)) == 1
    assert registers(driver, 1).get("goal_position") == before
    good(client.action(1))
    assert registers(driver, 1).get("goal_position") == before + 20
    assert client.action(1).error == 2


def sync_params(address: int, size: int) -> dxl2.SyncParams:
    params = dxl2.SyncParams(address, size, True)
    for servo_id in (2, 1):
        params.add_motor(servo_id)
    return params


def test_sync_reads_and_a_sync_write(driver: Any, client: dxl2.MotorBus) -> None:
    wanted = dxl2.SyncParams(102, 2, True)
    wanted.add_value(1, 100)
    wanted.add_value(2, -100)
    client.sync_write(wanted)
    assert good(client.sync_read(sync_params(102, 2))) == [-100, 100]
    assert good(client.fast_sync_read(sync_params(102, 2), True)) == [-100, 100]
    places = [present(driver, 2), present(driver, 1)]
    assert good(client.fast_sync_read(sync_params(132, 4), True)) == places


def test_bulk_reads_and_a_bulk_write(driver: Any, client: dxl2.MotorBus) -> None:
    wanted = dxl2.BulkParams()
    wanted.add_value(1, 112, 4, 55)
    wanted.add_value(2, 102, 2, -33, True)
    client.bulk_write(wanted)
    asked = dxl2.BulkParams()
    asked.add_address(2, 102, 2, True)
    asked.add_address(1, 112, 4, True)
    assert good(client.bulk_read(asked)) == [-33, 55]
    assert good(client.fast_bulk_read(asked)) == [-33, 55]
    assert registers(driver, 1).get("profile_velocity") == 55


def test_stuffed_answers(driver: Any, client: dxl2.MotorBus) -> None:
    for servo_id in (1, 2):
        registers(driver, servo_id).put("goal_position", -131073)
    assert good(client.read(1, 116, 4, True)) == -131073
    assert good(client.sync_read(sync_params(116, 4))) == [-131073, -131073]


def test_an_alert_comes_with_every_answer(driver: Any, client: dxl2.MotorBus) -> None:
    driver.bench.servos[0].core.injected_error = 0x20
    driver.bench.device.advance_to(time.monotonic())
    with pytest.raises(dxl2.HardwareError, match="device id: 1"):
        client.read(1, 132, 4)
    good(client.read(2, 132, 4))


def test_reboot_backup_and_factory_reset(driver: Any, client: dxl2.MotorBus) -> None:
    good(client.write(1, 84, 2, 700))
    good(client.control_table_backup(1))
    good(client.write(1, 84, 2, 900))
    good(client.reboot(1))
    client.conn.serial.timeout = 0.5
    until_answered(client, 1)
    assert registers(driver, 1).get("position_p_gain") == XM430_W350.factory_defaults.get(
        "position_p_gain", 800
    )
    good(client.control_table_restore(1))
    until_answered(client, 1)
    assert good(client.read(1, 84, 2)) == 700
    good(client.clear_position(1))
    good(client.write(1, 31, 1, 60))
    good(client.factory_reset_except_id_baudrate(1))
    until_answered(client, 1)
    assert good(client.read(1, 31, 1)) == 80
    assert driver.bench.servos[0].servo_id == 1
