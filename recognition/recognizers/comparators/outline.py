"""Outline of a pressed patch: radii, polygon, angles and lengths, for planar comparators."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recognition.features.footprint import PadGrid

OUTLINE_SHARE = 0.3
"""The outline is where the pressure has fallen to this share of its peak."""

_STEP_MM = 0.25
"""Step in mm along a ray in the search for the outline; the crossing is then interpolated."""


def centroid_mm(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return the centre of the load in mm (2,); that of the pad for an empty patch."""
    total = float(patch.sum())
    if total <= 0.0:
        middle: NDArray[np.float64] = grid.xy_mm.mean(axis=0)
        return middle
    return (patch @ grid.xy_mm) / total


def sample_mm(
    patch: NDArray[np.float64], grid: PadGrid, points_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return linearly interpolated values of a patch; they fall to 0 one pitch outside the pad.

    Parameters
    ----------
    patch : (n_taxels,)
        Values of one pad, row-major.
    points_mm : (..., 2)
        Points in the pad's plane.

    Returns
    -------
    (...) float64
    """
    rows, columns = grid.shape
    padded = np.pad(patch.reshape(rows, columns), 1)
    last = np.maximum(np.array([rows, columns]) - 1, 1)
    step_mm = (grid.xy_mm[-1] - grid.xy_mm[0]) / last
    step_mm = np.where(step_mm == 0.0, grid.pitch_mm, step_mm)
    at = (points_mm - grid.xy_mm[0]) / step_mm + 1.0
    sampled: NDArray[np.float64] = map_coordinates(
        padded, np.moveaxis(at, -1, 0), order=1, mode="constant", cval=0.0
    )
    return sampled


def outline_radii_mm(
    patch: NDArray[np.float64], grid: PadGrid, n_angles: int
) -> NDArray[np.float64]:
    """Return the distance from the centroid to the outline in each direction, in mm.

    On each ray it is the farthest point with `OUTLINE_SHARE` of the peak, so two patches side by
    side have one outline. Directions cover a full turn, the first is along x.

    Parameters
    ----------
    patch : (n_taxels,)
        Values of one pad, at least 0.

    Returns
    -------
    (n_angles,) float64
        Never below a tenth of a millimetre; all equal for an empty patch.
    """
    peak = float(patch.max())
    if peak <= 0.0:
        return np.ones(n_angles)
    angle = np.arange(n_angles) * (2.0 * np.pi / n_angles)
    extent_mm = np.ptp(grid.xy_mm, axis=0) + 2.0 * grid.pitch_mm
    radius_mm = np.arange(0.0, float(np.hypot(*extent_mm)), _STEP_MM)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points_mm = centroid_mm(patch, grid) + radius_mm[None, :, None] * ray[:, None, :]
    value = sample_mm(patch, grid, points_mm) / peak - OUTLINE_SHARE
    inside = value > 0.0
    inside[:, 0] = True
    last = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)
    after = np.minimum(last + 1, inside.shape[1] - 1)
    rows = np.arange(n_angles)
    drop = value[rows, last] - value[rows, after]
    part = np.where(drop > 0.0, value[rows, last] / np.where(drop > 0.0, drop, 1.0), 0.0)
    found = radius_mm[last] + np.clip(part, 0.0, 1.0) * _STEP_MM
    return np.asarray(np.maximum(found, 0.1), dtype=np.float64)


def canonical_start(radii: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a radius vector (A,), A even, rotated so that it begins at the patch's long axis.

    It begins at the end of the axis that has the larger radii in the following half circle.
    """
    n = len(radii)
    angle = np.arange(n) * (2.0 * np.pi / n)
    phase = 0.5 * float(np.angle(np.sum(radii * np.exp(2j * angle))))
    turned = np.roll(radii, -round(phase * n / (2.0 * np.pi)))
    half = n // 2
    return turned if turned[:half].sum() >= turned[half:].sum() else np.roll(turned, -half)


def polygon(radii_mm: NDArray[np.float64], n_vertices: int) -> NDArray[np.float64]:
    """Return the polygon of an outline, by repeated removal of the vertex with the least bend.

    Parameters
    ----------
    radii_mm : (A,)
        The outline, see `outline_radii_mm`.
    n_vertices
        Number of remaining vertices, at least 3.

    Returns
    -------
    (n_vertices, 2) float64
        Counter-clockwise, about the centroid, in mm.
    """
    angle = np.arange(len(radii_mm)) * (2.0 * np.pi / len(radii_mm))
    points = radii_mm[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    while len(points) > max(n_vertices, 3):
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        one, two = points - before, after - before
        area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        points = np.delete(points, int(np.argmin(area)), axis=0)
    return np.asarray(points, dtype=np.float64)


def angles_and_lengths(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return turning angle and edge length, in turn, of a closed polygon (V, 2), as (2 V,).

    Lengths are shares of the perimeter, angles are in units of a half turn. The first one is the
    longest edge, so position, rotation and scale have no effect.
    """
    edge = np.roll(vertices, -1, axis=0) - vertices
    length = np.hypot(edge[:, 0], edge[:, 1])
    following = np.roll(edge, -1, axis=0)
    cross = edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0]
    turn = np.arctan2(cross, (edge * following).sum(axis=1)) / np.pi
    start = int(np.argmax(length))
    pairs = np.stack([np.roll(length, -start) / length.sum(), np.roll(turn, -start)], axis=1)
    return pairs.ravel()
