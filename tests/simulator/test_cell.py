import can
import numpy as np
import pytest

from gripper.dynamixel.control_table import REGISTERS
from simulator.cell import SimulatedCell
from simulator.clock import VirtualClock
from simulator.errors import PortUnplugged
from simulator.servo.protocol2 import Instruction, encode_instruction
from simulator.settings import SimulatorSettings
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import FrameFormat
from tactile.layout import pinch_layout
from tactile.source import TactileFrame


class Host:
    """A host that speaks raw bytes on both buses of a cell."""

    def __init__(self, cell: SimulatedCell) -> None:
        self.cell = cell
        self.assembler = FrameAssembler(FrameFormat.of(cell.settings.layout))

    def write(self, name: str, raw: int) -> None:
        register = REGISTERS[name]
        value = raw.to_bytes(register.size, "little", signed=raw < 0)
        parameters = register.address.to_bytes(2, "little") + value
        for servo_id in (1, 2):
            self.cell.servo_port.write(encode_instruction(servo_id, Instruction.WRITE, parameters))
            answer = self.cell.servo_port.read(64, 0.05)
            assert (answer[4], answer[8]) == (servo_id, 0), f"{name}: {answer.hex()}"

    def squeeze(self, current_a: float) -> None:
        """Close with a motor current, after a short push that overcomes the friction."""
        self.write("torque_enable", 0)
        self.write("operating_mode", 0)
        self.write("torque_enable", 1)
        self.write("goal_current", -round(current_a / 2.69e-3))
        self.cell.clock.sleep(1.0)

    def start_unit(self) -> None:
        boot_up = self.cell.can_bus.recv(0.1)
        assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\0")
        self.cell.can_bus.send(can.Message(is_extended_id=False, data=(1, 5)))

    def frame(self) -> TactileFrame:
        self.cell.can_bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        while (message := self.cell.can_bus.recv(0.02)) is not None:
            frame = self.assembler.push(bytes(message.data), 8, self.cell.clock.monotonic())
            if frame is not None:
                return frame
        pytest.fail("the burst ended before the frame was whole")


def test_the_servos_current_becomes_the_grip_and_the_grip_becomes_counts() -> None:
    with SimulatedCell() as cell:
        host = Host(cell)
        host.start_unit()
        cell.place("box")
        assert host.frame().counts.max() <= 20
        forces_n, peaks = [], []
        for current_a in (0.2, 0.3, 0.5):
            host.squeeze(current_a)
            near_n, far_n = cell.world.contact_force_n()
            # The nest holds 0.05 N.
            assert near_n == pytest.approx(far_n, abs=0.06)
            frame = host.frame()
            forces_n.append(near_n)
            peaks.append(int(frame.counts.max()))
        assert forces_n == sorted(forces_n)
        assert 1.0 < forces_n[0] < forces_n[-1] < 20.0
        assert peaks == sorted(peaks)
        gripping = np.isin(cell.settings.layout.taxel_pad, cell.settings.layout.gripping_pads)
        assert frame.counts[gripping].max() > 60
        assert frame.counts[~gripping].max() <= 20


def test_everything_runs_on_the_clock_that_was_given() -> None:
    clock = VirtualClock(start_s=1000.0)
    with SimulatedCell(SimulatorSettings(layout=pinch_layout()), clock) as cell:
        host = Host(cell)
        host.start_unit()
        assert clock.monotonic() == pytest.approx(1000.02, abs=1e-3)
        assert host.frame().counts.shape == (156,)
    assert clock.on_advance == []


def test_a_closed_cell_is_of_no_use() -> None:
    cell = SimulatedCell()
    cell.close()
    cell.close()
    with pytest.raises(PortUnplugged):
        cell.servo_port.write(b"\0")
    with pytest.raises(can.CanOperationError):
        cell.can_bus.recv(0)
