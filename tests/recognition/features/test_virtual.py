"""Tilted grasps: patches turned by a few degrees and nothing else."""

import dataclasses

import numpy as np
import pytest

from recognition.features.aperture import aperture_features
from recognition.features.footprint import describe_footprint, pad_grid
from recognition.features.virtual import tilt
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest
from recognition.statistics.lda import fit_lda

ANGLE_RAD = np.pi / 12


@pytest.fixture(scope="module")
def grids(train):
    rest = learn_rest(train)
    return [pad_grid(rest.pads, p) for p in rest.gripping]


@pytest.fixture(scope="module")
def ridge(train, grids):
    """Return the levels of a grasp with a long smooth patch across both pads."""
    levels = load_levels(train[:1], learn_rest(train))
    x, y = (grids[0].xy_mm - [1.0, -0.5]).T
    along, across = np.cos(0.3) * x + np.sin(0.3) * y, np.cos(0.3) * y - np.sin(0.3) * x
    patch = np.exp(-0.5 * (along / 5.0) ** 2 - 0.5 * (across / 2.5) ** 2)
    maps = tuple(np.broadcast_to(patch, m.shape).copy() for m in levels.maps)
    return dataclasses.replace(levels, maps=maps)


def axis_rad(levels, grid):
    cosine, sine = describe_footprint(levels.maps[0], 1e-4 * levels.noise[..., 0], grid).direction[
        0, -1
    ]
    return 0.5 * np.arctan2(sine, cosine)


@pytest.mark.parametrize("angle_rad", [ANGLE_RAD, -ANGLE_RAD])
def test_a_tilt_turns_the_patch_by_its_angle_about_its_centre(ridge, grids, angle_rad):
    tilted = tilt(ridge, grids, angle_rad)
    turned = axis_rad(tilted, grids[0]) - axis_rad(ridge, grids[0])
    assert turned == pytest.approx(angle_rad, abs=0.04)
    for before, after in zip(ridge.maps, tilted.maps, strict=True):
        assert after.sum() == pytest.approx(before.sum(), rel=0.05)
        centre, moved = (m[0, -1] @ grids[0].xy_mm / m[0, -1].sum() for m in (before, after))
        assert moved == pytest.approx(centre, abs=0.3)


def test_no_tilt_changes_nothing_and_no_tilt_changes_the_opening(ridge, grids):
    same = tilt(ridge, grids, 0.0)
    assert same.maps[0] == pytest.approx(ridge.maps[0])
    assert same.timed_load == pytest.approx(ridge.timed_load)
    tilted = tilt(ridge, grids, ANGLE_RAD)
    assert np.array_equal(aperture_features(tilted), aperture_features(ridge))


def test_pads_laid_out_the_other_way_round_turn_the_same_way(ridge, grids):
    rows, columns = grids[0].shape
    order = np.arange(rows * columns).reshape(rows, columns).T.ravel()
    other = dataclasses.replace(grids[0], xy_mm=grids[0].xy_mm[order], shape=(columns, rows))
    there = dataclasses.replace(ridge, maps=tuple(m[..., order] for m in ridge.maps))
    swapped = tilt(there, [other, other], ANGLE_RAD)
    assert swapped.maps[0] == pytest.approx(tilt(ridge, grids, ANGLE_RAD).maps[0][..., order])


def test_deviations_that_no_row_shows_stop_counting():
    rng = np.random.default_rng(0)
    classes = np.repeat(np.arange(3), 40)
    rows = rng.normal(0.0, 5.0, (3, 4))[classes] + rng.normal(size=(120, 4))
    nuisance = np.array([[30.0, 0.0, 0.0, 0.0], [-30.0, 0.0, 0.0, 0.0]])
    plain, wise = fit_lda(rows, classes, 3), fit_lda(rows, classes, 3, nuisance=nuisance)
    moved = rows + 20.0 * np.eye(1, 4)
    assert np.mean(plain.distances(moved).argmin(axis=1) == classes) < 0.7
    assert np.mean(wise.distances(moved).argmin(axis=1) == classes) > 0.95
