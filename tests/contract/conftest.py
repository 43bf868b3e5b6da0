"""The ends of both links for tests that hold for simulated and real devices alike.

Without options the tests run on the simulator, and those on hardware are skipped:

    pytest tests/contract --servo-port /dev/ttyUSB0
    pytest tests/contract --can-interface socketcan --can-channel can0
    pytest tests/contract --cell-config my-cell.yaml --axes

Nothing moves and no torque is switched on without --allow-motion; EEPROM is left as it was found.
"""

import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import can
import pytest
from canopen.profiles.p402 import State402

from cell.build import drive_bus
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.axes import drive_axes, si_per_unit
from cell.simulation import simulation_of
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import REGISTERS, TORQUE_ENABLE, Register
from gripper.dynamixel.models import XM430_W350
from gripper.dynamixel.serial_port import ByteStream
from motion.axes import Axes, Watch
from motion.drive import Cia402Drive, DriveBus
from pytest_tactile_cell.bench import LinkBench
from pytest_tactile_cell.faults import FaultRegistry
from pytest_tactile_cell.options import HardwareOptions, config_path
from simulator.servo.protocol2 import crc16
from tactile.can.bus import CanBus, close_bus
from tactile.control_unit.node import TactileLink
from tactile.control_unit.settings import LinkSettings
from tactile.source import TactileFrame
from tests.faults.campaign import CHANGES

ANSWER_S = 0.05
BOOT_S = 3.0
POWER_UP_S = 0.2
"""The simulated unit has just got power and hears nothing before its first boot-up."""
NMT_RESET_COMMUNICATION = 130
EEPROM = [r for r in REGISTERS.values() if r.eeprom and r.name not in XM430_W350.absent]


@dataclass(frozen=True, kw_only=True)
class Servos:
    """Servos at the host's end of their line; nothing moves unless ``may_move``."""

    bus: ServoBus
    stream: ByteStream
    clock: Clock
    ids: tuple[int, ...]
    may_move: bool

    @property
    def one(self) -> int:
        return self.ids[0]

    @property
    def nobody(self) -> int:
        """An ID that no servo has."""
        return next(i for i in range(252, 0, -1) if i not in self.ids)

    def exchange(self, instruction: int, params: bytes, *, damage: int = 0) -> bytes | None:
        """Send one packet as it stands and return the status packet, None without an answer."""
        body = struct.pack("<BHB", self.one, len(params) + 3, instruction) + params
        packet = b"\xff\xff\xfd\x00" + body
        packet += struct.pack("<H", crc16(packet) ^ damage)
        self.stream.drop_input()
        self.stream.write(packet)
        answer, end_s = b"", self.clock.monotonic() + ANSWER_S
        while (left_s := end_s - self.clock.monotonic()) > 0:
            answer += self.stream.read(64, left_s)
            if len(answer) >= 7 and len(answer) >= 7 + int.from_bytes(answer[5:7], "little"):
                break
        return answer or None

    @contextmanager
    def restoring(self, *registers: Register) -> Iterator[None]:
        """Write back at the end what the registers held before."""
        before = {(i, r): self.bus.read(i, r) for i in self.ids for r in registers}
        try:
            yield
        finally:
            for (servo_id, register), raw in before.items():
                self.bus.write(servo_id, register, raw)


