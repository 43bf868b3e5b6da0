"""Fit of kinds of shape to pressed pads: least squares through the foam, with known noise.

The parameters of the object are size, form and pose in the plane of the pads. The others are the
depth at each level of the load, and values of foam, sensor and opening. All have a prior. The
marginal likelihood (Laplace's approximation) then compares kinds with different numbers of
parameters.

For the fusion of several grasps, a fit becomes `KindEvidence`. Position, turn, depths and the form
beyond the thickness are integrated out, each with its prior. Two parts remain: the logarithm of the
half thickness, and the common values of a cell's grasps (foam, gain, spread, zero of the opening).
Their priors are divided out, so that several grasps can be multiplied and each prior counts once.

No pad follows the law of `recognition.shape.foam` exactly, and a foam is often not known well. So
every kind of shape is fitted under several foams. These are the known foam, separate columns of
another stiffness, and columns that push each other in, nearly like an elastic body. The answers are
weighted by their fit to the grasp.

The known foam is first. If the two likeliest kinds gain nothing by another foam, no other foam is
tried. A kind that was much less likely under the last foam is not tried under a further one. It
keeps the parameters of its last fit, at which its evidence is a lower bound. Grasps are fused for
each hypothesis, so each needs a value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recognition.shape.foam import FoamModel
from recognition.shape.models import SHAPE_MODELS, ShapeModel
from recognition.shape.pressed_pads import PressedPads
from recognition.shape.residuals import FOAM, PadUncertainty, ShapeProblem

Array = NDArray[np.float64]
Faces = tuple[tuple[int, ...], ...]
"""Numbers of the grasps of each thickness."""

_STEPS = 40
"""Most evaluations of a fit."""
_ENOUGH = 1e-3
"""Largest relative decrease of the cost, a sum of squares over variances, of a converged fit."""


def misfit_of(
    squared: NDArray[np.float64], informative: NDArray[np.bool_], n_determined: float
) -> float:
    """Return the squared residual per degree of freedom: 1 if the noise explains it.

    Untouched taxels fit any shape. On pads with little noise they would hide a bad fit, so the
    value of the informative data is used if it is larger.

    Parameters
    ----------
    squared : (n_data,)
        Squared residuals over their variances.
    informative : (n_data,)
        Whether each depends on a shape: not those of untouched taxels.
    n_determined
        Number of parameters that the data determine, not the prior.
    """
    overall = float(squared.sum()) / max(1.0, len(squared) - n_determined)
    by_shape = float(squared[informative].sum()) / max(1.0, int(informative.sum()) - n_determined)
    return max(overall, by_shape)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeFit:
    """Fit of one kind of shape."""

    model: ShapeModel
    """The kind."""
    theta: Array
    """(n,) float64: parameters: log of the half thickness in mm, the model's own, then pose,
    depths, foam."""
    normal: Array
    """(n, n) float64: J^T J of the data alone, with the Jacobian J of the scaled residuals r."""
    gradient: Array
    """(n,) float64: J^T r of the data alone."""
    prior_mean: Array
    prior_sd: Array
    """(n,) float64: the prior."""
    chi2: float
    """Sum of the squared residuals of the data over their variances."""
    misfit: float
    """Squared residual per degree of freedom, see `recognition.shape.fit`."""
    n_shared: int
    """Number of the last parameters, which are common to all grasps of a cell."""

    def at_scale(self, scale: float) -> "ShapeFit":
        """Return the fit with ``scale`` times the variances of the data.

        It is one Gauss-Newton step: with a larger scale the prior has more weight.
        """
        away = self.prior_sd**-2 * (self.theta - self.prior_mean)
        precision = self.normal / scale + np.diag(self.prior_sd**-2)
        step = -np.linalg.solve(precision, self.gradient / scale + away)
        return replace(
            self,
            theta=self.theta + step,
            gradient=self.gradient + self.normal @ step,
            chi2=max(0.0, self.chi2 + float(step @ (2.0 * self.gradient + self.normal @ step))),
        )


def fit_shape(
    model: ShapeModel,
    data: PressedPads,
    foam: FoamModel,
    uncertainty: PadUncertainty,
    *,
    near: ShapeFit | None = None,
    pads_of: ShapeFit | None = None,
) -> ShapeFit:
    """Fit one kind of shape: Levenberg-Marquardt from the best of a few starts.

    Parameters
    ----------
    model, data
        The kind of shape, and the pads.
    foam, uncertainty
        Foam and sensor, and the uncertainty of both.
    near
        Start: a fit of the same kind to the same data under another foam.
    pads_of
        Start of foam and depths: a fit of another kind to the same data under this foam.
    """
    problem = ShapeProblem(model, data, foam, uncertainty)
    starts = problem.starts() if near is None else near.theta[None]
    if near is not None and pads_of is not None:
        n_pads = len(FOAM) + problem.n_levels
        starts = np.repeat(starts, 2, axis=0)
        starts[1, -n_pads:] = pads_of.theta[-n_pads:]
    first = (problem.residuals(starts) ** 2).sum(axis=1) if len(starts) > 1 else np.zeros(1)
    theta = starts[int(np.argmin(first))]
    if model.turns:
        # A turn has no preferred value: its prior only bounds it around its start.
        problem.mean[problem.pose + 2] = theta[problem.pose + 2]
    # The cache gives residuals and Jacobian of one computation to both functions.
    around = lru_cache(maxsize=2)(lambda at: problem.around(np.frombuffer(at)))
    prior = np.diag(1.0 / problem.sd)
    theta = least_squares(
        lambda x: np.append(around(x.tobytes())[0], (x - problem.mean) / problem.sd),
        theta,
        jac=lambda x: np.concatenate([around(x.tobytes())[1], prior]),
        x_scale=problem.sd,
        ftol=_ENOUGH,
        xtol=None,
        gtol=None,
        max_nfev=_STEPS,
    ).x
    residuals, jacobian = around(theta.tobytes())
    normal = jacobian.T @ jacobian
    # Residuals are ordered by taxel, then by level; others follow.
    informative = np.ones(len(residuals), dtype=bool)
    informative[: data.share.size] = np.repeat(data.pressed, len(data.share))
    determined = np.trace(np.linalg.solve(normal + np.diag(problem.sd**-2), normal))
    return ShapeFit(
        model=model,
        theta=theta,
        normal=normal,
        gradient=jacobian.T @ residuals,
        prior_mean=problem.mean,
        prior_sd=problem.sd,
        chi2=float(residuals @ residuals),
        misfit=misfit_of(residuals * residuals, informative, float(determined)),
        n_shared=problem.n - problem.rest,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KindEvidence:
    """Log likelihood of one kind: ``level + eta @ s - s @ precision @ s / 2``.

    The first of the m parameters s is the logarithm of the half thickness in mm, the others are
    those of the cell.
    """

    kind: str
    """Kind of shape."""
    level: float
    eta: Array
    precision: Array
    """Scalar, (m,) and (m, m) float64."""
    prior_mean: Array
    prior_sd: Array
    """(m,) float64: the prior of s."""
    log_prior: float
    """Logarithm of the prior probability of the hypothesis."""
    log_half_mm: float
    """The likeliest logarithm of the half thickness in mm, by this grasp alone."""
    dimensions_m: Mapping[str, float]
    """Dimensions in m by their names, by this grasp alone; the thickness is the first."""

    def scattered(self, sd_m: float) -> "KindEvidence":
        """Return the same with a further error of the thickness in m, only of this grasp."""
        sd = sd_m / (2e-3 * np.exp(self.log_half_mm))
        column = self.precision[0]
        weight = float(column[0]) + sd**-2
        return replace(
            self,
            level=self.level
            + float(0.5 * self.eta[0] ** 2 / weight - 0.5 * np.log(weight * sd * sd)),
            eta=self.eta - column * (self.eta[0] / weight),
            precision=self.precision - np.outer(column, column) / weight,
        )

    def tempered(self, share: float) -> "KindEvidence":
        """Return the same with the weight of a ``share`` of a grasp."""
        return replace(
            self, level=share * self.level, eta=share * self.eta, precision=share * self.precision
        )


def evidence_of(fit: ShapeFit, scale: float, log_prior: float = 0.0) -> KindEvidence:
    """Return the evidence of a fit, with ``scale`` times the variances of its data.

    The scale is above 1 if no kind fits within the noise.
    """
    fit, n = fit.at_scale(scale), len(fit.theta)
    shared = np.r_[0, n - fit.n_shared : n]
    integrated = np.setdiff1d(np.arange(n), shared)
    precision = fit.normal / scale + np.diag(fit.prior_sd**-2)
    cross = precision[np.ix_(integrated, shared)]
    inner = precision[np.ix_(integrated, integrated)]
    left = precision[np.ix_(shared, shared)] - cross.T @ np.linalg.solve(inner, cross)
    at, mean, weight = fit.theta[shared], fit.prior_mean[shared], fit.prior_sd[shared] ** -2
    away = (fit.theta - fit.prior_mean) / fit.prior_sd
    _, volume = np.linalg.slogdet(inner)
    peak = (
        -0.5 * (fit.chi2 / scale + away @ away + volume)
        - np.log(np.delete(fit.prior_sd, shared)).sum()
    )
    return KindEvidence(
        kind=fit.model.kind,
        level=float(peak - 0.5 * at @ left @ at + 0.5 * mean @ (weight * mean)),
        eta=left @ at - weight * mean,
        precision=left - np.diag(weight),
        prior_mean=mean,
        prior_sd=fit.prior_sd[shared],
        log_prior=log_prior,
        log_half_mm=float(at[0]),
        dimensions_m=fit.model.dimensions_m(
            1e-3 * float(np.exp(fit.theta[0])), fit.theta[1 : fit.model.n_own]
        ),
    )


def joint_evidence(
    items: Sequence[KindEvidence], faces: Faces = ((0,),)
) -> tuple[float, Array, Array]:
    """Return log evidence, and mean and deviation (n_faces,) of each log half thickness in mm.

    The log evidence is the marginal likelihood up to a term that is common to all kinds.

    Parameters
    ----------
    items
        One kind under one foam, in each grasp.
    faces
        Numbers of the grasps of each thickness.
    """
    first, n_faces = items[0], len(faces)
    n = n_faces + len(first.prior_mean) - 1
    mean = np.r_[np.full(n_faces, first.prior_mean[0]), first.prior_mean[1:]]
    sd = np.r_[np.full(n_faces, first.prior_sd[0]), first.prior_sd[1:]]
    precision, eta = np.diag(sd**-2), mean / sd**2
    level = -0.5 * float((mean / sd) @ (mean / sd)) - float(np.log(sd).sum())
    for number, face in enumerate(faces):
        places = np.r_[number, n_faces:n]
        for i in face:
            precision[np.ix_(places, places)] += items[i].precision
            eta[places] += items[i].eta
            level += items[i].level
    covariance = np.linalg.inv(precision)
    means = covariance @ eta
    _, volume = np.linalg.slogdet(precision)
    log_evidence = level + 0.5 * float(eta @ means) - 0.5 * float(volume)
    return log_evidence, means[:n_faces], np.sqrt(np.diag(covariance)[:n_faces])


_KNOWN_PROBABILITY = 0.5
"""Prior probability of the known foam."""
_SIDEWAYS = 0.7
"""`FoamModel.sideways` of columns that push each other in."""
_LOOSE = PadUncertainty(
    modulus=1.5,
    gain=0.2,
    spread=0.35,
    stiffening=1.5,
    bend=0.12,
    aperture_m=math.hypot(0.2e-3, 0.25e-3),
    aperture_jitter_m=0.12e-3,
)
"""Uncertainty of an unknown foam, under which the depth of both pads together is uncertain, too."""
_FAR = 12.0
"""Deficit of the logarithmic evidence from which a kind is not fitted under a further foam."""
_SURE = 3.0
"""Least excess of the logarithmic evidence of the known foam with which others are not tried."""
_N_PROBED = 2
"""Number of the likeliest kinds that are tried first under a second foam."""


Fits = dict[str, ShapeFit]
"""Fits by kind of shape."""


def all_fits(data: PressedPads, foam: FoamModel) -> tuple[list[ShapeFit], list[float]]:
    """Return fits of all kinds under all possible foams, and logarithms of prior probabilities.

    The order is the same for all grasps: all kinds for each foam.
    """
    others = [replace(foam, sideways=sideways) for sideways in (0.0, _SIDEWAYS)]
    each_other = (1.0 - _KNOWN_PROBABILITY) / len(others)
    last: Fits = {
        kind: fit_shape(model, data, foam, PadUncertainty()) for kind, model in SHAPE_MODELS.items()
    }
    fits = list(last.values())
    evidence = _evidence(last)
    probed: Fits = {}
    for kind in sorted(evidence, key=lambda kind: -evidence[kind])[:_N_PROBED]:
        probed[kind] = _fit(kind, data, others[0], last)
    gain = max(_evidence(probed).values()) - max(evidence.values())
    sure = gain + np.log(each_other / _KNOWN_PROBABILITY) < -_SURE
    for number, other in enumerate(others):
        here: Fits = {}
        evidence = _evidence(last)
        least = max(evidence.values()) - _FAR if number else -math.inf
        pads_of: ShapeFit | None = None
        for kind in SHAPE_MODELS:
            if number == 0 and kind in probed:
                here[kind] = probed[kind]
            elif sure or evidence[kind] < least:
                # The last fit, with the priors of this foam.
                sd = ShapeProblem(last[kind].model, data, other, _LOOSE).sd
                here[kind] = replace(last[kind], prior_sd=sd)
            else:
                here[kind] = _fit(kind, data, other, last, pads_of)
            pads_of = here[kind]
        last = here
        fits += here.values()
    log_prior = np.log(np.repeat([_KNOWN_PROBABILITY, each_other, each_other], len(SHAPE_MODELS)))
    return fits, log_prior.tolist()


def _fit(
    kind: str, data: PressedPads, foam: FoamModel, last: Fits, pads_of: ShapeFit | None = None
) -> ShapeFit:
    return fit_shape(SHAPE_MODELS[kind], data, foam, _LOOSE, near=last[kind], pads_of=pads_of)


def _evidence(fits: Mapping[str, ShapeFit]) -> dict[str, float]:
    scale = max(1.0, min(fit.misfit for fit in fits.values()))
    return {kind: joint_evidence([evidence_of(fit, scale)])[0] for kind, fit in fits.items()}
