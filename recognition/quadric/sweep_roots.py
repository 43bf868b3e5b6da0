"""One eigenvalue of each of many small arrow matrices, with an error bound that is checked.

The characteristic polynomial is never expanded: it is evaluated from the entries of the arrow by
the recursion over its poles, which keeps a small eigenvalue of a graded matrix to full relative
accuracy. All roots are real, so Laguerre's method goes to the next root on its side from any start,
monotonically and with cubic order; from 0 that is the smallest positive or negative eigenvalue.

Each result is verified: an eigenvalue lies within (m + 1) |p / p'| of it plus rounding, and by
inertia none lies nearer to 0. What cannot be verified is left to ``numpy.linalg.eigvalsh``.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recognition.quadric.eigen import Reading, SmallestEigenvalue
from recognition.quadric.sweep import Array, Arrow

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""
_STEPS = 12
"""Most steps of Laguerre's method; it converges cubically."""
_LAST_STEP = 1e-5
"""Relative size of a step after which the rest is below rounding, by cubic convergence."""
_NEARER = 1e-9
"""Relative distance from a root at which no other eigenvalue may lie before it."""
_ACCEPTED = 32 * _EPS
"""Largest error bound relative to the largest entry: that of a full solver."""
_SIZE = 4
"""Rows of the whole matrix, for the floor of rounding of
`recognition.quadric.eigen.smallest_of`."""

