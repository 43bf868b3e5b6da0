"""The sweep of Algorithm 1 without keeping its values: extremes and histogram of one object.

The full product of the loops (x, y and the three angles each in a loop of its own) has 256,021,343
poses. Each distinct rotated translation is solved once and counted as often as it stands in the
loops, chunk by chunk, so that memory does not grow with the grid.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import TrajectoryError
from recognition.quadric.eigen import check_symmetric
from recognition.quadric.sweep import (
    Array,
    arrow_form,
    distinct,
    points,
    rotates_translation,
    scales_translation,
    weighted_chunks,
)
from recognition.quadric.sweep_roots import smallest_of_arrow
from recognition.quadric.trajectory import Axes, SweepSettings, blocks

FULL_PRODUCT = SweepSettings(
    translation_axes=Axes.SEPARATE, rotation_axes=Axes.SEPARATE, max_evaluations=1_000_000_000
)
"""Every loop variable on an axis of its own: 256,021,343 poses an object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweepSummary:
    """Smallest eigenvalues of one object over a whole grid, as numbers of poses."""

    least: float
    greatest: float
    """Extremes over all poses."""
    edges: Array
    """(n_bins + 1,) float64: ascending edges of the bins; read-only."""
    counts: NDArray[np.int64]
    """(n_bins,) int64: poses in each bin, its lower edge included, its upper edge only in the last
    one; read-only."""
    below: int
    above: int
    """Poses outside the edges."""
    n_degenerate: int
    """Poses whose value is rounding noise."""
    n_evaluations: int
    """Poses of the grid."""
    n_solved: int
    """Matrices that were solved for them."""
    n_fallback: int
    """Those of them that were left to the full solver."""

    def __post_init__(self) -> None:
        self.edges.setflags(write=False)
        self.counts.setflags(write=False)


def _checked_edges(edges: ArrayLike) -> Array:
    edges = np.array(edges, dtype=np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise TrajectoryError("edges must be at least two ascending numbers")
    return edges


def sweep_summary(
    Q: ArrayLike, edges: ArrayLike, settings: SweepSettings = FULL_PRODUCT
) -> SweepSummary:
    """Run the loops of Algorithm 1 for one object and count its values.

    Parameters
    ----------
    Q : (4, 4)
        Property matrix of the taught object.
    edges : (n_bins + 1,)
        Ascending edges of the histogram's bins.
    settings
        Grid and readings.

    Raises
    ------
    QuadricError
        Where the matrix is not symmetric or not finite.
    TrajectoryError
        Where it is not one 4x4 matrix, or the edges do not ascend.
    """
    Q = check_symmetric(Q)
    if Q.shape != (4, 4):
        raise TrajectoryError(f"taught quadric has shape {Q.shape}, expected (4, 4)")
    edges = _checked_edges(edges)
    form = arrow_form(Q)
    scaled_shift = scales_translation(settings.order)
    bins = np.zeros(len(edges) + 1, dtype=np.int64)
    least, greatest = np.inf, -np.inf
    n_degenerate = n_solved = n_fallback = 0
    for u, n_poses in weighted_chunks(
        points(settings.translation, 2, separate=settings.translation_axes is Axes.SEPARATE),
        settings.angle_rad,
        rotated=rotates_translation(settings.order),
        separate=settings.rotation_axes is Axes.SEPARATE,
    ):
        features = form.features(u)
        first, weight = distinct(features, n_poses)
        features = features[:, first]
        for rows, columns in blocks(len(settings.scale), len(first)):
            arrow = form.arrow(
                features[:, columns], settings.scale[rows], scaled_shift=scaled_shift
            )
            found = smallest_of_arrow(arrow, settings.reading)
            value = found.smallest.value
            least = min(least, float(value.min()))
            greatest = max(greatest, float(value.max()))
            bins += _weighted_bins(value, weight[columns], edges)
            n_degenerate += int(np.sum(found.smallest.degenerate * weight[columns]))
            n_solved += value.size
            n_fallback += found.n_fallback
    return SweepSummary(
        least=least,
        greatest=greatest,
        edges=edges,
        counts=bins[1:-1],
        below=int(bins[0]),
        above=int(bins[-1]),
        n_degenerate=n_degenerate,
        n_evaluations=settings.n_evaluations,
        n_solved=n_solved,
        n_fallback=n_fallback,
    )


def _weighted_bins(value: Array, weight: NDArray[np.int64], edges: Array) -> NDArray[np.int64]:
    """Return the summed weights below the edges, in each bin, and above them."""
    place = np.searchsorted(edges, value, side="right")
    place[value == edges[-1]] = len(edges) - 1  # the last bin holds its upper edge
    weights = np.broadcast_to(weight, value.shape).ravel()
    counted = np.bincount(place.ravel(), weights=weights, minlength=len(edges) + 1)
    return np.rint(counted).astype(np.int64)  # whole numbers below 2^53 are exact
