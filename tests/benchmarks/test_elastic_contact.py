"""The other contact physics against known solutions: Hertz, separate columns, a bonded layer."""

import numpy as np
import pytest

from benchmarks.recognition._elastic_contact import ElasticGrid, ElasticPad, bonded_layer
from benchmarks.recognition._elastic_grasps import (
    MATERIALS,
    PADS,
    Sensed,
    elastic_grasp,
    pressed_object,
)
from recognition.grasp import GraspCommand

RADIUS_M = 5e-3
CELL_M = 0.1e-3
N = 48


def ball_lag_m(cell_m: float = CELL_M) -> np.ndarray:
    """How far a paraboloid lies below its top over a square of cells."""
    x_m = (np.arange(N) - 0.5 * N + 0.5) * cell_m
    return (x_m[:, None] ** 2 + x_m[None] ** 2) / (2.0 * RADIUS_M)


@pytest.mark.parametrize("depth_m", [0.2e-3, 0.4e-3, 0.8e-3])
def test_a_ball_on_a_half_space_is_hertz_contact(depth_m: float) -> None:
    pad = ElasticPad(modulus_pa=1e6, poisson=0.3)
    stiffness_pa = 1e6 / (1.0 - 0.3**2)
    pressure_pa = ElasticGrid(pad, (N, N), CELL_M).press(depth_m - ball_lag_m())
    force_n = pressure_pa.sum() * CELL_M**2
    radius_m = np.sqrt((pressure_pa > 0.0).sum() * CELL_M**2 / np.pi)
    assert force_n == pytest.approx(4 / 3 * stiffness_pa * RADIUS_M**0.5 * depth_m**1.5, rel=0.01)
    assert radius_m == pytest.approx(np.sqrt(RADIUS_M * depth_m), rel=0.03)
    highest_pa = 2.0 * stiffness_pa / np.pi * np.sqrt(depth_m / RADIUS_M)
    assert pressure_pa.max() == pytest.approx(highest_pa, rel=0.01)


def test_a_layer_much_thinner_than_the_contact_is_separate_columns() -> None:
    poisson, thick_m, depth_m, cell_m = 0.2, 0.1e-3, 0.3e-3, 0.12e-3
    pad = ElasticPad(modulus_pa=1e6, poisson=poisson, thickness_m=thick_m)
    confined_pa = 1e6 * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    pressure_pa = ElasticGrid(pad, (N, N), cell_m).press(depth_m - ball_lag_m(cell_m))
    force_n = pressure_pa.sum() * cell_m**2
    assert force_n == pytest.approx(np.pi * RADIUS_M * confined_pa / thick_m * depth_m**2, rel=0.02)
    radius_m = np.sqrt((pressure_pa > 0.0).sum() * cell_m**2 / np.pi)
    assert radius_m == pytest.approx(np.sqrt(2.0 * RADIUS_M * depth_m), rel=0.03)


def test_a_bonded_layer_has_the_compliance_of_the_books() -> None:
    """Nogi and Kato (1997) write it in closed form."""
    alpha, poisson = np.array([0.01, 0.3, 1.0, 3.0, 10.0, 40.0]), 0.35
    kappa = 3.0 - 4.0 * poisson
    twice = 2.0 * np.minimum(alpha, 20.0)
    book = (2 * kappa * np.sinh(twice) - 2 * twice) / (
        2 * kappa * np.cosh(twice) + twice**2 + 1 + kappa**2
    )
    compliance, stress = bonded_layer(alpha, poisson)
    np.testing.assert_allclose(compliance, book, rtol=1e-6)
    assert stress[0] == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.diff(stress) < 0.0)
    assert stress[-1] == 0.0


def test_no_pull_and_no_overlap() -> None:
    wanted_m = 0.4e-3 - ball_lag_m()
    wanted_m[:, : N // 3] = -np.inf
    grid = ElasticGrid(ElasticPad(modulus_pa=1e6, thickness_m=2e-3), (N, N), CELL_M)
    pressure_pa = grid.press(wanted_m)
    gap_m = grid.displacement_m(pressure_pa) - wanted_m
    assert pressure_pa.min() == 0.0
    assert not pressure_pa[:, : N // 3].any()
    assert gap_m.min() > -2e-6
    assert np.abs(gap_m[pressure_pa > 0.0]).max() < 2e-6


@pytest.mark.parametrize("name", MATERIALS)
def test_a_grasp_carries_its_force_and_closes(name: str) -> None:
    placing = GraspCommand(x_m=1e-3, y_m=0.0, rotation_rad=0.4, roll_rad=0.0, force_n=6.0)
    trial = pressed_object("ball", "sphere:diameter=9mm", placing, MATERIALS[name])
    sensor = Sensed(noise=0.0, aperture_sd_m=0.0, force_sd=0.0, pad_gain_sd=0.0, taxel_gain_sd=0.0)
    grasp = elastic_grasp(trial, sensor, 1)
    assert grasp.pads.same_as(PADS["paper"])
    end_m = grasp.aperture_m[-1]
    assert grasp.aperture_m[0] == pytest.approx(10.2e-3, abs=1e-5)
    assert 4e-3 < end_m < 8e-3
    assert np.all(np.diff(grasp.aperture_m[:15]) < 0.0)
    share = (grasp.counts[-1] / grasp.pads.adc_max).astype(float)
    felt_n = -np.log(1.0 - share ** (1.0 / MATERIALS[name].bend)) / 0.449
    lost = MATERIALS[name].relaxation
    assert felt_n.sum() == pytest.approx(12.0 * (1.0 - 0.5 * lost), rel=0.07)
