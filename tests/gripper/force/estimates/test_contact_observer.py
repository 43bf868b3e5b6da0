"""The observer of fingers that press on a part."""

import pytest

from gripper.force.estimates.contact_observer import ContactObserver
from gripper.values.force_sensor import ForceSample
from tests.gripper.force.grips import PERIOD_S, make_grip, make_period


@pytest.mark.parametrize("speed_m_s", [0.0, -1e-9, 1e-9])
def test_fingers_set_out_with_the_force_beyond_friction_whichever_way_they_crept(speed_m_s) -> None:
    observer = ContactObserver(make_grip(2.0), 0.0, stiffness_n_m=1e4, lacking_n=0.0)
    observer.speed_m_s = speed_m_s
    beyond_n, dt_s = 0.2, 0.005
    found_m_s = observer.speed_after_m_s(dt_s, 2.0 + 3.0 + beyond_n, (3.0, 3.0))
    assert found_m_s == pytest.approx(beyond_n * dt_s / observer.mass_kg, abs=1e-8)
    assert observer.speed_after_m_s(dt_s, 2.0 + 3.0, (3.0, 3.0)) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize(("drive_n", "moves"), [(-0.1, -1), (1.1, 0), (5.1, 0), (6.0, 1)])
def test_a_gearing_that_holds_the_load_locks_the_fingers_far_below_the_force(
    drive_n: float, moves: int
) -> None:
    observer = ContactObserver(make_grip(5.0), 0.0, stiffness_n_m=1e4, lacking_n=0.0)
    found_m_s = observer.speed_after_m_s(0.005, drive_n, (0.2, 4.0))
    assert (found_m_s > 0.0) - (found_m_s < 0.0) == moves


def pressed(observer: ContactObserver, seen_n_m: float) -> None:
    """Close for 0.1 s at 10 mm/s; frames show a stiffness in N/m, 45 ms later."""
    speed_m_s, begins_n = 0.01, observer.force_n
    for i in range(1, 21):
        now_s = i * PERIOD_S
        period = make_period(now_s, 0.0, speed_m_s=-2.0 * speed_m_s)
        seen_n = begins_n + seen_n_m * speed_m_s * max(0.0, now_s - 0.045)
        sample = ForceSample(t_s=now_s, force_n=(seen_n, seen_n), lag_s=0.045)
        drive_n = observer.force_n + observer.lacking_n + 3.0
        shown = sample if i % 4 == 0 else None
        observer.step(period.moment, drive_n=drive_n, frictions_n=(3.0, 3.0), sample=shown)


@pytest.mark.parametrize(("true_n_m", "softer"), [(400.0, True), (1e4, False)])
def test_a_part_counts_as_soft_once_the_force_does_not_grow_as_expected(true_n_m, softer) -> None:
    observer = ContactObserver(make_grip(1.0), 0.0, stiffness_n_m=8e3, lacking_n=0.0)
    observer.learn_stiffness(400.0, 0.3)
    assert observer.stiffness_n_m > 4e3
    pressed(observer, true_n_m)
    before_n_m = observer.stiffness_n_m
    observer.learn_stiffness(400.0, 0.3)
    assert (observer.stiffness_n_m < 0.7 * before_n_m) is softer
    once_n_m = observer.stiffness_n_m
    observer.learn_stiffness(400.0, 0.3)
    assert observer.stiffness_n_m == once_n_m


def test_a_part_that_is_stiffer_than_expected_counts_at_once() -> None:
    observer = ContactObserver(make_grip(1.0), 0.0, stiffness_n_m=3e3, lacking_n=0.0)
    observer.learn_stiffness(2e4, 0.3)
    assert observer.stiffness_n_m > 8e3
