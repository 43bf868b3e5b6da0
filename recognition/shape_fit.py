"""Fit one kind of shape to pressed pads: least squares through the foam, with known noise.

Fitted together are size and form, the pose in the plane of the pads, the depth at each level of
the load, and what is not known exactly of foam, sensor and opening. All have a prior; the marginal
likelihood (Laplace's approximation) then compares kinds with different numbers of parameters.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.foam_model import FoamModel
from recognition.shape_data import SPREAD_STEP, PressedPads
from recognition.shape_models import ShapeModel

Array = NDArray[np.float64]

_MAX_STEPS = 14
_STEP = 1e-3
_TURN_SD = float(np.sqrt(np.pi / 2.0))
_START_DEPTHS_MM = np.array([0.1, 0.4, 0.8, 1.2, 1.6, 2.0, 2.5])


@dataclass(frozen=True, slots=True, kw_only=True)
class Trust:
    """How well foam, sensor and opening are known.

    Attributes
    ----------
    modulus, gain, spread
        Standard deviation of the logarithm.
    aperture_m
        Standard deviation in m of the opening, the same over one grasp.
    aperture_jitter_m
        Standard deviation in m of the opening at one level.
    force
        Relative standard deviation of the commanded force.
    """

    modulus: float = 0.1
    gain: float = 0.1
    spread: float = 0.05
    aperture_m: float = 0.2e-3
    aperture_jitter_m: float = 0.06e-3
    force: float = 0.06


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
        J^T J of the data alone.
    prior_mean, prior_sd : (n,) float64
        The prior.
    chi2
        Sum of the squared residuals of the data over their variances.
    n_data
        Number of the data.
    n_shared
        Number of the last parameters, which all grasps of a cell have in common.
    """

    model: ShapeModel
    theta: Array
    normal: Array
    prior_mean: Array
    prior_sd: Array
    chi2: float
    n_data: int
    n_shared: int

    @property
    def half_m(self) -> float:
        """Half thickness along the closing axis in m."""
        return 1e-3 * float(np.exp(self.theta[0]))

    @property
    def freedom(self) -> int:
        """Data less parameters, at least 1."""
        return max(1, self.n_data - len(self.theta))

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


class _Problem:
    """Residuals of one kind on one grasp, for many sets of parameters at once."""

    def __init__(self, model: ShapeModel, data: PressedPads, foam: FoamModel, trust: Trust) -> None:
        self.model, self.data, self.foam, self.trust = model, data, foam, trust
        self.n_levels = len(data.share)
        self.pose = model.n_own
        self.depth = self.pose + 2 + int(model.turns)
        self.rest = self.depth + self.n_levels
        self.n = self.rest + 4
        n_turn = int(model.turns)
        self.mean = np.array(
            [
                *model.mean,
                *(1e3 * data.centre_m),
                *[0.0] * n_turn,
                *[1.2] * self.n_levels,
                *[0.0] * 4,
            ]
        )
        self.sd = np.array(
            [
                *model.sd,
                1.5,
                1.5,
                *[_TURN_SD] * n_turn,
                *[1.0] * self.n_levels,
                trust.modulus,
                trust.gain,
                trust.spread,
                1e3 * trust.aperture_m,
            ]
        )
        self._along_step = (data.wider.along - data.bed.along) / SPREAD_STEP
        self._across_step = (data.wider.across - data.bed.across) / SPREAD_STEP
        self._knows_aperture = bool(np.isfinite(data.aperture_m).all())
        self._knows_force = bool(np.isfinite(data.force_n)) and data.force_n > 0.0
        cells = data.bed.x_m[:, 0]
        self._cell_m = float(abs(cells[1] - cells[0])) if len(cells) > 1 else 1e-3

    def forces_n(self, theta: Array, depths: slice | None = None) -> Array:
        """Return forces (B, K, n_taxels) in N; of some of the depths, by default of all."""
        bed, model = self.data.bed, self.model
        at = theta[:, :, None, None]
        h_m = 1e-3 * np.exp(at[:, 0])
        dx_m = bed.x_m - 1e-3 * at[:, self.pose]
        dy_m = bed.y_m - 1e-3 * at[:, self.pose + 1]
        if model.turns:
            c, s = np.cos(at[:, self.pose + 2]), np.sin(at[:, self.pose + 2])
            dx_m, dy_m = c * dx_m + s * dy_m, c * dy_m - s * dx_m
        u_m, v_m = np.broadcast_arrays(dx_m, dy_m)
        lag_m, covered = model.surface(h_m, at[:, 1 : model.n_own], u_m, v_m, self._cell_m)
        depth_m = 1e-3 * at[:, depths or slice(self.depth, self.rest)]
        pressure = self.foam.relative_pressure(depth_m - lag_m[:, None])
        pressure *= covered[:, None]
        # The spread enters linearly: it is never far from what it is thought to be.
        spread = at[:, self.rest + 2]
        along = bed.along + spread * self._along_step
        across = bed.across + spread * self._across_step
        forces = along[:, None] @ (pressure @ across.transpose(0, 2, 1)[:, None])
        scale_n = bed.cell_area_m2 * self.foam.modulus_pa * np.exp(theta[:, self.rest])
        forces_n: Array = forces.reshape(*forces.shape[:2], -1) * scale_n[:, None, None]
        return forces_n

    def residuals(self, theta: Array) -> Array:
        """Return residuals (B, n_data) of the data over their standard deviations."""
        data, trust = self.data, self.trust
        force_n = self.forces_n(theta)
        share = self.foam.response(force_n * np.exp(theta[:, self.rest + 1])[:, None, None])
        parts = [((share - data.share) / data.sd).reshape(len(theta), -1)]
        if self._knows_aperture:
            depth_m = 1e-3 * theta[:, self.depth : self.rest]
            thick_m = 2e-3 * np.exp(theta[:, :1])
            shown_m = thick_m - 2.0 * depth_m + 1e-3 * theta[:, -1:]
            parts.append((shown_m - data.aperture_m) / trust.aperture_jitter_m)
        if self._knows_force:
            total_n = force_n[:, -1].sum(axis=1, keepdims=True)
            parts.append((total_n - data.force_n) / (trust.force * data.force_n + 0.15))
        return np.concatenate(parts, axis=1)

    def starts(self) -> Array:
        """Return starting parameters (S, n): sizes from the opening, turns from the load."""
        data, model = self.data, self.model
        if self._knows_aperture:
            halves_mm = [max(0.5e3 * float(data.aperture_m[-1]) + 1.2, 0.8)]
        else:
            halves_mm = [3.0, 7.0, 15.0]
        variances, axes = np.linalg.eigh(data.spread_m2)
        # An evenly loaded stretch of half length a has the variance a^2 / 3.
        wide_m, long_m = np.sqrt(3.0 * np.maximum(variances - self.foam.spread_m**2, 4e-7))
        turn = float(np.arctan2(axes[1, 1], axes[0, 1]))
        turns = turn + np.pi * np.array([0.0, 0.5, 0.25, -0.25]) if model.turns else [0.0]
        starts = []
        for half_mm in halves_mm:
            for own in model.starts(1e-3 * half_mm, float(long_m), float(wide_m)):
                for angle in turns:
                    theta = self.mean.copy()
                    theta[: model.n_own] = (np.log(half_mm), *own)
                    if model.turns:
                        theta[self.pose + 2] = angle
                    starts.append(theta)
        return self._with_depths(np.array(starts))

    def _with_depths(self, theta: Array) -> Array:
        """Set the depth of each level so that the load is the measured one."""
        trial = np.repeat(theta, len(_START_DEPTHS_MM), axis=0)
        trial[:, self.depth : self.rest] = np.tile(_START_DEPTHS_MM, len(theta))[:, None]
        one = self.forces_n(trial, slice(self.depth, self.depth + 1))[:, 0]
        loads = self.foam.response(one).sum(axis=1).reshape(len(theta), -1)
        measured = self.data.share.sum(axis=1)
        for row, load in zip(theta, loads, strict=True):
            row[self.depth : self.rest] = np.interp(measured, load, _START_DEPTHS_MM)
        return theta


