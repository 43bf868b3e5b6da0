"""The newest force samples: as many as a decision needs; and what shows that nothing is held."""

import pytest

from gripper.values.force_sensor import ForceSample, RecentForce
from gripper.values.state import shows_nothing
from tests.values import make_state


def sample(t_s: float, force_n: float = 1.0, noise_n: float = 0.3) -> ForceSample:
    return ForceSample(t_s=t_s, force_n=(force_n - 0.5, force_n + 0.5), noise_n=noise_n)


def test_a_slow_sensor_gives_its_last_few_samples() -> None:
    recent = RecentForce(0.08)
    for i in range(10):
        recent.push(sample(0.02 * i, float(i)))
    assert [one.force_n[1] for one in recent] == [9.5, 8.5, 7.5]
    assert recent.grip_n == 8.0
    assert recent.noise_n == pytest.approx(0.3 / 3.0**0.5)


@pytest.mark.parametrize(("noise_n", "n"), [(0.05, 1), (0.16, 4), (0.24, 9), (5.0, 11)])
def test_a_fast_sensor_gives_as_many_as_its_noise_asks_for(noise_n, n) -> None:
    recent = RecentForce(0.08)
    for i in range(40):
        recent.push(sample(0.00499 * i, noise_n=noise_n))
    assert len(recent) == n
    assert recent.noise_n <= 0.08 or n == 11


def test_the_same_sample_again_is_none_and_what_it_replaces_is_returned() -> None:
    recent = RecentForce(0.08, one_frame=True)
    assert recent.push(sample(0.0)) == []
    assert recent.push(sample(0.0)) is None
    assert recent.push(sample(0.01)) == []
    assert recent.push(sample(0.02)) == [sample(0.0)]
    assert recent.push(sample(0.03, noise_n=0.01)) == [sample(0.01), sample(0.02)]
    assert (recent.oldest, recent.newest) == (sample(0.03, noise_n=0.01),) * 2


@pytest.mark.parametrize(
    ("speed_m_s", "current_n", "pads_n", "nothing"),
    [
        (0.0, 0.1, 0.6, True),
        (0.0, 0.1, 1.2, False),
        (0.0, 2.0, 0.6, False),  # the pads are blind
        (0.05, 2.0, 0.6, True),  # the current moves the fingers
    ],
)
def test_a_held_part_shows_on_a_pad_or_in_the_current_at_rest(
    speed_m_s, current_n, pads_n, nothing
) -> None:
    state = make_state(aperture_velocity_m_s=speed_m_s, force_from_current_n=current_n)
    assert shows_nothing(state, sample(1.0, pads_n - 0.5), 1.0) is nothing
