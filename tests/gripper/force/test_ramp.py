from dataclasses import replace
from itertools import pairwise
from math import inf, nan

import pytest
from hypothesis import given, settings, strategies as st

from gripper.errors import LimitExceeded
from gripper.force.ramp import ForceRamp, RampSegment

FORCES = st.floats(0.0, 50.0).map(lambda force_n: round(force_n, 6))
RATES = st.floats(0.1, 20.0)
HOLDS = st.floats(0.0, 2.0)


@st.composite
def ramps(draw: st.DrawFn) -> ForceRamp:
    if draw(st.booleans()):
        return ForceRamp.linear(draw(FORCES), draw(RATES), draw(HOLDS), draw(FORCES))
    levels = sorted(draw(st.lists(FORCES, min_size=1, max_size=5)))
    return ForceRamp.staircase(levels, draw(RATES), draw(HOLDS))


@pytest.mark.slow
@settings(max_examples=80)
@given(ramps())
def test_monotone_bounded_rate_limited_and_ending_at_the_target(ramp: ForceRamp) -> None:
    step_s = max(ramp.duration_s, 1e-3) / 200
    values = [ramp.setpoint_n(i * step_s) for i in range(201)]
    low_n, high_n = sorted((ramp.start_n, ramp.final_n))
    changes = [b - a for a, b in pairwise(values)]
    assert all(low_n - 1e-9 <= v <= high_n + 1e-9 for v in values)
    assert all(c >= -1e-9 for c in changes) or all(c <= 1e-9 for c in changes)
    assert all(abs(c) <= ramp.max_rate_n_s * step_s + 1e-9 for c in changes)
    assert [*map(ramp.setpoint_n, (-1.0, ramp.duration_s + 1.0))] == [ramp.start_n, ramp.final_n]


@settings(max_examples=80)
@given(ramps(), st.floats(-1.0, 60.0))
def test_begun_at_a_measured_force_the_setpoint_does_not_jump(ramp, now_n) -> None:
    begun = ramp.starting_from(now_n)
    assert begun.setpoint_n(0.0) == pytest.approx(max(0.0, now_n), abs=1e-9)
    assert begun.final_n == ramp.final_n
    assert begun.max_rate_n_s <= max(ramp.max_rate_n_s, 1.0) * (1.0 + 1e-6)


def test_staircase_names_its_levels() -> None:
    ramp = ForceRamp.staircase((1.0, 3.0, 4.0), rate_n_s=2.0, hold_s=0.5)
    assert ramp.duration_s == pytest.approx(0.5 + 1.0 + 0.5 + 3 * 0.5)
    times_s = [0.2, 0.7, 1.5, 2.2, 2.7, 3.2, 99.0]
    assert [ramp.at(t)[0].level for t in times_s] == [None, 0, None, 1, None, 2, 2]
    assert [ramp.setpoint_n(t) for t in (0.7, 2.2, 3.2)] == [1.0, 3.0, 4.0]
    assert [ramp.starting_from(2.0).at(t)[0].level for t in (0.1, 0.6)] == [None, 1]


def test_a_start_above_the_measured_force_is_approached_at_the_ramps_rate() -> None:
    begun = ForceRamp.linear(8.0, 2.0, 1.0, start_n=3.0).starting_from(1.0)
    assert [begun.setpoint_n(t) for t in (0.5, 2.0)] == pytest.approx([2.0, 5.0])
    assert ForceRamp.linear(2.0, 2.0, 1.0, start_n=3.0).starting_from(4.0).setpoint_n(0.25) == 3.5


def test_a_measured_force_beyond_the_end_is_lowered_and_the_hold_kept() -> None:
    begun = ForceRamp.linear(2.0, 2.0, 1.0).starting_from(3.0)
    assert (begun.setpoint_n(0.25), begun.duration_s) == pytest.approx((2.5, 1.5))


SEGMENT = RampSegment(duration_s=1.0, start_n=0.0, end_n=1.0)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ForceRamp.linear(nan, 1.0), "force_n"),
        (lambda: ForceRamp.linear(1.0, inf), "rate_n_s"),
        (lambda: ForceRamp.linear(1.0, 1.0, hold_s=-1.0), "hold_s"),
        (lambda: ForceRamp.staircase((1.0, nan), 1.0, 0.1), r"levels_n\[1\]"),
        (lambda: ForceRamp.staircase((3.0, 1.0), 1.0, 0.1), "not both"),
        (lambda: ForceRamp.staircase((), 1.0, 0.1), "empty"),
        (lambda: ForceRamp(segments=()), "at least one"),
        (lambda: ForceRamp(segments=(SEGMENT, replace(SEGMENT, start_n=2.0))), "ends at"),
        (lambda: ForceRamp(segments=(replace(SEGMENT, duration_s=0.0),)), "above 0"),
        (lambda: ForceRamp(segments=(replace(SEGMENT, start_n=-1.0),)), "start_n"),
    ],
)
def test_ramps_that_jump_or_turn_round_cannot_exist(make, says) -> None:
    with pytest.raises(LimitExceeded, match=says):
        make()


def test_an_ended_ramp_stays_at_its_force_and_names_the_level_it_was_at_or_on_its_way_to() -> None:
    ramp = ForceRamp.staircase((2.0, 4.0), rate_n_s=4.0, hold_s=1.0)
    for elapsed_s, force_n, level in ((0.25, 1.0, 0), (0.6, 2.0, 0), (1.75, 3.0, 1), (9.0, 4.0, 1)):
        ended = ramp.ended_at(elapsed_s)
        assert (ended.duration_s, ended.start_n, ended.final_n) == (0.0, force_n, force_n)
        assert {ended.at(t)[0].level for t in (0.0, 1.0)} == {level}
