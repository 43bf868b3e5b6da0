"""Fit one kind of shape to pressed pads: least squares through the foam, with known noise.

Fitted together are size and form, the pose in the plane of the pads, the depth at each level of
the load, and what is not known exactly of foam, sensor and opening. All have a prior; the marginal
likelihood (Laplace's approximation) then compares kinds with different numbers of parameters.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recognition.foam_model import FoamModel
from recognition.misfit import misfit_of, n_determined
from recognition.shape_data import PressedPads
from recognition.shape_models import ShapeModel
from recognition.shape_problem import FOAM, ShapeProblem, Trust

Array = NDArray[np.float64]

_MAX_STEPS = 18
_ENOUGH = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeFit:
    """One kind of shape, fitted.

    Attributes
    ----------
    model
        The kind.
    theta : (n,) float64
        Parameters: log of the half thickness in mm, the model's own, then pose, depths, foam.
    normal : (n, n) float64
    gradient : (n,) float64
        J^T J and J^T r of the data alone.
    prior_mean, prior_sd : (n,) float64
        The prior.
    chi2
        Sum of the squared residuals of the data over their variances.
    misfit
        Squared residual per degree of freedom, see `recognition.misfit`.
    n_shared
        Number of the last parameters, which all grasps of a cell have in common.
    """

    model: ShapeModel
    theta: Array
    normal: Array
    gradient: Array
    prior_mean: Array
    prior_sd: Array
    chi2: float
    misfit: float
    n_shared: int

    @property
    def half_m(self) -> float:
        """Half thickness along the closing axis in m."""
        return 1e-3 * float(np.exp(self.theta[0]))

    def at_scale(self, scale: float) -> "ShapeFit":
        """Return the fit where the variances of the data are ``scale`` times as large.

        One Gauss-Newton step: with a larger scale what is known beforehand counts for more.
        """
        away = self.prior_sd**-2 * (self.theta - self.prior_mean)
        step = -np.linalg.solve(self._precision(scale), self.gradient / scale + away)
        return replace(
            self,
            theta=self.theta + step,
            gradient=self.gradient + self.normal @ step,
            chi2=max(0.0, self.chi2 + float(step @ (2.0 * self.gradient + self.normal @ step))),
        )

    def log_evidence(self, scale: float = 1.0) -> float:
        """Return the log marginal likelihood up to what is the same for all kinds.

        Parameters
        ----------
        scale
            Factor on the variances of the data: above 1 where no kind fits within the noise.
        """
        away = (self.theta - self.prior_mean) / self.prior_sd
        _, volume = np.linalg.slogdet(self._precision(scale))
        return float(
            -0.5 * (self.chi2 / scale + away @ away + volume) - np.log(self.prior_sd).sum()
        )

    def log_half_sd(self, scale: float = 1.0) -> float:
        """Return the standard deviation of the logarithm of the half thickness."""
        return float(np.sqrt(np.linalg.inv(self._precision(scale))[0, 0]))

    def dimensions_m(self) -> dict[str, float]:
        """Return the dimensions in m by their names."""
        return self.model.dimensions_m(self.half_m, self.theta[1 : self.model.n_own])

    def _precision(self, scale: float) -> Array:
        return self.normal / scale + np.diag(self.prior_sd**-2)


def fit_shape(
    model: ShapeModel,
    data: PressedPads,
    foam: FoamModel,
    trust: Trust | None = None,
    *,
    near: ShapeFit | None = None,
    pads_of: ShapeFit | None = None,
) -> ShapeFit:
    """Fit one kind of shape: Levenberg-Marquardt from the best of a few starts.

    Parameters
    ----------
    model, data
        The kind of shape, and the pads.
    foam, trust
        What is known of foam and sensor, and how well.
    near
        A fit of the same kind to the same data under another foam: to start from.
    pads_of
        A fit of another kind to the same data under this foam: to start foam and depths from.
    """
    problem = ShapeProblem(model, data, foam, trust or Trust())
    starts = problem.starts() if near is None else near.theta[None]
    if near is not None and pads_of is not None:
        n_pads = len(FOAM) + problem.n_levels
        starts = np.repeat(starts, 2, axis=0)
        starts[1, -n_pads:] = pads_of.theta[-n_pads:]
    first = (problem.residuals(starts) ** 2).sum(axis=1) if len(starts) > 1 else np.zeros(1)
    if model.turns:
        # A turn has no preferred value: its prior only bounds it, around where it starts.
        problem.mean[problem.pose + 2] = starts[int(np.argmin(first)), problem.pose + 2]
    theta, residuals, jacobian = _minimise(problem, starts[int(np.argmin(first))])
    normal = jacobian.T @ jacobian
    return ShapeFit(
        model=model,
        theta=theta,
        normal=normal,
        gradient=jacobian.T @ residuals,
        prior_mean=problem.mean,
        prior_sd=problem.sd,
        chi2=float(residuals @ residuals),
        misfit=misfit_of(
            residuals * residuals, data.tells(len(residuals)), n_determined(normal, problem.sd)
        ),
        n_shared=problem.n - problem.rest,
    )


def _minimise(problem: ShapeProblem, theta: Array) -> tuple[Array, Array, Array]:
    """Return the best parameters, and residuals and Jacobian of the data there."""
    precision = problem.sd**-2
    damping = 1e-2
    residuals, jacobian = problem.around(theta)
    cost = _cost(residuals, theta, problem)
    for _ in range(_MAX_STEPS):
        normal = jacobian.T @ jacobian + np.diag(precision)
        gradient = jacobian.T @ residuals + precision * (theta - problem.mean)
        gain = 0.0
        for _ in range(6):
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial = theta + np.clip(step, -1.0, 1.0)
            new_residuals, new_jacobian = problem.around(trial)
            new = _cost(new_residuals, trial, problem)
            if new < cost:
                gain = cost - new
                theta, cost, residuals, jacobian = trial, new, new_residuals, new_jacobian
                damping = max(0.2 * damping, 1e-6)
                break
            damping *= 8.0
        if gain < _ENOUGH:
            break
    return theta, residuals, jacobian


def _cost(residuals: Array, theta: Array, problem: ShapeProblem) -> float:
    away = (theta - problem.mean) / problem.sd
    return float(residuals @ residuals + away @ away)
