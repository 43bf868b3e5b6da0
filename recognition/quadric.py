"""Fit a height field to a contact patch: the paper's property matrix in the form (7).

The surface is z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k. Written as P^T Q P = 0 with
P = (x, y, z, 1) and the scale fixed by 2 j = -1::

        | a d 0  g  |
    Q = | d b 0  h  |        j = -1/2
        | 0 0 0  j  |
        | g h j  k  |

so that k is the fitted height at the origin, in the unit of the heights.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import QuadricError
from recognition.transform import congruence

J = -0.5
"""The entry j of every height-field matrix: 2 j = -1."""
UNKNOWNS = 6
"""a, b, d, g, h, k."""
MIN_POINTS = 7
"""Six unknowns and one point to judge the fit by."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Quadric:
    """A fitted height field.

    Attributes
    ----------
    Q : (4, 4) float64
        Form (7), read-only. x and y are (position - centre_m) / scale_m, z is the height.
    residual
        Weighted root mean square of the height error, in the unit of the heights.
    condition
        Condition number of the weighted design matrix.
    n_points
        Points of positive weight.
    centre_m : (2,) float64
        Weighted centroid of the points in the pad's plane, read-only.
    scale_m
        Weighted root-mean-square distance of the points from the centre.
    """

    Q: NDArray[np.float64]
    residual: float
    condition: float
    n_points: int
    centre_m: NDArray[np.float64]
    scale_m: float

    def __post_init__(self) -> None:
        for name, shape in (("Q", (4, 4)), ("centre_m", (2,))):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise QuadricError(f"{name} is not a finite array of shape {shape}: {array}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def hessian(self) -> NDArray[np.float64]:
        """Second derivatives of the height, (2, 2), per squared length in m^2."""
        return 2.0 * self.Q[:2, :2] / self.scale_m**2

    @property
    def gradient(self) -> NDArray[np.float64]:
        """First derivatives of the height at the centre, (2,), per length in m."""
        return 2.0 * self.Q[:2, 3] / self.scale_m

    @property
    def height(self) -> float:
        """Fitted height at the centre: k."""
        return float(self.Q[3, 3])

    @property
    def extremum(self) -> float:
        """Height where the fitted surface is level: k' = k - g^T A^-1 g, the peak of a cap.

        Raises QuadricError where the surface has no single such point (a trough or a plane).
        """
        A, g = self.Q[:2, :2], self.Q[:2, 3]
        condition = float(np.linalg.cond(A))
        if not condition < 1e12:
            raise QuadricError(f"no single extremum: curvatures have condition {condition:.3g}")
        return self.height - float(g @ np.linalg.solve(A, g))

    def matrix_in(self, unit_m: float) -> NDArray[np.float64]:
        """Return Q, (4, 4), with x and y from the pad's origin in units of ``unit_m``.

        The height keeps its unit: 1e-3 gives millimetres against counts.
        """
        to_pad = np.diag([self.scale_m / unit_m, self.scale_m / unit_m, 1.0, 1.0])
        to_pad[:2, 3] = self.centre_m / unit_m
        return congruence(self.Q, to_pad)

    def principal_curvatures_1_m(self, height_unit_m: float) -> tuple[float, float]:
        """Return both principal curvatures at the centre in 1/m, smaller first.

        Parameters
        ----------
        height_unit_m
            Indentation in m that one unit of height stands for (1.0 for heights in m).
        """
        return principal_curvatures(self.hessian * height_unit_m, self.gradient * height_unit_m)


def principal_curvatures(hessian: ArrayLike, gradient: ArrayLike) -> tuple[float, float]:
    """Return the eigenvalues of the shape operator of a graph z(x, y), smaller first.

    Parameters
    ----------
    hessian : (2, 2)
        Second derivatives of z; with x, y and z in one unit of length the result is its inverse.
    gradient : (2,)
        First derivatives of z.
    """
    slope = np.asarray(gradient, dtype=np.float64)
    first = np.eye(2) + np.outer(slope, slope)
    second = np.asarray(hessian, dtype=np.float64) / np.sqrt(1.0 + slope @ slope)
    half = np.linalg.inv(np.linalg.cholesky(first))
    low, high = np.linalg.eigvalsh(half @ second @ half.T)
    return float(low), float(high)


def height_field_matrix(
    *, a: float, b: float, d: float = 0.0, g: float = 0.0, h: float = 0.0, k: float
) -> NDArray[np.float64]:
    """Write z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k as (4, 4) in the form (7)."""
    return np.array(
        [[a, d, 0.0, g], [d, b, 0.0, h], [0.0, 0.0, 0.0, J], [g, h, J, k]], dtype=np.float64
    )


def fit_height_field(
    xy_m: ArrayLike,
    height: ArrayLike,
    weight: ArrayLike | None = None,
    *,
    max_condition: float = 1e6,
) -> Quadric:
    """Fit the height field by weighted linear least squares.

    Parameters
    ----------
    xy_m : (n, 2)
        Positions in m.
    height : (n,)
        Heights in any one unit; counts by default in this package.
    weight : (n,), optional
        Weight of each squared residual, >= 0; 1 where not given.
    max_condition
        Largest condition number of the design matrix, taken in centred and scaled coordinates.

    Raises
    ------
    QuadricError
        For shapes that do not fit, values that are not finite, negative weights, fewer than 7
        points of positive weight, or points that do not span the six unknowns: all on one line,
        on two parallel rows, or on any other conic.
    """
    xy, z, w = _checked(xy_m, height, weight)
    n = int(np.count_nonzero(w))
    if n < MIN_POINTS:
        raise QuadricError(f"{n} points, a height field needs at least {MIN_POINTS}")
    w = w / w.sum()
    centre = w @ xy
    scale = float(np.sqrt(w @ np.sum((xy - centre) ** 2, axis=1)))
    if not scale > 0:
        raise QuadricError(f"all {n} points are at one place")
    x, y = ((xy - centre) / scale).T
    root = np.sqrt(w)
    design = np.stack([x * x, y * y, 2 * x * y, 2 * x, 2 * y, np.ones_like(x)], axis=1)
    u, singular, vt = np.linalg.svd(design * root[:, None], full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
    if not condition <= max_condition:
        raise QuadricError(
            f"{n} points do not determine a height field: condition {condition:.3g}, limit "
            f"{max_condition:.3g}; they lie on a line, on two rows or on another conic"
        )
    a, b, d, g, h, k = vt.T @ ((u.T @ (z * root)) / singular)
    residual = float(np.sqrt(w @ (design @ (a, b, d, g, h, k) - z) ** 2))
    return Quadric(
        Q=height_field_matrix(a=a, b=b, d=d, g=g, h=h, k=k),
        residual=residual,
        condition=condition,
        n_points=n,
        centre_m=centre,
        scale_m=scale,
    )


def _checked(
    xy_m: ArrayLike, height: ArrayLike, weight: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    xy = np.asarray(xy_m, dtype=np.float64)
    z = np.asarray(height, dtype=np.float64)
    w = np.ones(z.shape) if weight is None else np.asarray(weight, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2 or z.shape != (len(xy),) or w.shape != z.shape:
        raise QuadricError(f"points {xy.shape}, heights {z.shape}, weights {w.shape} do not fit")
    if not all(np.all(np.isfinite(array)) for array in (xy, z, w)):
        raise QuadricError("points, heights or weights have values that are not finite")
    if np.any(w < 0):
        raise QuadricError(f"a weight is negative: {float(w.min()):.3g}")
    return xy, z, w
