"""A simulated drive and a simulated wrist, in virtual time, with the axes that command them."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import XM430_W350
from motion.axes import Axes, Watch
from motion.drive import Cia402Drive, DriveBus, DriveSettings
from motion.object_dictionary import HomingMethod
from motion.servo import ServoAxis, ServoAxisSettings
from simulator.can.drive import DriveMount, SimulatedDrive
from simulator.can.link import CanLink, InMemoryCanBus
from simulator.clock import VirtualClock
from simulator.servo.bus import MemoryServoStream
from simulator.servo.wrist import SimulatedWrist, WristMount
from tests.cell.cells import once

NODE = 11
PER_M = 1e6
PER_RAD = 4096 / math.tau
BOOT_S = 0.1
SETTINGS = DriveSettings(
    name="x",
    linear=True,
    increments=PER_M,
    low=-0.02,
    high=0.02,
    velocity=0.05,
    acceleration=0.5,
    window=2e-5,
    lag=1e-3,
    node_id=NODE,
    homing=HomingMethod.NEGATIVE_SWITCH,
    home=-0.025,
    homing_velocity=0.05,
)
WRIST_SETTINGS = ServoAxisSettings(
    name="roll",
    linear=False,
    increments=PER_RAD,
    low=0.0,
    high=math.pi,
    velocity=1.44,
    acceleration=7.5,
    window=0.018,
    lag=0.14,
    servo_id=7,
    model=XM430_W350,
    zero=500,
    current_a=1.0,
    loss_s=0.1,
)


@dataclass
class DriveBench:
    """One drive along x, 1 increment a µm, switches at ±25 mm."""

    clock: VirtualClock
    simulated: SimulatedDrive
    link: CanLink
    bus: InMemoryCanBus
    drive: Cia402Drive
    axes: Axes
    supervised: list[float] = field(default_factory=list)

    def move(self, x_m: float) -> float:
        note = self.supervised.append
        return self.axes.move({"x": x_m}, lambda: note(self.clock.monotonic()))["x"]

    def second_drive(self) -> Callable[[], None]:
        """Let a drive with the same node-ID join the bus; returns what takes it off again."""
        return self.link.add(SimulatedDrive(self.simulated.mount, start_s=self.clock.monotonic()))

    def once_moving(self, act: Callable[[], Any]) -> None:
        """Do something once, 20 ms after the axis began to move."""
        once(self.clock, lambda: self.simulated.moving, act, after_s=0.02)


MakeDrive = Callable[..., DriveBench]


@pytest.fixture
def make_drive(undo: ExitStack) -> MakeDrive:
    def make(*, start_m: float = 3e-3, **changes: Any) -> DriveBench:
        settings = replace(SETTINGS, **changes)
        clock = VirtualClock()
        simulated = SimulatedDrive(
            DriveMount(
                node_id=NODE,
                increments=PER_M,
                start=start_m,
                low_switch=-0.025,
                high_switch=0.025,
                absolute=settings.homing is None,
            )
        )
        link = CanLink(simulated)
        bus = InMemoryCanBus(link, clock)
        undo.callback(bus.shutdown)
        clock.sleep(BOOT_S)
        watch = Watch(clock, 0.005)
        drive = Cia402Drive(settings, DriveBus(bus, watch, 0.125))
        return DriveBench(clock, simulated, link, bus, drive, Axes([drive], watch))

    return make


@dataclass
class WristBench:
    """One servo, 0 to 180 degrees, 0 at 500 pulses; it begins at 100 degrees."""

    clock: VirtualClock
    simulated: SimulatedWrist
    servo: ServoAxis
    axes: Axes

    def move(self, roll_rad: float) -> float:
        return self.axes.move({"roll": roll_rad})["roll"]


@pytest.fixture
def make_wrist() -> Callable[..., WristBench]:
    def make(*, start_rad: float = 1.75) -> WristBench:
        clock = VirtualClock()
        mount = WristMount(servo_id=7, increments=PER_RAD, zero=500, start=start_rad)
        simulated = SimulatedWrist(mount)
        clock.on_advance.append(simulated.advance)
        stream = MemoryServoStream(simulated.bus, clock)
        watch = Watch(clock, 0.005)
        bus = ServoBus(stream, baudrate=1_000_000, clock=clock)
        servo = ServoAxis(WRIST_SETTINGS, bus, watch)
        return WristBench(clock, simulated, servo, Axes([servo], watch))

    return make
