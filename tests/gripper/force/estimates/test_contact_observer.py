"""The observer of fingers that press on a part."""

import pytest

from gripper.force.estimates.contact_observer import ContactObserver
from tests.gripper.force.grips import make_grip


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
