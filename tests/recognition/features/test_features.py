"""Values that a grasp takes, and those that it refuses."""

import dataclasses

import numpy as np
import pytest

from recognition.features import (
    FEATURE_GROUPS,
    aperture_features,
    describe_footprint,
    features_of,
    harmonic_features,
    pad_grid,
    pressed,
    profile_features,
)
from recognition.grasp import Grasp, PadArray
from recognition.ramp.ramp import learn_rest, load_levels
from tests.recognition.conftest import OBJECTS, make_grasps
from tests.values import make_pads

PADS = PadArray.grid(2, 2, 3e-3)


def counts_of(value: float) -> np.ndarray:
    return Grasp(pads=PADS, counts=np.full((3, 8), value), t_s=np.arange(3.0)).counts


def test_counts_of_one_pad_alone_are_refused_with_the_pads_that_they_lack() -> None:
    with pytest.raises(ValueError, match=r"expected \(3, 8\): .* of the 2 pads, 4 \+ 4"):
        Grasp(pads=PADS, counts=np.zeros((3, 4)), t_s=np.arange(3.0))


@pytest.mark.parametrize(("value", "rounded"), [(0, 0), (-0.4, 0), (6.7, 7), (4095.4, 4095)])
def test_counts_are_rounded(value: float, rounded: int) -> None:
    assert set(counts_of(value).ravel().tolist()) == {rounded}


@pytest.mark.parametrize("value", [-5.7, -1, 4095.6, 65531, 65536 + 7, np.nan, np.inf])
def test_counts_beyond_the_scale_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"counts go from .* must be from 0 to adc_max = 4095"):
        counts_of(value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *(
            ({"adc_max": most}, "a whole number from 1 to 65535")
            for most in (0, 65536, 9.5, np.nan)
        ),
        ({"rows": 0}, "a pad has no taxel"),
    ],
)
def test_pads_whose_counts_do_not_fit_into_a_grasp_are_refused(change, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PadArray.grid(**({"rows": 2, "columns": 2, "pitch_m": 3e-3} | change))


@pytest.mark.parametrize("t_s", [[0.0, np.nan, 1.0], [0.0, 2.0, 1.0], [0.0, 1.0, np.inf]])
def test_times_that_fall_are_refused(t_s) -> None:
    with pytest.raises(ValueError, match="t_s falls, or has a value that is not finite"):
        Grasp(pads=PADS, counts=np.ones((3, 8)), t_s=t_s)


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


# -- Features of a patch and of the opening, and what they must not depend on ----------------------


K = 5


@pytest.fixture(scope="module")
def grid():
    return pad_grid(make_pads(shapes=((24, 24),)), 0)


def patch(grid, *, sx=8.0, sy=5.0, turn=0.0, at=(0.0, 0.0), height=0.6):
    dx, dy = (grid.xy_mm - np.array(at)).T
    u = np.cos(turn) * dx + np.sin(turn) * dy
    v = np.cos(turn) * dy - np.sin(turn) * dx
    return np.broadcast_to(height * np.exp(-((u / sx) ** 2 + (v / sy) ** 2) / 2), (1, K, len(u)))


QUIET = np.zeros((1, K))


def answers(maps, grid):
    """Return energies and strongest answers (in 1/mm) of the harmonics to one patch, flat."""
    return np.exp(harmonic_features([describe_footprint(maps, QUIET, grid)])[0])


def profile(maps, grid):
    """Return the profile of one patch."""
    return profile_features([describe_footprint(maps, QUIET, grid)])[0]


def test_pitch_comes_from_the_positions():
    assert pad_grid(make_pads(), 1).pitch_mm == pytest.approx([3.0, 3.0])
    assert pad_grid(make_pads(shapes=((5, 1),)), 0).pitch_mm == pytest.approx([3.0, 1.0])
    # Scattered taxels, as of barometers under rubber: two rows may lie within a hair.
    scattered = make_pads(shapes=((4, 1),))
    xy_m = 1e-3 * np.array([[0.0, 0.03], [6.0, -0.03], [6.001, 0.0], [-3.0, 0.0]])
    scattered = dataclasses.replace(scattered, taxel_xy_m=xy_m)
    assert pad_grid(scattered, 0).pitch_mm == pytest.approx([3.0, 1.0], abs=1e-3)


def test_axes_are_the_widths_of_the_patch(grid):
    log_axes = describe_footprint(patch(grid), QUIET, grid).log_axes[0, -1]
    assert np.exp(log_axes[:2]) == pytest.approx([64 + 2.25, 25 + 2.25], rel=0.05)


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 2])
@pytest.mark.parametrize("at", [(0.0, 0.0), (3.0, -3.0), (1.3, 0.7)])
def test_shape_does_not_change_when_the_patch_moves_or_turns(grid, turn, at):
    still = describe_footprint(patch(grid), QUIET, grid)
    moved = describe_footprint(patch(grid, turn=turn, at=at), QUIET, grid)
    for name in ("log_load", "log_extent", "log_axes", "tails", "harmonics"):
        assert getattr(moved, name) == pytest.approx(getattr(still, name), abs=0.12), name
    assert answers(patch(grid, turn=turn, at=at), grid) == pytest.approx(
        answers(patch(grid), grid), abs=0.02
    )


