"""How badly a model of pressed pads misses them: squared residual per degree of freedom."""

import numpy as np
from numpy.typing import NDArray


def misfit_of(squared: NDArray[np.float64], tells: NDArray[np.bool_], n_determined: float) -> float:
    """Return the squared residual per degree of freedom: 1 where the noise explains it.

    Untouched taxels fit any shape. On pads with little noise they would hide that none fits, so it
    is that of the data that tell of a shape where that is larger.

    Parameters
    ----------
    squared : (n_data,)
        Squared residuals over their variances.
    tells : (n_data,)
        Which of them tell of a shape: see `PressedPads.tells`.
    n_determined
        How many parameters the data determine, see `n_determined`.
    """
    overall = float(squared.sum()) / max(1.0, len(squared) - n_determined)
    telling = float(squared[tells].sum()) / max(1.0, int(tells.sum()) - n_determined)
    return max(overall, telling)


def n_determined(normal: NDArray[np.float64], prior_sd: NDArray[np.float64]) -> float:
    """Return how many parameters the data determine rather than what is known beforehand.

    Parameters
    ----------
    normal : (n, n)
        J^T J of the data alone.
    prior_sd : (n,)
        Standard deviations of the prior.
    """
    return float(np.trace(np.linalg.solve(normal + np.diag(prior_sd**-2), normal)))
