"""What no cell can be made of is refused, with the name of the setting."""

import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from gripper.dynamixel.models import XM430_W350
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.faults import CanLinkFaults, Disturber
from simulator.can.wire import CanWire
from simulator.cell import SimulatedCell
from simulator.clock import Pace, VirtualClock
from simulator.errors import SimulatorSettingsError
from simulator.servo.bus import ServoBusDevice
from simulator.servo.device import SimulatedServo
from simulator.servo.gearing import Gearing
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, RackLinkage, ServoMount
from simulator.servo.motor import ServoMotor
from simulator.settings import SimulatorSettings


def servo(**settings: int) -> SimulatedServo:
    return SimulatedServo(1, XM430_W350, ServoMotor(), settings=settings)


def fingers(motors: int = 2, **options: float) -> FingerMechanics:
    made = [ServoMotor() for _ in range(motors)]
    mounts = [ServoMount() for _ in range(motors)]
    return FingerMechanics(made, mounts, ParallelogramLinkage(), **{"aperture_m": 0.01} | options)


def disturb(faults: CanLinkFaults) -> None:
    list(Disturber(faults, np.random.default_rng(0)).pass_on(0.0, b""))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ControlUnitSettings(node_id=0), "node_id"),
        (lambda: ControlUnitSettings(node_id=128), "node_id"),
        (lambda: ControlUnitSettings(bitrate=0), "bitrate"),
        (lambda: ControlUnitSettings(boot_s=-1.0), "boot_s"),
        (lambda: CanWire(0), "bit rate"),
        (lambda: SimulatorSettings(aperture_m=0.5), "aperture_m"),
        (lambda: SimulatedCell(SimulatorSettings(servo_baud_rate=12345)), "servo_baud_rate"),
        (lambda: ServoBusDevice([servo(), servo()], 57600), "IDs"),
        (lambda: ServoBusDevice([servo()], 0), "baudrate"),
        (lambda: servo(present_position=1), "present_position"),
        (lambda: servo(no_such_item=1), "no_such_item"),
        (lambda: servo(return_delay_time=255), "return_delay_time"),
        (lambda: fingers(0), "one or two motors"),
        (lambda: fingers(half_opening_min_m=-0.1), "half_opening_min_m"),
        (lambda: fingers().drive_to(-1.0), "aperture -1.0 m"),
        (lambda: fingers().drive_to(1.0), "aperture 1.0 m"),
        (lambda: fingers().drive_to(math.nan), "aperture nan m"),
        (lambda: ServoMount(direction=0), "direction"),
        (lambda: ParallelogramLinkage(link_m=0.0), "link_m"),
        (lambda: RackLinkage(travel_m=math.inf), "travel_m"),
        (lambda: ParallelogramLinkage().angle_rad(0.07), "out of reach"),
        (lambda: RackLinkage().angle_rad(0.06), "beyond"),
        (lambda: Gearing(load_friction=1.0), "load_friction"),
        (lambda: Gearing(ripple=-0.1), "ripple"),
        (lambda: Gearing(backlash_rad=math.nan), "backlash_rad"),
        (lambda: ServoMotor(angle_rad=math.nan), "finite"),
    ],
)
def test_the_setting_is_named(make: Callable[[], object], says: str) -> None:
    with pytest.raises(SimulatorSettingsError, match=says):
        make()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: VirtualClock(start_s=math.nan), "finite time"),
        (lambda: VirtualClock().advance_to(math.inf), "finite time"),
        (lambda: VirtualClock().sleep(-1e-9), "sleep takes"),
        (lambda: VirtualClock().sleep(math.nan), "sleep takes"),
        (lambda: VirtualClock().sleep(math.inf), "sleep takes"),
        (lambda: Pace(VirtualClock(), time, speed=0.0), "positive speed"),
        (lambda: Pace(VirtualClock(), time, speed=math.inf), "positive speed"),
    ],
)
def test_times_that_no_clock_shows_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()
