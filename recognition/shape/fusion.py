"""Fusion of shape and size over several grasps of one object.

Foam, gain, spread and zero of the opening are common unknowns of the grasps of a cell, so their
error does not average out. Noise and pose are new in each grasp and do average out. Objects of
revolution have one thickness in all poses. A `flat` or `oval` may have several, for example a bar
of 10 mm by 16 mm. Grasps are split at the widest gap between their thicknesses while two
thicknesses explain them better than one.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.shape.answer import ShapeAnswer, clear_kind, likeliest_of, mixed, shares
from recognition.shape.fit import KindEvidence
from recognition.statistics.fusion import independent_share

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
_LOG_MM = float(np.log(1e-3))
"""Logarithm of a millimetre in m."""

Array = NDArray[np.float64]
Faces = tuple[tuple[int, ...], ...]
"""Numbers of the grasps of each thickness."""


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
    weight = shares(
        [
            items[0].log_prior + _joint(items, faces)[0] - len(faces) * _LOG_ODDS_OF_ANOTHER
            for items, faces in zip(tempered, faces_of, strict=True)
        ]
    )
    probability, best = likeliest_of([items[0].kind for items in hypotheses], weight)
    faces = faces_of[best]
    together = [_joint(items, faces) for items in tempered]
    thicknesses = [
        mixed(
            weight,
            [float(mean[number]) + _LOG_MM for _, mean, _ in together],
            [float(sd[number]) for _, _, sd in together],
            len(face),
        )
        for number, face in enumerate(faces)
    ]
    # The faces are in the order of their thickness: of equally frequent ones the thinnest.
    main = max(range(len(faces)), key=lambda number: len(faces[number]))
    kind, seen = hypotheses[best][0].kind, thicknesses[main]
    misfit = float(np.median([answer.misfit for answer in answers]))
    return ShapeAnswer(
        kind=clear_kind(kind, probability[kind], misfit),
        probability=probability,
        size_m=seen.size_m,
        low_m=seen.low_m,
        high_m=seen.high_m,
        dimensions_m=_dimensions_m([hypotheses[best][i] for i in faces[main]], seen.size_m),
        misfit=misfit,
        thicknesses=tuple(sorted(thicknesses, key=lambda thickness: thickness.size_m)),
    )


def _faces(items: Sequence[KindEvidence]) -> Faces:
    """Return the grasps of each thickness, thinnest first."""
    order = np.argsort([item.log_half_mm for item in items], kind="stable")
    at = np.array([items[i].log_half_mm for i in order])
    faces: Faces = (tuple(int(i) for i in order),)
    if items[0].kind not in _SEVERAL_THICKNESSES:
        return faces
    log_evidence = _joint(items, faces)[0]
    cuts: list[int] = []
    for cut in 1 + np.argsort(-np.diff(at), kind="stable"):
        tried = sorted([*cuts, int(cut)])
        split = tuple(tuple(int(i) for i in part) for part in np.split(order, tried))
        log_split = _joint(items, split)[0] - len(tried) * _LOG_ODDS_OF_ANOTHER
        if log_split <= log_evidence:
            break
        cuts, faces, log_evidence = tried, split, log_split
    return faces


def _joint(items: Sequence[KindEvidence], faces: Faces) -> tuple[float, Array, Array]:
    """Return log evidence, and mean and deviation (n_faces,) of each log half thickness in mm."""
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


def _dimensions_m(of_face: Sequence[KindEvidence], size_m: float) -> dict[str, float]:
    """Return the median of all dimensions, except the thickness, which is known better."""
    names = list(of_face[0].dimensions_m)
    medians = {
        name: float(np.median([item.dimensions_m[name] for item in of_face])) for name in names
    }
    return medians | {names[0]: size_m}