def test_centroid_and_direction_say_where_it_lies(grid):
    moved = describe_footprint(patch(grid, turn=np.pi / 4, at=(3.0, -3.0)), QUIET, grid)
    assert moved.centroid_mm[0, -1] == pytest.approx([3.0, -3.0], abs=0.1)
    assert moved.direction[0, -1, 0] == pytest.approx(0.0, abs=0.02)
    assert moved.direction[0, -1, 1] > 0.3


def test_gain_moves_the_load_and_leaves_the_form(grid):
    weak = describe_footprint(patch(grid, height=0.3), QUIET, grid)
    strong = describe_footprint(patch(grid, height=0.6), QUIET, grid)
    assert strong.log_load - weak.log_load == pytest.approx(np.log(2), abs=0.05)
    assert strong.log_axes == pytest.approx(weak.log_axes, abs=0.05)
    assert answers(patch(grid, height=0.3), grid) == pytest.approx(
        answers(patch(grid, height=0.6), grid), abs=0.02
    )


def test_noise_below_three_sigma_is_not_a_patch():
    maps = np.array([[[0.02, 0.05, 0.5]]])
    assert pressed(maps, np.array([[0.01]]))[0, 0].tolist() == [0.0, 0.05, 0.5]


def test_harmonics_are_the_answers_of_the_plain_formula():
    pad = pad_grid(make_pads(shapes=((7, 5),)), 0)
    maps = np.random.default_rng(3).uniform(0.05, 0.6, (1, K, 35))
    harmonics = harmonic_features([describe_footprint(maps, QUIET, pad)]).reshape(2, 3, 6, 2)
    area = float(np.prod(pad.pitch_mm))
    root = np.sqrt(maps[0, 4] / (maps[0, 4].sum() * area))
    for w, width in enumerate((2.0, 3.4, 5.4)):
        answers = []
        for x in pad.xy_mm[0, 0] + pad.pitch_mm[0] * np.arange(-3, 10):
            for y in pad.xy_mm[0, 1] + pad.pitch_mm[1] * np.arange(-3, 8):
                z = ((pad.xy_mm - (x, y)) @ (1, 1j)) / width
                window = np.exp(-0.5 * np.abs(z) ** 2) * area / (2 * np.pi * width**2)
                waves = [np.ones(35), np.abs(z) ** 2 - 2, *(z**m for m in (1, 2, 3, 4))]
                answers.append([abs(np.sum(root * window * wave)) for wave in waves])
        strength = np.array(answers)
        energy = (strength**2).sum(axis=0) * area
        assert harmonics[1, w, :, 0] == pytest.approx(np.log(energy + 2e-4))
        assert harmonics[1, w, :, 1] == pytest.approx(np.log(strength.max(axis=0) + 1.3e-3))


def test_harmonics_tell_two_bumps_from_one_patch_of_their_size(grid):
    apart = patch(grid, sx=3.0, sy=3.0, at=(6.0, 0.0)) + patch(grid, sx=3.0, sy=3.0, at=(-6.0, 0.0))
    one = patch(grid, sx=np.hypot(6.0, 3.0), sy=3.0, height=apart.max())
    axes = [describe_footprint(m, QUIET, grid).log_axes[0, -1] for m in (apart, one)]
    assert axes[0] == pytest.approx(axes[1], abs=0.15)
    assert np.abs(np.log(answers(apart, grid) / answers(one, grid))).max() > 0.5


def test_centred_part_of_the_profile_does_not_move_with_the_patch(grid):
    n, still = grid.shape[0], profile(patch(grid), grid)
    moved = profile(patch(grid, at=(6.0, 0.0)), grid)
    reach = len(still) // 2 - n
    assert moved[n : n + reach] == pytest.approx(still[n : n + reach], abs=0.02)
    assert moved[:n] == pytest.approx(np.roll(still[:n], 2), abs=0.02)


def test_opening_features_give_size_and_squeeze(train):
    features = aperture_features(load_levels(train, learn_rest(train)))
    final, touch = features[:, 0], features[:, 1]
    assert final == pytest.approx([g.aperture_m[-1] * 1e3 for g in train], abs=0.15)
    assert np.all(touch > final)


# -- The table of feature groups: nothing forgotten, and vectors of the groups that are used -------


def test_one_pad_has_no_other_to_compare_with():
    pads = make_pads(shapes=((10, 6),))
    grasps = make_grasps(2, seed=0, pads=pads, gripping=(0,))
    rest = learn_rest(grasps)
    levels = load_levels(grasps, rest)
    alone = [describe_footprint(levels.maps[0], levels.noise[..., 0], pad_grid(pads, 0))]
    widths = {name: of(levels, alone).shape[1] for name, of in FEATURE_GROUPS.items()}
    assert [name for name, width in widths.items() if not width] == ["pads"]
    assert features_of(levels, rest, opening=False).shape == (len(grasps), sum(widths.values()))


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (2, 1), (2, 2), (6, 2)])
def test_pads_of_one_or_two_rows_have_every_feature(shape):
    grasps = make_grasps(3, seed=1, pads=make_pads(shapes=(shape, shape)), objects=OBJECTS[:2])
    rest = learn_rest(grasps)
    levels = load_levels(grasps, rest)
    for opening in (True, False):
        assert np.all(np.isfinite(features_of(levels, rest, opening=opening)))
