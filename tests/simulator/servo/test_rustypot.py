"""Clients written by others talk to the simulated servos over a real pseudo-terminal."""

import time
from typing import Any

import dynamixel_sdk
import pytest

rustypot = pytest.importorskip("rustypot")

TIMEOUT_S = 10.0
"""Patience in s with an answer: other tests run beside this one."""


@pytest.fixture
def driver(serve) -> Any:
    return serve(settings={"operating_mode": 5})


@pytest.fixture
def client(driver):
    controller = rustypot.Xl430PyController(driver.endpoint.path, 1_000_000, TIMEOUT_S)
    yield controller
    controller.close()


def present(driver: Any, servo_id: int) -> int:
    return driver.bench.servos[servo_id - 1].core.position.present_raw()


def registers(driver: Any, servo_id: int):
    return driver.bench.servos[servo_id - 1].core.registers


def test_ping_and_scan(client):
    assert client.ping(1)
    assert client.scan([1, 2]) == {1: 1020, 2: 1020}


def test_reading_and_writing(driver, client):
    data = client.read_raw_data(1, 132, 4)
    assert int.from_bytes(bytes(data), "little") == present(driver, 1)
    client.write_raw_data(1, 116, list((2100).to_bytes(4, "little")))
    assert registers(driver, 1).get("goal_position") == 2100


def test_a_stuffed_write_and_the_stuffed_answer(driver, client):
    payload = list(bytes.fromhex("FFFFFDFF"))
    assert client.write_raw_data_with_error(1, 116, payload) == 0
    assert registers(driver, 1).get("goal_position") == -131073
    data, error = client.read_raw_data_with_error(1, 116, 4)
    assert (bytes(data), error) == (bytes(payload), 0)


@pytest.mark.parametrize("fast", [False, True])
def test_sync_reads(driver, client, fast: bool):
    client.set_fast_sync_read(fast)
    blocks = client.sync_read_raw_data([1, 2], 126, 10)
    for servo_id, block in zip((1, 2), blocks, strict=True):
        assert int.from_bytes(bytes(block)[6:], "little") == present(driver, servo_id)


@pytest.mark.parametrize("fast", [False, True])
def test_payloads_that_look_like_a_header(driver, client, fast: bool):
    for i in (1, 2):
        registers(driver, i).put("goal_position", -131073)
    client.set_fast_sync_read(fast)
    blocks = client.sync_read_raw_data([1, 2], 116, 4)
    assert [bytes(block) for block in blocks] == [bytes.fromhex("FFFFFDFF")] * 2


@pytest.mark.parametrize("fast", [False, True])
def test_alert_and_access_errors(driver, client, fast: bool):
    client.set_fast_sync_read(fast)
    driver.bench.servos[1].core.injected_error = 0x20
    driver.bench.device.advance_to(time.monotonic())
    answers = client.sync_read_raw_data_with_error([1, 2], 132, 4)
    assert [error for _, error in answers] == [0, 0x80]


def test_a_refused_read_shows_its_error(client):
    (answer,) = client.sync_read_raw_data_with_error([1], 71, 1)
    assert answer[1] == 7


def test_reboot(driver, client):
    registers(driver, 1).put("profile_velocity", 5)
    client.reboot(1)
    assert registers(driver, 1).get("profile_velocity") == 0


# The vendor's own package as a client


@pytest.fixture
def sdk(driver, monkeypatch):
    # It waits for an answer for twice this time, in ms: other tests run beside this one.
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 5000)
    port = dynamixel_sdk.PortHandler(driver.endpoint.path)
    assert port.openPort()
    assert port.setBaudRate(1_000_000)
    yield port, dynamixel_sdk.PacketHandler(2.0)
    port.closePort()


def test_the_sdk_pings_reads_and_writes(driver, sdk):
    port, packets = sdk
    assert packets.ping(port, 1) == (1020, 0, 0)
    assert packets.read4ByteTxRx(port, 2, 132) == (present(driver, 2), 0, 0)
    assert packets.write2ByteTxRx(port, 1, 102, 123) == (0, 0)
    assert registers(driver, 1).get("goal_current") == 123
    assert packets.write2ByteTxRx(port, 1, 102, 1194) == (0, 6)
    assert packets.writeTxRx(port, 1, 132, 1, [0]) == (0, 7)


@pytest.mark.parametrize("reader", ["GroupSyncRead", "GroupFastSyncRead"])
def test_the_sdk_reads_groups(driver, sdk, reader: str):
    port, packets = sdk
    group = dynamixel_sdk.GroupSyncRead(port, packets, 126, 10)
    for i in (1, 2):
        assert group.addParam(i)
    assert (group.txRxPacket() if reader == "GroupSyncRead" else group.fastSyncRead()) == 0
    assert [group.getData(i, 132, 4) for i in (1, 2)] == [present(driver, i) for i in (1, 2)]


def test_the_sdk_writes_groups(driver, sdk):
    port, packets = sdk
    group = dynamixel_sdk.GroupSyncWrite(port, packets, 102, 2)
    assert group.addParam(1, [100, 0])
    assert group.addParam(2, [0x9C, 0xFF])
    assert group.txPacket() == 0
    assert packets.read2ByteTxRx(port, 2, 102) == (0xFF9C, 0, 0)
    assert [registers(driver, i).get("goal_current") for i in (1, 2)] == [100, -100]


def test_the_unstuffed_write_of_the_sdk_is_not_carried_out(driver, sdk, monkeypatch):
    port, packets = sdk
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 50)
    before = registers(driver, 1).get("goal_position")
    result, _ = packets.write4ByteTxRx(port, 1, 116, 0xFFFDFFFF)
    assert result == dynamixel_sdk.COMM_RX_TIMEOUT
    assert registers(driver, 1).get("goal_position") == before
