"""Shape and size of a grasped object, with probabilities, also of an object never taught."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp
from recognition.shape.fit import KindEvidence, ShapeFit, evidence_of
from recognition.shape.foam import FoamModel
from recognition.shape.pressed_pads import reduce_to_pads
from recognition.shape.search import all_fits

UNCLEAR = "unclear"
"""The answer if no kind of shape is likely enough, or none fits."""

_MIN_PROBABILITY = 0.5
"""Least probability of a kind as the answer."""
_MAX_MISFIT = 3.0
"""Largest squared residual per degree of freedom of a kind as the answer."""
_90_PERCENT = 1.645
"""Half width of a 90 % interval of a normal distribution in standard deviations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Thickness:
    """One thickness along the closing axis."""

    size_m: float
    low_m: float
    high_m: float
    """The thickness in m, and its 90 % interval."""
    n_grasps: int = 1
    """Number of grasps with this thickness."""

    def __str__(self) -> str:
        return f"{1e3 * self.size_m:.1f} mm ({1e3 * self.low_m:.1f} to {1e3 * self.high_m:.1f})"

    def as_dict(self) -> dict[str, object]:
        """Return plain data, lengths in mm."""
        return {
            "size_mm": 1e3 * self.size_m,
            "interval_mm": [1e3 * self.low_m, 1e3 * self.high_m],
            "n_grasps": self.n_grasps,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeAnswer:
    """Shape and size by one grasp, or by several of one object."""

    kind: str
    """``sphere``, ``oval``, ``cylinder``, ``flat``, ``dumbbell`` or `UNCLEAR`."""
    probability: Mapping[str, float] = field(hash=False)
    """Probability of each kind, given that the object is one of them."""
    size_m: float
    low_m: float
    high_m: float
    """Thickness along the closing axis in m (the diameter of a round object), and its 90 %
    interval, over all kinds."""
    dimensions_m: Mapping[str, float] = field(hash=False)
    """Dimensions of the likeliest kind in m by their names, without interval."""
    misfit: float
    """Squared residual of the best kind per degree of freedom: 1 if it fits within the noise; the
    median of several grasps."""
    thicknesses: tuple[Thickness, ...]
    """All thicknesses of several grasps, thinnest first; the most frequent one is `size_m`. One
    grasp has one."""
    evidence: tuple[KindEvidence, ...] = field(default=(), repr=False, compare=False)
    """Evidence of this grasp for each hypothesis, for `recognition.shape.fusion`; empty for several
    grasps."""

    @property
    def n_grasps(self) -> int:
        """Number of grasps in the answer."""
        return sum(thickness.n_grasps for thickness in self.thicknesses)

    @property
    def likeliest(self) -> str:
        """The likeliest kind, even if it is too unlikely for an answer."""
        return max(self.probability, key=lambda kind: self.probability[kind])

    def __str__(self) -> str:
        return f"{self.kind}, {' and '.join(map(str, self.thicknesses))}"

    def as_dict(self) -> dict[str, object]:
        """Return plain data, lengths in mm."""
        return {
            "kind": self.kind,
            "probability": {kind: round(p, 4) for kind, p in self.probability.items()},
            "size_mm": 1e3 * self.size_m,
            "interval_mm": [1e3 * self.low_m, 1e3 * self.high_m],
            "dimensions_mm": {name: 1e3 * value for name, value in self.dimensions_m.items()},
            "misfit": self.misfit,
            "thicknesses": [thickness.as_dict() for thickness in self.thicknesses],
        }


def shape_of(grasp: Grasp, foam: FoamModel | None = None) -> ShapeAnswer:
    """Return shape and size of a grasped object, over all kinds and foams.

    Parameters
    ----------
    grasp
        From the open gripper on.
    foam
        The likeliest foam, and the sensor.

    Raises
    ------
    ContactError
        Not both pads were touched, or they do not face each other taxel by taxel.
    """
    foam = foam or FoamModel()
    return joint_answer(*all_fits(reduce_to_pads(grasp, foam), foam))


def joint_answer(fits: Sequence[ShapeFit], log_prior: Sequence[float] | None = None) -> ShapeAnswer:
    """Return the joint answer of the fits of all kinds.

    Parameters
    ----------
    fits
        Of all kinds, to the same data; several of one kind are for several possible foams.
    log_prior
        Logarithm of the prior probability of each; equal by default.
    """
    prior = [0.0] * len(fits) if log_prior is None else list(log_prior)
    misfit = min(fit.misfit for fit in fits)
    scale = max(1.0, misfit)
    fits = [fit.at_scale(scale) for fit in fits]
    weight = shares([fit.log_evidence(scale) + p for fit, p in zip(fits, prior, strict=True)])
    probability, best = likeliest_of([fit.model.kind for fit in fits], weight)
    seen = mixed(
        weight,
        [float(np.log(fit.half_m)) for fit in fits],
        [fit.log_half_sd(scale) for fit in fits],
    )
    kind = fits[best].model.kind
    return ShapeAnswer(
        kind=clear_kind(kind, probability[kind], misfit),
        probability=probability,
        size_m=seen.size_m,
        low_m=seen.low_m,
        high_m=seen.high_m,
        dimensions_m=fits[best].dimensions_m(),
        misfit=float(misfit),
        thicknesses=(seen,),
        evidence=tuple(evidence_of(fit, scale, p) for fit, p in zip(fits, prior, strict=True)),
    )


def shares(log_evidence: Sequence[float]) -> NDArray[np.float64]:
    """Return the probability of each hypothesis."""
    weight = np.exp(np.array(log_evidence) - max(log_evidence))
    probability: NDArray[np.float64] = weight / weight.sum()
    return probability


def likeliest_of(kinds: Sequence[str], weight: NDArray[np.float64]) -> tuple[dict[str, float], int]:
    """Return the probability of each kind, and the best hypothesis of the likeliest."""
    probability = dict.fromkeys(kinds, 0.0)
    for kind, share in zip(kinds, weight.tolist(), strict=True):
        probability[kind] += share
    likeliest = max(probability, key=lambda kind: probability[kind])
    of_kind = [number for number, kind in enumerate(kinds) if kind == likeliest]
    return probability, max(of_kind, key=lambda number: weight[number])


def mixed(
    weight: NDArray[np.float64],
    log_half_m: Sequence[float],
    sd: Sequence[float],
    n_grasps: int = 1,
) -> Thickness:
    """Return the thickness over all hypotheses, from the log half thickness in m of each."""
    centre, spread = np.array(log_half_m), np.array(sd)
    mean = float(weight @ centre)
    reach = _90_PERCENT * float(np.sqrt(weight @ (spread**2 + (centre - mean) ** 2)))
    return Thickness(
        size_m=2.0 * float(np.exp(mean)),
        low_m=2.0 * float(np.exp(mean - reach)),
        high_m=2.0 * float(np.exp(mean + reach)),
        n_grasps=n_grasps,
    )


def clear_kind(kind: str, probability: float, misfit: float) -> str:
    """Return the likeliest kind, or `UNCLEAR` if it is too unlikely or does not fit."""
    return kind if probability >= _MIN_PROBABILITY and misfit <= _MAX_MISFIT else UNCLEAR
