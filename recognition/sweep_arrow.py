"""What the poses of Algorithm 1 leave of a quadric: an arrow matrix of at most three poles.

With M = [s R | t'] and u = R^T t', the transformed matrix is, but for a rotation of the axes that
changes no eigenvalue::

    Q'' = | A/s^2               b/s - A u/s^2             |      Q = | A   b |
          | (b/s - A u/s^2)^T   k - 2 b.u/s + u.A u/s^2   |          | b^T k |

so that a pose enters by its scale s and its rotated translation u alone. In the axes of A the upper
block is diagonal: the eigenvalues are those of an arrow matrix, and only the squares of its shaft
count. Axes of equal curvature share one pole: all but one of their eigenvalues are lambda(A)/s^2
whatever the pose (interlacing), and of u only its length in their plane counts.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_EPS = float(np.finfo(np.float64).eps)
_EQUAL = 8 * _EPS  # relative to the largest: below it, numbers of a matrix count as equal or 0

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrow:
    """A batch of arrow matrices: diag(pole) bordered by a shaft and a corner.

    Attributes
    ----------
    pole : tuple of arrays
        Diagonal entries, at most three, ascending along the tuple; each broadcasts to the batch.
    shaft : tuple of arrays
        Square of the border's entry beside each pole, not negative.
    corner : (...) float64
        Last diagonal entry.
    fixed : tuple of arrays
        Further eigenvalues of the whole matrix that the arrow does not hold.
    n_negative
        Negative eigenvalues of the arrow, the same in the whole batch (Sylvester); None where the
        matrix is singular.
    """

    pole: tuple[Array, ...]
    shaft: tuple[Array, ...]
    corner: Array
    fixed: tuple[Array, ...]
    n_negative: int | None

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
    """A quadric ready for the sweep; make it with `arrow_form`.

    Attributes
    ----------
    poles
        Distinct eigenvalues of A that couple to the pose.
    fixed
        Eigenvalues of A that stay eigenvalues, divided by s^2.
    k
        Last entry of Q.
    n_negative
        See `Arrow`.
    """

    poles: tuple[_Pole, ...]
    fixed: tuple[float, ...]
    k: float
    n_negative: int | None

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
