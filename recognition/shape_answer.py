"""Shape and size of what was grasped, with probabilities, also of an object never taught."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from recognition.foam_model import FoamModel
from recognition.grasp import Grasp
from recognition.ramp import Rest
from recognition.shape_data import PressedPads, press_data
from recognition.shape_fit import ShapeFit, Trust, fit_shape
from recognition.shape_models import SHAPE_MODELS

UNCLEAR = "unclear"
"""The answer where no kind of shape is likely enough, or none fits."""

_MIN_PROBABILITY = 0.5
_MAX_SCALE = 3.0
_90_PERCENT = 1.645


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeAnswer:
    """What one grasp tells of shape and size.

    Attributes
    ----------
    kind
        ``sphere``, ``oval``, ``cylinder``, ``flat``, ``dumbbell`` or `UNCLEAR`.
    probability
        Probability of each kind, given that it is one of them.
    size_m, low_m, high_m
        Thickness along the closing axis in m (the diameter of what is round), and the interval
        that holds it with 90 % probability, over all kinds.
    dimensions_m
        Dimensions of the likeliest kind in m by their names, without interval.
    misfit
        Squared residual of the best kind per degree of freedom: 1 where it fits within the noise.
    """

    kind: str
    probability: Mapping[str, float]
    size_m: float
    low_m: float
    high_m: float
    dimensions_m: Mapping[str, float]
    misfit: float

    @property
    def likeliest(self) -> str:
        """The likeliest kind, also where it is too unlikely for an answer."""
        return max(self.probability, key=lambda kind: self.probability[kind])

    def __str__(self) -> str:
        size = f"{1e3 * self.size_m:.1f} mm ({1e3 * self.low_m:.1f} to {1e3 * self.high_m:.1f})"
        return f"{self.kind}, {size}"

    def as_dict(self) -> dict[str, object]:
        """Return plain data, lengths in mm."""
        return {
            "kind": self.kind,
            "probability": {kind: round(p, 4) for kind, p in self.probability.items()},
            "size_mm": 1e3 * self.size_m,
            "interval_mm": [1e3 * self.low_m, 1e3 * self.high_m],
            "dimensions_mm": {name: 1e3 * value for name, value in self.dimensions_m.items()},
            "misfit": self.misfit,
        }


def shape_of(
    grasp: Grasp,
    *,
    foam: FoamModel | None = None,
    trust: Trust | None = None,
    rest: Rest | None = None,
) -> ShapeAnswer:
    """Say what shape and size a grasped object has.

    Parameters
    ----------
    grasp
        From the open gripper on.
    foam, trust
        What is known of foam and sensor, and how well.
    rest
        What the pads read untouched; the grasp's own first frames by default.

    Raises
    ------
    ContactError
        Not both pads were touched, or they do not face each other taxel by taxel.
    """
    foam = foam or FoamModel()
    return shape_from(press_data(grasp, foam, rest), foam=foam, trust=trust)


def shape_from(data: PressedPads, *, foam: FoamModel, trust: Trust | None = None) -> ShapeAnswer:
    """Compare all kinds on pressed pads; see `shape_of`."""
    fits = [fit_shape(model, data, foam, trust) for model in SHAPE_MODELS.values()]
    return compare(fits)


def compare(fits: list[ShapeFit]) -> ShapeAnswer:
    """Return the answer that fits of all kinds give together."""
    misfit = min(fit.chi2 / fit.freedom for fit in fits)
    scale = max(1.0, misfit)
    log_evidence = np.array([fit.log_evidence(scale) for fit in fits])
    weight = np.exp(log_evidence - log_evidence.max())
    weight /= weight.sum()
    centre = np.array([np.log(fit.half_m) for fit in fits])
    spread = np.array([fit.log_half_sd(scale) for fit in fits])
    mean = float(weight @ centre)
    sd = float(np.sqrt(weight @ (spread**2 + (centre - mean) ** 2)))
    best = int(np.argmax(weight))
    clear = weight[best] >= _MIN_PROBABILITY and misfit <= _MAX_SCALE
    return ShapeAnswer(
        kind=fits[best].model.kind if clear else UNCLEAR,
        probability={fit.model.kind: float(w) for fit, w in zip(fits, weight, strict=True)},
        size_m=2.0 * float(np.exp(mean)),
        low_m=2.0 * float(np.exp(mean - _90_PERCENT * sd)),
        high_m=2.0 * float(np.exp(mean + _90_PERCENT * sd)),
        dimensions_m=fits[best].dimensions_m(),
        misfit=float(misfit),
    )
