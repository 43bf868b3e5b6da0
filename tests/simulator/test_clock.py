import pytest

from simulator.clock import Pace, VirtualClock


def test_callbacks_see_each_piece_and_the_end() -> None:
    clock = VirtualClock()
    seen: list[float] = []
    clock.on_advance.append(seen.append)
    clock.sleep(0.0035)
    assert seen == pytest.approx([0.001, 0.002, 0.003, 0.0035])
    assert clock.monotonic() == seen[-1]


def test_rounding_makes_no_extra_piece() -> None:
    clock = VirtualClock(start_s=0.1)
    seen: list[float] = []
    clock.on_advance.append(seen.append)
    clock.sleep(0.3)
    assert len(seen) == 300
    assert seen[-1] == 0.1 + 0.3


def test_the_past_changes_nothing() -> None:
    clock = VirtualClock(start_s=1.0)
    clock.on_advance.append(lambda _now_s: pytest.fail("time must not move"))
    clock.advance_to(0.5)
    clock.sleep(0.0)
    assert clock.monotonic() == 1.0


def test_a_callback_cannot_move_the_clock() -> None:
    clock = VirtualClock()
    clock.on_advance.append(lambda now_s: clock.advance_to(now_s + 1.0))
    with pytest.raises(RuntimeError, match="must not move"):
        clock.sleep(0.001)
    clock.on_advance.clear()
    clock.sleep(0.001)
    assert clock.monotonic() == pytest.approx(0.002)


class Machine:
    """A real clock that only the test moves; ``slow_s`` passes with each look at it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.slow_s = 0.0
        self.waits: list[float] = []

    def monotonic(self) -> float:
        self.now_s += self.slow_s
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.waits.append(seconds)
        self.now_s += seconds


def test_a_paced_clock_has_a_speed_and_an_end() -> None:
    clock, real = VirtualClock(), Machine()
    pace = Pace(clock, real, speed=4.0)
    clock.sleep(2.0)
    assert real.now_s - 100.0 == pytest.approx(0.5, abs=0.011)
    pace.end()
    real.waits.clear()
    clock.sleep(2.0)
    assert real.waits == []


def test_a_slow_machine_makes_virtual_time_run_later_and_catches_up_only_a_little() -> None:
    clock, real = VirtualClock(), Machine()
    pace = Pace(clock, real)
    real.now_s += 0.15
    assert pace.lag_s() == pytest.approx(0.15)
    clock.sleep(0.15)
    assert real.waits == []
    real.now_s += 3600.0
    assert pace.lag_s() == pytest.approx(0.2)
    clock.sleep(1.2)
    assert sum(real.waits) == pytest.approx(1.0, abs=0.011)
    real.slow_s = 0.002
    before_s = real.now_s
    clock.sleep(1.0)  # each piece of 1 ms takes 2 ms of the machine: nothing is waited for
    assert real.now_s - before_s == pytest.approx(2.0, abs=0.05)
    assert pace.lag_s() == pytest.approx(0.2, abs=0.01)