Side = Literal[1, -1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Eigenvalues of a batch."""

    smallest: SmallestEigenvalue
    """As `recognition.quadric.eigen.smallest_of` gives them."""
    n_fallback: int
    """How many of them were left to the full solver."""


def smallest_of_arrow(arrow: Arrow, reading: Reading = Reading.SMALLEST_MAGNITUDE) -> Found:
    """Return the smallest eigenvalue of each matrix of the batch in the given reading."""
    if reading is Reading.ALGEBRAIC_MINIMUM:
        value, n_fallback = _lowest(arrow)
        for fixed in arrow.fixed:
            value = np.minimum(value, fixed)
        magnitude = np.abs(value)
    elif arrow.n_negative is None:
        magnitude, n_fallback = np.zeros(arrow.corner.shape), 0
    else:
        magnitude, n_fallback = _nearest_zero(arrow, arrow.n_negative)
        for fixed in arrow.fixed:
            magnitude = np.minimum(magnitude, np.abs(fixed))
    floor, degenerate = _rounding(arrow, magnitude)
    if reading is not Reading.ALGEBRAIC_MINIMUM:
        value = np.maximum(magnitude, floor)
        if reading is Reading.COVARIANCE:
            value = value**2
    return Found(
        smallest=SmallestEigenvalue(value=value, degenerate=degenerate), n_fallback=n_fallback
    )


def _polynomial(arrow: Arrow, at: Array) -> tuple[Array, Array, Array]:
    """Return det(arrow - at I) and its first two derivatives."""
    p, p1, p2 = arrow.corner - at, np.asarray(-1.0), np.asarray(0.0)
    q, q1, q2 = np.asarray(1.0), np.asarray(0.0), np.asarray(0.0)
    for i, (pole, shaft) in enumerate(zip(arrow.pole, arrow.shaft, strict=True)):
        x = pole - at
        if i == 0:
            p, p1, p2 = x * p - shaft, -x - p, np.asarray(2.0)
            q, q1 = x, np.asarray(-1.0)
            continue
        if i == 1:
            p, p1, p2 = x * p - shaft * q, x * p1 - p + shaft, 2.0 * (x - p1)
        else:
            p, p1, p2 = (
                x * p - shaft * q,
                x * p1 - p - shaft * q1,
                x * p2 - 2.0 * p1 - shaft * q2,
            )
        q, q1, q2 = x * q, x * q1 - q, x * q2 - 2.0 * q1
    return p, p1, p2


def _laguerre(arrow: Arrow, start: Array, side: Side, sign: float) -> Array:
    """Go to the next root on one side of where the polynomial has the given sign."""
    n = len(arrow.pole) + 1
    at = start
    for _ in range(_STEPS):
        p, p1, p2 = _polynomial(arrow, at)
        p, p1, p2 = sign * p, (side * sign) * p1, sign * p2
        discriminant = (n - 1) * ((n - 1) * p1 * p1 - n * p * p2)
        root = np.sqrt(np.maximum(discriminant, 0.0))
        # where a root is met exactly and twice, both are 0 and there is nowhere to go
        step = n * p / np.maximum(root - p1, np.finfo(np.float64).tiny)
        at = at + side * step
        if np.all(np.abs(step) <= _LAST_STEP * np.abs(at)):
            break
    return at


def _negative_below(arrow: Arrow, at: Array) -> NDArray[np.int64]:
    """Count the eigenvalues below a value, by Sylvester's law of inertia."""
    p, q = arrow.corner - at, np.asarray(1.0)
    below = np.zeros(arrow.corner.shape, dtype=np.int64)
    for pole, shaft in zip(arrow.pole, arrow.shaft, strict=True):
        x = pole - at
        p = x * p - shaft * q
        q = x * q
        below += x < 0
    found: NDArray[np.int64] = below + ((p < 0) != (q < 0))
    return found


def _bound(arrow: Arrow, at: Array) -> Array:
    """Return how far the nearest eigenvalue can be from a value, rounding included."""
    p, p1, _ = _polynomial(arrow, at)
    terms, q = np.abs(arrow.corner) + np.abs(at), np.asarray(1.0)
    for pole, shaft in zip(arrow.pole, arrow.shaft, strict=True):
        x = np.abs(pole - at)
        terms = x * terms + shaft * q
        q = x * q
    n = len(arrow.pole) + 1
    slope = np.maximum(np.abs(p1), np.finfo(np.float64).tiny)
    found: Array = (n * np.abs(p) + 4 * _EPS * terms) / slope
    return found


def _largest_entry(arrow: Arrow) -> Array:
    size = np.abs(arrow.corner)
    for pole, shaft in zip(arrow.pole, arrow.shaft, strict=True):
        size = np.maximum(size, np.abs(pole))
        size = np.maximum(size, np.sqrt(shaft))
    return size


def _marked(arrow: Arrow, which: NDArray[np.bool_]) -> Arrow:
    """Return the marked matrices of a batch."""
    shape = arrow.corner.shape
    pick = [
        tuple(np.broadcast_to(part, shape)[which] for part in parts)
        for parts in (arrow.pole, arrow.shaft, arrow.fixed)
    ]
    return Arrow(
        pole=pick[0],
        shaft=pick[1],
        corner=arrow.corner[which],
        fixed=pick[2],
        n_negative=arrow.n_negative,
    )


def _nearest_zero(arrow: Arrow, n_negative: int) -> tuple[Array, int]:
    """Return min |lambda| of regular arrows, and how many were left to the full solver."""
    sample = arrow.matrices(np.arange(arrow.corner.size).reshape(arrow.corner.shape) == 0)[0]
    values = np.linalg.eigvalsh(sample)
    side: Side = 1 if values[np.argmin(np.abs(values))] > 0 else -1
    sign = -1.0 if n_negative % 2 else 1.0
    magnitude, good = _on_side(arrow, n_negative, side, sign)
    missed = ~good
    if not missed.any():
        return magnitude, 0
    other: Side = 1 if side == -1 else -1
    rest = _marked(arrow, missed)
    found, good = _on_side(rest, n_negative, other, sign)
    if not good.all():
        found[~good] = np.abs(np.linalg.eigvalsh(rest.matrices(~good))).min(axis=-1)
    magnitude[missed] = found
    return magnitude, int(np.sum(~good))


def _on_side(
    arrow: Arrow, n_negative: int, side: Side, sign: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the root next to 0 on one side as magnitudes, and where it is proved to be nearest."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        root = _laguerre(arrow, np.asarray(0.0), side, sign)
        good = _bound(arrow, root) <= _ACCEPTED * _largest_entry(arrow)
        good &= side * root > 0
        within = (1.0 - _NEARER) * np.abs(root)
        good &= _negative_below(arrow, within) == n_negative
        good &= _negative_below(arrow, -within) == n_negative
    return np.abs(root), good


def _lowest(arrow: Arrow) -> tuple[Array, int]:
    """Return the algebraic minimum of each arrow, and how many were left to the full solver."""
    reach = np.sqrt(sum(arrow.shaft, np.zeros(arrow.corner.shape)))
    start = arrow.corner
    for pole in arrow.pole:
        start = np.minimum(start, pole)
    size = _largest_entry(arrow)
    start = start - reach - _EPS * size
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        value = _laguerre(arrow, start, 1, 1.0)
        good = _bound(arrow, value) <= _ACCEPTED * size
        good &= _negative_below(arrow, value - _NEARER * size) == 0
    if not good.all():
        value[~good] = np.linalg.eigvalsh(arrow.matrices(~good))[:, 0]
    return value, int(np.sum(~good))


def _rounding(arrow: Arrow, magnitude: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the floor of rounding where it matters, else 0, and where a value is not above it."""
    m = len(arrow.pole) + 1
    bound = m * _largest_entry(arrow)
    for fixed in arrow.fixed:
        bound = np.maximum(bound, np.abs(fixed))
    floor = np.zeros(magnitude.shape)
    near = magnitude <= _SIZE * _EPS * bound
    if near.any():
        close = _marked(arrow, near)
        ends = np.linalg.eigvalsh(close.matrices(np.ones(close.corner.shape, dtype=np.bool_)))
        largest = np.maximum(np.abs(ends[:, 0]), np.abs(ends[:, -1]))
        for fixed in close.fixed:
            largest = np.maximum(largest, np.abs(fixed))
        floor[near] = _SIZE * _EPS * largest
    return floor, near & (magnitude <= floor)
