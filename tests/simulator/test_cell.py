"""The simulated cell, its clock, and what no cell can be made of."""

import math
import time
from collections.abc import Callable

import can
import pytest

from gripper.dynamixel.models import XM430_W350
from simulator.cell import SimulatedCell
from simulator.clock import Pace, VirtualClock
from simulator.errors import PortUnplugged, SimulatorSettingsError
from simulator.servo.device import SimulatedServo
from simulator.servo.mechanics import ParallelogramLinkage, RackLinkage
from simulator.servo.motor import ServoMotor
from simulator.settings import SimulatorSettings


def test_everything_runs_on_the_clock_that_was_given() -> None:
    clock = VirtualClock(start_s=1000.0)
    with SimulatedCell(clock=clock) as cell:
        boot_up = cell.can_bus.recv(0.1)
        assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\0")
        assert clock.monotonic() == pytest.approx(1000.02, abs=1e-3)
    assert clock.on_advance == []


def test_a_closed_cell_is_of_no_use() -> None:
    cell = SimulatedCell()
    cell.close()
    cell.close()
    with pytest.raises(PortUnplugged):
        cell.servo_port.write(b"\0")
    with pytest.raises(can.CanOperationError):
        cell.can_bus.recv(0)


@pytest.mark.parametrize(("start_s", "way_s", "n"), [(0.0, 0.0035, 4), (1.0, 0.3, 300)])
def test_callbacks_see_each_piece_and_the_end_and_rounding_makes_no_further_one(
    start_s, way_s, n
) -> None:
    clock = VirtualClock(start_s=start_s)
    seen: list[float] = []
    clock.on_advance.append(seen.append)
    clock.sleep(way_s)
    assert seen[:-1] == pytest.approx([start_s + 1e-3 * k for k in range(1, n)])
    assert clock.monotonic() == seen[-1] == start_s + way_s


def test_a_paced_clock_has_a_speed_and_an_end() -> None:
    clock, real = VirtualClock(), VirtualClock()
    pace = Pace(clock, real, speed=4.0)
    clock.sleep(2.0)
    assert (ended_s := real.monotonic()) == pytest.approx(0.5, abs=0.011)
    pace.end()
    clock.sleep(2.0)
    assert real.monotonic() == ended_s


def test_a_slow_machine_makes_virtual_time_run_later_and_catches_up_only_a_little() -> None:
    clock, real = VirtualClock(), VirtualClock()
    pace = Pace(clock, real)
    real.sleep(0.15)
    assert pace.lag_s() == pytest.approx(0.15)
    clock.sleep(0.15)
    assert real.monotonic() == 0.15
    real.sleep(3600.0)
    assert pace.lag_s() == pytest.approx(0.2)
    clock.sleep(1.2)
    assert real.monotonic() == pytest.approx(3601.15, abs=0.011)
    # Each piece of 1 ms takes 2 ms of the machine: nothing is waited for.
    clock.on_advance.insert(0, lambda _now_s: real.sleep(0.002))
    clock.sleep(1.0)
    assert real.monotonic() == pytest.approx(3603.15, abs=0.05)
    assert pace.lag_s() == pytest.approx(0.2, abs=0.01)


def servo(**settings: int) -> SimulatedServo:
    return SimulatedServo(1, XM430_W350, ServoMotor(), settings=settings)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: SimulatedCell(SimulatorSettings(aperture_m=0.5)), "out of reach"),
        (lambda: servo(present_position=1), "present_position"),
        (lambda: servo(no_such_item=1), "no_such_item"),
        (lambda: servo(return_delay_time=255), "return_delay_time"),
        (lambda: ParallelogramLinkage().angle_rad(0.07), "out of reach"),
        (lambda: RackLinkage().angle_rad(0.06), "beyond"),
    ],
)
def test_the_setting_is_named(make: Callable[[], object], says: str) -> None:
    with pytest.raises(SimulatorSettingsError, match=says):
        make()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: VirtualClock().advance_to(math.inf), "finite time"),
        (lambda: VirtualClock().sleep(math.inf), "sleep takes"),
        (lambda: Pace(VirtualClock(), time, speed=0.0), "positive speed"),
    ],
)
def test_times_that_no_clock_shows_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()
