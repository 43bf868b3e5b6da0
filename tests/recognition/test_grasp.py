"""Values that a grasp takes, and those that it refuses."""

import numpy as np
import pytest

from recognition.grasp import Grasp, PadArray

PADS = PadArray.grid(2, 2, 3e-3)


def counts_of(value: float) -> np.ndarray:
    counts = np.full((3, 8), value)
    return Grasp(pads=PADS, counts=counts, t_s=np.arange(3.0)).counts


def test_counts_of_one_pad_alone_are_refused_with_the_pads_that_they_lack() -> None:
    with pytest.raises(ValueError, match=r"expected \(3, 8\): .* of the 2 pads, 4 \+ 4"):
        Grasp(pads=PADS, counts=np.zeros((3, 4)), t_s=np.arange(3.0))


@pytest.mark.parametrize(("value", "kept"), [(0, 0), (-0.4, 0), (6.7, 7), (4095.4, 4095)])
def test_counts_are_rounded(value: float, kept: int) -> None:
    assert set(counts_of(value).ravel().tolist()) == {kept}


@pytest.mark.parametrize("value", [-5.7, -1, 4095.6, 65531, 65536 + 7, np.nan, np.inf])
def test_counts_beyond_the_scale_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"counts go from .* must be from 0 to adc_max = 4095"):
        counts_of(value)


def test_later_writes_to_an_array_do_not_change_a_grasp_that_was_made_of_it() -> None:
    counts = np.full((3, 8), 5, dtype=np.uint16)
    seen = counts[:]
    seen.setflags(write=False)
    grasps = [Grasp(pads=PADS, counts=one, t_s=np.arange(3.0)) for one in (counts, seen)]
    counts[:] = 9
    assert all((grasp.counts == 5).all() for grasp in grasps)


def test_the_first_frames_of_a_grasp_need_no_further_memory() -> None:
    whole = Grasp(pads=PADS, counts=np.ones((3, 8)), t_s=np.arange(3.0))
    cut = whole.first_frames(2)
    assert cut.n_frames == 2
    assert np.shares_memory(cut.counts, whole.counts)
    with pytest.raises(ValueError, match="read-only"):
        cut.counts[0, 0] = 3
