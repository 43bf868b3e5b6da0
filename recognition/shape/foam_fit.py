"""Foam calibration: stiffness of the foam and gain of the sensor from grasps of a known shape.

One grasp gives the depth of a known surface (from the opening), the commanded force, and the
readings of the taxels. Common parameters of all grasps are modulus, gain, spread of the pressure,
stiffening of the foam and the offset of the opening. Each grasp has its pose in the plane of the
pads and the depth at each level of the load. The fit uses Gauss-Newton steps with damping, and
priors on all parameters. The push between columns is chosen from a few values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recognition.errors import ContactError
from recognition.grasp import Grasp
from recognition.ramp.ramp import learn_rest
from recognition.shape.fit import Linearisation, minimise, misfit_of, n_determined
from recognition.shape.foam import FoamModel, PadBed, closed_columns_m, neighbours
from recognition.shape.models import Drawing, posed
from recognition.shape.pressed_pads import PressedPads, reduce_to_pads

Array = NDArray[np.float64]

GLOBALS = ("modulus", "gain", "spread", "aperture", "stiffening")
"""Parameters that are common to all grasps, in the order of `FoamFit.sd`."""

SIDEWAYS = (0.0, 0.4, 0.7)
"""No, some, much push between columns; the best fit is used (`FoamModel.sideways`)."""

_PRIOR_SD = np.array([1.0, 1.0, 0.3, 2.0, 1.0])
"""Standard deviations of the priors of `GLOBALS`: logarithms, the opening in mm."""
_GAIN_SD_WITHOUT_FORCE = 0.02
"""That of the log gain without a commanded force: only modulus times gain is known then."""
_POSE_SD = np.array([1.5, 1.5, 1.25])
"""The same for the pose of a grasp about its start: x and y in mm, turn in rad."""
_DEPTH_MM, _DEPTH_SD_MM = 1.2, 1.0
"""Mean and standard deviation of the prior of a depth in mm."""
_STEP = 1e-3
"""Step of the numerical derivative, in the unit of each parameter."""
_STEPS, _TRIALS = 25, 5
"""Most Gauss-Newton steps, and most dampings in one step."""
_LONGEST = 0.7
"""Longest step of one parameter, in its unit."""
_COLUMN_STEPS = 8
"""Number of steps of the solver for columns that push each other in."""
_APERTURE_JITTER_M = 0.08e-3
"""Standard deviation in m of the opening at one level."""
_FORCE_SD, _FORCE_FLOOR_N = 0.06, 0.15
"""Standard deviation of the commanded force, as a share of it and in N."""
_CELL_M = 0.75e-3
"""Longest side in m of a cell of the pressure grid."""
_TRIAL_DEPTHS_MM = np.linspace(0.05, 2.7, 12)
"""Depths in mm for the interpolation of the levels' depths at the start."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoamFit:
    """Foam and sensor after the calibration on the gauge."""

    foam: FoamModel
    """Foam and sensor."""
    sd: Array
    """(5,) float64: standard deviation of log modulus, log gain, log spread, of the offset in mm,
    and of log densification."""
    misfit: float
    """Squared residual per degree of freedom: 1 if the model fits within the noise; see
    `recognition.shape.fit`."""
    opening_sd_m: float
    """Standard deviation of the zero of the opening between grasps in m; 0 without openings."""
    n_grasps: int
    """Number of grasps in the fit."""


def fit_foam(grasps: Sequence[Grasp], drawing: Drawing, start: FoamModel | None = None) -> FoamFit:
    """Calibrate foam and sensor on grasps of one known object.

    Parameters
    ----------
    grasps
        At least two, at different poses or forces.
    start
        Prior mean of the foam.

    Raises
    ------
    ContactError
        Fewer than two of the grasps touched both pads.
    ValueError
        The grasps come from different pads.
    """
    foam = start or FoamModel()
    rest = learn_rest(grasps, most_pads=2)
    data = []
    for grasp in grasps:
        try:
            data.append(reduce_to_pads(grasp, replace(foam, aperture_offset_m=0.0), rest))
        except ContactError:
            continue
    if len(data) < 2:
        raise ContactError(
            f"{len(data)} of {len(grasps)} grasps of the gauge touched both pads, at least 2 are "
            "needed: grasp it again"
        )
    return _Fit(data, drawing, foam, grasps[0], rest.gripping[0]).run()


