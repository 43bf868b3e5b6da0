"""Force messages in the sensor: the zero that the unit gets, and the comparison with the frames."""

from contextlib import nullcontext

import numpy as np
import pytest

from tactile.errors import ForceContradicted
from tactile.frames.force_message import (
    TABLE_NODES,
    ForceMessage,
    ForceStatus,
    decode_table,
    decode_zero,
)
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.force_check import ForceCheck, force_table
from tactile.sensor.sensor import TactileSensor
from tests.tactile.sensor.test_sensor import CALIBRATION, LAYOUT, Frames, readings


def message(t_s: float, *force_n: float) -> ForceMessage:
    first_n, second_n = force_n
    return ForceMessage(t_s=t_s, counter=0, status=ForceStatus.ZEROED, force_n=(first_n, second_n))


class Forces:
    """A source of messages that shows one force, each 3 ms."""

    def __init__(self, frames: Frames) -> None:
        self.frames = frames
        self.sends_forces = True
        self.force_n = (0.0, 0.0)
        self.zeros: list[bytes] = []
        self.due_s = 0.0

    def write_zero(self, zero: bytes) -> None:
        self.zeros.append(zero)

    def take_forces(self) -> tuple[ForceMessage, ...]:
        found = []
        while self.due_s <= self.frames.now_s:
            found.append(message(self.due_s, *self.force_n))
            self.due_s += 0.003
        return tuple(found)


def tared() -> tuple[TactileSensor, Frames, Forces]:
    frames = Frames()
    forces = Forces(frames)
    sensor = TactileSensor(frames, LAYOUT, CALIBRATION, clock=frames, forces=forces)
    sensor.start()
    assert not sensor.has_forces
    sensor.tare()
    return sensor, frames, forces


def test_the_table_is_that_of_the_calibration() -> None:
    table_n = decode_table(force_table(LAYOUT, FoamCalibration(255, gain=1.5)))
    counts = np.linspace(0.0, 255.0, TABLE_NODES)
    np.testing.assert_allclose(
        table_n[0], FoamCalibration(255, gain=1.5).force_n(counts), atol=3e-4
    )
    np.testing.assert_array_equal(table_n[0], table_n[1])


def test_a_tare_gives_the_unit_its_zero_and_a_threshold_above_the_noise() -> None:
    sensor, _, forces = tared()
    assert sensor.has_forces
    assert sensor.tare_result is not None
    touch_counts, zero_counts, bad = decode_zero(forces.zeros[-1], 128, 255)
    first, second = LAYOUT.gripping_pads
    expected = np.concatenate(
        [sensor.tare_result.offset_counts[LAYOUT.taxels_of(pad)] for pad in (first, second)]
    )
    np.testing.assert_allclose(zero_counts, expected, atol=0.003)
    assert not bad.any()
    assert 3.0 < touch_counts < 5.0
    assert sensor.take_forces() == ()


def test_a_taxel_that_fails_in_a_grip_sends_the_force_back_to_the_frames_until_it_is_free() -> None:
    sensor, frames, forces = tared()
    broken = LAYOUT.taxels_of(LAYOUT.gripping_pads[1]).start + 7

    def stick(counts: np.ndarray) -> None:
        counts[broken] = 33

    frames.alter = stick
    readings(sensor, frames, 40)
    assert not sensor.has_forces
    assert len(forces.zeros) == 1
    sensor.check_zero()
    assert sensor.has_forces
    bad = decode_zero(forces.zeros[-1], 128, 255)[2]
    assert np.flatnonzero(bad).tolist() == [64 + 7]


def test_the_noise_of_a_message_follows_what_is_touched() -> None:
    sensor, frames, forces = tared()
    readings(sensor, frames, 5)
    light_n = sensor.scan_noise_n
    frames.press(4.0, "blob")
    forces.force_n = (4.0, 0.0)
    readings(sensor, frames, 10)
    assert 0.05 < light_n <= sensor.scan_noise_n < 0.4


def test_messages_that_differ_from_the_frames_are_a_fault_with_both_numbers() -> None:
    sensor, frames, forces = tared()
    forces.force_n = (4.0, 4.0)
    frames.press(4.0, finger=0)
    both = frames.base.copy()
    frames.press(4.0, finger=1)
    frames.base += both
    readings(sensor, frames, 40)
    forces.force_n = (4.0, 6.5)
    with pytest.raises(
        ForceContradicted, match=r"show 6\.\d+ N on finger 1, the frames [34]\.\d+ N"
    ):
        readings(sensor, frames, 20)
    with pytest.raises(ForceContradicted):
        sensor.poll()


@pytest.mark.parametrize(
    ("noise_n", "shown_n", "missing_n", "found"),
    [
        (0.05, 2.0, 0.9, True),
        (0.10, 2.0, 0.9, False),
        (0.10, 3.0, 1.8, True),
        (0.05, 1.2, 1.2, False),
        (0.05, 1.8, 1.8, True),
    ],
)
def test_the_noise_decides_what_frames_may_leave_out(noise_n, shown_n, missing_n, found) -> None:
    check = ForceCheck(mean_frames=3)
    check.reset(taxel_noise_n=noise_n)
    frames_n = shown_n - missing_n
    with pytest.raises(ForceContradicted) if found else nullcontext():
        for n in range(100):
            check.add(message(0.002 * n, shown_n, shown_n))
            if n % 10 == 9:
                check.compare(0.002 * n, (frames_n, frames_n))


def test_a_force_that_moves_is_no_contradiction_and_a_short_one_neither() -> None:
    check = ForceCheck(mean_frames=3)
    for n in range(400):
        force_n = 10.0 * 0.003 * n
        check.add(message(0.003 * n, force_n, force_n))
        if n % 7 == 6:  # the frames' mean is 30 ms behind
            check.compare(0.003 * n, (max(0.0, force_n - 0.3), max(0.0, force_n - 0.3)))
    check.reset(taxel_noise_n=0.05)
    for n in range(60):
        check.add(message(2.0 + 0.003 * n, 5.0 if n < 12 else 1.0, 1.0))
        if n % 7 == 6:
            check.compare(2.0 + 0.003 * n, (1.0, 1.0))
