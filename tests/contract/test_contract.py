"""What servos, control unit and drives do on their lines, simulated or real.

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
from itertools import pairwise
from typing import Any

import can
import pytest
from canopen.profiles.p402 import OperationMode, State402

from cell.build import drive_bus
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config, link_settings
from cell.control.axes import drive_axes
from cell.simulation import simulation_of
from gripper.clock import Clock
from gripper.dynamixel import control_table as table
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS, XM430_W350
from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import BusTimeout, ServoRejected
from motion import object_dictionary as motion_od
from motion.axes import Axes, Watch
from motion.drive import Cia402Drive
from motion.errors import AxisNotOperational
from motion.object_dictionary import state_of
from pytest_tactile_cell.bench import LinkBench
from pytest_tactile_cell.faults import FaultRegistry
from pytest_tactile_cell.options import HardwareOptions, config_path
from simulator.servo.protocol2 import crc16
from tactile.can.bus import CanBus, close_bus
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.node import TactileLink
from tactile.errors import ObjectRefused
from tactile.source import TactileFrame
from tests.faults.campaign import CHANGES

ANSWER_S = 0.05
BOOT_S = 3.0
POWER_UP_S = 0.2
"""The simulated unit has just got power and hears nothing before its first boot-up."""
NMT_RESET_COMMUNICATION = 130
EEPROM = [r for r in table.REGISTERS.values() if r.eeprom and r.name not in XM430_W350.absent]


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
    def restoring(self, *registers: table.Register) -> Iterator[None]:
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


def _bench(request: Any, config: CellConfig, registry: FaultRegistry) -> LinkBench:
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
        if bus.read(servo_id, table.TORQUE_ENABLE):
            pytest.fail(
                f"servo {servo_id} holds torque, a part may be in the grip: nothing was "
                "written. Release it on purpose (tactile-cell hand release --config FILE "
                "--confirm), then switch the torque off",
                pytrace=False,
            )
    before = {i: [bus.read(i, r) for r in EEPROM] for i in group.ids}
    yield group
    assert {i: [bus.read(i, r) for r in EEPROM] for i in group.ids} == before
    assert not any(bus.read(i, table.TORQUE_ENABLE) for i in group.ids)


@pytest.fixture
def moving_servos(servos: Servos) -> Iterator[Servos]:
    """Servos whose torque may be switched on; it is off again at the end."""
    if not servos.may_move:
        pytest.skip("needs torque: --allow-motion")
    try:
        yield servos
    finally:
        for servo_id in servos.ids:
            servos.bus.write(servo_id, table.TORQUE_ENABLE, 0)


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
        settings=link_settings(wanted),
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
    clock: Clock
    may_move: bool

    def heartbeats(self, seconds: float) -> list[bytes]:
        """Return the data of the heartbeats that come within so many s."""
        bus, beats = self.device._bus, list[bytes]()
        cob_id = motion_od.COB_HEARTBEAT + self.device.settings.node_id
        bus.subscribe(cob_id, lambda _id, data, _time_s: beats.append(bytes(data)))
        end_s = self.clock.monotonic() + seconds
        while (left_s := end_s - self.clock.monotonic()) > 0:
            bus.wait(left_s)
            bus.service()
        return beats


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
        device.identify()
        yield Drive(
            device=device,
            axes=axes,
            clock=clock,
            may_move=request.param == "simulator" or request.config.getoption("allow_motion"),
        )
        device._write("Controlword", State402.CW_DISABLE_VOLTAGE)
        device._write("Producer heartbeat time", 0)


# -- Servos ---------------------------------------------------------------------------------------


READ, WRITE = 0x02, 0x03
UNKNOWN_INSTRUCTION = 0x77
RESULT_INSTRUCTION, RESULT_CRC, RESULT_RANGE = 2, 3, 4
RESULT_LENGTH, RESULT_LIMIT, RESULT_ACCESS = 5, 6, 7
PROFILE = (table.PROFILE_ACCELERATION, table.PROFILE_VELOCITY)
LED_ON = b"\x41\x00\x01"
"""Address 65 and the value 1."""


def error_of(answer: bytes | None) -> int:
    """Error number of a status packet, without the Alert bit."""
    assert answer is not None
    assert (answer[:4], answer[7]) == (b"\xff\xff\xfd\x00", 0x55)
    return answer[8] & 0x7F


def refusal(servos: Any, register: Any, raw: int) -> int:
    """Error number with which a write is refused."""
    with pytest.raises(ServoRejected) as caught:
        servos.bus.write(servos.one, register, raw)
    return caught.value.code


def test_ping_tells_model_and_firmware_as_the_registers_do(servos: Any) -> None:
    for servo_id in servos.ids:
        answer = servos.bus.ping(servo_id)
        assert answer.model_number in {model.number for model in MODELS.values()}
        assert answer.model_number == servos.bus.read(servo_id, table.MODEL_NUMBER)
        assert answer.firmware == servos.bus.read(servo_id, table.FIRMWARE_VERSION)


def test_nobody_answers_for_an_absent_servo(servos: Any) -> None:
    with pytest.raises(BusTimeout, match=str(servos.nobody)):
        servos.bus.ping(servos.nobody)
    servos.bus.ping(servos.one)


def test_what_is_written_is_read_back(servos: Any) -> None:
    with servos.restoring(table.LED, table.PROFILE_VELOCITY):
        for raw in (0, 1):
            servos.bus.write(servos.one, table.LED, raw)
            assert servos.bus.read(servos.one, table.LED) == raw
        for raw in (1, 255, 256, 32767):
            servos.bus.write(servos.one, table.PROFILE_VELOCITY, raw)
            assert servos.bus.read(servos.one, table.PROFILE_VELOCITY) == raw


def test_present_values_are_plausible_at_rest(servos: Any) -> None:
    answer = servos.bus.sync_read(
        servos.ids, table.RegisterBlock.between(table.PRESENT_CURRENT, table.PRESENT_POSITION)
    )
    for values in answer.values():
        assert abs(values["present_current"]) < 20
        assert abs(values["present_velocity"]) < 5


def test_a_sync_read_with_an_absent_servo_gives_nothing(servos: Any) -> None:
    with pytest.raises(BusTimeout, match=str(servos.nobody)):
        servos.bus.sync_read((servos.nobody, servos.one), table.RegisterBlock(table.LED))
    assert servos.bus.sync_read((servos.one,), table.RegisterBlock(table.LED))


def test_a_sync_write_reaches_all_and_a_sync_read_tells_what_single_reads_tell(servos: Any) -> None:
    with servos.restoring(*PROFILE):
        wanted = {servo_id: (servo_id, 200 + servo_id) for servo_id in servos.ids}
        servos.bus.sync_write(wanted, table.RegisterBlock(*PROFILE))
        answer = servos.bus.sync_read(servos.ids, table.RegisterBlock(*PROFILE))
        assert list(answer) == list(servos.ids)
        for servo_id, raws in wanted.items():
            assert tuple(servos.bus.read(servo_id, register) for register in PROFILE) == raws
            assert tuple(answer[servo_id].values()) == raws


def test_a_damaged_packet_is_refused_or_ignored_and_never_carried_out(servos: Any) -> None:
    with servos.restoring(table.LED):
        servos.bus.write(servos.one, table.LED, 0)
        for damage in (0x0001, 0x8000, 0xFFFF):
            answer = servos.exchange(WRITE, LED_ON, damage=damage)
            if answer is not None:
                assert error_of(answer) == RESULT_CRC
            assert servos.bus.read(servos.one, table.LED) == 0
        assert error_of(servos.exchange(WRITE, LED_ON)) == 0
        assert servos.bus.read(servos.one, table.LED) == 1


def test_stuffed_parameters_are_understood(servos: Any) -> None:
    # A read of 00FD bytes from address FFFF: its parameters FF FF FD 00 travel as FF FF FD FD 00.
    # A servo that did not remove the stuffing would read from elsewhere, or stay silent.
    assert error_of(servos.exchange(READ, b"\xff\xff\xfd\xfd\x00")) != 0
    assert servos.bus.read(servos.one, table.MODEL_NUMBER)


def test_an_unknown_instruction_is_refused(servos: Any) -> None:
    assert error_of(servos.exchange(UNKNOWN_INSTRUCTION, b"")) == RESULT_INSTRUCTION


def test_what_is_refused_changes_nothing(servos: Any) -> None:
    limit = servos.bus.read(servos.one, table.CURRENT_LIMIT)
    for item, change, raw, result in (
        (table.LED, {}, 2, RESULT_RANGE),
        (table.GOAL_CURRENT, {}, limit + 1, RESULT_LIMIT),
        (table.HARDWARE_ERROR_STATUS, {"writable": True}, 0, RESULT_ACCESS),
        (table.PROFILE_VELOCITY, {"size": 1}, 1, RESULT_LENGTH),
    ):
        before = servos.bus.read(servos.one, item)
        assert refusal(servos, replace(item, **change), raw) == result, item.name
        assert servos.bus.read(servos.one, item) == before


def test_the_watchdog_of_a_servo_without_torque_does_not_trip(servos: Any) -> None:
    with servos.restoring(table.BUS_WATCHDOG):
        servos.bus.write(servos.one, table.BUS_WATCHDOG, 5)
        servos.clock.sleep(0.3)
        assert servos.bus.read(servos.one, table.BUS_WATCHDOG) == 5


def test_the_watchdog_trips_with_torque_and_refuses_goals_until_it_is_cleared(
    moving_servos: Any,
) -> None:
    servos = moving_servos
    goal = servos.bus.read(servos.one, table.GOAL_CURRENT)
    servos.bus.write(servos.one, table.TORQUE_ENABLE, 1)
    servos.bus.write(servos.one, table.BUS_WATCHDOG, 5)
    servos.clock.sleep(0.3)
    assert servos.bus.read(servos.one, table.BUS_WATCHDOG) == table.WATCHDOG_TRIPPED_RAW
    assert refusal(servos, table.GOAL_CURRENT, goal) == RESULT_RANGE
    servos.bus.write(servos.one, table.BUS_WATCHDOG, 0)
    servos.bus.write(servos.one, table.GOAL_CURRENT, goal)
    assert servos.bus.read(servos.one, table.BUS_WATCHDOG) == 0


def test_eeprom_is_writable_without_torque_only(moving_servos: Any) -> None:
    servos = moving_servos
    before = servos.bus.read(servos.one, table.MOVING_THRESHOLD)
    servos.bus.write(servos.one, table.MOVING_THRESHOLD, before)
    servos.bus.write(servos.one, table.TORQUE_ENABLE, 1)
    assert refusal(servos, table.MOVING_THRESHOLD, before) == RESULT_ACCESS
    servos.bus.write(servos.one, table.TORQUE_ENABLE, 0)
    servos.bus.write(servos.one, table.MOVING_THRESHOLD, before)


# -- What the tactile control unit does on its bus, simulated or real (its EDS, CiA 301) -----------


PRE_OPERATIONAL, OPERATIONAL = 127, 5
ABORT = 0x80
READ_OBJECT = 0x40
WRITE_2, WRITE_4, WRITTEN = 0x2B, 0x23, 0x60


def request(command: int, index: int, subindex: int, value: int = 0) -> bytes:
    return struct.pack("<BHBL", command, index, subindex, value)


def test_the_unit_is_what_its_eds_says(unit) -> None:
    identity = unit.link.start()  # compares layout, formats and mapping, or raises
    assert (identity.vendor_id, identity.product_code) == (od.VENDOR_ID, od.PRODUCT_CODE)
    assert identity.revision >> 16 == od.REVISION >> 16
    assert identity.name


def test_each_sync_gives_one_whole_frame(unit) -> None:
    unit.link.start()
    frames = unit.frames(20 * unit.link.settings.sync_period_s)
    assert 18 <= len(frames) <= 21
    assert all((b.counter - a.counter) & 0xFFFF == 1 for a, b in pairwise(frames))
    layout = unit.link.layout
    for frame in frames:
        assert frame.counts.shape == (layout.n_taxels,)
        assert frame.counts.max() <= layout.adc_max
    statistics = unit.link.statistics
    assert len(frames) <= statistics.requests
    counts = statistics.frames
    assert (counts.lost, counts.torn, counts.short, counts.corrupt) == (0, 0, 0, 0)


def test_without_sync_no_frame_comes(unit) -> None:
    unit.link.start()
    unit.frames(0.1)
    unit.link.stop()
    end_s = unit.clock.monotonic() + 0.05
    while unit.clock.monotonic() < end_s:
        unit.receive(0x180 + unit.node_id, 0.01)  # what was on its way
    assert unit.receive(0x180 + unit.node_id, 0.2) is None


def test_a_reset_is_told_by_a_boot_up_and_ends_pre_operational(unit) -> None:
    unit.send(0, bytes((1, unit.node_id)))
    unit.reset()  # fails without a boot-up
    assert unit.sdo(request(WRITE_2, 0x1017, 0, 50))[0] == WRITTEN
    assert unit.receive(0x700 + unit.node_id)[1] == bytes([PRE_OPERATIONAL])


def test_the_heartbeat_comes_as_often_as_it_is_set(unit) -> None:
    node, period_s = unit.node_id, 0.1
    assert unit.sdo(request(WRITE_2, 0x1017, 0, round(1000 * period_s)))[0] == WRITTEN
    beats = [unit.receive(0x700 + node, 2.0) for _ in range(6)]
    assert all(beat is not None for beat in beats)
    gaps_s = [b[0] - a[0] for a, b in pairwise(beats[1:])]
    assert all(gap_s == pytest.approx(period_s, rel=0.5) for gap_s in gaps_s), gaps_s
    assert sum(gaps_s) == pytest.approx(len(gaps_s) * period_s, rel=0.2)
    assert all(beat[1] == bytes([PRE_OPERATIONAL]) for beat in beats[1:])
    unit.send(0, bytes((1, node)))
    assert [unit.receive(0x700 + node, 2.0)[1][0] for _ in range(3)][-1] == OPERATIONAL


REFUSED = {
    "no object": (request(READ_OBJECT, 0x5FFF, 0), 0x0602_0000),
    "no sub-index": (request(READ_OBJECT, 0x1018, 9), 0x0609_0011),
    "read only": (request(WRITE_4, 0x1018, 1, 1), 0x0601_0002),
    "no command": (request(0xE0, 0x1018, 1), 0x0504_0001),
}
"""Requests, each with the code of its abort (CiA 301)."""


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_done_is_aborted_with_its_code(unit, why: str) -> None:
    asked, code = REFUSED[why]
    answer = unit.sdo(asked)
    assert answer[0] == ABORT
    assert answer[1:4] == asked[1:4]
    assert int.from_bytes(answer[4:], "little") == code
    # and the server still serves
    assert int.from_bytes(unit.sdo(request(READ_OBJECT, 0x1018, 1))[4:], "little") == od.VENDOR_ID


# -- What a CiA 402 drive does on its bus, simulated or real, as far as the axes rely on it --------


READY = ("SWITCH ON DISABLED", "READY TO SWITCH ON")


def test_it_is_a_drive_with_the_modes_that_are_needed(drive: Any) -> None:
    assert drive.device._read("Device type") & 0xFFFF == 402
    modes = drive.device._read("Supported drive modes")
    assert modes & OperationMode.SUPPORTED["PROFILED POSITION"]
    assert state_of(drive.device._status()) in drive.device.identify()


def test_its_heartbeat_comes_as_often_as_it_shall(drive: Any) -> None:
    drive.device._write("Producer heartbeat time", 50)
    beats = drive.heartbeats(1.0)
    assert 15 <= len(beats) <= 25
    assert all(len(data) == 1 and data[0] & 0x7F in (4, 5, 127) for data in beats)


def test_a_stopped_drive_beats_on_and_answers_no_sdo(drive: Any) -> None:
    drive.device._write("Producer heartbeat time", 50)
    drive.device._command("STOPPED")
    with pytest.raises(AxisNotOperational, match="NMT state stopped"):
        drive.device.identify()
    drive.device.clear_fault(reboot=False)
    assert {data[0] & 0x7F for data in drive.heartbeats(0.5)[1:]} == {5}


def test_what_is_set_up_is_read_back(drive: Any) -> None:
    drive.device._set_up()
    settings = drive.device.settings
    low = settings.limits[0] - drive.device._home_count
    assert drive.device._read("Software position limit.Min position limit") == low
    assert drive.device._read("Profile velocity") == settings.counts(settings.velocity)
    assert drive.device._read("Quick stop option code") == motion_od.STAY_IN_QUICK_STOP


def test_an_object_that_is_not_there_is_refused(drive: Any) -> None:
    with pytest.raises(ObjectRefused, match="06090011"):
        drive.device._client.upload(0x1018, 9)


def test_without_power_stage_it_goes_between_two_states(drive: Any) -> None:
    device = drive.device
    device._write("Controlword", State402.CW_DISABLE_VOLTAGE)
    for control, state in zip(
        (State402.CW_SHUTDOWN, State402.CW_DISABLE_VOLTAGE), READY[::-1], strict=True
    ):
        device._write("Controlword", control)
        device._until(lambda state=state: device._state() == state, "does not follow")
        assert device._read("Velocity actual value") == 0


@pytest.mark.slow
def test_it_goes_to_both_ends_and_stops_quickly_on_the_way(drive: Any) -> None:
    if not drive.may_move:
        pytest.skip("needs motion: --allow-motion")
    axis = drive.device
    settings = axis.settings
    low, high, near = settings.low, settings.high, settings.window
    middle, way = 0.5 * (low + high), 0.4 * (high - low)
    for target in (middle - way, middle + way):
        assert drive.axes.move({axis.name: target})[axis.name] == pytest.approx(target, abs=near)

    half_s = way / settings.velocity
    began_s = drive.clock.monotonic()

    def stop() -> None:
        if drive.clock.monotonic() - began_s > half_s:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        drive.axes.move({axis.name: middle - way}, stop)
    assert drive.device._state() == "QUICK STOP ACTIVE"
    assert middle - way + near < axis.position < middle + way
