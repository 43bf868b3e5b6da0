"""A gripper from its port: what the block verifies at its beginning and keeps at its end."""

from contextlib import suppress
from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, GroupSyncRead

from gripper import (
    ForceRamp,
    ForceSample,
    Gripper,
    GripperPhase,
    GripperSettings,
    RackPinion,
    open_gripper,
)
from gripper.dynamixel.protocol2 import CheckedPacketHandler
from gripper.dynamixel.serial_port import SdkPort, open_line
from gripper.errors import LimitExceeded, PortLost, VerificationFailed
from simulator import SimulatedCell, simulated_cell
from tactile import GripForce, open_sensor


class NoPads:
    def latest_force(self) -> None:
        return None


def opened(line: Any, *args: Any) -> Gripper:
    return open_gripper(line, *args, force_sensor=NoPads())


def gripped_n(sim: SimulatedCell) -> float:
    return min(sim.world.contact_force_n())


@pytest.mark.slow
def test_an_error_in_the_block_closes_the_port_and_keeps_the_part() -> None:
    with simulated_cell("box") as sim, open_sensor(sim.can_bus) as sensor:
        sensor.tare()
        line, force = sim.servo_port, GripForce(sensor, ForceSample)
        with suppress(KeyError), open_gripper(line, force_sensor=force) as gripper:
            gripper.open()
            gripper.grasp(ForceRamp.linear(5.0, 10.0))
            raise KeyError
        assert line.closed
        sim.clock.sleep(3.0)
        assert gripped_n(sim) > 4.0
        with opened(sim.servo_port) as gripper:
            assert gripper.phase is GripperPhase.HELD_AFTER_FAULT
            assert gripped_n(sim) > 4.0
            gripper.release()
            assert gripped_n(sim) == 0.0
        assert not any(servo.torque_on for servo in sim.devices.servo_bus.servos)


def test_a_gripper_that_cannot_be_or_does_not_match_leaves_no_port_open() -> None:
    with simulated_cell() as sim:
        line = sim.servo_port
        sim.inject("servos.off")
        with pytest.raises(VerificationFailed), opened(line):
            pass
        assert line.closed
        line = sim.open_servo_port()
        with pytest.raises(LimitExceeded, match="driven by 1 servos, the settings name 2"):
            opened(line, GripperSettings(), RackPinion(pinion_radius_m=0.012))
        assert line.closed
    with pytest.raises(PortLost, match="cannot open serial port /dev/nowhere"):
        opened("/dev/nowhere")


@pytest.mark.parametrize(
    ("knob", "result"), [("drop", COMM_RX_TIMEOUT), ("bit_flip", COMM_RX_CORRUPT)]
)
def test_the_groups_of_the_sdk_have_no_value_of_an_answer_that_is_lost(knob, result) -> None:
    with simulated_cell() as sim:
        port, place = SdkPort(*open_line(sim.servo_port, 1_000_000)), (132, 4)
        group = GroupSyncRead(port, CheckedPacketHandler(), *place)
        assert all(group.addParam(servo_id) for servo_id in (1, 2))
        setattr(sim.devices.faults.servo_wire, knob, 1.0)
        assert group.txRxPacket() == result
        assert not group.isAvailable(2, *place)
