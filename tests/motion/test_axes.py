"""Several axes as one: all move, and when one fails all stop. A wrist among them."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock, call

import pytest

from motion.axes import Axes
from motion.drive import Cia402Drive
from motion.errors import (
    AxisFault,
    AxisLimitExceeded,
    AxisMissing,
    AxisRestarted,
    AxisSilent,
    PositionImplausible,
)
from simulator.can.drive import SimulatedDrive
from tests.cell.cells import once
from tests.motion.conftest import BOOT_S, DriveBench, MakeDrive

NEAR_M, NEAR_RAD = 5e-5, math.radians(1.0)


@pytest.fixture
def both(make_drive: MakeDrive) -> tuple[DriveBench, SimulatedDrive, Mock]:
    """Two drives on one bus, x and y, whose axes are one; and each preparation of x."""
    bench = make_drive(homing=None, start_m=0.0)
    mount = replace(bench.simulated.mount, node_id=12)
    bench.link.add(second := SimulatedDrive(mount, start_s=bench.clock.monotonic()))
    bench.clock.sleep(BOOT_S)
    y = Cia402Drive(replace(bench.drive.settings, name="y", node_id=12), bench.drive._bus)
    bench.drive.prepare = prepared = Mock(wraps=bench.drive.prepare)  # type: ignore[method-assign]
    bench.axes = Axes([bench.drive, y], bench.drive._watch)
    return bench, second, prepared


def test_all_axes_move_at_once_and_are_prepared_once(both) -> None:
    bench, second, prepared = both
    with pytest.raises(AxisLimitExceeded, match=r"axis y was asked for 21.00 mm"):
        bench.axes.move({"x": 0.01, "y": 0.021})
    assert (bench.simulated.state, second.state) == ("SWITCH ON DISABLED",) * 2
    bench.axes.move({"x": 0.015, "y": -0.01})
    began_s, wanted = bench.clock.monotonic(), {"x": -0.015, "y": 0.02}
    assert bench.axes.move(wanted) == pytest.approx(wanted, abs=NEAR_M)
    # 30 mm at 50 mm/s, 0.1 s of acceleration and as much of braking.
    assert bench.clock.monotonic() - began_s == pytest.approx(0.7, abs=0.05)
    assert prepared.call_args_list == [call(reset=False)]


@pytest.mark.parametrize("way_m", [0.02, 0.001])
def test_when_one_axis_fails_all_are_stopped_and_prepared_anew(both, way_m: float) -> None:
    """Also an axis that fails after it has arrived."""
    bench, second, prepared = both
    x = bench.simulated
    once(
        bench.clock,
        lambda: second.moving and (way_m > 0.01 or x.position > way_m - 1e-5),
        lambda: x.fail(0x2310),
        after_s=0.02,
    )
    with pytest.raises(AxisFault, match=r"axis x .*: remedy the cause.*; all axes stand still"):
        bench.axes.move({"x": way_m, "y": 0.02})
    assert (second.moving, second.position < 0.015) == (False, True)
    bench.axes.move({"x": 0.0, "y": 0.0})
    assert prepared.call_args == call(reset=True)


@pytest.fixture
def bench(make_wrist: Any) -> Any:
    return make_wrist()


@pytest.mark.slow
def test_a_wrist_turns_between_its_limits(bench) -> None:
    for roll_rad in (0.0, math.pi, 1.0):
        assert bench.move(roll_rad) == pytest.approx(roll_rad, abs=NEAR_RAD)
        assert bench.simulated.position == pytest.approx(roll_rad, abs=NEAR_RAD)
    with pytest.raises(AxisLimitExceeded, match=r"limits are 0.00 deg to 180.00 deg"):
        bench.move(-0.1)


@pytest.mark.parametrize("level", [0, 1])
def test_a_wrist_that_confirms_no_write_turns_all_the_same(bench, level: int) -> None:
    bench.simulated.servo.registers.put("status_return_level", level)
    assert bench.move(1.0) == pytest.approx(1.0, abs=0.02)


def test_a_wrist_that_counts_in_another_turn_is_taken_where_it_stands(make_wrist) -> None:
    bench = make_wrist(start_rad=1.75 - math.tau)
    bench.move(1.0)
    assert bench.simulated.position == pytest.approx(1.0 - math.tau, abs=NEAR_RAD)


def test_a_wrist_stays_where_it_is_when_its_torque_comes_on(bench) -> None:
    bench.servo.prepare(reset=False)
    bench.simulated.servo.set_torque(on=False)
    bench.simulated.servo.registers.put("goal_position", 500)  # of an earlier program
    bench.servo.prepare(reset=False)
    bench.clock.sleep(0.2)
    assert bench.simulated.position == pytest.approx(1.75, abs=NEAR_RAD)


@pytest.mark.parametrize(
    ("fail", "error", "words"),
    [
        ("block", AxisFault, "is stalled: .* pulses behind its profile"),
        ("silent", AxisSilent, "does not answer as it should"),
        ("overload", AxisFault, "hardware error overload: remedy the cause"),
        ("reboot", AxisSilent, "does not answer as it should"),
        ("jump", PositionImplausible, r"reads a position of 2\d\d.\d\d deg, its limits are 0"),
    ],
)
def test_a_wrist_that_fails_is_named_and_goes_on_once_it_is_well(bench, fail, error, words) -> None:
    bench.move(0.5)
    simulated = bench.simulated

    acts = {
        "block": lambda: setattr(simulated, "blocked", True),
        "silent": lambda: setattr(simulated, "dead", True),
        "overload": lambda: simulated.fail(0),
        "reboot": simulated.power_cycle,
        "jump": lambda: setattr(simulated.servo.plant, "encoder_offset_rad", 3.5),
    }
    once(bench.clock, lambda: simulated.moving, acts[fail])
    with pytest.raises(error, match=words):
        bench.move(3.0)
    assert simulated.position < 1.0
    simulated.blocked = simulated.dead = False
    bench.clock.sleep(1.0)
    if fail == "jump":
        assert not simulated.servo.torque_on  # nobody can hold what nobody can measure
        simulated.servo.plant.encoder_offset_rad = 0.0
    assert bench.move(1.0) == pytest.approx(1.0, abs=NEAR_RAD)


def test_a_wrist_that_is_silent_for_a_moment_is_asked_again(bench) -> None:
    bench.move(0.5)
    silent = bench.simulated.bus.faults.silent
    began_s = once(bench.clock, lambda: bench.simulated.moving, lambda: silent.add(7))
    once(bench.clock, lambda: bool(began_s), silent.clear, after_s=0.06)
    assert bench.move(3.0) == pytest.approx(3.0, abs=NEAR_RAD)
    assert began_s


def test_a_wrist_that_restarted_meanwhile_is_found(bench) -> None:
    bench.move(0.5)
    bench.simulated.servo.boot(bench.clock.monotonic())
    bench.clock.sleep(1.0)
    with pytest.raises(AxisRestarted, match="has lost its torque"):
        bench.move(1.0)


def test_a_wrist_whose_host_is_gone_stops_by_itself(bench) -> None:
    bench.move(0.5)
    bench.servo.go_to(3.0)
    bench.clock.sleep(1.0)
    assert not bench.simulated.moving
    assert bench.simulated.position < 1.5
    bench.move(1.0)


@pytest.mark.parametrize(("n_lost", "way_rad"), [(0, 0.06), (4, 0.4)])
def test_a_wrist_stops_though_the_reason_lasts_or_answers_are_lost(bench, n_lost, way_rad) -> None:
    """With a lost stop its own watchdog ends the motion."""
    bench.axes._watch._period_s = 1e-4  # due in each transaction
    began_s: list[float] = []

    def supervise() -> None:
        if bench.simulated.moving:
            began_s.append(bench.clock.monotonic())
        if began_s and bench.clock.monotonic() > began_s[0] + 0.3:
            bench.simulated.bus.faults.drop_next, began_s[0] = n_lost * (began_s[0] > 0.0), -1.0
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        bench.axes.move({"roll": 0.1}, supervise)
    stopped_rad = bench.simulated.position
    bench.clock.sleep(3.0)
    assert abs(bench.simulated.position - stopped_rad) < way_rad
    bench.move(1.0)


def test_a_wrist_is_refused_that_is_another_or_stands_outside(make_wrist) -> None:
    with pytest.raises(AxisFault, match="its limits are 0 to 2048: turn it back by hand"):
        make_wrist(start_rad=4.5).move(1.0)
    bench = make_wrist()
    registers = bench.simulated.bus.servos[0].registers
    registers.put("drive_mode", 4)
    with pytest.raises(AxisMissing, match="Drive Mode 4"):
        bench.move(1.0)
    registers.put("model_number", 1030)
    with pytest.raises(AxisMissing, match="has model number 1030, a XM430-W350 has 1020"):
        bench.move(1.0)


def test_faults_of_an_earlier_program_are_cleared_without_motion(make_wrist, make_drive) -> None:
    bench, wrist = make_drive(), make_wrist()
    both = Axes([wrist.servo, bench.drive], bench.drive._watch)
    bench.simulated.fail(0x2310)
    wrist.simulated.servo.plant.overload()
    wrist.clock.sleep(0.1)
    with pytest.raises(AxisFault, match="hardware error overload"):
        both.clear_faults(reboot=False)
    assert bench.simulated.state == "SWITCH ON DISABLED"
    both.clear_faults(reboot=True)
    bench.move(0.0)
    wrist.move(1.0)
