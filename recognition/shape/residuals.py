"""Residuals of one kind of shape: modelled against measured readings, opening and force."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.shape.foam import FoamModel, closed_columns_m, neighbours
from recognition.shape.models import ShapeModel
from recognition.shape.pressed_pads import SPREAD_STEP, SPREAD_STEPS, PressedPads

Array = NDArray[np.float64]
Fine = NDArray[np.floating[Any]]
"""Fields over the pad: of single precision."""

FOAM = ("modulus", "gain", "spread", "stiffening", "bend", "aperture")
"""The last parameters of every fit: logarithms of factors, then mm of opening."""

_FINE = np.float32
"""Type of the fields: half the time of float64; its rounding is far below the noise."""
_STEP = 2e-3
"""Step of the numerical derivative, in the unit of each parameter."""
_STEPS = 8
"""Number of steps of the solver for columns that push each other in."""
_FEW_STEPS = 4
"""The same from a solution for similar parameters."""
_POSITION_SD_MM = 1.5
"""Standard deviation of the prior of the position in mm, about the centre of the load."""
_TURN_SD = float(np.sqrt(np.pi / 2.0))
"""That of the turn in rad: wide, it only bounds the turn."""
_DEPTH_MM, _DEPTH_SD_MM = 1.2, 1.0
"""Mean and standard deviation of the prior of a depth in mm."""
_FORCE_FLOOR_N = 0.15
"""Standard deviation of the commanded force in N, in addition to its share."""
_START_DEPTHS_MM = np.array([0.1, 0.4, 0.8, 1.2, 1.6, 2.0, 2.5])
"""Depths in mm for the interpolation of the levels' depths at the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PadUncertainty:
    """Uncertainty of foam, sensor and opening."""

    modulus: float = 0.1
    gain: float = 0.1
    spread: float = 0.05
    stiffening: float = 0.1
    """Standard deviation of the logarithm of modulus, gain, spread and densification."""
    bend: float = 0.02
    """Standard deviation of the logarithm of an exponent of the reading: 0 follows the law."""
    aperture_m: float = 0.2e-3
    """Standard deviation in m of the opening, constant in one grasp."""
    aperture_jitter_m: float = 0.06e-3
    """Standard deviation in m of the opening at one level."""
    force: float = 0.06
    """Relative standard deviation of the commanded force."""


