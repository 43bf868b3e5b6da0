"""Counts to forces, and the filters between: the paper's figures, borders, noise, single frames."""

from functools import partial

import numpy as np
import pytest

from tactile.errors import CalibrationError
from tactile.layout import paper_layout
from tactile.sensor.calibration import FoamCalibration, TableCalibration
from tactile.sensor.filters import ActiveTaxels, Neighbourhood, fill_bad
from tactile.sensor.sensor import TaxelForces
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import compute_tare
from tests.tactile.conftest import counts_of

LAYOUT = paper_layout()
HOOD = Neighbourhood(LAYOUT)
N = LAYOUT.n_taxels


def taxel(row: int, column: int) -> int:
    return row * 4 + column


def mask(*taxels: int) -> np.ndarray:
    result = np.zeros(N, dtype=bool)
    result[list(taxels)] = True
    return result


def test_spatial_mean_is_binomial_inside() -> None:
    values = np.zeros(N)
    values[taxel(8, 1)] = 16.0
    smooth = HOOD.mean(values)
    assert [smooth[taxel(8, c)] for c in (0, 1, 2, 3)] == pytest.approx([16 * 2 / 12, 4, 2, 0])
    assert smooth[taxel(7, 2)] == pytest.approx(1.0)


def test_nothing_reaches_across_pads() -> None:
    values = np.zeros(N)
    values[LAYOUT.taxels_of(0)] = 5.0
    other = np.ones(N, dtype=bool)
    other[LAYOUT.taxels_of(0)] = False
    assert not HOOD.mean(values)[other].any()
    assert not HOOD.highest_neighbour(values)[other].any()
    np.testing.assert_array_equal(HOOD.connected(mask(0), np.ones(N, dtype=bool)), ~other)


def test_bad_taxels_take_their_neighbours_mean() -> None:
    values = np.arange(N, dtype=float)
    broken = values.copy()
    broken[[taxel(5, 1), taxel(9, 2)]] = [0.0, 255.0]
    filled = fill_bad(HOOD, broken, mask(taxel(5, 1), taxel(9, 2)))
    np.testing.assert_allclose(filled, values)
    assert fill_bad(HOOD, values, mask()) is values


def test_a_bad_taxel_without_good_neighbours_is_zero() -> None:
    filled = fill_bad(HOOD, np.full(N, 9.0), np.ones(N, dtype=bool))
    assert not filled.any()


def test_regions_grow_through_allowed_taxels_only() -> None:
    seed = mask(taxel(2, 0))
    allowed = mask(taxel(2, 0), taxel(3, 1), taxel(4, 2), taxel(7, 0))
    region = HOOD.connected(seed, allowed)
    np.testing.assert_array_equal(region, mask(taxel(2, 0), taxel(3, 1), taxel(4, 2)))
    assert not HOOD.connected(mask(taxel(9, 0)), allowed).any()


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: ActiveTaxels(HOOD, np.zeros(N)), ValueError, "above 0"),
        *(
            (partial(law, *values), CalibrationError, "gains")
            for gain in (0.0, -1.0, float("nan"), [1.0, float("inf")])
            for law, values in (
                (FoamCalibration, (255, gain)),
                (TableCalibration, ((1.0,), (1.0,), 255, gain)),
            )
        ),
        (lambda: FoamCalibration(0), CalibrationError, "adc_max is 0"),
        (lambda: TableCalibration((1.0,), (1.0,), 0), CalibrationError, "adc_max is 0"),
        *(
            (partial(TableCalibration, *nodes, 255), CalibrationError, "rise from above 0")
            for nodes in (
                ((), ()),
                ((5.0, 3.0), (1.0, 2.0)),
                ((3.0, 5.0), (1.0, 1.0)),
                ((0.0,), (1.0,)),
            )
        ),
    ],
)
def test_what_cannot_be_is_refused(make, error, says) -> None:
    with pytest.raises(error, match=says):
        make()


def touched_by(touch: ActiveTaxels, peak: float) -> set[int]:
    counts = np.zeros(N)
    counts[taxel(8, 1)] = peak
    return set(np.flatnonzero(touch.step(counts)))


def test_touch_starts_high_and_ends_low() -> None:
    # One taxel of 16 counts is 4 counts after smoothing; the noise there is 0.375.
    touch = ActiveTaxels(HOOD, np.ones(N))
    assert touched_by(touch, 5.0 * 0.375 * 4) == set()
    assert taxel(8, 1) in touched_by(touch, 6.0 * 0.375 * 4)
    assert taxel(8, 1) in touched_by(touch, 3.5 * 0.375 * 4)
    assert touched_by(touch, 1.0 * 0.375 * 4) == set()
    assert touched_by(touch, 5.0 * 0.375 * 4) == set()


