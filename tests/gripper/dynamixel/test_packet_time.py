"""Processor time of a cycle, a sync read and a sync write of two servos, on a pseudo-terminal."""

import os
import pty
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress

import pytest
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PortHandler,
    Protocol2PacketHandler,
)

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_BLOCK, REGISTERS
from gripper.dynamixel.protocol2 import Instruction
from gripper.dynamixel.serial_port import SerialStream
from gripper.servos.goal_limits import GOAL_BLOCK
from simulator.servo.protocol2 import encode_status

IDS = (1, 2)
RAWS = (10, 0, 0, 0, 2048)
PERIOD_S = 0.005


def answer(master: int) -> None:
    """Answer each sync read until the terminal is closed."""
    answers = b"".join(encode_status(i, 0, bytes(PRESENT_BLOCK.size)) for i in IDS)
    with suppress(OSError):
        while requests := os.read(master, 512):
            for request in requests.split(b"\xff\xff\xfd\x00")[1:]:
                if request[3] == Instruction.SYNC_READ:
                    os.write(master, answers)


def cycle_of_the_bus(bus: ServoBus) -> None:
    bus.sync_read(IDS, PRESENT_BLOCK)
    bus.sync_write(dict.fromkeys(IDS, RAWS), GOAL_BLOCK)


def cycle_of_the_sdk(read: GroupSyncRead, write: GroupSyncWrite) -> None:
    assert read.txRxPacket() == COMM_SUCCESS
    for servo_id in IDS:
        for item in REGISTERS.values():
            if PRESENT_BLOCK.address <= item.address < PRESENT_BLOCK.address + PRESENT_BLOCK.size:
                read.getData(servo_id, item.address, item.size)
        write.addParam(servo_id, GOAL_BLOCK.encode(RAWS))
    assert write.txPacket() == COMM_SUCCESS
    write.clearParam()


def processor_s(cycle: Callable[[], None], n: int = 300) -> float:
    begin_s = time.thread_time()
    for _ in range(n):
        cycle()
    return (time.thread_time() - begin_s) / n


@pytest.mark.real_time
def test_the_packets_of_the_sdk_cost_less_than_a_fifth_of_a_period() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    thread = threading.Thread(target=answer, args=(master,))
    thread.start()
    path = os.ttyname(slave)
    bus = ServoBus(SerialStream(path), baudrate=1_000_000, clock=time, allowance_s=0.1)
    ours_s = min(processor_s(lambda: cycle_of_the_bus(bus)) for _ in range(3))
    bus.close()
    port, packets = PortHandler(path), Protocol2PacketHandler()
    port.setBaudRate(1_000_000)
    read = GroupSyncRead(port, packets, PRESENT_BLOCK.address, PRESENT_BLOCK.size)
    write = GroupSyncWrite(port, packets, GOAL_BLOCK.address, GOAL_BLOCK.size)
    assert all(read.addParam(servo_id) for servo_id in IDS)
    theirs_s = min(processor_s(lambda: cycle_of_the_sdk(read, write)) for _ in range(3))
    port.closePort()
    os.close(slave)
    thread.join(5.0)
    os.close(master)
    print(  # noqa: T201
        f"bus {1e6 * ours_s:.0f} us, SDK {1e6 * theirs_s:.0f} us, ratio {ours_s / theirs_s:.2f}"
    )
    assert theirs_s < 0.2 * PERIOD_S
    assert ours_s < 0.2 * PERIOD_S
