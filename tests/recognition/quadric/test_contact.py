import numpy as np
import pytest

from recognition.errors import ContactError
from recognition.grasp import Grasp
from recognition.quadric.contact import estimate_baseline, main_patch, noise_threshold, robust_noise
from tests.recognition.conftest import make_pads


def _grasp(pads, counts):
    n = len(counts)
    nothing = np.full(n, np.nan)
    return Grasp(
        pads=pads, counts=counts, t_s=np.arange(n) * 0.02, aperture_m=nothing, force_n=nothing
    )


def _ramp(pads, rng, *, n_quiet, n_frames=30, offset=0.0, noise=3.0):
    """A bump on pad 0 that grows after n_quiet frames; pad 1 stays untouched."""
    bump = np.zeros(pads.n_taxels)
    bump[: 16 * 4] = 150.0 * np.exp(-np.sum((pads.taxel_xy_m[:64] / 0.006) ** 2, axis=1))
    load = np.clip((np.arange(n_frames) - n_quiet + 1) / (n_frames - n_quiet), 0, 1)
    counts = offset + load[:, None] * bump + rng.normal(scale=noise, size=(n_frames, pads.n_taxels))
    return _grasp(pads, np.clip(np.round(counts), 0, 255))


PADS = make_pads(shapes=((16, 4), (16, 4)), adc_max=255, pitch_m=4e-3)


def test_baseline_is_the_mean_of_each_taxel_before_contact():
    rng = np.random.default_rng(0)
    offset = rng.uniform(20, 60, PADS.n_taxels)
    found = estimate_baseline(_ramp(PADS, rng, n_quiet=12, offset=offset))
    assert 9 <= found.quiet_frames[0] <= 13
    assert found.quiet_frames[1] == 30
    # twelve frames of noise 3 leave a standard deviation of 0.9
    assert np.abs(found.counts - offset).max() < 4.0
    assert np.abs(found.counts - offset).mean() < 1.0
    assert found.noise_counts == pytest.approx([3.0, 3.0], rel=0.15)


def test_baseline_of_a_grasp_that_begins_in_contact_is_the_pads_median():
    rng = np.random.default_rng(1)
    grasp = _ramp(PADS, rng, n_quiet=0, n_frames=12, offset=30.0)
    found = estimate_baseline(grasp)
    assert found.quiet_frames.tolist() == [0, 12]
    assert np.ptp(found.counts[:64]) == 0.0
    assert found.counts[0] == pytest.approx(30.0, abs=2.0)


def test_baseline_of_one_frame():
    counts = np.full((1, PADS.n_taxels), 7)
    counts[0, 20:23] = 90
    found = estimate_baseline(_grasp(PADS, counts))
    assert found.counts == pytest.approx(np.full(PADS.n_taxels, 7.0))
    assert found.quiet_frames.tolist() == [0, 0]


def test_noise_of_the_paper_is_found_with_its_one_sided_offset():
    rng = np.random.default_rng(2)
    noise = np.clip(np.abs(rng.normal(scale=10, size=(40, PADS.n_taxels))), 1, 20)
    found = estimate_baseline(_grasp(PADS, np.round(noise)))
    assert found.counts.mean() == pytest.approx(noise.mean(), abs=0.3)
    assert found.noise_counts == pytest.approx([noise.std()] * 2, rel=0.2)


def test_robust_noise_ignores_outliers_and_never_falls_below_rounding():
    rng = np.random.default_rng(3)
    values = rng.normal(scale=5.0, size=5000)
    values[:200] = 1e4
    assert robust_noise(values) == pytest.approx(5.0, rel=0.1)
    assert robust_noise(np.zeros(100)) == pytest.approx(1 / np.sqrt(12), rel=0.01)
    assert robust_noise([]) == robust_noise(np.zeros(3))


def test_threshold_falls_with_averaging_down_to_one_count_of_255():
    assert noise_threshold(5.0, 1, 255) == pytest.approx(20.0)
    assert noise_threshold(5.0, 4, 255) == pytest.approx(10.0)
    assert noise_threshold(0.3, 100, 255) == pytest.approx(1.02)


def heights(*loaded):
    """Heights of all taxels: counts by pad, row and column, 0 elsewhere."""
    grid = np.zeros((2, 16, 4))
    for pad, row, column, counts in loaded:
        grid[pad, row, column] = counts
    return grid.ravel()


def test_the_most_loaded_patch_joins_over_corners():
    touching_over_a_corner = ((1, 2, 1, 50.0), (1, 3, 2, 60.0))
    height = heights(*touching_over_a_corner, (1, 10, 0, 20.0), (1, 11, 0, 20.0), (0, 5, 1, 255.0))
    assert main_patch(height, PADS, 1, 2.0).tolist() == [64 + 9, 64 + 14]
    assert main_patch(height, PADS, 0, 2.0).tolist() == [5 * 4 + 1]


def test_the_rim_takes_unloaded_neighbours_along_and_leaves_other_patches():
    height = heights((0, 5, 1, 80.0), (0, 7, 1, 30.0))  # two rows apart: two patches
    patch = main_patch(height, PADS, 0, 2.0, rim=1)
    assert len(patch) == 9
    assert sorted(height[patch])[-2:] == [0.0, 80.0]
    assert 7 * 4 + 1 not in main_patch(height, PADS, 0, 2.0, rim=2)
    assert len(main_patch(heights((0, 0, 0, 9.0)), PADS, 0, 2.0, rim=1)) == 4


def test_an_untouched_pad_is_refused_with_its_largest_height():
    message = "pad 0 is not touched: largest height 1 counts, threshold 2"
    with pytest.raises(ContactError, match=message):
        main_patch(heights((0, 3, 3, 1.0), (1, 3, 3, 9.0)), PADS, 0, 2.0)
