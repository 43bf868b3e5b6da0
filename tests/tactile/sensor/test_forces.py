"""Force messages in the sensor: the zero that the unit gets, and the comparison with the frames."""

import itertools
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gripper.values.force_sensor import ForceSample
from tactile.errors import ForceContradicted
from tactile.sensor.force_check import ForceCentres, ForceCheck
from tactile.sensor.grip_force import GripForce
from tactile.sensor.sensor import TactileSensor
from tactile.source import ForceMessage, PadZero, ScanStatus, SourceIdentity
from tests.marks import LONG
from tests.tactile.conftest import counts_of
from tests.tactile.sensor.test_sensor import CALIBRATION, LAYOUT, Frames, readings


def message(t_s: float, *force_n: float) -> ForceMessage:
    first_n, second_n = force_n
    return ForceMessage(t_s=t_s, counter=0, status=ScanStatus.ZEROED, force_n=(first_n, second_n))


class Forces(Frames):
    """A link that shows one force, each 3 ms, beside its frames."""

    identity = SourceIdentity(sends_forces=True)

    def __init__(self) -> None:
        super().__init__()
        self.force_n = (0.0, 0.0)
        self.zeros: list[PadZero] = []
        self.due_s = 0.0
        self.status = ScanStatus.ZEROED

    def set_zero(self, zero: PadZero) -> None:
        self.zeros.append(zero)

    def new_forces(self) -> tuple[ForceMessage, ...]:
        messages = []
        while self.due_s <= self.now_s:
            last = message(self.due_s, *self.force_n)
            centre = ForceCentres(LAYOUT).of(CALIBRATION.force_n(self.base))
            messages.append(replace(last, status=self.status, centre_taxels=centre))
            self.due_s += 0.003
        return tuple(messages)


def tared() -> tuple[TactileSensor, Forces]:
    link = Forces()
    sensor = TactileSensor(link, CALIBRATION, clock=link)
    sensor.start()
    assert not sensor.has_forces
    sensor.tare()
    return sensor, link


def test_a_tare_sets_zero_and_noise_of_the_source() -> None:
    sensor, link = tared()
    assert len(repr(sensor.tare_result)) < 200
    assert sensor.has_forces
    assert sensor.tare_result is not None
    first, second = LAYOUT.gripping_pads
    expected = np.concatenate(
        [sensor.tare_result.offset_counts[LAYOUT.taxels_of(pad)] for pad in (first, second)]
    )
    np.testing.assert_array_equal(link.zeros[-1].offset_counts, expected)
    assert not link.zeros[-1].bad.any()
    assert 3.0 < link.zeros[-1].touch_counts < 5.0
    assert sensor.take_forces() == ()


def test_a_taxel_that_fails_in_a_grip_sends_the_force_back_to_the_frames_until_it_is_free() -> None:
    sensor, link = tared()
    link.stuck = {LAYOUT.taxels_of(LAYOUT.gripping_pads[1]).start + 7: 33}
    readings(sensor, link, 40)
    assert not sensor.has_forces
    assert len(link.zeros) == 1
    sensor.check_zero()
    assert sensor.has_forces
    assert np.flatnonzero(link.zeros[-1].bad).tolist() == [64 + 7]


def test_the_noise_of_a_message_follows_what_is_touched() -> None:
    sensor, link = tared()
    readings(sensor, link, 5)
    light_n = sensor.scan_noise_n
    link.press(4.0, "blob")
    link.force_n = (4.0, 0.0)
    readings(sensor, link, 10)
    assert 0.05 < light_n <= sensor.scan_noise_n < 0.4


def gripping(*, noise: bool = True) -> tuple[TactileSensor, Frames, GripForce[ForceSample]]:
    """Return a sensor of frames alone that has taken its zero, and its force for a loop."""
    link = Frames()
    link.noise = noise
    sensor = TactileSensor(link, CALIBRATION, clock=link)
    sensor.start()
    sensor.tare()
    sensor.refresh()
    return sensor, link, GripForce(sensor, ForceSample)


@pytest.mark.parametrize(("noise", "alone"), [(False, True), (True, False)])
def test_the_force_of_quiet_frames_is_that_of_one_frame_and_of_noisy_ones_the_mean(
    noise: bool, alone: bool
) -> None:
    sensor, link, force = gripping(noise=noise)
    link.press(4.0, "blob")
    readings(sensor, link, 1)
    reading, sample = sensor.latest, force.latest_force()
    assert sample.force_n == (reading.scan_force_n if alone else reading.finger_force_n)
    if alone:
        assert sample.noise_n == sensor.scan_noise_n < 0.02
        assert sample.lag_s == reading.frame.t_s - reading.frame.scanned_s