@dataclass(frozen=True, kw_only=True)
class Unit:
    """The control unit at the host's end of its bus."""

    bus: CanBus
    clock: Clock
    node_id: int
    link: TactileLink

    def frames(self, seconds: float) -> list[TactileFrame]:
        """Poll for so long and return the frames that came."""
        received: list[TactileFrame] = []
        end_s = self.clock.monotonic() + seconds
        while self.clock.monotonic() < end_s:
            received += self.link.poll().frames
            self.clock.sleep(0.001)
        return received

    def send(self, cob_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def receive(self, cob_id: int, timeout_s: float = 1.0) -> tuple[float, bytes] | None:
        """Return time and data of the next message with this COB-ID, None without one."""
        end_s = self.clock.monotonic() + timeout_s
        while (left_s := end_s - self.clock.monotonic()) > 0:
            message = self.bus.recv(left_s)
            if message is not None and message.arbitration_id == cob_id:
                return self.clock.monotonic(), bytes(message.data)
        return None

    def sdo(self, request: bytes) -> bytes:
        """Send 8 bytes to the SDO server and return its 8 bytes."""
        self.send(0x600 + self.node_id, request)
        answer = self.receive(0x580 + self.node_id)
        assert answer is not None, "the SDO server is silent"
        return answer[1]

    def reset(self) -> None:
        """Let the unit boot, so that it forgets what was set up, and wait until it says so."""
        while self.bus.recv(0) is not None:
            pass  # an earlier boot-up is not this one
        self.send(0, bytes((NMT_RESET_COMMUNICATION, self.node_id)))
        end_s = self.clock.monotonic() + BOOT_S
        while (left_s := end_s - self.clock.monotonic()) > 0:
            message = self.receive(0x700 + self.node_id, left_s)
            if message is not None and message[1] == b"\0":
                return
        pytest.fail(f"control unit {self.node_id} sends no boot-up within {BOOT_S} s after a reset")


def _bench(
    request: pytest.FixtureRequest, config: CellConfig, registry: FaultRegistry
) -> LinkBench:
    options = HardwareOptions.of(request.config)
    if request.param == "simulator":
        options = replace(options, servo_port=None, can_interface=None, can_channel=None)
    return LinkBench(config, options, registry)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test on the simulator, and on hardware where an option names it."""
    ports = (("servos", "servo_port"), ("unit", "can_interface"), ("drive", "axes"))
    for fixture, port in ports:
        if fixture in metafunc.fixturenames:
            reason = f"no hardware named: --{port.replace('_', '-')}"
            missing = not metafunc.config.getoption(port)
            marks = [pytest.mark.skip(reason=reason)] if missing else []
            real = pytest.param("hardware", marks=marks)
            metafunc.parametrize(fixture, ["simulator", real], indirect=True)


@pytest.fixture
def servos(
    request: pytest.FixtureRequest, cell_config: CellConfig, cell_faults: FaultRegistry
) -> Iterator[Servos]:
    bench = _bench(request, cell_config, cell_faults)
    bus, (stream, clock) = bench.servo_bus, bench.servo_line
    group = Servos(
        bus=bus,
        stream=stream,
        clock=clock,
        ids=tuple(servo.id for servo in cell_config.gripper.servos),
        may_move=request.param == "simulator" or bench.options.allow_motion,
    )
    for servo_id in group.ids:
        if bus.read(servo_id, TORQUE_ENABLE):
            pytest.fail(
                f"servo {servo_id} holds torque, a part may be in the grip: nothing was "
                "written. Release it on purpose (tactile-cell hand release --config FILE "
                "--confirm), then switch the torque off",
                pytrace=False,
            )
    before = {i: [bus.read(i, r) for r in EEPROM] for i in group.ids}
    yield group
    assert {i: [bus.read(i, r) for r in EEPROM] for i in group.ids} == before
    assert not any(bus.read(i, TORQUE_ENABLE) for i in group.ids)


@pytest.fixture
def moving_servos(servos: Servos) -> Iterator[Servos]:
    """Servos whose torque may be switched on; it is off again at the end."""
    if not servos.may_move:
        pytest.skip("needs torque: --allow-motion")
    try:
        yield servos
    finally:
        for servo_id in servos.ids:
            servos.bus.write(servo_id, TORQUE_ENABLE, 0)


@pytest.fixture
def unit(
    request: pytest.FixtureRequest, cell_config: CellConfig, cell_faults: FaultRegistry
) -> Iterator[Unit]:
    bench = _bench(request, cell_config, cell_faults)
    wanted = cell_config.tactile
    bus, clock = bench.can_line
    link = TactileLink(
        bus,
        node_id=wanted.node_id,
        layout=layout_from_config(wanted),
        settings=LinkSettings(
            sync_period_s=wanted.sync_period_ms * 1e-3, heartbeat_s=wanted.heartbeat_ms * 1e-3
        ),
    )
    opened = Unit(bus=bus, clock=clock, node_id=wanted.node_id, link=link)
    opened.clock.sleep(POWER_UP_S)
    opened.reset()
    yield opened
    link.stop()
    opened.reset()


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A drive at the host's end of its bus, and the axis that it moves, if it may."""

    device: Cia402Drive
    axes: Axes
    name: str
    low: float
    high: float
    bus: DriveBus
    node_id: int
    clock: Clock
    may_move: bool

    def heard(self, cob_id: int, seconds: float) -> list[tuple[float, bytes]]:
        """Return time and data of the messages of an identifier that come within so many s."""
        messages: list[tuple[float, bytes]] = []
        self.bus.subscribe(
            cob_id,
            lambda _id, data, _time_s: messages.append((self.clock.monotonic(), bytes(data))),
        )
        end_s = self.clock.monotonic() + seconds
        while (left_s := end_s - self.clock.monotonic()) > 0:
            self.bus.wait(left_s)
            self.bus.service()
        return messages


@pytest.fixture
def drive(request: pytest.FixtureRequest) -> Iterator[Drive]:
    """The first drive of the config; simulated: the x axis of the fault campaign."""
    clock: Clock = time
    bus: can.BusABC | None
    with ExitStack() as closing:
        if request.param == "simulator":
            config = changed_config(CellConfig(), CHANGES)
            simulated = simulation_of(config)
            closing.callback(simulated.close)
            bus, clock = simulated.axes_can_bus, simulated.clock
            clock.sleep(POWER_UP_S)
        else:
            config = load_config(config_path(request.config))
            bus = drive_bus(config)
            closing.callback(close_bus, bus)
        axis = config.positioner.drives[0]
        watch, loss_s = Watch(clock, 0.005), 1e-3 * config.positioner.can.heartbeat_loss_ms
        axes = Axes(drive_axes([axis], bus, watch, loss_s=loss_s), watch)
        device = axes._axes[axis.moves]
        assert isinstance(device, Cia402Drive)
        si = si_per_unit(axis.moves)
        device.identify()
        yield Drive(
            device=device,
            axes=axes,
            name=axis.moves,
            low=axis.low * si,
            high=axis.high * si,
            bus=device._bus,
            node_id=axis.node_id,
            clock=clock,
            may_move=request.param == "simulator" or request.config.getoption("allow_motion"),
        )
        device._write("Controlword", State402.CW_DISABLE_VOLTAGE)
        device._write("Producer heartbeat time", 0)
