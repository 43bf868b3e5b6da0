"""All kinds of shape under all possible foams: which fits are worth their time.

The foam as it is known comes first. Where the two likeliest kinds gain nothing by another foam, the
known one is it, and the other foams are not tried. Nor is a kind tried again under a further foam
that was far from the others under the last one. What is not tried keeps its place with the
parameters of the last fit, at which its evidence is a lower bound: grasps are fused hypothesis by
hypothesis.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from recognition.foam_model import FoamModel
from recognition.shape_data import PressedPads
from recognition.shape_fit import ShapeFit, fit_shape
from recognition.shape_foams import PossibleFoam, possible_foams
from recognition.shape_models import SHAPE_MODELS
from recognition.shape_problem import ShapeProblem, Trust

_FAR = 12.0
"""A kind whose logarithmic evidence is so much less is not fitted under a further foam."""
_SURE = 3.0
"""By so much the known foam must be the likelier one for others not to be tried."""
_N_PROBED = 2

Fits = dict[str, ShapeFit]


def all_fits(
    data: PressedPads, foam: FoamModel, trust: Trust
) -> tuple[list[ShapeFit], list[float]]:
    """Return fits of all kinds under all possible foams, and how likely each is beforehand.

    The order is the same for all grasps: foam by foam, in each all kinds. The second list holds
    logarithms of probabilities.
    """
    known, *others = possible_foams(foam, trust)
    last: Fits = {
        kind: fit_shape(model, data, known.foam, known.trust)
        for kind, model in SHAPE_MODELS.items()
    }
    fits = list(last.values())
    evidence = _evidence(last, trust)
    probed: Fits = {}
    for kind in sorted(evidence, key=lambda kind: -evidence[kind])[:_N_PROBED]:
        probed[kind] = _fit(kind, data, others[0], last)
    gain = max(_evidence(probed, trust).values()) - max(evidence.values())
    sure = gain + np.log(others[0].probability / known.probability) < -_SURE
    for number, possible in enumerate(others):
        here: Fits = {}
        far = _far(last, trust) if number else frozenset()
        pads_of: ShapeFit | None = None
        for kind in SHAPE_MODELS:
            if number == 0 and kind in probed:
                here[kind] = probed[kind]
            elif sure or kind in far:
                here[kind] = _as_it_was(last[kind], data, possible)
            else:
                here[kind] = _fit(kind, data, possible, last, pads_of)
            pads_of = here[kind]
        last = here
        fits += here.values()
    log_prior = [
        float(np.log(possible.probability)) for possible in (known, *others) for _ in SHAPE_MODELS
    ]
    return fits, log_prior


def _fit(
    kind: str,
    data: PressedPads,
    possible: PossibleFoam,
    last: Fits,
    pads_of: ShapeFit | None = None,
) -> ShapeFit:
    return fit_shape(
        SHAPE_MODELS[kind],
        data,
        possible.foam,
        possible.trust,
        near=last[kind],
        pads_of=pads_of,
    )


def _as_it_was(fit: ShapeFit, data: PressedPads, possible: PossibleFoam) -> ShapeFit:
    """Return the last fit with the priors of another foam."""
    problem = ShapeProblem(fit.model, data, possible.foam, possible.trust)
    return replace(fit, prior_sd=problem.sd)


def _evidence(fits: Mapping[str, ShapeFit], trust: Trust) -> dict[str, float]:
    scale = max(1.0, trust.misfit, min(fit.misfit for fit in fits.values()))
    return {kind: fit.at_scale(scale).log_evidence(scale) for kind, fit in fits.items()}


def _far(last: Mapping[str, ShapeFit], trust: Trust) -> frozenset[str]:
    """Return the kinds that are too unlikely under the last foam to be worth another one."""
    evidence = _evidence(last, trust)
    best = max(evidence.values())
    return frozenset(kind for kind, value in evidence.items() if value < best - _FAR)
