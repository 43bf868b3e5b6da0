from itertools import pairwise
from math import inf, nan

import pytest
from hypothesis import given, settings, strategies as st

from gripper.errors import LimitExceeded
from gripper.force.ramp import ForceRamp

FORCES = st.floats(0.0, 50.0).map(lambda force_n: round(force_n, 6))
RATES = st.floats(0.1, 20.0)
RAMPS = st.builds(ForceRamp.linear, FORCES, RATES, st.floats(0.0, 2.0), FORCES)


@pytest.mark.slow
@settings(max_examples=80)
@given(RAMPS)
def test_monotone_bounded_rate_limited_and_ending_at_the_target(ramp: ForceRamp) -> None:
    step_s = max(ramp.duration_s, 1e-3) / 200
    values = [ramp.setpoint_n(i * step_s) for i in range(201)]
    low_n, high_n = sorted((ramp.start_n, ramp.final_n))
    changes = [b - a for a, b in pairwise(values)]
    assert all(low_n - 1e-9 <= v <= high_n + 1e-9 for v in values)
    assert all(c >= -1e-9 for c in changes) or all(c <= 1e-9 for c in changes)
    assert all(abs(c) <= ramp.rate_n_s * step_s + 1e-9 for c in changes)
    assert [*map(ramp.setpoint_n, (0.0, ramp.duration_s + 1.0))] == [ramp.start_n, ramp.final_n]


@settings(max_examples=80)
@given(RAMPS, st.floats(-1.0, 60.0))
def test_begun_at_a_measured_force_the_setpoint_does_not_jump(ramp, now_n) -> None:
    begun = ramp.starting_from(now_n)
    assert begun.setpoint_n(0.0) == max(0.0, now_n)
    assert (begun.final_n, begun.rate_n_s) == (ramp.final_n, ramp.rate_n_s)


def test_a_start_above_the_measured_force_is_approached_at_the_ramps_rate() -> None:
    begun = ForceRamp.linear(8.0, 2.0, 1.0, start_n=3.0).starting_from(1.0)
    assert [begun.setpoint_n(t) for t in (0.5, 2.0)] == pytest.approx([2.0, 5.0])
    assert ForceRamp.linear(2.0, 2.0, 1.0, start_n=3.0).starting_from(4.0).setpoint_n(0.25) == 3.5


def test_a_measured_force_beyond_the_end_is_lowered_and_the_hold_kept() -> None:
    begun = ForceRamp.linear(2.0, 2.0, 1.0).starting_from(3.0)
    assert (begun.setpoint_n(0.25), begun.duration_s) == pytest.approx((2.5, 1.5))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ForceRamp.linear(nan, 1.0), "final_n"),
        (lambda: ForceRamp.linear(1.0, inf), "rate_n_s"),
        (lambda: ForceRamp.linear(1.0, 0.0), "rate_n_s"),
        (lambda: ForceRamp.linear(1.0, 1.0, hold_s=-1.0), "hold_s"),
        (lambda: ForceRamp.linear(1.0, 1.0, start_n=-1.0), "start_n"),
        (lambda: ForceRamp.steady(-1.0), "start_n"),
        (lambda: ForceRamp.linear(1.0, 1.0).starting_from(nan), "force_n"),
    ],
)
def test_ramps_that_no_force_follows_cannot_exist(make, says) -> None:
    with pytest.raises(LimitExceeded, match=says):
        make()