def fit_shape(
    model: ShapeModel, data: PressedPads, foam: FoamModel, trust: Trust | None = None
) -> ShapeFit:
    """Fit one kind of shape: Levenberg-Marquardt from the best of a few starts."""
    problem = _Problem(model, data, foam, trust or Trust())
    starts = problem.starts()
    first = (problem.residuals(starts) ** 2).sum(axis=1)
    if model.turns:
        # A turn has no preferred value: its prior only bounds it, around where it starts.
        problem.mean[problem.pose + 2] = starts[int(np.argmin(first)), problem.pose + 2]
    theta, residuals, jacobian = _minimise(problem, starts[int(np.argmin(first))])
    return ShapeFit(
        model=model,
        theta=theta,
        normal=jacobian.T @ jacobian,
        prior_mean=problem.mean,
        prior_sd=problem.sd,
        chi2=float(residuals @ residuals),
        n_data=len(residuals),
        n_shared=problem.n - problem.rest,
    )


def _minimise(problem: _Problem, theta: Array) -> tuple[Array, Array, Array]:
    """Return the best parameters, and residuals and Jacobian of the data there."""
    precision = problem.sd**-2
    damping = 1e-2
    shifts = _STEP * np.eye(problem.n)
    batch = problem.residuals(np.concatenate([theta[None], theta + shifts]))
    residuals, jacobian = batch[0], (batch[1:] - batch[0]).T / _STEP
    cost = _cost(residuals, theta, problem)
    for _ in range(_MAX_STEPS):
        normal = jacobian.T @ jacobian + np.diag(precision)
        gradient = jacobian.T @ residuals + precision * (theta - problem.mean)
        gain = 0.0
        for _ in range(4):
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial = theta + np.clip(step, -1.0, 1.0)
            batch = problem.residuals(np.concatenate([trial[None], trial + shifts]))
            new = _cost(batch[0], trial, problem)
            if new < cost:
                gain = cost - new
                theta, cost, residuals = trial, new, batch[0]
                jacobian = (batch[1:] - batch[0]).T / _STEP
                damping = max(0.2 * damping, 1e-6)
                break
            damping *= 8.0
        if gain < 0.02:
            break
    return theta, residuals, jacobian


def _cost(residuals: Array, theta: Array, problem: _Problem) -> float:
    away = (theta - problem.mean) / problem.sd
    return float(residuals @ residuals + away @ away)
