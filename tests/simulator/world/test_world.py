"""The world between the fingers: objects on the pads, and recorded grasps in its place."""

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from simulator.errors import SimulatorStateError
from simulator.world.pads import (
    NEST_FRICTION_N,
    Foam,
    ForceTable,
    PadPair,
    PressureGrid,
    SensorLaw,
    ideal_counts,
    noise_counts,
    resistance_mohm,
)
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose
from simulator.world.world import PhysicalWorld, WorldSettings
from tactile.layout import TaxelLayout, paper_layout, pinch_layout

QUIET = WorldSettings(noise_level=0.0)


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
    # Two sheets in series: 145 kPa, 55 x 20 mm, 3 mm each; where they meet does not matter.
    assert plain.go(-1e-4, 0.0)[0] == pytest.approx(145e3 * 1.1e-3 * 1e-4 / 6e-3, rel=0.02)
    assert plain.go(4e-4, -5e-4)[0] == pytest.approx(plain.go(-1e-4, 0.0)[0])
    # A pad that leans touches with one end first, and both pads feel one force.
    first_n, second_n = leaning.go(3e-4, 3e-4)
    assert first_n == second_n > 0.5
    taxels = [leaning.pad_force_n(finger) for finger in (0, 1)]
    assert [t.sum() for t in taxels] == pytest.approx([first_n, second_n])
    assert taxels[0].reshape(16, 4)[0].sum() < 1e-9
    assert taxels[0].reshape(16, 4)[-1].sum() > 0.1
    counts = leaning.world.scan()
    sums = [counts[leaning.layout.taxels_of(pad)].sum() for pad in leaning.layout.gripping_pads]
    assert sums[0] / sums[1] == pytest.approx(1.5, rel=0.05)


def test_pads_meet_beside_a_thin_part() -> None:
    with_part, without = Bench(), Bench()
    with_part.world.place("cylinder:diameter=2mm,length=12mm")
    opened_n, met_n = (with_part.go(half_m, half_m)[0] for half_m in (1e-5, -2e-4))
    assert met_n - opened_n > without.go(-2e-4, -2e-4)[0] > 1.0
    assert with_part.pad_force_n(0).sum() == pytest.approx(met_n, rel=0.05)


class Bench:
    """A world with hand-moved fingers and a way to squeeze to a force."""

    def __init__(self, layout: TaxelLayout | None = None, settings: WorldSettings = QUIET) -> None:
        self.layout = layout or paper_layout()
        self.fingers = Mock(finger_position_m=(12e-3, 12e-3))
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
    along_m, across_m = np.sqrt(weights @ (xy_m - weights @ xy_m) ** 2)
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
    layout, spreads = pinch_layout(), {}
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
    friction_n = NEST_FRICTION_N
    bench.world.place("box", ObjectPose(z_m=1e-3))
    assert bench.go(6.5e-3, 6.5e-3) == (0.0, 0.0)
    assert bench.world._press.z_m == 1e-3
    # Finger 1 meets it first and pushes it along with no more than the nest's friction.
    assert bench.go(6.5e-3, 4.5e-3) == pytest.approx((0.0, friction_n), abs=1e-4)
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
    _dt_s, force_n, stiffness_n_m = bench.fingers.step.call_args.args
    grown_n = bench.world.contact_force_n()
    assert grown_n[0] - force_n[0] == pytest.approx(1e-5 * stiffness_n_m[0], rel=0.02)


def test_time_passes_in_steps_of_a_millisecond(bench) -> None:
    step = bench.fingers.step
    for until_s, steps in ((0.0104, 10), (0.0109, 10), (0.011, 11)):
        bench.world.advance_to(until_s)
        assert step.call_count == steps
    bench.world.skip_to(1.0)
    bench.world.advance_to(1.001)
    assert [call.args[0] for call in step.call_args_list] == [1e-3] * 12


def test_the_noise_is_new_for_each_frame_and_the_same_for_each_run() -> None:
    worlds = [PhysicalWorld(paper_layout(), Mock(), WorldSettings(seed=7)) for _ in range(2)]
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


# -- The foam of the pads, and taxels on it: pressure, spread, counts, noise -----------------------


FOAM = Foam()


def pressure_pa(indentation_m: float) -> float:
    return float(FOAM.pressure_pa(np.array([indentation_m]))[0])


def test_it_yields_as_the_foam_of_the_paper_and_of_a_data_sheet() -> None:
    # The paper: 50 g/cm2 = 4.9 kPa at an indentation of 0.1 mm, a strain of 3 %.
    assert pressure_pa(0.1e-3) == pytest.approx(4.9e3, rel=0.03)
    # The data sheet of a urethane foam: a compression by a quarter.
    assert 34e3 < pressure_pa(0.25 * FOAM.thickness_m) < 58e3


