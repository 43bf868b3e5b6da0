"""The centre of force on each gripping pad."""

import numpy as np
import pytest

from tactile.layout import paper_layout
from tactile.sensor.grip_force import ForceCentres


def test_the_centre_is_the_mean_place_weighted_by_force() -> None:
    layout = paper_layout()
    force_n = np.zeros(layout.n_taxels)
    assert ForceCentres(layout).of(force_n) is None
    first, second = (np.flatnonzero(layout.taxel_pad == pad) for pad in layout.gripping_pads)
    force_n[first[[0, 1]]] = (1.0, 3.0)
    assert ForceCentres(layout).of(force_n) is None
    force_n[second[5]] = 0.2
    found = ForceCentres(layout).of(force_n)
    assert found is not None
    position_m = layout.position_m[:, :2]
    one_m = 0.25 * position_m[first[0]] + 0.75 * position_m[first[1]]
    assert found == pytest.approx(tuple(0.5 * (one_m + position_m[second[5]])))
    # Pads that do not grip have no say.
    other = np.flatnonzero(~np.isin(layout.taxel_pad, layout.gripping_pads))
    force_n[other] = 9.0
    assert ForceCentres(layout).of(force_n) == found
