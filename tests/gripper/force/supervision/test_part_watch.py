"""The watch of a part, the confirmation that nothing is held, pads that report a wrong force."""

from dataclasses import replace

import pytest

from benchmarks.performance.force_ramps import NOISE_N, PARTS, Rig
from gripper.errors import ForceAboveCap, ForceImbalance, GripContradicted
from gripper.force.estimates.grip import Grip
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.force.supervision.part_watch import EmptyGrip, PartWatch
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from tests.gripper.force.grips import LINKAGE, PERIOD_S, STATE, make_grip, make_moment
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
        moment = make_moment(
            self.now_s,
            sample,
            closed_m=STATE.aperture_m - self.aperture_m,
            speed_m_s=-self.closing_m_s,
            drive_n=self.pressing_n,
        )
        self.grip.stiffness.apertures.add(self.now_s, self.aperture_m)
        first, *others = moment.state.servos
        first = replace(first, velocity_rad_s=self.first_share * first.velocity_rad_s)
        state = replace(moment.state, servos=(first, *others))
        return self.watch.update(replace(moment, state=state))


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
@pytest.mark.parametrize("end_n", [0.8, 1.5])
def test_a_light_part_that_is_taken_is_lost_though_no_finger_runs(
    make_started, rate_hz, end_n
) -> None:
    """Friction holds the fingers where the part was: they close only when they try to."""
    cell = make_started(rate_hz=rate_hz, slip_drop_n=20.0)

    def take(cycle) -> None:
        if cycle.setpoint_n == end_n:
            cell.part.present = False

    outcome = cell.gripper.grasp(ForceRamp.linear(end_n, rate_n_s=4.0, hold_s=1.5), take)
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


@pytest.mark.parametrize("rate_hz", [None, 500.0])
def test_a_force_that_jumps_above_the_cap_is_told_as_that(make_cell, rate_hz) -> None:
    """It may be less above the cap than noise alone may be: the jump shows that it is none."""
    cell = make_cell(rate_hz=rate_hz, noise_n=0.05, force_max_n=7.0, force_noise_n=2.0)
    cell.hold_part(RAMP)
    cell.sensor.offset_n = 4.0
    with pytest.raises(ForceAboveCap, match="force_max_n is 7"):
        cell.gripper.hold(1.5)


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("in_s", [0.0, 0.4], ids=["before the approach", "in the approach"])
def test_fingers_that_pads_send_through_the_air_stop_before_they_hit_the_part(
    make_started, in_s, rate_hz
) -> None:
    """A zero that jumps shows a contact where there is none, and nothing resists the ramp."""
    cell = make_started(width_m=0.008, aperture_m=0.03, force_max_n=15.0, rate_hz=rate_hz)
    jump = cell.once(lambda: setattr(cell.sensor, "offset_n", 7.0), in_s=in_s)
    with pytest.raises(GripContradicted, match="ended without a part"):
        cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.3), jump)
    cell.clock.sleep(1.0)
    assert cell.peak_n == 0.0
    assert cell.mechanics.aperture_m > 0.012


def test_closed_fingers_that_feel_a_little_name_a_small_part(make_started) -> None:
    cell = make_started(width_m=0.0014, stiffness_n_m=2000.0, noise_n=0.02, aperture_m=0.01)
    with pytest.raises(GripContradicted, match="part is too small to be held, or the pads press"):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=20.0))
    assert cell.torques == [1, 1]


@pytest.mark.parametrize("other_n", [0.2, 9.0])
def test_uneven_pads_open_no_finger_and_freeze_both(cell, other_n: float) -> None:
    cell.hold_part(RAMP)
    measure, begun_s, cell.least_n = cell.sensor.measure, cell.clock.monotonic(), cell.force_n
    cell.sensor.measure = lambda now_s, force_n: measure(now_s, (force_n[0], other_n))
    with pytest.raises(ForceImbalance, match="both are frozen"):
        cell.gripper.squeeze(ForceRamp.linear(8.0, rate_n_s=3.0))
    assert cell.clock.monotonic() - begun_s < 0.5
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    assert cell.least_n > 3.0


LAG_S, FRAME_S = 0.02, 0.02
MECHANICS = Mechanics(GripperSettings(), LINKAGE)
"""0.6 N are a contact, so 0.3 N on both pads are a load."""


def periods(*samples_n: float, frame_n: float | None = 0.0, **noise: float) -> list[bool]:
    """Return whether each period confirmed an empty grip, with a sample in each; all 0 N later."""
    empty = EmptyGrip(MECHANICS, STATE, stiffness_n_m=None, ran=True)
    done: list[bool] = []
    for i in range(1, 20):
        t_s = STATE.t_s + PERIOD_S * i
        force_n = samples_n[i - 1] if i <= len(samples_n) else 0.0
        scanned_s = STATE.t_s + FRAME_S * (i // 4) - LAG_S
        frame = {} if frame_n is None else {"frame_s": scanned_s, "frame_n": (frame_n, frame_n)}
        sample = ForceSample(t_s=t_s, force_n=(force_n, force_n), lag_s=LAG_S, **frame, **noise)
        done.append(empty.step(Moment(now_s=t_s, dt_s=PERIOD_S, state=STATE, sample=sample)).done)
    return done


def test_samples_of_after_the_stop_alone_confirm_that_nothing_is_held() -> None:
    assert periods().index(True) == 15, "80 ms after the stop"
    assert periods(frame_n=None).index(True) == 0, "a sensor whose samples come from frames"
    assert periods(2.0, 2.0, 2.0, frame_n=None).index(True) == 3


@pytest.mark.parametrize(
    ("samples_n", "frame_n", "says"),
    [
        ((0.0,) * 19, 0.5, r"samples show 0\.00 and 0\.00 N, the frames 0\.50 and 0\.50 N, more"),
        ((0.5,) * 19, 0.0, r"samples show 0\.50 and 0\.50 N, the frames 0\.00 and 0\.00 N, more"),
        ((0.5,) * 19, None, r"samples show 0\.50 and 0\.50 N, more than 0\.30 N on both .*Look"),
    ],
)
def test_a_load_on_both_pads_contradicts_an_empty_grip(samples_n, frame_n, says) -> None:
    for noise_n in (0.2, 0.02):
        with pytest.raises(GripContradicted, match=says):
            periods(*samples_n, frame_n=frame_n, noise_n=noise_n)
