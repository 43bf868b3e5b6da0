"""Several axes as one: all move, and when one fails all stop. A wrist among them."""

import math
from typing import Any

import pytest

from motion.axes import Axes
from motion.axis import Axis, AxisSettings
from motion.bus import Watch
from motion.errors import (
    AxisFault,
    AxisLimitExceeded,
    AxisMissing,
    AxisRestarted,
    AxisSilent,
    PositionImplausible,
)
from simulator.clock import VirtualClock
from tests.cell.conftest import once

NEAR_RAD = math.radians(1.0)
WATCH = Watch(VirtualClock(), 0.005)


class StubAxis(Axis):
    """An axis that arrives in some polls, and may fail at one of them."""

    def __init__(self, name: str, *, polls: int = 3, fails_at: int = 99) -> None:
        settings = AxisSettings(
            name=name, linear=True, increments=100.0, low=-1.0, high=1.0, velocity=1.0,
            acceleration=1.0, window=0.05, lag=0.05,
        )  # fmt: skip
        super().__init__(settings, "stub", WATCH)
        self.calls: list[str] = []
        self._at, self._polls, self._fails_at, self._polled = 0, polls, fails_at, 0

    def identify(self) -> str:
        return "ready"

    def prepare(self, *, reset: bool) -> None:
        self.calls.append(f"prepare {reset}")

    def clear_fault(self, *, reboot: bool) -> None:
        self.calls.append(f"clear {reboot}")

    def wake(self) -> None:
        self.calls.append("wake")

    def go_to(self, position: float) -> None:
        self._at = self.target(position)
        self.calls.append(f"go {self._at}")

    def arrived(self) -> bool:
        self._polled += 1
        if self._polled == self._fails_at:
            raise AxisFault(f"{self.name} is at fault")
        return self._polled >= self._polls

    def rest(self) -> None:
        self.calls.append("rest")

    def read_increments(self) -> int:
        return self._at

    def stop(self) -> None:
        self.calls.append("stop")

    def standing(self) -> bool:
        return True


def test_all_axes_move_at_once_and_are_prepared_once() -> None:
    x, y = StubAxis("x"), StubAxis("y")
    axes = Axes([x, y], WATCH)
    with pytest.raises(AxisLimitExceeded, match=r"axis y was asked for 1100.00 mm"):
        axes.move({"x": 0.5, "y": 1.1})
    assert x.calls == y.calls == []
    assert axes.move({"x": 0.5, "y": -0.25}) == {"x": 0.5, "y": -0.25}
    assert x.calls == ["prepare False", "go 50", "rest"]
    axes.move({"x": 0.0, "y": 0.0})
    assert y.calls == ["prepare False", "go -25", "rest", "wake", "go 0", "rest"]


@pytest.mark.parametrize("fails_at", [2, 5])
def test_when_one_axis_fails_all_are_stopped_and_prepared_anew(fails_at: int) -> None:
    """Also an axis that fails after it has arrived."""
    x, y = StubAxis("x", fails_at=fails_at), StubAxis("y", polls=9)
    axes = Axes([x, y], WATCH)
    with pytest.raises(AxisFault, match="x is at fault; all axes stand still"):
        axes.move({"x": 0.5, "y": 0.5})
    assert x.calls[-1] == y.calls[-1] == "stop"
    axes.move({"x": 0.0, "y": 0.0})
    assert y.calls[-3:] == ["prepare True", "go 0", "rest"]


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
    bench = make_drive()
    bench.simulated.fail(0x2310)
    bench.axes.clear_faults(reboot=False)
    assert bench.simulated.state == "SWITCH ON DISABLED"
    bench.move(0.0)
    wrist = make_wrist()
    wrist.simulated.servo.plant.overload()
    wrist.clock.sleep(0.1)
    with pytest.raises(AxisFault, match="hardware error overload"):
        wrist.axes.clear_faults(reboot=False)
    wrist.axes.clear_faults(reboot=True)
    wrist.move(1.0)
