"""The world between the fingers: objects on the pads, and recorded grasps in its place."""

import math
from dataclasses import replace

import numpy as np
import pytest

from simulator.errors import SimulatorSettingsError, SimulatorStateError
from simulator.world.press import PadPair
from simulator.world.recorded import RecordedWorld
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose
from simulator.world.taxels import NoiseModel
from simulator.world.world import PhysicalWorld, WorldSettings
from tactile.layout import TaxelLayout, paper_layout, pinch_layout

QUIET = WorldSettings(noise=NoiseModel(kind="none"))


def test_empty_pads_meet_foam_on_foam() -> None:
    pads = PadPair(
        shift_m=(1e-3, -1e-3),
        tilt_rad=(math.radians(2.0), 0.0),
        gains=(1.2, 0.8),
        stiffness=(1.0, 0.5),
    )
    plain, leaning = Bench(), Bench(settings=replace(QUIET, pads=pads))
    for bench in (plain, leaning):
        assert bench.go(1e-3, 1e-3) == (0.0, 0.0)
    # Two sheets in series: 150 kPa, 55 x 20 mm, 3 mm each; where they meet does not matter.
    assert plain.go(-1e-4, 0.0)[0] == pytest.approx(150e3 * 1.1e-3 * 1e-4 / 6e-3, rel=0.02)
    assert plain.go(4e-4, -5e-4)[0] == pytest.approx(plain.go(-1e-4, 0.0)[0])
    # A pad that leans touches with one end first, and both pads feel one force.
    first_n, second_n = leaning.go(3e-4, 3e-4)
    assert first_n == second_n > 0.5
    taxels = [leaning.pad_force_n(finger) for finger in (0, 1)]
    assert [t.sum() for t in taxels] == pytest.approx([first_n, second_n])
    assert taxels[0].reshape(16, 4)[0].sum() == 0.0
    assert taxels[0].reshape(16, 4)[-1].sum() > 0.1
    counts = leaning.world.scan()
    felt = [counts[leaning.layout.taxels_of(pad)].sum() for pad in leaning.layout.gripping_pads]
    assert felt[0] / felt[1] == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize("wrong", [{"gains": (0.0, 1.0)}, {"shift_m": (1.0, 0.0)}])
def test_pads_beyond_what_a_hand_has_are_refused(wrong) -> None:
    with pytest.raises(SimulatorSettingsError, match="pads are"):
        PadPair(**wrong)


class HandMovedFingers:
    """Fingers that the test puts where it wants."""

    def __init__(self, half_m: float = 12e-3) -> None:
        self.finger_position_m = (half_m, half_m)
        self.driven_m: list[float] = []
        self.steps: list[tuple[tuple[float, float], tuple[float, float]]] = []

    def drive_to(self, aperture_m: float) -> None:
        self.driven_m.append(aperture_m)

    def step(
        self,
        dt_s: float,
        contact_force_n: tuple[float, float],
        contact_stiffness_n_m: tuple[float, float],
    ) -> None:
        assert dt_s == 1e-3
        self.steps.append((contact_force_n, contact_stiffness_n_m))


class Bench:
    """A world with hand-moved fingers and a way to squeeze to a force."""

    def __init__(self, layout: TaxelLayout | None = None, settings: WorldSettings = QUIET) -> None:
        self.layout = layout or paper_layout()
        self.fingers = HandMovedFingers()
        self.world = PhysicalWorld(self.layout, self.fingers, settings)
        self.now_s = 0.0

    def go(self, near_m: float, far_m: float) -> tuple[float, float]:
        self.fingers.finger_position_m = (near_m, far_m)
        self.now_s += 1e-3
        self.world.advance_to(self.now_s)
        return self.world.contact_force_n()

    def squeeze(self, force_n: float) -> None:
        """Close both fingers evenly until the pads carry ``force_n`` within 0.5 %."""
        low_m, high_m = 0.0, 12e-3
        while high_m - low_m > 1e-7:
            half_m = 0.5 * (low_m + high_m)
            if self.go(half_m, half_m)[0] > force_n:
                low_m = half_m
            else:
                high_m = half_m
        assert self.go(high_m, high_m)[0] == pytest.approx(force_n, rel=5e-3)

    def pad_force_n(self, finger: int) -> np.ndarray:
        pad = self.layout.gripping_pads[finger]
        shape = tuple(self.layout.pad_shape[pad])
        return self.world.taxel_force_n()[self.layout.taxels_of(pad)].reshape(shape)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def spread_m(bench: Bench) -> tuple[float, float]:
    """Return the footprint's standard deviations along x and y."""
    force_n = bench.pad_force_n(0).ravel()
    xy_m = bench.layout.taxel_xy_m[bench.layout.taxels_of(bench.layout.gripping_pads[0])]
    weights = force_n / force_n.sum()
    offset_m = xy_m - weights @ xy_m
    along_m, across_m = np.sqrt(weights @ offset_m**2)
    return along_m, across_m


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout()], ids=["paper", "pinch"])
@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_the_taxels_carry_the_contact_force(name: str, layout: TaxelLayout) -> None:
    bench = Bench(layout)
    bench.world.place(name, ObjectPose(x_m=2e-3, y_m=-1e-3, rotation_rad=0.7))
    for force_n in (0.5, 4.0, 12.0):
        bench.squeeze(force_n)
        contact_n = bench.world.contact_force_n()
        for finger in (0, 1):
            assert bench.pad_force_n(finger).sum() == pytest.approx(contact_n[finger], rel=0.01)


