"""Sweep of poses: each pose of Algorithm 1 as a scale and a rotated translation of an arrow matrix.

With M = [s R | t'] and u = R^T t', the transformed matrix is, but for a rotation of the axes that
changes no eigenvalue::

    Q'' = | A/s^2               b/s - A u/s^2             |      Q = | A   b |
          | (b/s - A u/s^2)^T   k - 2 b.u/s + u.A u/s^2   |          | b^T k |

so that a pose enters by its scale s and its rotated translation u alone. In the axes of A the upper
block is diagonal: the eigenvalues are those of an arrow matrix, and only the squares of its shaft
count. Axes of equal curvature share one pole: all but one of their eigenvalues are lambda(A)/s^2
whatever the pose (interlacing), and of u only its length in their plane counts.

u = R^T t where the rotation comes before the translation, u = t where it does not. Many poses share
one u, which is then solved once: the loops run over a full turn with both ends, Euler angles name
each rotation twice, and a square grid of translations is carried into itself by quarter turns
about z.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from recognition.quadric.quadric import rotation_x, rotation_xyz, rotation_y, rotation_z

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""
_EQUAL = 8 * _EPS
"""Entries of a matrix that differ by less, relative to the largest, count as equal or 0."""
_STEP = 2.0**-45
"""Coordinates that agree to this part of the largest are one: far below any step of a grid, and
above the rounding of two ways to the same place."""
_CHUNK = 1 << 18
"""Rotated translations in memory at a time."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrow:
    """A batch of arrow matrices: diag(pole) bordered by a shaft and a corner."""

    pole: tuple[Array, ...]
    """tuple of arrays: diagonal entries, at most three, ascending along the tuple; each broadcasts
    to the batch."""
    shaft: tuple[Array, ...]
    """tuple of arrays: square of the border's entry beside each pole, not negative."""
    corner: Array
    """(...) float64: last diagonal entry."""
    fixed: tuple[Array, ...]
    """tuple of arrays: further eigenvalues of the whole matrix that the arrow does not hold."""
    n_negative: int | None
    """Negative eigenvalues of the arrow, the same in the whole batch (Sylvester); None where the
    matrix is singular."""

    def matrices(self, which: NDArray[np.bool_]) -> Array:
        """Return the marked ones as full symmetric matrices, (n, m + 1, m + 1)."""
        m = len(self.pole)
        out = np.zeros((int(which.sum()), m + 1, m + 1))
        for i, (pole, shaft) in enumerate(zip(self.pole, self.shaft, strict=True)):
            out[:, i, i] = np.broadcast_to(pole, which.shape)[which]
            out[:, i, m] = out[:, m, i] = np.sqrt(np.broadcast_to(shaft, which.shape)[which])
        out[:, m, m] = self.corner[which]
        return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pole:
    """One distinct eigenvalue of A: its value, its axes (3, n), and b along the first of them."""

    value: float
    axes: Array
    slope: float

    @property
    def squared(self) -> Array:
        """Axes of which only the length counts."""
        if self.value == 0.0:
            return self.axes[:, :0]
        return self.axes if self.slope == 0.0 else self.axes[:, 1:]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrowForm:
    """A quadric ready for the sweep; make it with `arrow_form`."""

    poles: tuple[_Pole, ...]
    """Distinct eigenvalues of A that couple to the pose."""
    fixed: tuple[float, ...]
    """Eigenvalues of A that stay eigenvalues, divided by s^2."""
    k: float
    """Last entry of Q."""
    n_negative: int | None
    """See `Arrow`."""

    def features(self, u: Array) -> Array:
        """Return what counts of rotated translations (n, 3), as (n_features, n), n_features <= 3.

        Coordinates along b where it is not 0, squared lengths elsewhere; none for a direction in
        which the quadric does not change. Equal columns give equal eigenvalues.
        """
        rows = []
        for pole in self.poles:
            if pole.slope != 0.0:
                rows.append(u @ pole.axes[:, 0])
            if pole.squared.shape[1]:
                rows.append(np.sum((u @ pole.squared) ** 2, axis=1))
        return np.array(rows).reshape(len(rows), len(u))

    def arrow(self, features: Array, scale: Array, *, scaled_shift: bool = False) -> Arrow:
        """Return the arrow matrices of all scales (rows) and features (columns).

        Parameters
        ----------
        features : (n_features, n)
            See `features`.
        scale : (n_scale,)
            Scale factors, not 0.
        scaled_shift
            Whether the translation is scaled as well (order S before T).
        """
        s = np.asarray(scale, dtype=np.float64)[:, None]
        corner = np.full((len(s), features.shape[1]), self.k)
        shafts, row = [], 0
        for pole in self.poles:
            curvature = pole.value / s**2
            shaft: Array = np.zeros((1, 1))
            if pole.slope != 0.0:
                u = features[row] * s if scaled_shift else features[row]
                shaft = (pole.slope / s - curvature * u) ** 2
                corner += u * (curvature * u - 2.0 * pole.slope / s)
                row += 1
            if pole.squared.shape[1]:
                squared = features[row] * s**2 if scaled_shift else features[row]
                moment = curvature * squared
                shaft = shaft + curvature * moment
                corner += moment
                row += 1
            shafts.append(shaft)
        return Arrow(
            pole=tuple(pole.value / s**2 for pole in self.poles),
            shaft=tuple(shafts),
            corner=corner,
            fixed=tuple(value / s**2 for value in self.fixed),
            n_negative=self.n_negative,
        )