def test_a_light_flat_touch_is_seen_at_the_large_scale() -> None:
    touch = ActiveTaxels(HOOD, np.ones(N))
    counts = np.zeros(N)
    counts[[taxel(r, c) for r in range(6, 11) for c in range(4)]] = 1.9
    assert np.all(HOOD.mean(counts)[taxel(8, 1)] / 0.375 < 5.5)
    assert touch.step(counts)[taxel(8, 1)]


def test_equation_11_gives_the_papers_curve_from_zero_to_full_scale() -> None:
    # Resistances of the paper's sensor in MOhm: the first term of its equation alone.
    resistance = np.array([1.579, 0.643, 0.262, 0.107, 0.0435])
    for adc_max, gain in ((255, 1.0), (4095, 2.0)):
        force_n = FoamCalibration(adc_max, gain).force_n(adc_max * (1 - resistance / 1.579))
        np.testing.assert_allclose(force_n, gain * np.arange(0.0, 9.0, 2.0), rtol=1e-3)


def test_law_is_smooth_and_rising_through_zero() -> None:
    force_n = FoamCalibration(255).force_n(np.arange(-20.0, 255.0))
    steps = np.diff(force_n)
    assert np.all(steps > 0)
    assert steps[19] == pytest.approx(steps[20], rel=0.01)
    assert force_n[20] == 0.0


def test_full_scale_gives_the_smallest_force_that_saturates() -> None:
    calibration = FoamCalibration(255)
    force_n = calibration.force_n(np.array([254.5, 255.0, 400.0]))
    np.testing.assert_allclose(force_n, 13.88, atol=0.01)
    assert calibration.force_n(np.array([254.4])) < force_n[0] - 0.1


def test_a_table_goes_straight_from_node_to_node_and_on_beyond_them() -> None:
    line = TableCalibration((500.0,), (1.0,), 4095)
    assert line.force_n(np.array([-10.0, 0.0, 500.0])) == pytest.approx([-0.02, 0, 1.0])
    law = TableCalibration((10.0, 30.0), (0.1, 0.7), 255, np.array([1.0, 2.0]))
    assert law.force_n(np.array([5.0, 5.0])) == pytest.approx([0.05, 0.1])
    assert law.force_n(np.array([20.0, 40.0])) == pytest.approx([0.4, 2.0])
    assert law.force_n(np.array([-5.0, 0.0])) == pytest.approx([-0.05, 0.0])


# -- Forces on the taxels of single frames: the sensor's law and zero, without its mean ------------


LAW = FoamCalibration(adc_max=LAYOUT.adc_max)
DEAD = 27
"""A taxel in the middle of the pressed ones."""


@pytest.fixture
def untouched() -> np.ndarray:
    """Forty frames of noise about an offset, with one dead taxel."""
    rng = np.random.default_rng(3)
    counts = np.clip(np.rint(rng.normal(6.0, 1.5, (40, LAYOUT.n_taxels))), 0, 255)
    counts[:, DEAD] = 0
    return counts.astype(np.uint16)


@pytest.fixture
def forces(untouched: np.ndarray) -> TaxelForces:
    zero = compute_tare(Neighbourhood(LAYOUT), untouched, SensorSettings(), 0.0)
    return TaxelForces(LAYOUT, LAW, zero)


def pressed(untouched: np.ndarray, force_n: float) -> np.ndarray:
    """Return a frame with a force on each of 5 x 3 taxels around the dead one."""
    taxels = [DEAD + 4 * row + column for row in range(-2, 3) for column in (-1, 0, 1)]
    counts = untouched[0].astype(float)
    counts[taxels] += counts_of(LAW, np.full(len(taxels), force_n))
    counts[DEAD] = 0
    return np.rint(counts).astype(np.uint16)


def test_untouched_pads_show_no_force(forces, untouched) -> None:
    forces_n = np.array([forces.of(frame) for frame in untouched])
    assert forces_n.dtype == np.float32
    assert np.count_nonzero(forces_n) < 1e-3 * forces_n.size


def test_a_press_shows_its_force_beside_and_on_a_dead_taxel(forces, untouched) -> None:
    pressed_n = forces.of(pressed(untouched, 0.5))
    assert pressed_n.sum() == pytest.approx(15 * 0.5, rel=0.1)
    assert (pressed_n[DEAD], pressed_n[64:].max()) == (pytest.approx(0.5, rel=0.1), 0.0)


def test_a_frame_shows_nothing_of_the_one_before(forces, untouched) -> None:
    alone_n = forces.of(untouched[1])
    forces.of(pressed(untouched, 0.5))
    np.testing.assert_array_equal(forces.of(untouched[1]), alone_n)