class _Fit:
    def __init__(
        self,
        data: Sequence[PressedPads],
        drawing: Drawing,
        foam: FoamModel,
        grasp: Grasp,
        pad: int,
    ) -> None:
        self.data, self.drawing, self.foam = data, drawing, foam
        self.pads, self.pad = grasp.pads, pad
        self.n_levels = len(data[0].share)
        knows_force = all(np.isfinite(d.force_n) and d.force_n > 0.0 for d in data)
        common_sd = _PRIOR_SD.copy()
        if not knows_force:
            # Without a force only the product of modulus and gain is known.
            common_sd[1] = _GAIN_SD_WITHOUT_FORCE
        own_sd = np.concatenate([_POSE_SD, np.full(self.n_levels, _DEPTH_SD_MM)])
        self.sd = np.concatenate([common_sd, np.tile(own_sd, len(data))])
        self.rolls = [0.0] * len(data)
        self.scale = 1.0

    def run(self) -> FoamFit:
        theta = self._start()
        fits: list[tuple[float, FoamFit]] = []
        found: list[Array] = []
        separate, some, much = SIDEWAYS
        for sideways in (separate, much, some):
            if sideways == some and fits[1][0] > fits[0][0]:
                break
            self.foam = replace(self.foam, sideways=sideways)
            cost, theta, fit = self._minimise(theta)
            fits.append((cost, fit))
            found.append(theta)
        best = min(range(len(fits)), key=lambda number: fits[number][0])
        fit, theta = fits[best][1], found[best]
        if fit.misfit > 1.0:
            # With a larger misfit the prior has more weight.
            self.foam, self.scale = replace(self.foam, sideways=fit.foam.sideways), fit.misfit
            again = self._minimise(theta)[2]
            fit = replace(again, misfit=max(fit.misfit, again.misfit))
        return fit

    def _minimise(self, theta: Array) -> tuple[float, Array, FoamFit]:
        theta, cost, found = minimise(
            self._linearise,
            theta,
            self.mean,
            self.sd,
            steps=_STEPS,
            trials=_TRIALS,
            longest=_LONGEST,
        )
        each = np.split(found.residuals, self.ends)
        misfit = misfit_of(
            self.scale * found.residuals * found.residuals,
            np.concatenate([d.informative(len(r)) for d, r in zip(self.data, each, strict=True)]),
            n_determined(found.normal, self.sd),
        )
        covariance = np.linalg.inv(found.normal + np.diag(self.sd**-2))
        fit = FoamFit(
            foam=self._foam(theta[: len(GLOBALS)]),
            sd=np.sqrt(np.diag(covariance)[: len(GLOBALS)]),
            misfit=misfit,
            opening_sd_m=self._opening_sd_m(each),
            n_grasps=len(self.data),
        )
        return cost, theta, fit

    def _opening_sd_m(self, each: Sequence[Array]) -> float:
        """Return the error of openings in single grasps, beyond the common zero."""
        squared = 0.0
        for data, residuals in zip(self.data, each, strict=True):
            if np.isfinite(data.aperture_m).all():
                start = data.share.size
                away = float(residuals[start : start + self.n_levels].mean())
                squared += self.scale * (away * _APERTURE_JITTER_M) ** 2
        return float(np.sqrt(squared / (len(each) - 1)))

    def _foam(self, common: Array) -> FoamModel:
        return replace(
            self.foam,
            modulus_pa=self.foam.modulus_pa * float(np.exp(common[0])),
            gain=self.foam.gain * float(np.exp(common[1])),
            spread_m=self.foam.spread_m * float(np.exp(common[2])),
            aperture_offset_m=1e-3 * float(common[3]),
            densification=self.foam.densification * float(np.exp(common[4])),
        )

    def _start(self) -> Array:
        common = np.zeros(len(GLOBALS))
        common[3] = 1e3 * self.foam.aperture_offset_m
        bed = self._bed(common)
        rows, lengths = [], []
        for i, data in enumerate(self.data):
            _, axes = np.linalg.eigh(data.spread_m2)
            turn = float(np.arctan2(axes[1, 1], axes[0, 1]))
            step_rad = self.drawing.roll_step_rad
            rolls = step_rad * np.arange(round(np.pi / step_rad)) if step_rad else np.zeros(1)
            best = np.inf
            for roll in rolls:
                self.rolls[i] = float(roll)
                for angle in turn + np.pi * np.array([0.0, 0.5, 0.25, -0.25]):
                    own = np.array([*(1e3 * data.centre_m), angle, *[_DEPTH_MM] * self.n_levels])
                    own[3:] = self._depths(i, bed, own)
                    residuals = self._residuals(i, bed, common, own, self._reach(i, own, bed))
                    if float(residuals @ residuals) < best:
                        best, chosen, roll_chosen = float(residuals @ residuals), own, float(roll)
            self.rolls[i] = roll_chosen
            rows.append(chosen)
            lengths.append(len(residuals))
        self.ends = np.cumsum(lengths)[:-1]
        theta = np.concatenate([common, *rows])
        for row in rows:
            row[3:] = _DEPTH_MM
        self.mean = np.concatenate([common, *rows])
        return theta

    def _bed(self, common: Array) -> PadBed:
        spread_m = self.foam.spread_m * float(np.exp(common[2]))
        return PadBed(self.pads, self.pad, spread_m, cell_m=_CELL_M)

    def _reach(self, i: int, own: Array, bed: PadBed) -> tuple[Array, float]:
        """Return the depth of the surface below its top in m, and the thickness in m."""
        near, far = posed(
            self.drawing,
            bed.x_m,
            bed.y_m,
            at_m=(1e-3 * float(own[0]), 1e-3 * float(own[1])),
            rotation_rad=float(own[2]),
            roll_rad=self.rolls[i],
        )
        thick_m = float(near.max() + far.max())
        lag_m = np.where(np.isfinite(near), near.max() - near, 1.0)
        return lag_m, thick_m if np.isfinite(thick_m) else 0.0

    def _forces_n(
        self,
        bed: PadBed,
        lag_m: Array,
        depth_mm: Array,
        modulus_pa: float,
        log_stiffening: float = 0.0,
    ) -> Array:
        near = lag_m < self.foam.thickness_m
        rows, columns = near.any(axis=1), near.any(axis=0)
        closed_m = closed_columns_m(
            1e-3 * depth_mm[:, None, None] - lag_m[np.ix_(rows, columns)],
            1.0,
            self.foam.sideways,
            (
                neighbours(bed.x_m[rows, 0], self.foam.sideways_m),
                neighbours(bed.y_m[0, columns], self.foam.sideways_m),
            ),
            steps=_COLUMN_STEPS if self.foam.sideways else 0,
        )
        pressure = self.foam.relative_pressure(closed_m, float(np.exp(log_stiffening)))
        forces = bed.along[:, rows] @ (pressure @ bed.across[:, columns].T)
        return modulus_pa * bed.cell_area_m2 * forces.reshape(len(depth_mm), -1)

    def _depths(self, i: int, bed: PadBed, own: Array) -> Array:
        forces = self._forces_n(
            bed, self._reach(i, own, bed)[0], _TRIAL_DEPTHS_MM, self.foam.modulus_pa
        )
        load = self.foam.response(forces).sum(axis=1)
        depths_mm: Array = np.interp(self.data[i].share.sum(axis=1), load, _TRIAL_DEPTHS_MM)
        return depths_mm

    def _residuals(
        self, i: int, bed: PadBed, common: Array, own: Array, reach: tuple[Array, float]
    ) -> Array:
        data = self.data[i]
        lag_m, thick_m = reach
        modulus_pa = self.foam.modulus_pa * float(np.exp(common[0]))
        forces_n = self._forces_n(bed, lag_m, own[3:], modulus_pa, float(common[4]))
        share = self.foam.response(forces_n * float(np.exp(common[1])))
        parts = [(data.whitener @ (share - data.share).T[..., None]).ravel()]
        if np.isfinite(data.aperture_m).all():
            shown_m = thick_m - 2e-3 * own[3:] + 1e-3 * common[3]
            parts.append((shown_m - data.aperture_m) / _APERTURE_JITTER_M)
        if np.isfinite(data.force_n) and data.force_n > 0.0:
            total_n = float(forces_n[-1].sum())
            parts.append(
                np.array([(total_n - data.force_n) / (_FORCE_SD * data.force_n + _FORCE_FLOOR_N)])
            )
        return np.concatenate(parts) / float(np.sqrt(self.scale))

    def _linearise(self, theta: Array) -> Linearisation:
        """Return the linearisation of all grasps; each has its own parameters, too."""
        n_common = len(GLOBALS)
        common = theta[:n_common]
        bed = self._bed(common)
        wider = common + _STEP * np.eye(n_common)
        wide_bed = self._bed(wider[2])
        normal, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        each = []
        for i, own in enumerate(theta[n_common:].reshape(len(self.data), -1)):
            reach = self._reach(i, own, bed)
            base = self._residuals(i, bed, common, own, reach)
            columns = [
                self._residuals(i, wide_bed if k == 2 else bed, wider[k], own, reach)
                for k in range(n_common)
            ]
            for k in range(len(own)):
                moved = own.copy()
                moved[k] += _STEP
                there = self._reach(i, moved, bed) if k < 3 else reach
                columns.append(self._residuals(i, bed, common, moved, there))
            here = Linearisation.of(base, (np.array(columns) - base).T / _STEP)
            where = np.r_[:n_common, n_common + i * len(own) : n_common + (i + 1) * len(own)]
            normal[np.ix_(where, where)] += here.normal
            gradient[where] += here.gradient
            each.append(base)
        return Linearisation(residuals=np.concatenate(each), normal=normal, gradient=gradient)
