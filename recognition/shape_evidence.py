"""What a grasp tells of one hypothesis, as a Gaussian: of the thickness, and what its cell shares.

A hypothesis is a kind of shape, and where several foams are possible a kind on one of these.

Position, turn, depths and the form beyond the thickness are integrated out, each with its prior.
What is left depends on the logarithm of the half thickness and on what all grasps of a cell have
in common: foam, gain, spread and the zero of the opening. Their priors are divided out, so that
several grasps can be multiplied and each prior counted once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recognition.shape_fit import ShapeFit

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KindEvidence:
    """Log likelihood of one kind: ``level + eta @ s - s @ precision @ s / 2``.

    The first of the m parameters s is the logarithm of the half thickness in mm, the others are
    those of the cell.

    Attributes
    ----------
    kind
        Kind of shape.
    level, eta, precision
        Scalar, (m,) and (m, m) float64.
    prior_mean, prior_sd : (m,) float64
        The prior of s.
    log_prior
        Logarithm of how likely the hypothesis is before anything is gripped.
    log_half_mm
        The likeliest logarithm of the half thickness in mm, by this grasp alone.
    dimensions_m
        Dimensions in m by their names, by this grasp alone; the thickness is the first.
    """

    kind: str
    level: float
    eta: Array
    precision: Array
    prior_mean: Array
    prior_sd: Array
    log_prior: float
    log_half_mm: float
    dimensions_m: Mapping[str, float]

    def scattered(self, sd_m: float) -> "KindEvidence":
        """Return the same with a further error of the thickness in m in this grasp alone."""
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
        """Return the same, counting as a ``share`` of a grasp."""
        return replace(
            self,
            level=share * self.level,
            eta=share * self.eta,
            precision=share * self.precision,
        )


def evidence_of(fit: ShapeFit, scale: float, log_prior: float = 0.0) -> KindEvidence:
    """Return what a fit tells, its data's variances ``scale`` times as large."""
    n = len(fit.theta)
    kept = np.r_[0, n - fit.n_shared : n]
    gone = np.setdiff1d(np.arange(n), kept)
    precision = fit.normal / scale + np.diag(fit.prior_sd**-2)
    cross = precision[np.ix_(gone, kept)]
    inner = precision[np.ix_(gone, gone)]
    left = precision[np.ix_(kept, kept)] - cross.T @ np.linalg.solve(inner, cross)
    at, mean, weight = fit.theta[kept], fit.prior_mean[kept], fit.prior_sd[kept] ** -2
    away = (fit.theta - fit.prior_mean) / fit.prior_sd
    _, volume = np.linalg.slogdet(inner)
    peak = (
        -0.5 * (fit.chi2 / scale + away @ away + volume)
        - np.log(np.delete(fit.prior_sd, kept)).sum()
    )
    return KindEvidence(
        kind=fit.model.kind,
        level=float(peak - 0.5 * at @ left @ at + 0.5 * mean @ (weight * mean)),
        eta=left @ at - weight * mean,
        precision=left - np.diag(weight),
        prior_mean=mean,
        prior_sd=fit.prior_sd[kept],
        log_prior=log_prior,
        log_half_mm=float(at[0]),
        dimensions_m=fit.dimensions_m(),
    )
