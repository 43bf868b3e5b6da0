"""Benches that several tests of the simulator share."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import canopen
import pytest

from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.models import XM430_W350, ServoModel
from simulator.can.link import CanDevice
from simulator.clock import VirtualClock
from simulator.servo.bus import MemoryServoStream, ServoBusDevice
from simulator.servo.device import SimulatedServo
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, ServoMount
from simulator.servo.motor import ServoMotor
from simulator.servo.protocol2 import Instruction, PacketParser, encode_packet


def encode_instruction(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the packet of an instruction to a servo."""
    return encode_packet(servo_id, bytes((instruction,)) + parameters)


class DeviceLine(canopen.Network):
    """canopen's network on a simulated device, which answers at once.

    Parameters
    ----------
    step_s
        Time that passes before each message to the device in s.
    message_s
        Time that each of its messages takes in s.
    """

    def __init__(self, device: CanDevice, *, step_s: float = 0.0, message_s: float = 0.0) -> None:
        super().__init__()
        self.device, self.step_s, self.message_s = device, step_s, message_s
        self.now_s = 0.0
        self.heard: list[tuple[int, bytes]] = []
        device.send = self._hear

    def _hear(self, ready_s: float, can_id: int, burst: list[bytes]) -> float:
        for data in burst:
            self.heard.append((can_id, data))
            self.notify(can_id, bytearray(data), ready_s)
        return ready_s + self.message_s * len(burst)

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self.wait(self.step_s)
        self.device.receive(can_id, bytes(data), self.now_s)

    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        self.device.advance(self.now_s)


FINGERS = partial(FingerMechanics, linkage=ParallelogramLinkage(), aperture_m=0.06)


class ServoBench:
    """Servos on a bus in memory; the fingers of one or two move as the clock is slept on."""

    def __init__(
        self,
        ids: Sequence[int] = (1, 2),
        *,
        model: ServoModel = XM430_W350,
        settings: Mapping[str, int] | None = None,
        baudrate: int = 1_000_000,
        motor: Callable[[ServoModel], ServoMotor] = ServoMotor,
        fingers: Callable[..., FingerMechanics] = FINGERS,
    ) -> None:
        self.clock = VirtualClock()
        self.motors = [motor(model) for _ in ids]
        self.forces_n = (0.0, 0.0)
        mounts = [ServoMount(direction=1), ServoMount(direction=-1)][: len(ids)]
        self.mechanics = fingers(self.motors, mounts)
        defaults = {"baud_rate": 3, "return_delay_time": 0}
        self.servos = [
            SimulatedServo(i, model, motor, settings={**defaults, **(settings or {})})
            for i, motor in zip(ids, self.motors, strict=True)
        ]
        self.device = ServoBusDevice(self.servos, baudrate)
        self.stream = MemoryServoStream(self.device, self.clock)
        self.clock.on_advance.append(self._advance)
        self._last_s = 0.0

    def _advance(self, now_s: float) -> None:
        self.mechanics.step(now_s - self._last_s, self.forces_n)
        self._last_s = now_s
        self.device.advance_to(now_s)

    def exchange(self, request: bytes, timeout_s: float = 0.02) -> bytes:
        """Send bytes and return all that comes back until the line is quiet for the time-out."""
        self.stream.write(request)
        answer = b""
        while piece := self.stream.read(256, timeout_s):
            answer += piece
        return answer

    def ask(self, servo_id: int, instruction: int, parameters: bytes = b"") -> tuple[int, bytes]:
        """Return error byte and data of the one status packet that answers."""
        answer = self.exchange(encode_instruction(servo_id, instruction, parameters))
        (packet,) = PacketParser().push(answer)
        assert packet.intact
        assert packet.packet_id == servo_id
        assert packet.instruction == 0x55
        return packet.parameters[0], packet.parameters[1:]

    def read(self, servo_id: int, address: int, size: int, *, signed: bool = False) -> int:
        error, data = self.ask(
            servo_id, Instruction.READ, address.to_bytes(2, "little") + size.to_bytes(2, "little")
        )
        assert error & 0x7F == 0
        assert len(data) == size
        return int.from_bytes(data, "little", signed=signed)

    def get(self, servo_id: int, name: str) -> int:
        """Read an item by its name."""
        item = REGISTERS[name]
        return self.read(servo_id, item.address, item.size, signed=item.signed)

    def gets(self, servo_id: int, *names: str) -> list[int]:
        """Read items by their names."""
        return [self.get(servo_id, name) for name in names]

    def put(self, servo_id: int, **values: int) -> None:
        """Write items by their names, one after the other, each without an error."""
        for name, value in values.items():
            item = REGISTERS[name]
            assert self.write(servo_id, item.address, item.size, value) == 0, name

    def write(self, servo_id: int, address: int, size: int, value: int) -> int:
        """Write one item and return the error byte."""
        data = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
        error, rest = self.ask(servo_id, Instruction.WRITE, address.to_bytes(2, "little") + data)
        assert rest == b""
        return error


@pytest.fixture
def bench() -> ServoBench:
    """Two XM430-W350 as they come."""
    return ServoBench()