def arrow_form(Q: Array) -> ArrowForm:
    """Bring one symmetric 4x4 matrix into the form above.

    Eigenvalues of A that differ by less than eight units of rounding of the largest count as
    equal, entries of b below that of the matrix as 0: both are changes within rounding of Q.
    """
    values, axes = np.linalg.eigh(Q[:3, :3])
    b = axes.T @ Q[:3, 3]
    size = float(np.abs(Q).max())
    values[np.abs(values) <= _EQUAL * np.abs(values).max()] = 0.0
    poles, fixed = [], []
    start = 0
    for stop in range(1, 4):
        if stop < 3 and values[stop] - values[start] <= _EQUAL * np.abs(values).max():
            continue
        group = slice(start, stop)
        value, along = float(np.mean(values[group])), b[group]
        slope = float(np.linalg.norm(along))
        if slope <= _EQUAL * size:
            slope, turned = 0.0, axes[:, group]
        else:
            turned = axes[:, group] @ _basis_along(along / slope)
        n_fixed = stop - start
        if value != 0.0 or slope != 0.0:
            poles.append(_Pole(value=value, axes=turned, slope=slope))
            n_fixed -= 1
        fixed += [value] * n_fixed
        start = stop
    whole = np.linalg.eigvalsh(Q)
    singular = np.abs(whole).min() <= 4 * _EPS * np.abs(whole).max()
    n_negative = int(np.sum(whole < 0)) - sum(value < 0 for value in fixed)
    return ArrowForm(
        poles=tuple(poles),
        fixed=tuple(fixed),
        k=float(Q[3, 3]),
        n_negative=None if singular else n_negative,
    )


def _basis_along(direction: Array) -> Array:
    """Return an orthogonal matrix whose first column is a unit vector (n,)."""
    basis, upper = np.linalg.qr(np.column_stack([direction, np.eye(len(direction))]))
    if upper[0, 0] < 0:
        basis = -basis
    found: Array = basis[:, : len(direction)]
    return found


def points(values: Array, n_axes: int, *, separate: bool) -> Array:
    """Return a loop's points, (n, n_axes): its value on all axes, or a loop for each axis."""
    if separate:
        return np.array(list(product(values, repeat=n_axes)))
    return np.repeat(values[:, None], n_axes, axis=1)


def rotates_translation(order: str) -> bool:
    """Return whether the rotation is undone before the translation: u = R^T t."""
    return order.index("T") < order.index("R")


