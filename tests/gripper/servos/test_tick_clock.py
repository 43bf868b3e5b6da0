"""The age of a servo's answers by its own clock: drift is followed, a lag is not."""

import random
from collections.abc import Callable

import pytest

from gripper.servos.feedback import TickClock

PERIOD_S = 0.005
Rate = Callable[[float], float]


def refused(
    rate: Rate,
    seconds: float,
    *,
    lags: Callable[[float], bool] = lambda _now_s: False,
    pauses: bool = False,
) -> tuple[int, int, int]:
    """Return how many new answers were refused, how many old ones, and how many old ones came.

    A clock runs at a rate; where it lags each answer is the one of the period before.
    """
    generator, clock = random.Random(1), TickClock(1)
    now_s, made_s, tick_s, before_ms = 0.0, 0.0, 30.0 * generator.random(), 0
    new = old = came = 0
    while now_s < seconds:
        made_after_s = now_s + generator.uniform(0.0002, 0.0004)
        tick_s += (made_after_s - made_s) * rate(now_s)
        made_s = made_after_s
        late_s = generator.uniform(0.0, 0.01) if generator.random() < 0.01 else 0.0
        received_s = made_s + generator.uniform(0.0007, 0.002) + late_s
        tick_ms = int(1e3 * tick_s) % 32768
        if lags(now_s):
            came += 1
            old += clock.check(before_ms, now_s, received_s) is not None
        else:
            new += clock.check(tick_ms, now_s, received_s) is not None
        before_ms = tick_ms
        now_s = max(now_s + PERIOD_S, received_s)
        if pauses and generator.random() < 0.002:
            now_s += generator.uniform(0.0, 3.0)
    return new, old, came


@pytest.mark.parametrize("rate", [0.97, 0.99, 1.0, 1.01, 1.03])
@pytest.mark.parametrize("pauses", [False, True])
def test_a_clock_that_is_off_by_three_percent_is_none_that_lags(rate, pauses) -> None:
    assert refused(lambda _now_s: rate, 60.0, pauses=pauses)[0] == 0


@pytest.mark.parametrize("rate", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("begins_s", [2.0, 5.1, 12.0])
def test_a_lag_of_one_period_is_refused_for_as_long_as_it_lasts(rate, begins_s) -> None:
    new, old, came = refused(
        lambda _now_s: rate, begins_s + 2.0, lags=lambda now_s: now_s > begins_s
    )
    assert new == 0
    assert old == came > 300


def test_after_a_lag_new_answers_are_taken_at_once() -> None:
    new, old, came = refused(lambda _now_s: 1.0, 20.0, lags=lambda now_s: now_s % 4.0 > 3.7)
    assert new == 0
    assert old == came > 200


def test_the_servos_own_clock_shows_old_answers_and_restarts() -> None:
    clock = TickClock(1)
    assert clock.check(32760, 0.0, 0.001) is None
    assert clock.check(2, 0.010, 0.011) is None
    old = clock.check(3, 0.040, 0.041)
    assert "old answer" in str(old)
    assert clock.check(33, 0.041, 0.042) is None
    assert clock.check(20000, 0.046, 0.047) is not None
    assert clock.check(20005, 0.051, 0.052) is None
    assert clock.check(1, 30.0, 30.001) is None
    assert clock.check(31000, 30.01, 30.011) is not None
    clock.forget()
    assert clock.check(7, 30.02, 30.021) is None