class ShapeProblem:
    """Residuals of one kind on one grasp, for many sets of parameters at once."""

    def __init__(
        self, model: ShapeModel, data: PressedPads, foam: FoamModel, uncertainty: PadUncertainty
    ) -> None:
        self.model, self.data, self.foam, self.uncertainty = model, data, foam, uncertainty
        self.n_levels = len(data.share)
        self.pose = model.n_own
        self.depth = self.pose + 2 + int(model.turns)
        self.rest = self.depth + self.n_levels
        self.n = self.rest + len(FOAM)
        prior = [
            *model.prior,
            *((centre_mm, _POSITION_SD_MM) for centre_mm in 1e3 * data.centre_m),
            *[(0.0, _TURN_SD)] * int(model.turns),
            *[(_DEPTH_MM, _DEPTH_SD_MM)] * self.n_levels,
            *((0.0, getattr(uncertainty, name)) for name in FOAM[:-1]),
            (0.0, 1e3 * uncertainty.aperture_m),
        ]
        self.mean, self.sd = np.array(prior).T.copy()
        bed = data.bed
        self._x_m, self._y_m = bed.x_m.astype(_FINE), bed.y_m.astype(_FINE)
        self._pushes = (
            neighbours(bed.x_m[:, 0], foam.sideways_m).astype(_FINE),
            neighbours(bed.y_m[0], foam.sideways_m).astype(_FINE),
        )
        self._has_aperture = bool(np.isfinite(data.aperture_m).all())
        self._has_force = bool(np.isfinite(data.force_n)) and data.force_n > 0.0
        cells = data.bed.x_m[:, 0]
        self._cell_m = float(abs(cells[1] - cells[0])) if len(cells) > 1 else 1e-3

    def _closed(
        self, theta: Array, depths: slice, start_m: Fine | None = None
    ) -> tuple[Fine, Fine]:
        """Return the closing of columns in m (B, K, n_x, n_y), and the covered share."""
        model = self.model
        at = theta[:, :, None, None].astype(_FINE)
        h_m = 1e-3 * np.exp(at[:, 0])
        dx_m = self._x_m - 1e-3 * at[:, self.pose]
        dy_m = self._y_m - 1e-3 * at[:, self.pose + 1]
        if model.turns:
            c, s = np.cos(at[:, self.pose + 2]), np.sin(at[:, self.pose + 2])
            dx_m, dy_m = c * dx_m + s * dy_m, c * dy_m - s * dx_m
        u_m, v_m = np.broadcast_arrays(dx_m, dy_m)
        lag_m, covered = model.surface(h_m, at[:, 1 : model.n_own], u_m, v_m, self._cell_m)
        # The depth of the surface in the foam.
        closed_m: Fine = 1e-3 * at[:, depths] - lag_m[:, None]
        covered = covered[:, None]
        if self.foam.sideways:
            closed_m = closed_columns_m(
                closed_m,
                covered,
                self.foam.sideways,
                self._pushes,
                steps=_STEPS if start_m is None else _FEW_STEPS,
                start_m=start_m,
            )
        return closed_m, covered

    def forces_n(self, theta: Array, depths: slice | None = None) -> Array:
        """Return forces (B, K, n_taxels) in N.

        Parameters
        ----------
        theta : (B, n)
            Parameters.
        depths
            Selected depths; all by default.
        """
        closed_m, covered = self._closed(theta, depths or slice(self.depth, self.rest))
        pressure = self._relative_pressure(closed_m, covered, theta)
        return self._scaled(self._on_taxels(pressure, theta), theta)

    def _relative_pressure(self, closed_m: Fine, covered: Fine, theta: Array) -> Fine:
        """Return the pressure over the modulus, (B, K, n_x, n_y)."""
        stiffening = np.exp(theta[:, self.rest + 3])[:, None, None, None].astype(_FINE)
        pressure: Fine = self.foam.relative_pressure(closed_m, stiffening)
        pressure *= covered
        return pressure

    def _on_taxels(self, pressure: Fine, theta: Array) -> Fine:
        """Return the pressure on the taxels (B, K, n_taxels) from (B, K, n_x, n_y)."""
        # The transfer of pressure to taxels, interpolated between computed spreads.
        log_factor = theta[:, self.rest + 2]
        place = np.clip(log_factor / SPREAD_STEP + SPREAD_STEPS, 0.0, 2 * SPREAD_STEPS - 1e-9)
        below = place.astype(np.int64)
        share = (place - below)[:, None, None].astype(_FINE)
        along, across = (
            part[below] + share * (part[below + 1] - part[below])
            for part in (self.data.along, self.data.across)
        )
        forces = along[:, None] @ (pressure @ across.transpose(0, 2, 1)[:, None])
        return forces.reshape(*forces.shape[:2], -1)

    def _scaled(self, on_taxels: Fine, theta: Array) -> Array:
        """Return forces in N from pressures on the taxels over the modulus."""
        scale_n = self.data.bed.cell_area_m2 * self.foam.modulus_pa * np.exp(theta[:, self.rest])
        return on_taxels * scale_n[:, None, None]

    def residuals(self, theta: Array, force_n: Array | None = None) -> Array:
        """Return residuals (B, n_data) of the data over their standard deviations.

        ``force_n`` are the `forces_n` of the parameters, if already computed.
        """
        data, uncertainty = self.data, self.uncertainty
        force_n = self.forces_n(theta) if force_n is None else force_n
        taxel_n = np.maximum(force_n, 1e-9) * np.exp(theta[:, self.rest + 1])[:, None, None]
        share = self.foam.response(taxel_n)
        share = share ** np.exp(theta[:, self.rest + 4])[:, None, None]
        away = (share - data.share).transpose(0, 2, 1)[..., None]
        parts = [(data.whitener @ away).reshape(len(theta), -1)]
        if self._has_aperture:
            depth_m = 1e-3 * theta[:, self.depth : self.rest]
            thick_m = 2e-3 * np.exp(theta[:, :1])
            opening_m = thick_m - 2.0 * depth_m + 1e-3 * theta[:, -1:]
            parts.append((opening_m - data.aperture_m) / uncertainty.aperture_jitter_m)
        if self._has_force:
            total_n = force_n[:, -1].sum(axis=1, keepdims=True)
            parts.append(
                (total_n - data.force_n) / (uncertainty.force * data.force_n + _FORCE_FLOOR_N)
            )
        return np.concatenate(parts, axis=1)

    def around(self, theta: Array) -> tuple[Array, Array]:
        """Return residuals (n_data,) and their Jacobian (n_data, n)."""
        shifted = np.concatenate([theta[None], theta + _STEP * np.eye(self.n)])
        batch = self.residuals(shifted, self._shifted_forces_n(shifted))
        return batch[0], (batch[1:] - batch[0]).T / _STEP

    def _shifted_forces_n(self, shifted: Array) -> Array:
        """Return forces (1 + n, K, n_taxels) in N, of parameters and of each of them shifted.

        As `forces_n`, but without repeated work: a depth changes one level, and only size, form and
        pose change the surface.
        """
        surfaces = shifted[: self.depth + 1].copy()
        # Each depth changes its own level, so one more surface is enough for all of them.
        surfaces = np.concatenate([surfaces, surfaces[:1]])
        levels = range(self.depth, self.rest)
        surfaces[-1, levels] = shifted[range(self.depth + 1, self.rest + 1), levels]
        depths, start_m = slice(self.depth, self.rest), None
        if self.foam.sideways:
            start_m = self._closed(shifted[:1], depths)[0][0]
        closed_m, covered = self._closed(surfaces, depths, start_m)
        pressure = self._relative_pressure(closed_m, covered, surfaces)
        on_taxels = self._on_taxels(pressure, surfaces)
        every = np.repeat(on_taxels[:1], len(shifted), axis=0)
        every[: self.depth + 1] = on_taxels[:-1]
        for level, row in enumerate(range(self.depth + 1, self.rest + 1)):
            every[row, level] = on_taxels[-1, level]
        spread, stiffening = (
            slice(1 + self.rest + FOAM.index(name), 2 + self.rest + FOAM.index(name))
            for name in ("spread", "stiffening")
        )
        every[spread] = self._on_taxels(pressure[:1], shifted[spread])
        stiffer = self._relative_pressure(closed_m[:1], covered[:1], shifted[stiffening])
        every[stiffening] = self._on_taxels(stiffer, shifted[stiffening])
        return self._scaled(every, shifted)

    def starts(self) -> Array:
        """Return starting parameters (S, n): sizes from the opening, turns from the load."""
        data, model = self.data, self.model
        if self._has_aperture:
            halves_mm = [max(0.5e3 * float(data.aperture_m[-1]) + 1.2, 0.8)]
        else:
            halves_mm = [3.0, 7.0, 15.0]
        variances, axes = np.linalg.eigh(data.spread_m2)
        # An evenly loaded line of half length a has the variance a^2 / 3.
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
        # The depth of each level is set so that the load is the measured one.
        trial = np.repeat(starts, len(_START_DEPTHS_MM), axis=0)
        trial[:, self.depth : self.rest] = np.tile(_START_DEPTHS_MM, len(starts))[:, None]
        force_n = self.forces_n(trial, slice(self.depth, self.depth + 1))[:, 0]
        loads = self.foam.response(force_n).sum(axis=1).reshape(len(starts), -1)
        measured = data.share.sum(axis=1)
        for theta, load in zip(starts, loads, strict=True):
            theta[self.depth : self.rest] = np.interp(measured, load, _START_DEPTHS_MM)
        return np.array(starts)
