import math

import numpy as np
import pytest

from simulator.errors import SimulatorSettingsError
from simulator.world.foam import Foam
from simulator.world.taxels import (
    CELL_M,
    NoiseModel,
    PressureGrid,
    SensorLaw,
    ideal_counts,
    resistance_mohm,
)
from tactile.layout import paper_layout, pinch_layout

ALL = (slice(None), slice(None))


def test_the_resistance_is_equation_11() -> None:
    # The paper quotes 650, 250, 100 and 50 kOhm; its own equation meets them within 13 kOhm.
    found = resistance_mohm(np.array([2.0, 4.0, 6.0, 8.0]))
    assert found == pytest.approx([0.643, 0.262, 0.107, 0.0435], abs=1e-3)
    assert np.all(np.abs(found - [0.65, 0.25, 0.1, 0.05]) < 0.013)


def test_counts_grow_from_zero_towards_full_scale() -> None:
    counts = ideal_counts(np.array([0.0, 1.0, 2.0, 4.0, 8.0, 100.0]), 255)
    assert counts[0] == 0.0
    assert np.all(np.diff(counts) > 0.0)
    assert counts[2] == pytest.approx(255 * (1 - 0.643 / 1.579), abs=0.1)
    assert counts[-1] == pytest.approx(255.0)
    assert ideal_counts(np.array([2.0]), 4095)[0] == pytest.approx(counts[2] * 4095 / 255)


def test_a_linear_sensor_counts_in_proportion() -> None:
    law = SensorLaw(gain=0.5, full_scale_n=2.0)
    assert ideal_counts(np.array([0.0, 1.0, 4.0]), 4095, law) == pytest.approx([0, 1023.75, 4095])


@pytest.mark.parametrize("pad", [paper_layout().pads[0], pinch_layout().pads[1]])
def test_no_force_is_lost_on_the_way_to_the_taxels(pad) -> None:
    grid = PressureGrid(pad, Foam())  # type: ignore[arg-type]
    rng = np.random.default_rng(1)
    pressure_pa = rng.uniform(0.0, 1e5, (grid.x_m.size, grid.y_m.size))
    force_n = grid.taxel_force_n(pressure_pa, grid.shares(ALL))
    assert force_n.sum() == pytest.approx(pressure_pa.sum() * grid.cell_area_m2, rel=1e-12)
    assert force_n.min() > 0.0


def test_the_grid_is_fine_and_divides_the_taxels_evenly() -> None:
    pad = paper_layout().pads[0]
    grid = PressureGrid(pad, Foam())
    step_m = grid.x_m[1, 0] - grid.x_m[0, 0]
    assert step_m <= CELL_M
    assert (pad.pitch_x_m / step_m) == pytest.approx(round(pad.pitch_x_m / step_m))
    assert grid.x_m.size * step_m == pytest.approx(pad.rows * pad.pitch_x_m)


def test_a_point_spreads_as_a_gaussian() -> None:
    pad = pinch_layout().pads[0]
    grid = PressureGrid(pad, Foam(spread_m=1.5e-3))
    i, j = grid.x_m.size // 2, grid.y_m.size // 2
    force_n = grid.taxel_force_n(
        np.array([[1.0 / grid.cell_area_m2]]), grid.shares((slice(i, i + 1), slice(j, j + 1)))
    ).reshape(pad.rows, pad.columns)
    offset_m = pad.taxel_xy_m()[:, 0] - grid.x_m[i, 0]
    width_m = math.sqrt(float(force_n.ravel() @ offset_m**2))
    # A taxel adds the variance of its own width.
    assert width_m == pytest.approx(math.sqrt(1.5e-3**2 + 3.4e-3**2 / 12), rel=0.05)


@pytest.mark.parametrize(
    ("kind", "low", "high", "mean"),
    [
        ("clipped_normal", 1.0, 20.0, 8.0),
        ("symmetric", -20.0, 20.0, 0.0),
        ("uniform", 1.0, 20.0, 10.5),
        ("none", 0.0, 0.0, 0.0),
    ],
)
def test_noise_has_the_range_of_its_reading(kind, low, high, mean) -> None:
    noise = NoiseModel(kind=kind).sample(np.random.default_rng(3), 100_000, 255)
    assert low <= noise.min()
    assert noise.max() <= high
    assert noise.mean() == pytest.approx(mean, abs=0.2)


def test_noise_scales_with_level_and_full_scale() -> None:
    full = NoiseModel().sample(np.random.default_rng(3), 1000, 255)
    half = NoiseModel(level=0.5).sample(np.random.default_rng(3), 1000, 255)
    fine = NoiseModel().sample(np.random.default_rng(3), 1000, 4095)
    assert half == pytest.approx(0.5 * full)
    assert fine == pytest.approx(full * 4095 / 255)
    assert not NoiseModel(level=0.0).sample(np.random.default_rng(3), 10, 255).any()


def test_impossible_noise_is_refused() -> None:
    with pytest.raises(SimulatorSettingsError, match="kind"):
        NoiseModel(kind="pink")  # type: ignore[arg-type]
    for level in (-0.1, 4.1, math.nan):
        with pytest.raises(SimulatorSettingsError, match="level"):
            NoiseModel(level=level)