@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_peaks_lie_in_the_useful_range_of_8_bit_counts(bench, name: str) -> None:
    bench.world.place(name)
    peaks = []
    for force_n in (2.0, 4.0, 6.0, 8.0):
        bench.squeeze(force_n)
        peaks.append(int(bench.world.scan().max()))
    assert peaks == sorted(peaks)
    assert peaks[0] >= 15
    assert 60 <= peaks[-1] <= 230


def test_a_ball_prints_round_a_cylinder_long_and_a_box_flat() -> None:
    layout = pinch_layout()
    spreads = {}
    for name in ("ball", "cylinder", "box"):
        bench = Bench(layout)
        bench.world.place(name)
        bench.squeeze(6.0)
        spreads[name] = spread_m(bench)
    assert spreads["ball"][0] == pytest.approx(spreads["ball"][1], rel=0.05)
    # A line of 20 mm has a standard deviation of 5.8 mm, a face of 15.9 x 10 mm 4.6 and 2.9 mm.
    assert spreads["cylinder"][0] == pytest.approx(6.1e-3, rel=0.07)
    assert spreads["cylinder"][1] < 0.45 * spreads["cylinder"][0]
    assert spreads["box"] == pytest.approx((4.9e-3, 3.4e-3), rel=0.1)

    bench = Bench(layout)
    bench.world.place("box")
    bench.squeeze(8.0)
    inside_n = bench.pad_force_n(0)[5:8, 2:4]
    assert np.ptp(inside_n) < 0.15 * inside_n.mean()


def test_an_offset_moves_the_footprint(bench) -> None:
    bench.world.place("ball", ObjectPose(x_m=6e-3, y_m=2e-3))
    bench.squeeze(4.0)
    force_n = bench.pad_force_n(1).ravel()
    xy_m = bench.layout.taxel_xy_m[bench.layout.taxels_of(bench.layout.gripping_pads[1])]
    assert force_n @ xy_m / force_n.sum() == pytest.approx([6e-3, 2e-3], abs=0.3e-3)


def test_the_object_floats_until_both_pads_push_equally(bench) -> None:
    friction_n = QUIET.nest_friction_n
    bench.world.place("box", ObjectPose(z_m=1e-3))
    assert bench.go(6.5e-3, 6.5e-3) == (0.0, 0.0)
    assert bench.world._press.z_m == 1e-3
    # Finger 1 meets it first and pushes it along with no more than the nest's friction.
    force_n = bench.go(6.5e-3, 4.5e-3)
    assert force_n == pytest.approx((0.0, friction_n), abs=1e-4)
    assert bench.world._press.z_m < 0.0
    near_n, far_n = bench.go(4.8e-3, 3.9e-3)
    assert near_n > 3.0
    assert abs(near_n - far_n) <= friction_n + 1e-4
    assert -0.6e-3 < bench.world._press.z_m < -0.3e-3


def test_the_object_stays_where_it_was_left(bench) -> None:
    bench.world.place("box")
    bench.go(3.9e-3, 4.5e-3)
    z_m = bench.world._press.z_m
    assert bench.go(12e-3, 12e-3) == (0.0, 0.0)
    assert bench.world._press.z_m == z_m != 0.0


