"""Foams under which a shape is read: what is thought of the pads, and what else they may be.

No pad follows the law of `recognition.foam_model` exactly, and what is known of one is often little
more than a guess. So every kind of shape is fitted under several foams, and the answers are
weighted by how well each explains the grasp: the foam as it is known, separate columns of another
stiffness, and columns that push each other in nearly as an elastic body does.
"""

import math
from dataclasses import dataclass, replace

from recognition.foam_model import FoamModel
from recognition.shape_problem import Trust

_KNOWN_PROBABILITY = 0.5
_SIDEWAYS = 0.7
_DEPTH_SD_M = 0.25e-3
"""How far both pads together may be from the depth that a foam says, in m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PossibleFoam:
    """One way the pads may be.

    Attributes
    ----------
    foam, trust
        Foam and sensor, and how well they are then known.
    probability
        How likely that is before anything is gripped.
    """

    foam: FoamModel
    trust: Trust
    probability: float


def possible_foams(foam: FoamModel, trust: Trust) -> tuple[PossibleFoam, ...]:
    """Return what the pads may be, the known foam first; probabilities sum to 1."""
    doubt = trust.other_foams
    loose = replace(
        trust,
        modulus=max(trust.modulus, 1.5 * doubt),
        gain=max(trust.gain, 0.2 * doubt),
        spread=max(trust.spread, 0.35 * doubt),
        stiffening=max(trust.stiffening, 1.5 * doubt),
        bend=max(trust.bend, 0.12 * doubt),
        aperture_m=math.hypot(trust.aperture_m, _DEPTH_SD_M),
        aperture_jitter_m=2.0 * trust.aperture_jitter_m,
    )
    rest = 0.5 * (1.0 - _KNOWN_PROBABILITY)
    return (
        PossibleFoam(foam=foam, trust=trust, probability=_KNOWN_PROBABILITY),
        PossibleFoam(foam=replace(foam, sideways=0.0), trust=loose, probability=rest),
        PossibleFoam(foam=replace(foam, sideways=_SIDEWAYS), trust=loose, probability=rest),
    )
