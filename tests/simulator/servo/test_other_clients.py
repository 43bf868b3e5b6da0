"""Clients written by others talk to the simulated servos over a real pseudo-terminal.

rustypot and the vendor's own package; `test_manual_dialogue` has a third encoder of packets.
"""

import select
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynamixel_sdk
import pytest
import rustypot

from simulator.realtime.terminals import SerialPty
from tests.simulator.conftest import ServoBench

TIMEOUT_S = 10.0
"""Patience in s with an answer: other tests run beside this one."""
LOOKS_LIKE_A_HEADER = bytes.fromhex("FFFFFDFF")


@dataclass
class Driver:
    """Servos behind a terminal."""

    bench: ServoBench
    endpoint: SerialPty


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[Driver]:
    """Two servos, whose terminal a thread serves."""
    bench, ended = ServoBench(settings={"operating_mode": 5}), threading.Event()
    endpoint = SerialPty(bench.device, tmp_path / "servos")

    def serve() -> None:
        while not ended.is_set():
            select.select([endpoint], [], [], 0.001)
            endpoint.poll(time.monotonic())

    thread = threading.Thread(target=serve)
    thread.start()
    yield Driver(bench, endpoint)
    ended.set()
    thread.join()
    endpoint.close()


@pytest.fixture
def rusty(driver: Any) -> Iterator[Any]:
    controller = rustypot.Xl430PyController(driver.endpoint.path, 1_000_000, TIMEOUT_S)
    yield controller
    controller.close()


def present(driver: Any, servo_id: int) -> int:
    return driver.bench.servos[servo_id - 1].present_raw()


def registers(driver: Any, servo_id: int) -> Any:
    return driver.bench.servos[servo_id - 1].registers


def test_a_ping_and_sync_reads_of_bytes_like_a_header(driver: Any, rusty: Any) -> None:
    assert rusty.ping(1)
    for block, servo_id in zip(rusty.sync_read_raw_data([1, 2], 126, 10), (1, 2), strict=True):
        assert int.from_bytes(bytes(block)[6:], "little") == present(driver, servo_id)
    assert rusty.write_raw_data_with_error(1, 116, list(LOOKS_LIKE_A_HEADER)) == 0
    registers(driver, 2).put("goal_position", -131073)
    blocks = rusty.sync_read_raw_data([1, 2], 116, 4)
    assert [bytes(block) for block in blocks] == [LOOKS_LIKE_A_HEADER] * 2


def test_the_vendors_package_reads_and_writes(driver: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # It waits for an answer for twice this time, in ms: other tests run beside this one.
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 5000)
    port, packets = dynamixel_sdk.PortHandler(driver.endpoint.path), dynamixel_sdk.PacketHandler(2)
    assert port.openPort()
    assert port.setBaudRate(1_000_000)
    assert packets.ping(port, 1) == (1020, 0, 0)
    assert packets.read4ByteTxRx(port, 2, 132) == (present(driver, 2), 0, 0)
    assert packets.write2ByteTxRx(port, 1, 102, 1194) == (0, 6)
    group = dynamixel_sdk.GroupSyncWrite(port, packets, 102, 2)
    assert group.addParam(1, [100, 0])
    assert group.addParam(2, [0x9C, 0xFF])
    assert group.txPacket() == 0
    assert packets.read2ByteTxRx(port, 2, 102) == (0xFF9C, 0, 0)
    assert [registers(driver, i).get("goal_current") for i in (1, 2)] == [100, -100]
    places = dynamixel_sdk.GroupSyncRead(port, packets, 126, 10)
    for i in (1, 2):
        assert places.addParam(i)
    assert places.txRxPacket() == 0
    assert [places.getData(i, 132, 4) for i in (1, 2)] == [present(driver, i) for i in (1, 2)]
    port.closePort()