def test_the_mechanics_feel_force_and_stiffness_of_the_step_before(bench) -> None:
    bench.world.place("box")
    bench.go(4.5e-3, 4.5e-3)
    bench.go(4.49e-3, 4.49e-3)
    force_n, stiffness_n_m = bench.fingers.steps[-1]
    grown_n = bench.world.contact_force_n()
    assert grown_n[0] - force_n[0] == pytest.approx(1e-5 * stiffness_n_m[0], rel=0.02)


def test_time_passes_in_steps_of_a_millisecond(bench) -> None:
    bench.world.advance_to(0.0104)
    assert len(bench.fingers.steps) == 10
    bench.world.advance_to(0.0109)
    assert len(bench.fingers.steps) == 10
    bench.world.advance_to(0.011)
    assert len(bench.fingers.steps) == 11
    bench.world.skip_to(1.0)
    bench.world.advance_to(1.001)
    assert len(bench.fingers.steps) == 12


def test_the_noise_is_new_for_each_frame_and_the_same_for_each_run() -> None:
    worlds = [
        PhysicalWorld(paper_layout(), HandMovedFingers(), WorldSettings(seed=7)) for _ in range(2)
    ]
    first, second = worlds[0].scan(), worlds[0].scan()
    assert first.dtype == np.uint16
    assert first.min() >= 1
    assert first.max() <= 20
    assert np.count_nonzero(first != second) > 300
    assert np.array_equal(first, worlds[1].scan())


def test_an_object_goes_only_between_open_fingers(bench) -> None:
    bench.world.place("box")
    bench.go(4.5e-3, 4.5e-3)
    with pytest.raises(SimulatorStateError, match="release it first"):
        bench.world.place("ball")
    assert bench.world.placed == ("box", ObjectPose())
    bench.world.remove()
    assert bench.world.placed is None
    assert bench.world.contact_force_n() == (0.0, 0.0)
    with pytest.raises(SimulatorStateError, match="open the gripper first"):
        bench.world.place("box")
    bench.go(12e-3, 12e-3)
    assert bench.world.place("box", ObjectPose(roll_rad=1.5)).roll_rad == 0.5 * math.pi


LAYOUT = pinch_layout()


def grasp(n: int) -> np.ndarray:
    counts = np.arange(n)[:, np.newaxis] + np.arange(LAYOUT.n_taxels)
    return counts.astype(np.uint16)


def test_each_scan_takes_the_next_frame_and_the_fingers_go_along() -> None:
    fingers = HandMovedFingers()
    world = RecordedWorld(LAYOUT, fingers)
    assert not world.scan().any()
    assert world.remaining == 0
    counts = grasp(3)
    world.load(counts, [0.03, math.nan, 0.02])
    assert world.remaining == 3
    assert fingers.driven_m == [0.03]
    for i in range(3):
        assert np.array_equal(world.scan(), counts[i])
        assert world.remaining == 2 - i
    assert fingers.driven_m == [0.03, 0.03, 0.02]
    assert np.array_equal(world.scan(), counts[2])
    assert world.contact_force_n() == (0.0, 0.0)


def test_a_frame_that_was_handed_out_is_nobody_elses() -> None:
    world = RecordedWorld(LAYOUT, HandMovedFingers())
    world.load(grasp(2), [0.03, 0.03])
    world.scan()[:] = 7
    assert world.scan()[0] == 1


@pytest.mark.parametrize(
    ("counts", "aperture_m", "message"),
    [
        (np.zeros((0, 156), np.uint16), [], "shape"),
        (np.zeros((2, 408), np.uint16), [0.0, 0.0], "shape"),
        (np.zeros((2, 156), np.uint16), [0.0], "aperture_m"),
        (np.zeros((2, 156)), [0.0, 0.0], "integers"),
        (np.full((2, 156), 4096), [0.0, 0.0], "0 to 4095"),
        (np.full((2, 156), -1), [0.0, 0.0], "0 to 4095"),
    ],
)
def test_grasps_that_do_not_fit_are_refused(counts, aperture_m, message) -> None:
    world = RecordedWorld(LAYOUT, HandMovedFingers())
    with pytest.raises(SimulatorSettingsError, match=message):
        world.load(counts, aperture_m)
    assert world.remaining == 0
