"""The watch of a part alone: its doubt, and the measurements that end it."""

from dataclasses import replace

import pytest

from benchmarks.performance.force_ramps import NOISE_N, PARTS, Rig
from gripper.errors import GripContradicted
from gripper.force.estimates.grip import Grip
from gripper.force.ramp import ForceRamp
from gripper.force.supervision.part_watch import PartWatch
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from tests.gripper.force.grips import PERIOD_S, STATE, make_grip, make_period
from tests.marks import LONG


class Watched:
    """A watch whose pads, frames, fingers and motors a test sets from period to period."""

    def __init__(self, force_n: float = 3.0) -> None:
        self.grip: Grip = make_grip(force_n)
        self.watch = PartWatch(self.grip, contact_n_m=1e4)
        self.now_s, self.force_n, self.frame_n = 0.0, force_n, force_n
        self.closing_m_s, self.pressing_n, self.noise_n = 0.0, 6.0, 0.05
        self.valid = self.scans = True
        """Whether samples are valid, and whether new frames come."""
        self.first_share = 1.0
        """Share of its speed that the first finger has."""
        self.aperture_m = STATE.aperture_m
        self._frame = 0.0, (force_n, force_n)

    def period(self, n: int = 1) -> bool:
        """Run periods; return whether one of them shows the part as lost."""
        return any(self._one() for _ in range(n))

    def _one(self) -> bool:
        self.now_s += PERIOD_S
        self.aperture_m -= PERIOD_S * self.closing_m_s
        frame_s = 0.02 * (self.now_s // 0.02)
        if self.scans and frame_s > self._frame[0]:
            self._frame = frame_s, (self.frame_n, self.frame_n)
        sample = ForceSample(
            t_s=self.now_s,
            force_n=(self.force_n, self.force_n),
            lag_s=0.0015,
            noise_n=self.noise_n,
            valid=self.valid,
            frame_s=self._frame[0],
            frame_n=self._frame[1],
        )
        period = make_period(
            self.now_s,
            0.0,
            sample,
            closed_m=STATE.aperture_m - self.aperture_m,
            speed_m_s=-self.closing_m_s,
            drive_n=self.pressing_n,
        )
        self.grip.apertures.add(self.now_s, self.aperture_m)
        moment = period.moment
        first, *others = moment.state.servos
        first = replace(first, velocity_rad_s=self.first_share * first.velocity_rad_s)
        state = replace(moment.state, servos=(first, *others))
        return self.watch.lost(replace(moment, state=state))


@pytest.fixture
def watched() -> Watched:
    made = Watched()
    assert not made.period(30)
    assert made.watch._suspicion is None
    return made


def test_pads_that_are_empty_for_a_moment_are_no_doubt(watched: Watched) -> None:
    watched.grip.planned_n = 0.7  # so little that nothing is sudden
    watched.force_n = watched.frame_n = 0.0
    watched.period(15)
    assert watched.watch._suspicion is not None
    assert not watched.watch.suspicious
    watched.force_n = watched.frame_n = 3.0
    assert not watched.period(15)
    assert watched.watch._suspicion is None


@pytest.mark.parametrize(("empty_s", "suspicious"), [(0.09, False), (0.11, True)])
def test_little_force_is_doubted_once_the_pads_were_empty_for_five_frames(
    watched: Watched, empty_s: float, suspicious: bool
) -> None:
    watched.grip.planned_n = 0.7
    watched.force_n = watched.frame_n = 0.0
    watched.pressing_n = 1.0
    # The first samples still have force in their mean.
    while watched.watch._suspicion is None:
        watched.period()
    watched.period(round(empty_s / PERIOD_S))
    assert watched.watch.suspicious is suspicious


def test_a_force_that_is_gone_waits_for_a_frame_from_after_it(watched: Watched) -> None:
    watched.scans, watched.pressing_n = False, 1.0
    watched.force_n = watched.frame_n = 0.0
    assert not watched.period(40)
    assert watched.watch.suspicious
    watched.scans = True
    assert watched.period(5)


@pytest.mark.parametrize("closing_m_s", [0.0, 0.03])
def test_samples_that_are_not_valid_show_no_lost_part(watched: Watched, closing_m_s) -> None:
    watched.valid, watched.closing_m_s = False, closing_m_s
    watched.force_n = watched.frame_n = 0.0
    assert not watched.period(25)
    assert watched.watch._suspicion is None


def test_fingers_that_run_together_confirm_it(watched: Watched) -> None:
    watched.force_n, watched.frame_n, watched.closing_m_s = 0.0, 0.0, 0.015
    assert watched.period(20)


@pytest.mark.parametrize(
    ("changes", "shows"),
    [
        ({"frame_n": 3.0}, "a frame scanned since then shows 3.00 and 3.00 N"),
        ({"frame_n": 0.0}, "the fingers do not run together from 23.4 mm"),
        ({"frame_n": 0.0, "closing_m_s": 0.004}, "the fingers do not run together from"),
    ],
)
def test_another_witness_that_shows_the_part_is_a_contradiction(
    watched: Watched, changes, shows, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gripper.force.supervision.part_watch._run", lambda *_: False)
    watched.force_n = 0.0
    for name, value in changes.items():
        setattr(watched, name, value)
    with pytest.raises(GripContradicted, match=shows) as error:
        watched.period(100)
    assert "fell from 3.00 N to 0.00 and 0.00 N" in str(error.value)


@pytest.mark.parametrize(("first_share", "lost"), [(1.0, True), (0.08, False)])
def test_fingers_that_run_meet_nothing_where_the_force_does_not_grow(
    watched: Watched, first_share: float, lost: bool
) -> None:
    """One finger that runs alone may be an encoder that drifts."""
    watched.closing_m_s, watched.first_share = 0.03, first_share
    assert watched.period(20) is lost


def test_force_that_comes_back_is_a_contradiction(watched: Watched) -> None:
    watched.force_n = watched.frame_n = 0.0
    assert not watched.period(3)
    assert watched.watch.suspicious
    watched.force_n = 3.0
    with pytest.raises(GripContradicted, match=r"fell from 3\.00 N to 0\.00 and 0\.00 N"):
        watched.period(100)
    assert watched.watch.suspicious
    watched.watch.resume()
    assert not watched.watch.suspicious  # a pause ends the doubt


def test_one_large_sample_at_the_start_is_no_force_that_is_gone() -> None:
    watched = Watched(2.0)
    watched.noise_n, watched.frame_n = 0.13, 0.45
    for watched.force_n in (0.97, *[0.38] * 9, *[0.1] * 4):
        assert not watched.period()
    assert not watched.watch.suspicious


def test_nothing_is_lost_that_was_never_held() -> None:
    never = Watched(force_n=0.0)
    assert not never.period(100)
    assert never.watch._suspicion is None


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("level_n", [0.8, 1.5])
def test_a_light_part_that_is_taken_is_lost_though_no_finger_runs(
    make_started, rate_hz, level_n
) -> None:
    """Friction holds the fingers where the part was: they close only when they try to."""
    cell = make_started(rate_hz=rate_hz, slip_drop_n=20.0)

    def take(cycle) -> None:
        if cycle.level is not None:
            cell.part.present = False

    outcome = cell.gripper.grasp(ForceRamp.linear(level_n, rate_n_s=4.0, hold_s=1.5), take)
    assert outcome.result is GraspResult.PART_LOST


@pytest.mark.slow
def test_a_soft_part_that_noise_shows_early_is_not_lost_before_it_is_held() -> None:
    """The approach ends at 0.07 N; the pads are empty for the first tenth of a second."""
    seeds = {"servos": 5033, "seed": 5033}
    rig = Rig(PARTS["foam ball, 0.2 N/mm"], NOISE_N, **seeds, rate_hz=200.0, force_max_n=15.0)
    rig.gripper.start()
    outcome = rig.gripper.grasp(ForceRamp.linear(3.0, rate_n_s=3.0))
    assert outcome.result is GraspResult.FORCE_REACHED


RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("force_n", [0.7, LONG(1.5)])
def test_a_light_part_is_not_lost_in_the_noise_of_single_scans(make_started, force_n) -> None:
    cell = make_started(rate_hz=333.0, noise_n=0.35, slip_drop_n=20.0)
    assert cell.gripper.grasp(ForceRamp.linear(force_n, rate_n_s=2.0)).contact_t_s is not None
    cell.gripper.hold(5.0)


@pytest.mark.slow
@pytest.mark.parametrize("stalls_s", [LONG(0.05), 0.15, 0.2])
def test_a_part_is_not_lost_because_the_loop_stalls(make_started, stalls_s) -> None:
    # A force that overshoots in a stall comes back at once: that is no slip.
    cell = make_started(
        force_stale_s=0.3, stall_max_s=0.25, watchdog_s=0.5, bus_loss_s=0.3, slip_drop_n=2.0
    )
    periods = 0

    def stall(cycle) -> None:
        nonlocal periods
        periods += 1
        if periods % 40 == 0:
            cell.clock.sleep(stalls_s)

    assert cell.gripper.grasp(RAMP, stall).result is GraspResult.FORCE_REACHED
    cell.gripper.hold(1.5, stall)
    assert cell.force_n == pytest.approx(4.0, abs=0.5)
