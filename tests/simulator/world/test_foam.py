import math

import numpy as np
import pytest

from simulator.errors import SimulatorSettingsError
from simulator.world.foam import Foam, ForceTable

FOAM = Foam()


def pressure_pa(indentation_m: float) -> float:
    return float(FOAM.pressure_pa(np.array([indentation_m]))[0])


def test_the_papers_threshold_is_a_strain_of_3_percent() -> None:
    # The paper: 50 g/cm2 = 4.9 kPa at an indentation of 0.1 mm.
    assert pressure_pa(0.1e-3) == pytest.approx(4.9e3, rel=0.03)


def test_the_foam_does_not_pull() -> None:
    assert pressure_pa(-1e-3) == 0.0
    assert pressure_pa(0.0) == 0.0


def test_it_stiffens_as_its_cells_close() -> None:
    indentation_m = np.linspace(0.0, 3.5e-3, 500)
    slope = np.diff(FOAM.pressure_pa(indentation_m))
    assert np.all(slope > 0.0)
    assert np.all(np.diff(slope) > -1e-6 * slope[:-1])
    assert pressure_pa(1.5e-3) == pytest.approx(1.5 * 150e3 * 0.5)
    assert pressure_pa(2.4e-3) > 5.0 * pressure_pa(1.2e-3)


def test_beyond_the_limit_it_goes_on_along_its_tangent() -> None:
    limit_m = 0.9 * FOAM.thickness_m
    before = (pressure_pa(limit_m) - pressure_pa(limit_m - 1e-8)) / 1e-8
    after = (pressure_pa(limit_m + 1e-4) - pressure_pa(limit_m)) / 1e-4
    assert after == pytest.approx(before, rel=1e-4)


def test_a_table_is_the_sum_over_the_cells() -> None:
    radius_m = 5e-3
    axis_m = (np.arange(40) - 19.5) * 0.25e-3
    x_m, y_m = np.meshgrid(axis_m, axis_m)
    below = radius_m**2 - x_m**2 - y_m**2
    reach_m = np.where(below >= 0.0, np.sqrt(np.maximum(below, 0.0)), -np.inf)
    table = ForceTable(FOAM, reach_m, 0.25e-3**2)
    for depth_m in (0.3e-3, 1.2345e-3, 2.5e-3):
        cells_m = np.where(np.isfinite(reach_m), depth_m - (table.reach_max_m - reach_m), 0.0)
        expected_n = float(FOAM.pressure_pa(cells_m).sum()) * 0.25e-3**2
        assert table.lookup(depth_m)[0] == pytest.approx(expected_n, rel=1e-3)


def test_a_small_dent_of_a_sphere_follows_the_winkler_bed() -> None:
    # Linear bed of springs: F = pi E R d^2 / t.
    soft = Foam(densification=0.0)
    axis_m = (np.arange(400) - 199.5) * 0.02e-3
    x_m, y_m = np.meshgrid(axis_m, axis_m)
    reach_m = np.sqrt((20e-3) ** 2 - x_m**2 - y_m**2)
    force_n, _ = ForceTable(soft, reach_m, 0.02e-3**2).lookup(0.3e-3)
    assert force_n == pytest.approx(math.pi * 150e3 * 20e-3 * 0.3e-3**2 / 3e-3, rel=0.02)


def test_the_stiffness_is_the_slope_of_the_force() -> None:
    table = ForceTable(FOAM, np.full((10, 10), 4e-3), 1e-6)
    for depth_m in (0.505e-3, 2.015e-3):
        force_n, stiffness_n_m = table.lookup(depth_m)
        further_n, _ = table.lookup(depth_m + 1e-6)
        assert further_n - force_n == pytest.approx(1e-6 * stiffness_n_m, rel=1e-6)
    assert table.lookup(0.0) == (0.0, 0.0)
    assert table.lookup(-1.0) == (0.0, 0.0)


def test_a_surface_beside_the_pad_is_refused() -> None:
    with pytest.raises(SimulatorSettingsError, match="beside the pad"):
        ForceTable(FOAM, np.full((3, 3), -np.inf), 1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {"thickness_m": 0.0},
        {"modulus_pa": math.nan},
        {"spread_m": -1.0},
        {"densification": -0.1},
        {"limit_strain": 1.0},
    ],
)
def test_impossible_foams_are_refused(change) -> None:
    with pytest.raises(SimulatorSettingsError, match=next(iter(change))):
        Foam(**change)
