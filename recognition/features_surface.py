"""The pressed patch as a quadric surface: its curvatures and the eigenvalues of its matrix.

The height field z = a x² + b y² + 2 d xy + 2 g x + 2 h y + k of `recognition.quadric`, fitted to
all grasps at once: x and y from the centre of the load, z as a fraction of the peak, each taxel
weighted by its load. A ridge keeps patches of a few taxels from having none or many solutions.
"""

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid, pressed

_SCALE_MM = 5.0
_RIDGE = 1e-3
_NEIGHBOUR_WEIGHT = 1e-4
_LEVELS = (2, 4)


def surface_features(
    maps: NDArray[np.float64], noise: NDArray[np.float64], grid: PadGrid
) -> NDArray[np.float64]:
    """Return (n, F): principal curvatures, height, residual and three smallest eigenvalues.

    None of them changes when the patch moves or turns on the pad, taxels being fine enough.

    Parameters
    ----------
    maps : (n, K, n_taxels)
        Values above rest, as a fraction of full scale.
    noise : (n, K)
        Standard deviation of each value.
    grid
        The pad.
    """
    levels = [k for k in _LEVELS if k < maps.shape[1]]
    patch = pressed(maps[:, levels], noise[:, levels])
    load = np.maximum(patch.sum(axis=-1), 1e-6)[..., None]
    height = patch / np.maximum(patch.max(axis=-1), 1e-6)[..., None]
    centre = (patch / load) @ grid.xy_mm
    x = (grid.xy_mm[:, 0] - centre[..., 0, None]) / _SCALE_MM
    y = (grid.xy_mm[:, 1] - centre[..., 1, None]) / _SCALE_MM
    # Free taxels beside the patch count a little: they bound the surface at the rim.
    weight = patch / load + _NEIGHBOUR_WEIGHT * np.exp(-(x * x + y * y))
    design = np.stack([x * x, y * y, 2 * x * y, 2 * x, 2 * y, np.ones_like(x)], axis=-1)
    weighted = np.swapaxes(design * weight[..., None], -1, -2)
    normal = weighted @ design + _RIDGE * np.eye(6)
    theta = np.linalg.solve(normal, weighted @ height[..., None])
    error = height - (design @ theta)[..., 0]
    a, b, d, g, h, k = np.moveaxis(theta[..., 0], -1, 0)
    mean, swing = (a + b) / 2, np.hypot((a - b) / 2, d)
    Q = np.zeros((*a.shape, 4, 4))
    for row, column, value in ((0, 1, d), (0, 3, g), (1, 3, h), (2, 3, np.full_like(a, -0.5))):
        Q[..., row, column] = Q[..., column, row] = value
    for row, value in ((0, a), (1, b), (3, k)):
        Q[..., row, row] = value
    size = np.sqrt((Q**2).sum(axis=(-1, -2)))[..., None]
    features = np.concatenate(
        [
            np.arcsinh(3 * np.stack([mean - swing, mean + swing], axis=-1)),
            np.stack([k, np.log(np.sqrt((weight * error**2).sum(axis=-1)) + 0.02)], axis=-1),
            np.linalg.eigvalsh(Q)[..., :3] / size,
        ],
        axis=-1,
    )
    return features.reshape(len(maps), -1)
