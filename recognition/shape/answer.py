"""Shape and size of a grasped object, with probabilities, also of an object never taught.

Foam, gain, spread and zero of the opening are common unknowns of the grasps of a cell. Their error
does not average out over several grasps. Noise and pose are new in each grasp and do average
out. Objects of revolution have one thickness in all poses. A `flat` or `oval` may have several, for
example a bar of 10 mm by 16 mm. Grasps are split at the widest gap between their thicknesses while
two thicknesses explain them better than one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp
from recognition.shape.fit import (
    Faces,
    KindEvidence,
    ShapeFit,
    all_fits,
    evidence_of,
    joint_evidence,
)
from recognition.shape.foam import FoamModel
from recognition.shape.pressed_pads import reduce_to_pads
from recognition.statistics.fusion import independent_share

UNCLEAR = "unclear"
"""The answer if no kind of shape is likely enough, or none fits."""

_MIN_PROBABILITY = 0.5
"""Least probability of a kind as the answer."""
_MAX_MISFIT = 3.0
"""Largest squared residual per degree of freedom of a kind as the answer."""
_90_PERCENT = 1.645
"""Half width of a 90 % interval of a normal distribution in standard deviations."""
SHAPE_DEPENDENCE = 0.5
"""Correlation of the errors of several grasps; see `fuse_shapes`."""

PLACING_M = 0.1e-3
"""Standard deviation in m of one object's thickness from grasp to grasp."""

_DISTINCT_M = 0.2e-3
"""The same for the split of thicknesses, so that an error of the opening makes no second one."""

_SEVERAL_THICKNESSES = frozenset({"flat", "oval"})
"""Kinds that may have different thicknesses in different poses."""
_LOG_ODDS_OF_ANOTHER = float(np.log(20.0))
"""Prior log odds against one more thickness of an object."""

Hypothesis = Sequence[KindEvidence]
"""Evidence of one kind under one foam, in each grasp."""


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
    """Evidence of this grasp for each hypothesis, for `fuse_shapes`; empty for several
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
    evidence = tuple(evidence_of(fit, scale, p) for fit, p in zip(fits, prior, strict=True))
    answer = _answer([(item,) for item in evidence], [((0,),)] * len(fits), misfit)
    return replace(answer, evidence=evidence)


def fuse_shapes(
    answers: Sequence[ShapeAnswer],
    *,
    dependence: float = SHAPE_DEPENDENCE,
    placing_m: float = PLACING_M,
) -> ShapeAnswer:
    """Return shape and size from several grasps of one object; the order does not matter.

    Raises ValueError without an answer, or if one was already fused.

    Parameters
    ----------
    answers
        Of single grasps; a single answer is returned unchanged.
    dependence
        n grasps have the weight of n / (1 + (n - 1) dependence) independent ones, because the
        errors of the model of foam and objects are similar in all.
    placing_m
        Standard deviation in m of the thickness from grasp to grasp.
    """
    if not answers:
        raise ValueError("no shapes to fuse: grasp at least once")
    if len(answers) == 1:
        return answers[0]
    if not all(answer.evidence for answer in answers):
        raise ValueError("a fused shape cannot be fused again; fuse the grasps' own answers")
    hypotheses = list(zip(*(answer.evidence for answer in answers), strict=True))
    faces_of = [_faces([item.scattered(_DISTINCT_M) for item in items]) for items in hypotheses]
    share = independent_share(len(answers), dependence)
    tempered = [
        [item.scattered(placing_m).tempered(share) for item in items] for items in hypotheses
    ]
    misfit = float(np.median([answer.misfit for answer in answers]))
    return _answer(tempered, faces_of, misfit)


def _answer(
    hypotheses: Sequence[Hypothesis], faces_of: Sequence[Faces], misfit: float
) -> ShapeAnswer:
    """Return the answer of all hypotheses, each with the grasps of its thicknesses."""
    log_weight = np.array(
        [
            items[0].log_prior + joint_evidence(items, faces)[0] - len(faces) * _LOG_ODDS_OF_ANOTHER
            for items, faces in zip(hypotheses, faces_of, strict=True)
        ]
    )
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    probability = dict.fromkeys((items[0].kind for items in hypotheses), 0.0)
    for items, share in zip(hypotheses, weight.tolist(), strict=True):
        probability[items[0].kind] += share
    kind = max(probability, key=lambda kind: probability[kind])
    of_kind = [number for number, items in enumerate(hypotheses) if items[0].kind == kind]
    best = max(of_kind, key=lambda number: weight[number])
    faces = faces_of[best]
    _, means, sds = zip(*(joint_evidence(items, faces) for items in hypotheses), strict=True)
    thicknesses = [
        _mixed(weight, mean, sd, len(face))
        for mean, sd, face in zip(np.transpose(means), np.transpose(sds), faces, strict=True)
    ]
    # The faces are in the order of their thickness: of equally frequent ones the thinnest.
    main = max(range(len(faces)), key=lambda number: len(faces[number]))
    seen = thicknesses[main]
    sizes_m = [hypotheses[best][i].dimensions_m for i in faces[main]]
    dimensions_m = {name: float(np.median([size[name] for size in sizes_m])) for name in sizes_m[0]}
    if len(hypotheses[best]) > 1:
        # Several grasps give the thickness better than their median.
        dimensions_m[next(iter(dimensions_m))] = seen.size_m
    clear = probability[kind] >= _MIN_PROBABILITY and misfit <= _MAX_MISFIT
    return ShapeAnswer(
        kind=kind if clear else UNCLEAR,
        probability=probability,
        size_m=seen.size_m,
        low_m=seen.low_m,
        high_m=seen.high_m,
        dimensions_m=dimensions_m,
        misfit=misfit,
        thicknesses=tuple(sorted(thicknesses, key=lambda thickness: thickness.size_m)),
    )


def _mixed(
    weight: NDArray[np.float64],
    log_half_mm: NDArray[np.float64],
    sd: NDArray[np.float64],
    n_grasps: int,
) -> Thickness:
    """Return the thickness over all hypotheses, from the log half thickness in mm of each."""
    mean = float(weight @ log_half_mm)
    reach = _90_PERCENT * float(np.sqrt(weight @ (sd**2 + (log_half_mm - mean) ** 2)))
    low_m, size_m, high_m = (2e-3 * float(np.exp(mean + x)) for x in (-reach, 0.0, reach))
    return Thickness(size_m=size_m, low_m=low_m, high_m=high_m, n_grasps=n_grasps)


def _faces(items: Sequence[KindEvidence]) -> Faces:
    """Return the grasps of each thickness, thinnest first."""
    order = np.argsort([item.log_half_mm for item in items], kind="stable")
    at = np.array([items[i].log_half_mm for i in order])
    faces: Faces = (tuple(int(i) for i in order),)
    if items[0].kind not in _SEVERAL_THICKNESSES:
        return faces
    log_evidence = joint_evidence(items, faces)[0]
    cuts: list[int] = []
    for cut in 1 + np.argsort(-np.diff(at), kind="stable"):
        tried = sorted([*cuts, int(cut)])
        split = tuple(tuple(int(i) for i in part) for part in np.split(order, tried))
        log_split = joint_evidence(items, split)[0] - len(tried) * _LOG_ODDS_OF_ANOTHER
        if log_split <= log_evidence:
            break
        cuts, faces, log_evidence = tried, split, log_split
    return faces
