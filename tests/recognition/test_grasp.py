"""Values that a grasp takes, and those that it refuses."""

import numpy as np
import pytest

from recognition.grasp import Grasp, PadArray

PADS = PadArray.grid(2, 2, 3e-3)


def counts_of(value: float) -> np.ndarray:
    counts = np.full((3, 8), value)
    return Grasp(pads=PADS, counts=counts, t_s=np.arange(3.0)).counts


@pytest.mark.parametrize(("value", "kept"), [(0, 0), (-0.4, 0), (6.7, 7), (4095.4, 4095)])
def test_counts_are_rounded(value: float, kept: int) -> None:
    assert set(counts_of(value).ravel().tolist()) == {kept}


@pytest.mark.parametrize("value", [-5.7, -1, 4095.6, 65531, 65536 + 7, np.nan, np.inf])
def test_counts_beyond_the_scale_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"counts go from .* must be from 0 to adc_max = 4095"):
        counts_of(value)
