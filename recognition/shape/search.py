"""Search over kinds of shape and possible foams, without fits that are not worth their time.

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
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from recognition.shape.fit import ShapeFit, evidence_of, fit_shape, joint_evidence
from recognition.shape.foam import FoamModel
from recognition.shape.models import SHAPE_MODELS
from recognition.shape.pressed_pads import PressedPads
from recognition.shape.residuals import PadUncertainty, ShapeProblem

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
