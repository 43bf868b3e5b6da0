"""Forces on the taxels of single frames: the sensor's law and zero, without its mean."""

import numpy as np
import pytest

from tactile.layout import paper_layout
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.filters import Neighbourhood
from tactile.sensor.tare import TareLimits, compute_tare
from tactile.sensor.taxel_forces import TaxelForces

LAYOUT = paper_layout()
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
    zero = compute_tare(Neighbourhood(LAYOUT), untouched, TareLimits(), 0.0)
    return TaxelForces(LAYOUT, LAW, zero)


def pressed(untouched: np.ndarray, force_n: float) -> np.ndarray:
    """Return a frame with a force on each of 5 x 3 taxels around the dead one."""
    taxels = [DEAD + 4 * row + column for row in range(-2, 3) for column in (-1, 0, 1)]
    counts = untouched[0].astype(float)
    counts[taxels] += LAW.counts(np.full(len(taxels), force_n))
    counts[DEAD] = 0
    return np.rint(counts).astype(np.uint16)


def test_untouched_pads_show_no_force(forces, untouched) -> None:
    shown_n = np.array([forces.of(frame) for frame in untouched])
    assert shown_n.dtype == np.float32
    assert np.count_nonzero(shown_n) < 1e-3 * shown_n.size


def test_a_press_shows_its_force_beside_and_on_a_dead_taxel(forces, untouched) -> None:
    shown_n = forces.of(pressed(untouched, 0.5))
    assert shown_n.sum() == pytest.approx(15 * 0.5, rel=0.1)
    assert shown_n[DEAD] == pytest.approx(0.5, rel=0.1)
    assert shown_n[64:].max() == 0.0


def test_a_frame_shows_nothing_of_the_one_before(forces, untouched) -> None:
    alone_n = forces.of(untouched[1])
    forces.of(pressed(untouched, 0.5))
    np.testing.assert_array_equal(forces.of(untouched[1]), alone_n)