@pytest.mark.parametrize("rows", [2, 16])
def test_the_noise_of_the_centre_follows_the_extent_of_the_contact(rows: int) -> None:
    sensor, link, force = gripping()
    forces_n = np.zeros(len(link.base))
    for taxels in LAYOUT.gripping_taxels:
        forces_n[taxels.start : taxels.start + 4 * rows] = 12.0 / (4 * rows)
    link.base = counts_of(CALIBRATION, forces_n)
    readings(sensor, link, 5)
    samples = [force.latest_force() for _ in range(60) if readings(sensor, link, 1)]
    scatter_m = np.std([sample.centre_m for sample in samples], axis=0).max()
    claimed_m = np.mean([sample.centre_noise_m for sample in samples])
    # Each frame is in three means, which are compared as if they had the noise of one frame.
    assert 0.35 * claimed_m < scatter_m < 0.8 * claimed_m


@pytest.mark.parametrize(
    ("status", "at_least"),
    [
        (ScanStatus.ZEROED, False),
        (ScanStatus.ZEROED | ScanStatus.SATURATED, True),
        (ScanStatus.ZEROED | ScanStatus.SATURATED | ScanStatus.CONVERTER_FAULT, False),
        (ScanStatus.SATURATED, False),
    ],
)
def test_messages_of_a_taxel_at_full_scale_are_a_lower_bound(status, at_least) -> None:
    sensor, link = tared()
    force = GripForce(sensor, ForceSample)
    link.status = status
    readings(sensor, link, 5)
    sample = force.latest_force()
    assert (sample.valid, sample.at_least) == (status == ScanStatus.ZEROED, at_least)


@pytest.mark.parametrize("full", [True, False])
def test_a_frame_of_a_taxel_at_full_scale_is_a_lower_bound(full: bool) -> None:
    sensor, link, force = gripping()
    forces = np.zeros(408)
    forces[33], forces[[29, 32, 34, 37]] = 20.0 if full else 1.5, 1.0
    link.base = counts_of(CALIBRATION, forces)
    readings(sensor, link, 4)
    sample = force.latest_force()
    assert (sample.valid, sample.at_least) == (not full, full)
    assert sample.force_n[0] > 4.0


def test_messages_that_differ_from_the_frames_are_a_fault_with_both_numbers() -> None:
    sensor, link = tared()
    link.force_n = (4.0, 4.0)
    link.press(4.0, finger=0)
    both = link.base.copy()
    link.press(4.0, finger=1)
    link.base += both
    readings(sensor, link, 40)
    link.force_n = (4.0, 6.5)
    with pytest.raises(ForceContradicted, match=r"6\.\d+ N on finger 1, .* same time [34]\.\d+ N"):
        readings(sensor, link, 20)
    with pytest.raises(ForceContradicted):
        sensor.poll()


def test_the_centre_is_the_mean_place_weighted_by_force() -> None:
    force_n = np.zeros(LAYOUT.n_taxels)
    assert ForceCentres(LAYOUT).of(force_n) is None
    first, second = (np.flatnonzero(LAYOUT.taxel_pad == pad) for pad in LAYOUT.gripping_pads)
    force_n[first[[0, 1]]] = (1.0, 3.0)
    assert ForceCentres(LAYOUT).of(force_n) is None
    force_n[second[5]] = 0.2
    centres = ForceCentres(LAYOUT).of(force_n)
    place = LAYOUT.taxel_xy_m / (55e-3 / 16, 5e-3)
    one = 0.25 * place[first[0]] + 0.75 * place[first[1]]
    assert centres == pytest.approx(tuple(0.5 * (one + place[second[5]])))
    # Pads that do not grip have no say.
    force_n[np.flatnonzero(~np.isin(LAYOUT.taxel_pad, LAYOUT.gripping_pads))] = 9.0
    assert ForceCentres(LAYOUT).of(force_n) == centres


def check_of(taxel_noise_n: float) -> ForceCheck:
    """Return a check of pads with this noise of one taxel in N."""
    check = ForceCheck()
    check.reset(taxel_noise_n)
    return check


def compared(
    check: ForceCheck,
    at_s: float,
    messages: Sequence[ForceMessage],
    frame_n: tuple[float, float],
    *,
    noise_n: float = 0.2,
    centre: tuple[float, float] | None = (0.0, 0.0),
) -> None:
    """Give the check the messages from around a scan, and the frame."""
    check.messages.extend(messages)
    check.compare(at_s, frame_n, noise_n, centre_taxels=centre)


def around(at_s: float, *force_n: float, centre=(0.0, 0.0)) -> list[ForceMessage]:
    messages = [message(at_s - 0.004 + 0.002 * i, *force_n) for i in range(5)]
    return [replace(one, centre_taxels=centre) for one in messages]


def test_a_load_that_is_spread_over_a_pad_is_no_difference() -> None:
    """A flat part on 64 taxels: frames show none of 2.5 N above the noise of each."""
    check, draw = check_of(0.045), np.random.default_rng(0)
    for n in range(100):
        whole_n = 2.5 + draw.normal(0.0, 0.045 * 8.0, 2)
        check.messages.extend(around(0.02 * n, 2.5, 2.5))
        check.compare(0.02 * n, (0.0, 0.8), 0.2, centre_taxels=(1.5, 0.0), whole_n=whole_n)