def test_it_stiffens_as_its_cells_close() -> None:
    slope = np.diff(FOAM.pressure_pa(np.linspace(0.0, 3.5e-3, 500)))
    assert (pressure_pa(-1e-3), pressure_pa(0.0)) == (0.0, 0.0)
    assert np.all(slope > 0.0)
    assert np.all(np.diff(slope) > -1e-6 * slope[:-1])
    assert pressure_pa(1.5e-3) == pytest.approx(0.75 * 145e3)
    assert pressure_pa(2.4e-3) > 4.0 * pressure_pa(1.2e-3)


def test_a_small_dent_of_a_sphere_follows_the_winkler_bed() -> None:
    # Linear bed of springs: F = pi E R d^2 / t.
    axis_m = (np.arange(400) - 199.5) * 0.02e-3
    x_m, y_m = np.meshgrid(axis_m, axis_m)
    reach_m = np.sqrt((20e-3) ** 2 - x_m**2 - y_m**2)
    force_n, _ = ForceTable(FOAM, reach_m, 0.02e-3**2).lookup(0.1e-3)
    assert force_n == pytest.approx(math.pi * 145e3 * 20e-3 * 0.1e-3**2 / 3e-3, rel=0.04)


def test_the_stiffness_is_the_slope_of_the_force() -> None:
    table = ForceTable(FOAM, np.full((10, 10), 4e-3), 1e-6)
    for depth_m in (0.505e-3, 2.015e-3):
        force_n, stiffness_n_m = table.lookup(depth_m)
        further_n, _ = table.lookup(depth_m + 1e-6)
        assert further_n - force_n == pytest.approx(1e-6 * stiffness_n_m, rel=1e-6)
    assert table.lookup(0.0) == (0.0, 0.0)
    assert table.lookup(-1.0) == (0.0, 0.0)


def test_the_resistance_is_equation_11() -> None:
    # The paper quotes 650, 250, 100 and 50 kOhm; its own equation meets them within 13 kOhm.
    resistance = resistance_mohm(np.array([2.0, 4.0, 6.0, 8.0]))
    assert resistance == pytest.approx([0.643, 0.262, 0.107, 0.0435], abs=1e-3)
    assert np.all(np.abs(resistance - [0.65, 0.25, 0.1, 0.05]) < 0.013)


def test_counts_grow_from_zero_towards_full_scale() -> None:
    counts = ideal_counts(np.array([0.0, 1.0, 2.0, 4.0, 8.0, 100.0]), 255)
    assert counts[0] == 0.0
    assert np.all(np.diff(counts) > 0.0)
    assert counts[2] == pytest.approx(255 * (1 - 0.643 / 1.579), abs=0.1)
    assert counts[-1] == pytest.approx(255.0)
    assert ideal_counts(np.array([2.0]), 4095)[0] == pytest.approx(counts[2] * 4095 / 255)


def test_a_linear_sensor_counts_in_proportion_up_to_full_scale() -> None:
    law = SensorLaw(gain=0.5, nodes=((0.0, 2.0), (0.0, 4095.0)))
    assert ideal_counts(np.array([0.0, 1.0, 4.0]), 4095, law) == pytest.approx([0, 1023.75, 4095])


def test_the_pressure_of_a_taxel_spreads_by_the_way_of_the_foam() -> None:
    pad = pinch_layout().pads[0]
    grid = PressureGrid(pad, FOAM)
    per_taxel, middle = grid.x_m.size // pad.rows, pad.rows // 2
    rows = slice(middle * per_taxel, (middle + 1) * per_taxel)
    pressure_pa = np.full((per_taxel, 1), 1.0 / (per_taxel * grid.cell_area_m2))
    force_n = grid.taxel_force_n(pressure_pa, grid.shares((rows, slice(0, 1))))
    variance_m2 = float(force_n @ (pad.taxel_xy_m()[:, 0] - grid.x_m[rows].mean()) ** 2)
    # An exponential has twice the square of its way; both taxels add about their own variance.
    assert variance_m2 == pytest.approx(2.0 * FOAM.spread_m**2 + 3.4e-3**2 / 6.0, rel=0.06)


def test_noise_has_the_range_of_the_paper() -> None:
    noise = noise_counts(np.random.default_rng(3), 100_000, 255)
    assert (noise.min(), noise.max()) == (1.0, 20.0)
    assert noise.mean() == pytest.approx(8.0, abs=0.2)


def test_noise_scales_with_level_and_full_scale() -> None:
    full = noise_counts(np.random.default_rng(3), 1000, 255)
    half = noise_counts(np.random.default_rng(3), 1000, 255, 0.5)
    fine = noise_counts(np.random.default_rng(3), 1000, 4095)
    assert half == pytest.approx(0.5 * full)
    assert fine == pytest.approx(full * 4095 / 255)
    assert not noise_counts(np.random.default_rng(3), 10, 255, 0.0).any()
