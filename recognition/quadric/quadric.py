"""Quadric of a contact patch, and the paper's Algorithm 1, which trains with quadrics.

The surface is a fitted height field in the paper's form (7), z = a x^2 + b y^2 + 2 d xy + 2 g x + 2
h y + k. Written as P^T Q P = 0 with P = (x, y, z, 1) and the scale fixed by 2 j = -1::

        | a d 0  g  |
    Q = | d b 0  h  |        j = -1/2
        | 0 0 0  j  |
        | g h j  k  |

so that k is the fitted height at the origin, in the unit of the heights. Homogeneous
transformations and the congruence of a quadric (paper eq. (2)) are batched: leading dimensions are
broadcast, the last two have one 4x4 matrix. Angles are in rad; lengths are in the unit of the
quadric's coordinates.

The paper's feature is the smallest eigenvalue of Q. The paper's numbers allow two readings of
"smallest"; each has its own name here. The solver is LAPACK's symmetric QR in
``numpy.linalg.eigvalsh``. Its error is of the order of eps * max|lambda|. On a spectrum from 1e-3
to 1e2 this is about 2e-11 relative to min|lambda|.

Algorithm 1 sweeps taught quadrics through poses. Values are in the order of the printed loops
(scale, translation, rotation, the last innermost). Open points of the printed text are settings
with defaults.

For the decision each object has a band of values. Between neighbouring bands is a window (A, B, C,
... in the paper's Fig. 4), with the threshold at its middle. If bands overlap, the window is closed
and gives no name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from recognition.errors import QuadricError, TrajectoryError, TransformError
from recognition.grasp import keep_array

J = -0.5
"""The entry j of every height-field matrix: 2 j = -1."""
_MAX_CONDITION = 1e6
"""Largest condition number of the design matrix of a fit, in centred and scaled coordinates."""
MIN_POINTS = 7
"""Fewest points of a fit: six unknowns and one more."""
_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""


def translation(offset: ArrayLike) -> NDArray[np.float64]:
    """Return translations; ``offset`` has shape (..., 3), the result (..., 4, 4)."""
    offset = np.asarray(offset, dtype=np.float64)
    out = np.tile(np.eye(4), (*offset.shape[:-1], 1, 1))
    out[..., :3, 3] = offset
    return out


def scaling(factor: ArrayLike) -> NDArray[np.float64]:
    """Return uniform scalings; ``factor`` has shape (...), must not be 0."""
    factor = np.asarray(factor, dtype=np.float64)
    if np.any(factor == 0):
        raise TransformError("a scale factor is 0: the transformation has no inverse")
    out = factor[..., None, None] * np.eye(4)
    out[..., 3, 3] = 1.0
    return out


def rotation_xyz(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return Rz Ry Rx (about x first), right-handed; ``angle_rad`` has shape (..., 3): x, y, z."""
    angle_rad = np.asarray(angle_rad, dtype=np.float64)
    out = np.tile(np.eye(4), (*angle_rad.shape[:-1], 1, 1))
    turns = Rotation.from_euler("xyz", angle_rad.reshape(-1, 3))
    out[..., :3, :3] = turns.as_matrix().reshape(*angle_rad.shape[:-1], 3, 3)
    return out


