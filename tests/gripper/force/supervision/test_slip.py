"""A held part that slips: by its force, the way of the fingers, or its place."""

import random
from typing import Any

import pytest

from gripper.errors import PartSlipped
from gripper.force.loop import Moment
from gripper.force.supervision.slip import SlipWatch
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from tests.values import make_state

SETTINGS = GripperSettings(servos=(ServoSettings(servo_id=1),))


def slips(watch: SlipWatch, sample: ForceSample, *, aperture_m: float = 0.01, **held: Any) -> str:
    """Return the sign of a slip in one period at the time of its sample; empty without one."""
    state = make_state(now_s := sample.t_s, aperture_m=aperture_m)
    try:
        watch.check(Moment(now_s=now_s, dt_s=0.005, state=state, sample=sample), **held)
    except PartSlipped as slip:
        return str(slip)
    return ""


def test_a_sudden_drop_is_a_slip_within_a_tenth_of_a_second() -> None:
    watch, now_s = SlipWatch(SETTINGS), 0.0
    text = ""
    while not text and now_s < 2.0:
        now_s += 0.02
        force_n = 4.0 if now_s < 1.0 else 3.0
        text = slips(watch, ForceSample(t_s=now_s, force_n=(force_n, force_n)), setpoint_n=4.0)
    assert "by itself: clear the fault, then release" in text
    assert 1.0 < now_s < 1.1


@pytest.mark.parametrize(
    ("forces_n", "noise_n"),
    [
        # A part that is taken: the force falls on, and the watch of the part reports its loss.
        ([4.0] * 80 + [1.5, 0.0, 0.0], 0.13),
        # A sample between messages before and after that, each quiet enough alone.
        ([4.0] * 80 + [2.5], 0.05),
        # The first sample that counts is noise, of a force that has not reached its set-point.
        ([3.4] * 60 + [4.4] + [3.4] * 20, 0.3),
    ],
)
def test_a_drop_that_goes_on_or_hangs_on_one_sample_is_no_slip(forces_n, noise_n) -> None:
    watch = SlipWatch(SETTINGS)
    for i, force_n in enumerate(forces_n):
        sample = ForceSample(t_s=0.005 * i, force_n=(force_n, force_n), noise_n=noise_n)
        assert not slips(watch, sample, setpoint_n=4.0)


def test_fingers_that_close_after_the_part_show_a_slip() -> None:
    watch = SlipWatch(SETTINGS)
    told = [
        slips(
            watch,
            ForceSample(t_s=0.005 * i, force_n=(4.0, 4.0)),
            setpoint_n=4.0,
            aperture_m=0.01 - 4e-6 * i,
        )
        for i in range(600)
    ]
    first = next(i for i, text in enumerate(told) if text)
    assert 1.5 < 4e-3 * (first - 60) < 1.6
    assert "closed by 1.5" in told[first]


def slid_m(period_s: float, noise_m: float, *, speed_m_s: float, gap_s: float = 0.0) -> float:
    """Return how far a part has slid when that is reported; 1 m where it never is.

    Between 2 s and ``gap_s`` s later there are no samples.
    """
    watch, draw = SlipWatch(SETTINGS), random.Random(5)
    for i in range(round(4.0 / period_s)):
        t_s = period_s * i
        if 2.0 < t_s < 2.0 + gap_s:
            continue
        x_m = speed_m_s * max(0.0, t_s - 1.0)
        centre_m = (x_m + draw.gauss(0.0, noise_m), 0.0)
        sample = ForceSample(t_s=t_s, force_n=(5.0, 5.0), centre_m=centre_m, centre_noise_m=noise_m)
        if text := slips(watch, sample, setpoint_n=5.0):
            assert "unless the zero of the pads drifts" in text or speed_m_s > 0.001
            return x_m
    return 1.0


@pytest.mark.parametrize(("period_s", "noise_m"), [(0.02, 0.0001), (0.005, 0.00025)])
def test_a_part_that_slides_along_the_pads_is_a_slip(period_s, noise_m) -> None:
    assert 0.0005 < slid_m(period_s, noise_m, speed_m_s=0.02) < 0.0012


def test_the_noisier_the_centre_the_farther_is_a_slide() -> None:
    assert 0.002 < slid_m(0.02, 0.0005, speed_m_s=0.02) < 0.004
    assert slid_m(0.02, 0.0005, speed_m_s=0.0) == 1.0


@pytest.mark.parametrize("frame_s", [None, 0.0])
def test_a_centre_of_messages_that_is_noisier_than_stated_is_no_slide(frame_s) -> None:
    watch, draw = SlipWatch(SETTINGS), random.Random(5)
    samples = (
        ForceSample(
            t_s=0.005 * i,
            force_n=(5.0, 5.0),
            centre_m=(draw.gauss(0.0, 0.0005), 0.0),
            centre_noise_m=0.00025,
            frame_s=frame_s,
        )
        for i in range(4000)
    )
    assert any(slips(watch, sample, setpoint_n=5.0) for sample in samples) is (frame_s is None)


def test_a_slow_slide_is_reported_at_the_largest_way_also_after_a_gap_of_the_samples() -> None:
    assert 0.0014 < slid_m(0.02, 0.0001, speed_m_s=0.001) < 0.0017
    assert slid_m(0.02, 0.0001, speed_m_s=0.0, gap_s=0.5) == 1.0
    assert slid_m(0.02, 0.0001, speed_m_s=0.001, gap_s=0.9) == pytest.approx(0.0019, abs=1e-4)


def test_force_beyond_the_set_point_that_is_given_back_is_no_slip() -> None:
    watch, pushed = SlipWatch(SETTINGS), SlipWatch(SETTINGS)
    for i in range(400):
        sample = ForceSample(t_s=0.005 * i, force_n=(4.4, 4.4) if i < 200 else (3.1, 3.1))
        assert not slips(watch, sample, setpoint_n=3.0)
        assert not slips(pushed, sample, setpoint_n=4.4, opens=i == 199)
