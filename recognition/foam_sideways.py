"""Columns of foam that also push their neighbours in: between separate columns and an elastic body.

A surface point gives way under its own column and under what the pressure around it does: with
``sideways`` = m its displacement is (1 - m) q + m G q, where q is how far each column is closed and
G a mean over the surroundings, weighted by a Gaussian. At m = 0 columns are separate. In wave
numbers the compliance (1 - m) + m exp(-k^2 s^2 / 2) falls as that of an elastic layer does.

Where a rigid surface touches, the displacement is the wanted one; elsewhere q is 0. That is solved
by projected steps with momentum (Nesterov's), from the solution for separate columns or from a
given one.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
"""Of single or of double precision; results have that of the arguments."""


def neighbours(points_m: Array, width_m: float) -> Array:
    """Return the weights (n, n) with which evenly spaced points push each other along one axis.

    Parameters
    ----------
    points_m : (n,)
        Where they are in m.
    width_m
        Standard deviation of the Gaussian in m.
    """
    step_m = float(abs(points_m[1] - points_m[0])) if len(points_m) > 1 else width_m
    away = (points_m[:, None] - points_m[None, :]) / width_m
    weights: Array = np.exp(-0.5 * away * away) * (step_m / (np.sqrt(2.0 * np.pi) * width_m))
    return weights


def closed_columns_m(
    wanted_m: Array,
    covered: Array | float,
    sideways: Array | float,
    pushes: tuple[Array, Array],
    *,
    steps: int,
    start_m: Array | None = None,
) -> Array:
    """Return how far columns are closed under a rigid surface.

    Parameters
    ----------
    wanted_m : (..., n_x, n_y)
        How far the surface reaches below the untouched foam in m; negative where there is a gap.
    covered
        Share of each cell that it covers, broadcast against ``wanted_m``.
    sideways
        m of the module's text, from 0 to below 1, broadcast against ``wanted_m``.
    pushes : (n_x, n_x), (n_y, n_y)
        `neighbours` along both axes.
    steps
        Number of steps; 0 gives the columns as they are at the start.
    start_m : (..., n_x, n_y)
        Where to start.

    Returns
    -------
    closed_m : (..., n_x, n_y)
        Closing of the columns in m, not negative; what it does is ``covered`` times as much.
    """
    along, across = pushes
    closed = np.maximum(wanted_m, 0.0) if start_m is None else start_m
    ahead = closed
    momentum = 1.0
    for _ in range(steps):
        load = covered * ahead
        pushed = along @ (load.reshape(-1, load.shape[-1]) @ across).reshape(load.shape)
        new = np.maximum(wanted_m + sideways * (ahead - pushed), 0.0)
        next_momentum = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        ahead = np.maximum(new + ((momentum - 1.0) / next_momentum) * (new - closed), 0.0)
        closed, momentum = new, next_momentum
    return closed