def by_inverse(Q: NDArray[np.float64], M_inv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform quadrics with the points, P' = M P: Q' = M^-T Q M^-1 (paper eq. (2)).

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric property matrices.
    M_inv : (..., 4, 4)
        M^-1; broadcast against ``Q``.

    Returns
    -------
    (..., 4, 4) float64
        Exactly symmetric. Rank and signature are those of ``Q``. The eigenvalues are those of ``Q``
        only if M is orthogonal, so for a rotation about the origin.
    """
    out: NDArray[np.float64] = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
    return 0.5 * (out + np.swapaxes(out, -1, -2))


def height_field_matrix(
    *, a: float, b: float, d: float = 0.0, g: float = 0.0, h: float = 0.0, k: float
) -> NDArray[np.float64]:
    """Write z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k as (4, 4) in the form (7)."""
    return np.array(
        [[a, d, 0.0, g], [d, b, 0.0, h], [0.0, 0.0, 0.0, J], [g, h, J, k]], dtype=np.float64
    )


def fit_height_field(xy_m: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit the height field by linear least squares.

    Raises QuadricError for fewer than 7 points, or points that do not determine the six unknowns:
    on one line, on two parallel rows, or on any other conic.

    Parameters
    ----------
    xy_m : (n, 2)
        Positions in m.
    height : (n,)
        Heights in any one unit; counts by default in this package.

    Returns
    -------
    (4, 4) float64
        Form (7). x and y are measured from the centroid of the points, in units of their root mean
        square distance from it; z is the height.
    """
    n = len(xy_m)
    if n < MIN_POINTS:
        raise QuadricError(f"{n} points, a height field needs at least {MIN_POINTS}")
    share = np.full(n, 1.0 / n)
    centre = share @ xy_m
    scale = float(np.sqrt(share @ np.sum((xy_m - centre) ** 2, axis=1)))
    if not scale > 0:
        raise QuadricError(f"all {n} points lie at one place; give points at different places")
    x, y = ((xy_m - centre) / scale).T
    root = np.sqrt(share)
    design = np.stack([x * x, y * y, 2 * x * y, 2 * x, 2 * y, np.ones_like(x)], axis=1)
    u, singular, vt = np.linalg.svd(design * root[:, None], full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
    if not condition <= _MAX_CONDITION:
        raise QuadricError(
            f"{n} points do not determine a height field: condition {condition:.3g}, limit "
            f"{_MAX_CONDITION:.3g}; they lie on a line, on two rows or on another conic"
        )
    a, b, d, g, h, k = vt.T @ ((u.T @ (height * root)) / singular)
    return height_field_matrix(a=a, b=b, d=d, g=g, h=h, k=k)


class Reading(StrEnum):
    """Readings of "the smallest eigenvalue"."""

    SMALLEST_MAGNITUDE = "smallest_magnitude"
    """min|lambda|: "of order 1e-3, the largest 1e2", last when sorted by falling magnitude."""
    ALGEBRAIC_MINIMUM = "algebraic_minimum"
    """lambda_1, the infimum of the Rayleigh quotient, eq. (3) to (6); <= 0 for a real surface."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallestEigenvalue:
    """Smallest eigenvalues of a batch."""

    value: NDArray[np.float64]
    """(...) float64: in the unit of the matrix; never below the floor of rounding in the readings
    that are magnitudes."""
    degenerate: NDArray[np.bool_]
    """(...) bool: true if the value is rounding noise, so the matrix may be singular. Its magnitude
    is then not above n * eps * max|lambda|, n the size of the matrix."""


def smallest_eigenvalue(
    Q: NDArray[np.float64], reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> SmallestEigenvalue:
    """Return the smallest eigenvalue of each property matrix.

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric matrices.
    reading
        Kind of the smallest; the paper's numbers fit only the smallest magnitude.
    """
    values = np.asarray(np.linalg.eigvalsh(Q), dtype=np.float64)
    n = values.shape[-1]
    magnitudes = np.abs(values)
    floor = n * _EPS * np.maximum(magnitudes[..., 0], magnitudes[..., -1])
    if reading is Reading.ALGEBRAIC_MINIMUM:
        value = values[..., 0]
        return SmallestEigenvalue(value=value, degenerate=np.abs(value) <= floor)
    magnitude = magnitudes[..., 0]
    for column in range(1, n):  # faster over long batches than a minimum along a short axis
        magnitude = np.minimum(magnitude, magnitudes[..., column])
    return SmallestEigenvalue(value=np.maximum(magnitude, floor), degenerate=magnitude <= floor)


NOISE_SHARE = 0.08
"""Widening of bands as a share of the level: the paper's noise of levels, 8 %."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweepSettings:
    """The grid of Algorithm 1 and its readings; the defaults are those of the printed text."""

    scale: NDArray[np.float64] = field(default_factory=lambda: np.linspace(1.0, 4.0, 31))
    """(n_scale,) float64: scale factors: 1 to 4 in steps of 0.1."""
    translation: NDArray[np.float64] = field(default_factory=lambda: np.linspace(-2.0, 2.0, 41))
    """(n_translation,) float64: translation along x and y in the unit of the matrices: -2 to 2 in
    steps of 0.1."""
    angle_rad: NDArray[np.float64] = field(default_factory=lambda: np.linspace(0.0, 2 * np.pi, 17))
    """(n_angle,) float64: rotation about x, y and z: 0 to 2 pi in steps of pi/8, both ends."""
    reading: Reading = Reading.SMALLEST_MAGNITUDE
    """Kind of the smallest eigenvalue."""

    def __post_init__(self) -> None:
        for name in ("scale", "translation", "angle_rad"):
            values = keep_array(self, name, getattr(self, name), np.float64)
            if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
                raise TrajectoryError(f"{name} must be a list of finite numbers, not {values}")


PAPER_SWEEP = SweepSettings()
"""The grid as printed: 21,607 matrices an object."""


def sweep(D: NDArray[np.float64], settings: SweepSettings = PAPER_SWEEP) -> NDArray[np.float64]:
    """Return the smallest eigenvalues over the training loops, (n_objects, n).

    They are in the order of the printed loops: scale outermost, rotation innermost.

    Raises TrajectoryError if ``D`` is not a list of 4x4 matrices.

    Parameters
    ----------
    D : (n_objects, 4, 4)
        Property matrices of the taught objects, symmetric.
    """
    if D.ndim != 3 or D.shape[1:] != (4, 4):
        raise TrajectoryError(f"taught quadrics have shape {D.shape}, expected (n_objects, 4, 4)")
    # M = T R S: a point is scaled first, then rotated, then translated. The printed text has one
    # loop variable for x and y, and one for all three angles.
    shift, turn = settings.translation[:, None], settings.angle_rad[:, None]
    back = translation(np.hstack([-shift, -shift, np.zeros_like(shift)]))[:, None]
    turned = np.swapaxes(rotation_xyz(np.repeat(turn, 3, axis=1)), -1, -2)
    values = []
    for factor in settings.scale:
        M_inv = (scaling(1.0 / factor) @ turned @ back).reshape(-1, 4, 4)
        Q = by_inverse(D[:, None], M_inv)
        values.append(smallest_eigenvalue(Q, settings.reading).value)
    return np.concatenate(values, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelBands:
    """Bands of the taught objects, with thresholds and windows between them."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """(n_objects,) float64: band of each object; NaN if an object has no level."""
    margin: float = NOISE_SHARE
    """Share of its edge by which a band is extended into open space."""

    @property
    def order(self) -> NDArray[np.int64]:
        """(n_levels,) int64: objects with a level, by the middle of their band, ascending."""
        order = np.argsort(0.5 * (self.low + self.high), kind="stable")
        return order[np.isfinite(self.low[order])]

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n_levels - 1,) float64: middle between the bands of neighbours in ``order``."""
        return 0.5 * (self.high[self.order[:-1]] + self.low[self.order[1:]])

    @property
    def window(self) -> NDArray[np.float64]:
        """(n_levels - 1,) float64: gap between them; closed if it is not above 0."""
        return np.asarray(self.low[self.order[1:]] - self.high[self.order[:-1]])

    def distance(self, value: float) -> NDArray[np.float64]:
        """Return the distance of a value from each band, (n_objects,); 0 inside, NaN: no level."""
        return np.maximum(np.maximum(self.low - value, value - self.high), 0.0)


def find_thresholds(values: Sequence[ArrayLike]) -> LevelBands:
    """Turn the values of each object into bands, thresholds and windows.

    Raises TrajectoryError if no object has a level.

    Parameters
    ----------
    values
        Any number of values for each object; NaN is left out. An object without values has no level
        and is never named.
    """
    low = np.full(len(values), np.nan)
    high = np.full(len(values), np.nan)
    for index, levels in enumerate(values):
        usable = np.asarray(levels, dtype=np.float64).ravel()
        usable = usable[np.isfinite(usable)]
        if len(usable):
            low[index], high[index] = usable.min(), usable.max()
    if not np.isfinite(low).any():
        raise TrajectoryError(
            f"no object of {len(values)} has a level: no grasp pressed enough neighbouring taxels "
            "for a surface, which needs pads of at least 3 x 3"
        )
    return LevelBands(low=low, high=high)


def with_noise(levels: LevelBands, noise_share: float) -> LevelBands:
    """Adjust bands and windows to the measured noise, like the paper's windows A to D.

    Raises TrajectoryError if ``noise_share`` is not from 0 below 1.

    Parameters
    ----------
    levels
        Bands without noise.
    noise_share
        Present relative uncertainty of a level.

    Returns
    -------
    LevelBands
        Bands are wider and windows narrower by this amount; a window may be closed. The margin is
        at least the noise.
    """
    if not 0.0 <= noise_share < 1.0:
        raise TrajectoryError(f"noise_share is {noise_share}, must be from 0 below 1")
    low = levels.low - noise_share * np.abs(levels.low)
    high = levels.high + noise_share * np.abs(levels.high)
    return LevelBands(low=low, high=high, margin=max(levels.margin, noise_share))


def check_level(levels: LevelBands, value: float) -> int | None:
    """Return the object whose band contains a value.

    Inside one band it is that object, inside several (a closed window) none. Between bands the
    threshold decides, within the extended bands.

    Returns
    -------
    int or None
        Index of the object; None for unknown.
    """
    distance = levels.distance(value)
    inside = np.flatnonzero(distance == 0.0)
    if len(inside):
        return int(inside[0]) if len(inside) == 1 else None
    wide = with_noise(levels, levels.margin)
    near = np.flatnonzero((value >= wide.low) & (value <= wide.high))
    if not len(near):
        return None
    nearest = near[distance[near] == distance[near].min()]
    return int(nearest[0]) if len(nearest) == 1 else None
