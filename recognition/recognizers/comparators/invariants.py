"""Differential invariants of a curve: numbers that do not change in a rigid motion.

After Ibrayev and Jia (the paper's refs. [3, 4]): with the curvature k and its derivative k' over
the arc length, every point of a parabola has the same

    I = |k|^(2/3) (1 + (k' / (3 k^2))^2),

and on an ellipse or a hyperbola with the half axes a and b two points give

    m = -(I_1 - I_2) / (|k_1|^(-2/3) - |k_2|^(-2/3)),   I + m |k|^(-2/3),

which are +-(a b)^(-2/3) and (a^2 +- b^2) / (a b)^(4/3). A cubic also has its third derivative.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.features.footprint import PadGrid
from recognition.recognizers.comparators.outline import centroid_mm, sample_mm

FULL_SCALE_MM = 3.0
"""Depth of a taxel at full scale in mm: the thickness of the paper's foam."""

_POINTS = np.array([-0.5, 0.0, 0.5])
"""Points of a section for the invariants, as shares of its reach."""
_SAMPLES = np.linspace(-1.0, 1.0, 21)
"""Points of a section for the fit of the cubic, as shares of its reach."""
_REACH = 1.6
"""Reach of a section on each side, in standard deviations of the load along it."""
_TINY = 1e-6
"""Least curvature in 1/mm: flat sections have no finite invariant."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalGeometry:
    """Curvature, 1/mm, and its derivative over the arc length, 1/mm², at points of a curve."""

    curvature: NDArray[np.float64]
    derivative: NDArray[np.float64]


def cubic_geometry(coefficients: NDArray[np.float64], at_mm: NDArray[np.float64]) -> LocalGeometry:
    """Return the geometry of y = c0 + c1 x + c2 x² + c3 x³, all in mm, at points x."""
    _, c1, c2, c3 = coefficients
    first = c1 + 2.0 * c2 * at_mm + 3.0 * c3 * at_mm**2
    second = 2.0 * c2 + 6.0 * c3 * at_mm
    stretch = 1.0 + first**2
    return LocalGeometry(
        curvature=second / stretch**1.5,
        derivative=(6.0 * c3 * stretch - 3.0 * first * second**2) / stretch**3,
    )


def parabola_invariant(geometry: LocalGeometry) -> NDArray[np.float64]:
    """Return I at each point, in mm^(-2/3); constant along a parabola."""
    k = np.maximum(np.abs(geometry.curvature), _TINY)
    invariant: NDArray[np.float64] = k ** (2 / 3) * (1.0 + (geometry.derivative / (3 * k**2)) ** 2)
    return invariant


def conic_invariants(geometry: LocalGeometry) -> tuple[float, float]:
    """Return m and I + m |k|^(-2/3), by least squares over all points.

    With points of one curvature, for example on a circle, m is 0.
    """
    k = np.maximum(np.abs(geometry.curvature), _TINY) ** (-2 / 3)
    value = parabola_invariant(geometry)
    spread = k - k.mean()
    total = float(spread @ spread)
    slope = -float(spread @ value) / total if total > (1e-6 * float(k.mean())) ** 2 else 0.0
    return slope, float(value.mean() + slope * k.mean())


def section_features(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return invariants of the two principal sections of one pad's patch (n_taxels,), 0 to 1.

    A cubic is fitted to the heights along the long and the short axis through the centroid. The
    features are its invariants at up to three points, for both directions of travel alike.

    Returns
    -------
    (16,) float64
        Finite; compressed by asinh or the logarithm.
    """
    centre = centroid_mm(patch, grid)
    delta = grid.xy_mm - centre
    share = patch / max(float(patch.sum()), 1e-12)
    moments = (share[:, None] * delta).T @ delta + np.diag(grid.pitch_mm**2 / 12.0)
    variance, axes = np.linalg.eigh(moments)
    basis = np.stack([_SAMPLES**power for power in range(4)], axis=1)
    solve = np.linalg.pinv(basis)
    described = []
    for axis in (1, 0):
        reach_mm = _REACH * float(np.sqrt(max(float(variance[axis]), 1e-6)))
        points_mm = centre + reach_mm * _SAMPLES[:, None] * axes[:, axis]
        height_mm = FULL_SCALE_MM * sample_mm(patch, grid, points_mm)
        coefficients = (solve @ height_mm) / reach_mm ** np.arange(4)
        described.append(_describe(coefficients, reach_mm))
    return np.concatenate(described)


def _describe(coefficients: NDArray[np.float64], reach_mm: float) -> NDArray[np.float64]:
    geometry = cubic_geometry(coefficients, reach_mm * _POINTS)
    m, conic = conic_invariants(geometry)
    left, middle, right = geometry.curvature
    return np.array(
        [
            np.arcsinh(10.0 * middle),
            np.arcsinh(10.0 * (left + right)),
            np.arcsinh(10.0 * abs(right - left)),
            np.arcsinh(10.0 * abs(geometry.derivative[1])),
            np.log(parabola_invariant(geometry)[1]),
            np.arcsinh(m),
            np.arcsinh(conic),
            np.arcsinh(100.0 * abs(coefficients[3])),
        ]
    )