def scales_translation(order: str) -> bool:
    """Return whether the translation is scaled along: u = s R^T t or u = s t."""
    return order.index("S") < order.index("T")


def in_printed_order(shift: Array, angle_rad: Array, *, rotated: bool) -> Array:
    """Return u of every translation (n, 2) and, innermost, every rotation (n, 3): (n, 3)."""
    shift = np.concatenate([shift, np.zeros((len(shift), 1))], axis=1)
    if not rotated:
        return np.repeat(shift, len(angle_rad), axis=0)
    R = rotation_xyz(angle_rad)[:, :3, :3]
    u: Array = np.einsum("rij,ti->trj", R, shift).reshape(-1, 3)
    return u


def weighted_chunks(
    shift: Array, angle_rad: Array, *, rotated: bool, separate: bool
) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Yield rotated translations (n, 3) with the number of poses that each stands for.

    All poses are counted once over all chunks. ``angle_rad`` is (n,), the values of the loop;
    ``separate``: whether each axis has a loop of its own.
    """
    plane = np.concatenate([shift, np.zeros((len(shift), 1))], axis=1)
    if not rotated:
        n_turns = len(angle_rad) ** (3 if separate else 1)
        yield plane, np.full(len(plane), n_turns)
        return
    if separate:
        # R = Rz Ry Rx: first all that z does within the plane, then y and x
        about_z = rotation_z(angle_rad)[:, :3, :3]
        plane = np.einsum("rij,ti->rtj", about_z, plane).reshape(-1, 3)
        after = rotation_y(angle_rad)[:, None, :3, :3] @ rotation_x(angle_rad)[None, :, :3, :3]
        after = after.reshape(-1, 3, 3)
    else:
        after = rotation_xyz(points(angle_rad, 3, separate=False))[:, :3, :3]
    first, n_first = distinct(plane.T)
    plane = plane[first]
    second, n_second = distinct(after.reshape(-1, 9).T)
    # rotations that differ in signs give the same u, or the same squares: keep them together
    rounded = np.round(np.abs(after[second].reshape(-1, 9)), 9)
    order = np.lexsort(rounded.T)
    after, n_second = after[second][order], n_second[order]
    step = max(1, _CHUNK // len(plane))
    for start in range(0, len(after), step):
        part = slice(start, start + step)
        u = np.einsum("rij,ti->rtj", after[part], plane).reshape(-1, 3)
        yield u, np.outer(n_second[part], n_first).ravel()


def distinct(
    columns: Array, weight: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of the columns (n_features, n) differ, and the weight that each gathers.

    Returns
    -------
    first : (n_distinct,) int64
        Index of one column of each group.
    gathered : (n_distinct,) int64
        Sum of the weights of its group; a column weighs 1 where ``weight`` is not given.
    """
    first, group = groups(columns)
    gathered = np.bincount(group, weights=weight, minlength=len(first))
    return first, np.rint(gathered).astype(np.int64)  # whole numbers below 2^53 are exact


def groups(columns: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return one index of each group of equal columns, and the group of every column."""
    n = columns.shape[1]
    if not columns.shape[0]:
        return np.zeros(1, dtype=np.int64), np.zeros(n, dtype=np.int64)
    largest = np.abs(columns).max(axis=1, keepdims=True)
    unit = np.where(largest > 0, largest * _STEP, 1.0)
    keys = np.rint(columns / unit).astype(np.int64)
    # Sorted by a mixture of the keys; groups go by the keys themselves, so that two keys
    # with one mixture can split a group and never join two
    mixed = np.zeros(n, dtype=np.uint64)
    for key in keys:
        mixed = (mixed ^ key.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    order = np.argsort(mixed, kind="stable")
    sorted_keys = keys[:, order]
    new = np.ones(n, dtype=np.bool_)
    new[1:] = np.any(sorted_keys[:, 1:] != sorted_keys[:, :-1], axis=0)
    group = np.empty(n, dtype=np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group