@pytest.mark.parametrize("hidden", [True, False])
def test_a_light_touch_of_a_quiet_pad_may_lack_in_the_messages(*, hidden: bool) -> None:
    """No taxel is above the unit's threshold; with one, the same difference is an error."""
    check, force_n = check_of(0.0), (0.4, 0.4)
    with nullcontext() if hidden else pytest.raises(ForceContradicted, match=r"0\.00 N on"):
        for n in range(30):
            check.messages.extend(around(0.02 * n, 0.0, 0.0))
            check.compare(0.02 * n, (0.0, 0.0) if hidden else force_n, 0.01, whole_n=force_n)


def frames_until_fault(check: ForceCheck, message_n: float, frame_n: float, **more: Any) -> int:
    """Return after how many frames a difference that stays is found; 100 for never."""
    centre = more.pop("message_centre", (0.0, 0.0))
    for n in range(1, 100):
        at_s = 0.02 * n
        messages = around(at_s, message_n, message_n, centre=centre)
        try:
            compared(check, at_s, messages, (frame_n, frame_n), **more)
        except ForceContradicted:
            return n
    return 100


@pytest.mark.parametrize(
    ("message_n", "frame_n", "taxel_n", "noise_n", "most"),
    [
        (0.0, 2.0, 0.02, 0.2, 2),  # the messages are empty
        (4.0, 6.0, 0.02, 0.2, 2),  # 2 N less
        (5.16, 6.0, 0.02, 0.15, 3),  # 14 % less
        (5.2, 6.0, 0.045, 0.3, 12),  # each third message at 0.6
        (2.6, 3.0, 0.02, 0.15, 12),
        (9.6, 6.0, 0.02, 0.2, 2),  # another table
        (1.8, 0.0, 0.02, 0.2, 12),
        (1.0, 0.4, 0.045, 0.3, 100),
        (5.8, 6.0, 0.02, 0.15, 100),  # no more than is allowed
    ],
)
def test_a_difference_is_found_the_sooner_the_larger_it_is(
    message_n, frame_n, taxel_n, noise_n, most
) -> None:
    n_frames = frames_until_fault(check_of(taxel_n), message_n, frame_n, noise_n=noise_n)
    assert n_frames == 100 if most == 100 else n_frames <= most


@pytest.mark.parametrize("seed", [0, *(LONG(n) for n in (1, 2))])
def test_noise_alone_is_no_difference(seed: int) -> None:
    check, draw = check_of(0.03), np.random.default_rng(seed)
    for n in range(3000):  # a minute
        at_s = 0.02 * n
        forces_n = 4.0 + draw.normal(0.0, 0.2, (5, 2))
        messages = [message(at_s - 0.004 + 0.002 * i, *forces_n[i]) for i in range(5)]
        first_n, second_n = 4.0 + draw.normal(0.0, 0.2, 2)
        compared(check, at_s, messages, (float(first_n), float(second_n)), centre=None)


def test_a_part_that_leaves_or_is_touched_between_two_messages_is_no_difference() -> None:
    check = check_of(0.02)
    forces_n = [6.0] * 30 + [0.0] * 30 + [5.0] * 30
    for n, (before_n, now_n) in enumerate(itertools.pairwise(forces_n)):
        compared(check, 0.02 * n, around(0.02 * n, before_n, before_n), (now_n, now_n))


def test_a_force_that_changes_fast_is_no_difference() -> None:
    def force_n(at_s: float) -> float:
        return max(0.0, 8.0 - 300.0 * max(0.0, at_s - 0.05))

    check, sent_s = check_of(0.02), 0.0
    for n in range(20):
        at_s, messages = 0.01 * n - 0.0033, []
        while sent_s < at_s + 0.005:
            messages.append(message(sent_s, force_n(sent_s), force_n(sent_s)))
            sent_s += 0.01
        compared(check, at_s, messages, (force_n(at_s),) * 2, noise_n=0.05, centre=None)


def test_a_message_in_three_that_shows_less_is_a_difference() -> None:
    check, kinds = check_of(0.02), itertools.cycle((6.0, 6.0, 3.6))

    def compare_twenty() -> None:
        for n in range(20):
            near = [message(0.02 * n + 0.002 * i, *[next(kinds)] * 2) for i in range(-3, 3)]
            compared(check, 0.02 * n, near, (6.0, 6.0), centre=None)

    with pytest.raises(ForceContradicted):
        compare_twenty()


@pytest.mark.parametrize(
    ("force_n", "centre", "most"),
    [(6.0, (1.0, 0.0), 3), (2.0, (0.0, -1.0), 25), (6.0, None, 2), (6.0, (0.2, 0.2), 100)],
)
def test_centres_that_are_elsewhere_or_missing_are_found(force_n, centre, most) -> None:
    n_frames = frames_until_fault(check_of(0.02), force_n, force_n, message_centre=centre)
    assert n_frames == 100 if most == 100 else n_frames <= most


def test_centres_of_several_touches_do_not_add_up() -> None:
    check = check_of(0.02)
    for n, centre in enumerate([(0.0, 0.0), None] * 20):
        messages = around(0.02 * n, 6.0, 6.0, centre=(1.0, 0.0))
        compared(check, 0.02 * n, messages, (6.0, 6.0), centre=centre)
