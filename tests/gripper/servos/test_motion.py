"""Speed of a servo by its positions: exact at rest, early in change, with lost readings."""

import random
from statistics import fmean

import pytest

from gripper.dynamixel.control_table import TICK_MODULO
from gripper.dynamixel.models import XM430_W350
from gripper.servos.motion import ServoMotion, slow_rad_s

COUNT_RAD = XM430_W350.rad_per_pulse
PERIOD_MS = 5


def speeds(ways_rad, *, dither=0.0) -> list[float]:
    """Return the speeds by rounded positions, one each 5 ms; None is a lost answer."""
    motion, rng = ServoMotion(XM430_W350), random.Random(1)
    measured = []
    for index, rad in enumerate(ways_rad):
        if rad is not None:
            count = round(rad / COUNT_RAD + rng.gauss(0.0, dither))
            tick_ms = (32_700 + index * PERIOD_MS) % TICK_MODULO
            measured.append(motion.speed_rad_s(tick_ms, count * COUNT_RAD))
    return measured


def ramp(*rates_rad_s: float) -> list[float]:
    """Return positions of motions of 60 periods at one rate after the other."""
    ways, rad = [], 0.3 * COUNT_RAD
    for rate_rad_s in rates_rad_s:
        for _ in range(60):
            ways.append(rad)
            rad += rate_rad_s * PERIOD_MS * 1e-3
    return ways


def test_a_first_position_shows_no_speed_and_a_repeated_one_replaces_it() -> None:
    motion = ServoMotion(XM430_W350)
    assert [motion.speed_rad_s(100, rad) for rad in (0.0, 0.001, 0.0)][::2] == [0.0, 0.0]
    for t_ms in range(105, 141, 5):
        measured_rad_s = motion.speed_rad_s(t_ms, 1e-3 * (t_ms - 100))
    assert measured_rad_s == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_servo_at_rest_whose_count_dithers_counts_as_slow(seed) -> None:
    rng = random.Random(seed)
    flips = [COUNT_RAD * rng.choice((0, 1)) for _ in range(400)]
    assert max(map(abs, speeds(flips))) <= slow_rad_s(XM430_W350)


@pytest.mark.parametrize("rate_rad_s", [0.03, 0.3, -1.0, 4.0])
def test_a_steady_speed_is_as_exact_as_at_rest(rate_rad_s) -> None:
    errors = [one - rate_rad_s for one in speeds(ramp(rate_rad_s), dither=0.3)[16:]]
    assert fmean(one**2 for one in errors) < (0.5 * slow_rad_s(XM430_W350)) ** 2


@pytest.mark.parametrize(
    ("before_rad_s", "after_rad_s", "periods"),
    [(0.0, 0.2, 12), (0.0, 0.4, 8), (0.3, 0.0, 8), (0.5, 0.0, 6), (-0.4, 0.4, 6)],
)
def test_a_large_change_shows_early(before_rad_s, after_rad_s, periods) -> None:
    measured = speeds(ramp(before_rad_s, after_rad_s))[60:]
    late = [abs(one - after_rad_s) > 0.25 * abs(after_rad_s - before_rad_s) for one in measured]
    assert not any(late[periods:])
    assert sum(late) >= 2


def test_the_speed_of_the_next_reading_follows_an_acceleration_at_once() -> None:
    motion, period_s, faster_rad_s2 = ServoMotion(XM430_W350), 1e-2, 25.0
    readings: list[tuple[float, float, float]] = []
    for index in range(-20, 5):
        run_s = max(0.0, index * period_s)
        rad = round(0.5 * faster_rad_s2 * run_s**2 / COUNT_RAD) * COUNT_RAD
        speed_rad_s = motion.speed_rad_s(1000 + 10 * index, rad)
        readings.append((faster_rad_s2 * (run_s + period_s), motion.next_rad_s, speed_rad_s))
    assert all(following == speed == 0.0 for _, following, speed in readings[:21])
    for true, following, speed in readings[22:]:
        assert following == pytest.approx(true, rel=0.45)
        assert speed < 0.6 * following


def test_lost_answers_leave_a_speed_and_a_pause_does_not() -> None:
    ways = ramp(0.4)
    lost = [None if 20 <= index < 23 else rad for index, rad in enumerate(ways)]
    assert speeds(lost)[20] == pytest.approx(0.4, abs=0.05)
    paused = [None if 20 <= index < 41 else rad for index, rad in enumerate(ways)]
    assert speeds(paused)[20] == 0.0


@pytest.mark.parametrize("later_ms", [0, 1])
def test_a_wrong_position_that_was_withdrawn_changes_no_speed(later_ms) -> None:
    motion, measured = ServoMotion(XM430_W350), []
    for tick_ms in range(100, 400, PERIOD_MS):
        motion.speed_rad_s(tick_ms, 4e-4 * tick_ms + 0.1)
        motion.withdraw()
        measured.append(motion.speed_rad_s(tick_ms + later_ms, 4e-4 * (tick_ms + later_ms)))
    assert measured[16:] == pytest.approx([0.4] * 44)
