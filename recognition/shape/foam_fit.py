"""Foam calibration: stiffness of the foam and gain of the sensor from grasps of a known shape.

One grasp gives the depth of a known surface (from the opening), the commanded force, and the
readings of the taxels. Common parameters of all grasps are modulus, gain, spread of the pressure,
stiffening of the foam and the offset of the opening. Each grasp has its pose in the plane of the
pads and the depth at each level of the load: it is a `recognition.shape.residuals.ShapeProblem`
whose shape is drawn. The push between columns is chosen from a few values.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recognition.errors import ContactError
from recognition.grasp import Grasp
from recognition.ramp.ramp import learn_rest
from recognition.shape.fit import Linearisation, minimise, misfit_of, n_determined
from recognition.shape.foam import FoamModel
from recognition.shape.models import Drawing, drawn_model
from recognition.shape.pressed_pads import PressedPads, reduce_to_pads
from recognition.shape.residuals import FOAM, PadUncertainty, ShapeProblem

Array = NDArray[np.float64]

SIDEWAYS = (0.0, 0.4, 0.7)
"""No, some, much push between columns; the best fit is used (`FoamModel.sideways`)."""

_TRUST = PadUncertainty(
    modulus=1.0,
    gain=1.0,
    spread=0.3,
    stiffening=1.0,
    bend=1e-3,
    aperture_m=2e-3,
    aperture_jitter_m=0.08e-3,
)
"""Priors of foam and sensor. The law of the sensor is known, so its bend is 0."""
_GAIN_SD_WITHOUT_FORCE = 0.02
"""That of the log gain without a commanded force: only modulus times gain is known then."""
_GLOBALS = tuple(map(FOAM.index, ("modulus", "gain", "spread", "aperture", "stiffening")))
"""Places of the numbers of `FoamFit.sd` among `FOAM`."""
_STEPS, _TRIALS = 25, 5
"""Most Gauss-Newton steps, and most dampings in one step."""
_LONGEST = 0.7
"""Longest step of one parameter, in its unit."""


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
    return _Fit(data, drawing, foam).run()


class _Fit:
    def __init__(self, data: Sequence[PressedPads], drawing: Drawing, foam: FoamModel) -> None:
        self.data, self.foam, self.scale = data, foam, 1.0
        knows_force = all(np.isfinite(d.force_n) and d.force_n > 0.0 for d in data)
        # Without a force only the product of modulus and gain is known.
        trust = _TRUST if knows_force else replace(_TRUST, gain=_GAIN_SD_WITHOUT_FORCE)
        self.problems, starts = zip(
            *(_placed(one, drawing, foam, trust) for one in data), strict=True
        )
        n_own = self.problems[0].rest
        common = self.problems[0].mean[n_own:].copy()
        common[FOAM.index("aperture")] = 1e3 * foam.aperture_offset_m
        self.mean, self.start, self.sd = (
            np.concatenate([first, *(one[:n_own] for one in each)])
            for first, each in (
                (common, [problem.mean for problem in self.problems]),
                (common, starts),
                (self.problems[0].sd[n_own:], [problem.sd for problem in self.problems]),
            )
        )

    def run(self) -> FoamFit:
        theta = self.start
        fits: list[tuple[float, FoamFit]] = []
        found: list[Array] = []
        separate, some, much = SIDEWAYS
        for sideways in (separate, much, some):
            if sideways == some and fits[1][0] > fits[0][0]:
                break
            cost, theta, fit = self._minimise(theta, sideways)
            fits.append((cost, fit))
            found.append(theta)
        best = min(range(len(fits)), key=lambda number: fits[number][0])
        fit, theta = fits[best][1], found[best]
        if fit.misfit > 1.0:
            # With a larger misfit the prior has more weight.
            self.scale = fit.misfit
            again = self._minimise(theta, fit.foam.sideways)[2]
            fit = replace(again, misfit=max(fit.misfit, again.misfit))
        return fit

    def _minimise(self, theta: Array, sideways: float) -> tuple[float, Array, FoamFit]:
        for problem in self.problems:
            problem.foam = replace(self.foam, sideways=sideways)
        theta, cost, found = minimise(
            self._linearise,
            theta,
            self.mean,
            self.sd,
            steps=_STEPS,
            trials=_TRIALS,
            longest=_LONGEST,
        )
        each = np.split(found.residuals, len(self.data))
        informative = [d.informative(len(r)) for d, r in zip(self.data, each, strict=True)]
        squared = self.scale * found.residuals * found.residuals
        misfit = misfit_of(
            squared, np.concatenate(informative), n_determined(found.normal, self.sd)
        )
        covariance = np.linalg.inv(found.normal + np.diag(self.sd**-2))
        common = dict(zip(FOAM, theta.tolist(), strict=False))
        foam = replace(
            self.foam,
            sideways=sideways,
            modulus_pa=self.foam.modulus_pa * math.exp(common["modulus"]),
            gain=self.foam.gain * math.exp(common["gain"]),
            spread_m=self.foam.spread_m * math.exp(common["spread"]),
            aperture_offset_m=1e-3 * common["aperture"],
            densification=self.foam.densification * math.exp(common["stiffening"]),
        )
        fit = FoamFit(
            foam=foam,
            sd=np.sqrt(np.diag(covariance)[list(_GLOBALS)]),
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
                away = float(residuals[data.share.size :][: len(data.share)].mean())
                squared += self.scale * (away * _TRUST.aperture_jitter_m) ** 2
        return float(np.sqrt(squared / (len(each) - 1)))

    def _linearise(self, theta: Array) -> Linearisation:
        """Return the linearisation of all grasps; each has its own parameters, too."""
        n_common = len(FOAM)
        normal, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        each = []
        owns = theta[n_common:].reshape(len(self.data), -1)
        for i, (problem, own) in enumerate(zip(self.problems, owns, strict=True)):
            residuals, jacobian = problem.around(np.concatenate([own, theta[:n_common]]))
            weight = self.scale**-0.5
            here = Linearisation.of(weight * residuals, weight * jacobian)
            first = n_common + i * len(own)
            where = np.r_[first : first + len(own), :n_common]
            normal[np.ix_(where, where)] += here.normal
            gradient[where] += here.gradient
            each.append(here.residuals)
        return Linearisation(residuals=np.concatenate(each), normal=normal, gradient=gradient)


def _placed(
    data: PressedPads, drawing: Drawing, foam: FoamModel, trust: PadUncertainty
) -> tuple[ShapeProblem, Array]:
    """Return the problem of one grasp in its likeliest roll, and the start of its fit."""
    step_rad = drawing.roll_step_rad
    best, found = math.inf, None
    for roll_rad in step_rad * np.arange(round(math.pi / step_rad)) if step_rad else (0.0,):
        model = drawn_model(drawing, float(roll_rad))
        problem = ShapeProblem(model, data, foam, trust)
        starts = problem.starts()
        starts[:, 0] = model.mean
        costs = (problem.residuals(starts) ** 2).sum(axis=1)
        if costs.min() < best:
            best, found = float(costs.min()), (problem, starts[int(np.argmin(costs))])
    assert found is not None
    problem, start = found
    problem.mean[problem.pose + 2] = start[problem.pose + 2]
    return problem, start
