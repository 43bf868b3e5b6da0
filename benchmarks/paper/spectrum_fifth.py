"""The paper's higher-dimensional form: P = (x, y, z, w, 1), Q of 5x5, lambda_5.

The paper leaves open what w is. Here it is the grip force as a part of the full force of the ramp,
from 0 to 1: the one further quantity that every frame has and that no pose changes. The surface
then holds how the height field grows along the ramp, not one moment of it::

    z = a x^2 + b y^2 + 2 d xy + 2 w (g x + h y) + k w^2 + 2 (w1 x + w2 y + w4 w) + w5

        | a  d  0  g  w1 |
    Q = | d  b  0  h  w2 |      w3 = -1/2, the place of j in the form (7)
        | 0  0  0  0  w3 |
        | g  h  0  k  w4 |
        | w1 w2 w3 w4 w5 |

linear in its ten unknowns. At a fixed w it is the form (7) again, see `at_fifth`. The aperture in
place of the force is fitted the same way: give it as ``w``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import QuadricError
from recognition.quadric.eigen import check_symmetric, eigenvalues
from recognition.quadric.quadric import J

_MAX_CONDITION = 1e10
"""Largest condition number of the design matrix: beyond it coefficients are rounding."""
_NAMES = ("a", "b", "d", "g", "h", "k", "w1", "w2", "w4", "w5")
"""The unknowns of the form, in the order of the design matrix."""

Array = NDArray[np.float64]


def fit_ramp_surface(xy: ArrayLike, w: ArrayLike, height: ArrayLike) -> Array:
    """Fit the 5x5 form to the heights of one patch along a ramp.

    Parameters
    ----------
    xy : (n_points, 2)
        Places of the taxels in units of the patch, order 1, about its centre.
    w : (n_frames,)
        Fifth coordinate of each frame: the part of the full force, from 0 to 1.
    height : (n_frames, n_points)
        Heights, counts in the paper's reading.

    Returns
    -------
    (5, 5) float64
        Symmetric.

    Raises
    ------
    QuadricError
        Where shapes do not fit, values are not finite, or the points and frames do not determine
        the ten unknowns.
    """
    xy, w, height = (np.asarray(one, dtype=np.float64) for one in (xy, w, height))
    if xy.ndim != 2 or xy.shape[1] != 2 or w.ndim != 1 or height.shape != (len(w), len(xy)):
        raise QuadricError(
            f"places {xy.shape}, fifth coordinates {w.shape} and heights {height.shape} do not "
            "fit: expected (n_points, 2), (n_frames,) and (n_frames, n_points)"
        )
    if not all(np.all(np.isfinite(one)) for one in (xy, w, height)):
        raise QuadricError("places, fifth coordinates or heights are not finite")
    x, y = np.tile(xy, (len(w), 1)).T
    f = np.repeat(w, len(xy))
    columns = [x * x, y * y, 2 * x * y, 2 * x * f, 2 * y * f, f * f, 2 * x, 2 * y, 2 * f]
    design = np.column_stack([*columns, np.ones_like(x)])
    if len(design) <= design.shape[1] or np.linalg.cond(design) > _MAX_CONDITION:
        raise QuadricError(
            "points and frames do not determine the surface: at least three forces and a patch "
            "that is not on one conic are needed"
        )
    found = np.linalg.lstsq(design, height.ravel(), rcond=None)[0]
    return ramp_matrix(**dict(zip(_NAMES, found.tolist(), strict=True)))


def ramp_matrix(
    *,
    a: float,
    b: float,
    d: float,
    g: float,
    h: float,
    k: float,
    w1: float,
    w2: float,
    w4: float,
    w5: float,
) -> Array:
    """Return the 5x5 matrix of the surface in the module's text."""
    return np.array(
        [
            [a, d, 0.0, g, w1],
            [d, b, 0.0, h, w2],
            [0.0, 0.0, 0.0, 0.0, J],
            [g, h, 0.0, k, w4],
            [w1, w2, J, w4, w5],
        ]
    )


def at_fifth(Q: ArrayLike, w: float) -> Array:
    """Return the 4x4 form at one value of the fifth coordinate: P = (x, y, z, 1)."""
    Q = _five(Q)
    fill = np.zeros((5, 4))
    fill[[0, 1, 2, 4], [0, 1, 2, 3]] = 1.0
    fill[3, 3] = w
    found: Array = fill.T @ Q @ fill
    return found


def carry(M: ArrayLike) -> Array:
    """Return the 5x5 matrix of a transformation (..., 4, 4): poses leave w as it is."""
    M = np.asarray(M, dtype=np.float64)
    out = np.zeros((*M.shape[:-2], 5, 5))
    keep = np.array([0, 1, 2, 4])
    out[..., keep[:, None], keep] = M
    out[..., 3, 3] = 1.0
    return out


def interlacing(Q: ArrayLike) -> Array:
    """Return by how much the spectra of Q and of its leading 4x4 block interlace, (..., 8).

    Cauchy: lambda_1(Q) <= lambda_1(Q4) <= lambda_2(Q) <= ... <= lambda_5(Q). The eight differences
    in that order; none is negative but for rounding.
    """
    Q = _five(Q)
    outer, inner = eigenvalues(Q), eigenvalues(Q[..., :4, :4])
    merged = np.empty((*outer.shape[:-1], 9))
    merged[..., 0::2], merged[..., 1::2] = outer, inner
    found: Array = np.diff(merged, axis=-1)
    return found


def _five(Q: ArrayLike) -> Array:
    Q = check_symmetric(Q)
    if Q.shape[-1] != 5:
        raise QuadricError(f"property matrix has shape {Q.shape}, expected (..., 5, 5)")
    return Q
