"""Columns that push each other in: between separate columns and an elastic body."""

import numpy as np
import pytest

from recognition.shape.foam import FoamModel, closed_columns_m, neighbours

POINTS_M = 0.5e-3 * (np.arange(31) - 15.0)
PUSHES = (neighbours(POINTS_M, 1.2e-3), neighbours(POINTS_M, 1.2e-3))
RADIUS_M = 5e-3


def ball_m(depth_m: float) -> np.ndarray:
    return depth_m - (POINTS_M[:, None] ** 2 + POINTS_M[None] ** 2) / (2.0 * RADIUS_M)


def test_an_even_pressure_gives_way_as_separate_columns_do() -> None:
    wide_m = 0.5e-3 * np.arange(80)
    weights = neighbours(wide_m, 1.2e-3)
    np.testing.assert_allclose(weights.sum(axis=1)[20:60], 1.0, atol=1e-6)


def test_without_sideways_columns_are_separate() -> None:
    wanted_m = ball_m(1e-3)
    closed_m = closed_columns_m(wanted_m, 1.0, 0.0, PUSHES, steps=5)
    np.testing.assert_allclose(closed_m, np.maximum(wanted_m, 0.0), atol=1e-12)


@pytest.mark.parametrize("sideways", [0.4, 0.7])
def test_the_surface_fits_where_it_touches_and_nothing_overlaps(sideways: float) -> None:
    wanted_m = ball_m(1e-3)
    closed_m = closed_columns_m(wanted_m, 1.0, sideways, PUSHES, steps=60)
    along, across = PUSHES
    given_m = (1.0 - sideways) * closed_m + sideways * along @ closed_m @ across
    touching = closed_m > 0.0
    np.testing.assert_allclose(given_m[touching], wanted_m[touching], atol=2e-6)
    assert np.all(given_m[~touching] >= wanted_m[~touching] - 2e-6)


def test_the_contact_is_smaller_and_the_rim_of_a_flat_face_carries_more() -> None:
    """As on an elastic body, and unlike separate columns."""
    separate = closed_columns_m(ball_m(1e-3), 1.0, 0.0, PUSHES, steps=0)
    pushed = closed_columns_m(ball_m(1e-3), 1.0, 0.7, PUSHES, steps=30)
    assert (pushed > 0.0).sum() < 0.9 * (separate > 0.0).sum()
    inside = (np.abs(POINTS_M) < 3e-3)[:, None] & (np.abs(POINTS_M) < 3e-3)[None]
    face = closed_columns_m(np.where(inside, 0.5e-3, -1.0), 1.0, 0.7, PUSHES, steps=30)
    assert face[15, 10] > 1.3 * face[15, 15]


def test_a_start_near_by_needs_few_steps() -> None:
    near = closed_columns_m(ball_m(0.99e-3), 1.0, 0.7, PUSHES, steps=60)
    exact = closed_columns_m(ball_m(1e-3), 1.0, 0.7, PUSHES, steps=60)
    quick = closed_columns_m(ball_m(1e-3), 1.0, 0.7, PUSHES, steps=4, start_m=near)
    assert np.abs(quick - exact).max() < 0.3 * np.abs(near - exact).max()


@pytest.mark.parametrize("value", [-0.1, 1.0, float("nan")])
def test_a_share_outside_its_range_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="sideways"):
        FoamModel(sideways=value)
