"""The watch over a part alone: stages of its doubt, and the witnesses that end it."""

from dataclasses import replace

import pytest

from gripper.errors import GripContradicted
from gripper.force.estimates.grip import Grip
from gripper.force.loop import Moment
from gripper.force.supervision.doubt import Doubted, Sure, Suspected
from gripper.force.supervision.part_watch import TRANSITIONS, PartWatch
from gripper.force_sensor import ForceSample
from gripper.kinematics import transmissions
from tests.gripper.force.control.grips import LINKAGE, PERIOD_S, STATE, make_grip


class Watched:
    """A watch whose pads, frames, fingers and motors a test sets from period to period."""

    def __init__(self, force_n: float = 3.0) -> None:
        self.grip: Grip = make_grip(force_n)
        self.watch = PartWatch(self.grip, contact_n_m=1e4)
        self.now_s, self.force_n, self.frame_n = 0.0, force_n, force_n
        self.closing_m_s, self.pressing_n = 0.0, 6.0
        self.aperture_m = STATE.aperture_m

    def period(self, n: int = 1) -> bool:
        """Run periods; return whether one of them shows the part as lost."""
        return any(self._one() for _ in range(n))

    def _one(self) -> bool:
        self.now_s += PERIOD_S
        self.aperture_m -= PERIOD_S * self.closing_m_s
        sample = ForceSample(
            t_s=self.now_s,
            force_n=(self.force_n, self.force_n),
            lag_s=0.0015,
            noise_n=0.05,
            frame_s=0.02 * (self.now_s // 0.02),
            frame_n=(self.frame_n, self.frame_n),
        )
        paths = transmissions(self.grip.settings, LINKAGE, STATE.angles_rad)
        current_a = -self.pressing_n * paths[0].radius_m / paths[0].kt_nm_a
        servos = tuple(
            replace(
                one, current_a=current_a, velocity_rad_s=-0.5 * self.closing_m_s / paths[0].radius_m
            )
            for one in STATE.servos
        )
        state = replace(
            STATE,
            t_s=self.now_s,
            aperture_m=self.aperture_m,
            aperture_velocity_m_s=-self.closing_m_s,
            servos=servos,
        )
        self.grip.apertures.add(self.now_s, self.aperture_m)
        moment = Moment(now_s=self.now_s, dt_s=PERIOD_S, state=state, sample=sample)
        return self.watch.lost(moment)


@pytest.fixture
def watched() -> Watched:
    made = Watched()
    assert not made.period(30)
    assert type(made.watch._stage) is Sure
    return made


def test_pads_that_are_empty_for_a_moment_are_no_doubt(watched: Watched) -> None:
    watched.grip.asked_n = 0.7  # so little that nothing is sudden
    watched.force_n = watched.frame_n = 0.0
    watched.period(15)
    assert type(watched.watch._stage) is Suspected
    assert not watched.watch.doubts
    watched.force_n = watched.frame_n = 3.0
    assert not watched.period(15)
    assert type(watched.watch._stage) is Sure


def test_much_force_that_is_gone_at_once_is_doubted_and_a_frame_confirms_it(
    watched: Watched,
) -> None:
    watched.force_n = watched.frame_n = 0.0
    watched.pressing_n = 4.0  # less than friction at rest: free fingers would stand as well
    periods = 0
    while not watched.period():
        periods += 1
        assert periods < 10
    assert watched.watch.doubts
    assert not watched.watch.ran


def test_fingers_that_run_together_confirm_it(watched: Watched) -> None:
    watched.force_n, watched.frame_n, watched.closing_m_s = 0.0, 0.0, 0.015
    assert watched.period(20)
    assert watched.watch.ran


@pytest.mark.parametrize(
    ("changes", "shows"),
    [
        ({"frame_n": 3.0}, "a frame scanned since then shows 3.00 and 3.00 N"),
        ({"frame_n": 0.0}, "the fingers stand at an opening of 23.4 mm"),
        ({"frame_n": 0.0, "closing_m_s": 0.004}, "neither frames nor fingers confirm that"),
    ],
)
def test_another_witness_that_shows_the_part_is_a_contradiction(
    watched: Watched, changes, shows, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gripper.force.supervision.doubt._run", lambda *_: False)
    watched.force_n = 0.0
    for name, value in changes.items():
        setattr(watched, name, value)
    with pytest.raises(GripContradicted, match=shows) as error:
        watched.period(100)
    assert "fell from 3.00 N to 0.00 and 0.00 N" in str(error.value)


def test_force_that_comes_back_is_a_contradiction(watched: Watched) -> None:
    watched.force_n = watched.frame_n = 0.0
    assert not watched.period(3)
    assert watched.watch.doubts
    watched.force_n = 3.0
    with pytest.raises(GripContradicted, match=r"now it is 3\.00 and 3\.00 N again"):
        watched.period(5)


def test_a_pause_ends_the_doubt(watched: Watched) -> None:
    watched.force_n = watched.frame_n = 0.0
    watched.period(3)
    assert watched.watch.doubts
    watched.watch.resume()
    assert not watched.watch.doubts


def test_nothing_is_lost_that_was_never_held() -> None:
    never = Watched(force_n=0.0)
    assert not never.period(100)
    assert type(never.watch._stage) is Sure


def test_each_stage_can_be_reached() -> None:
    assert {target for _, _, target in TRANSITIONS} == {Sure, Suspected, Doubted}
