import math

import pytest

from simulator.clock import VirtualClock


def test_time_moves_only_by_sleeping() -> None:
    clock = VirtualClock(start_s=5.0)
    assert clock.monotonic() == 5.0
    assert clock.monotonic() == 5.0
    clock.sleep(0.25)
    assert clock.monotonic() == pytest.approx(5.25)


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


@pytest.mark.parametrize("seconds", [-1e-9, math.nan, math.inf])
def test_impossible_waits_are_refused(seconds: float) -> None:
    with pytest.raises(ValueError, match="sleep takes"):
        VirtualClock().sleep(seconds)


def test_impossible_times_are_refused() -> None:
    with pytest.raises(ValueError, match="finite time"):
        VirtualClock(start_s=math.nan)
    with pytest.raises(ValueError, match="positive"):
        VirtualClock(step_s=0.0)
    with pytest.raises(ValueError, match="finite time"):
        VirtualClock().advance_to(math.inf)


def test_a_callback_cannot_move_the_clock() -> None:
    clock = VirtualClock()
    clock.on_advance.append(lambda now_s: clock.advance_to(now_s + 1.0))
    with pytest.raises(RuntimeError, match="must not move"):
        clock.sleep(0.001)
    clock.on_advance.clear()
    clock.sleep(0.001)
    assert clock.monotonic() == pytest.approx(0.002)
