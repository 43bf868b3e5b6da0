"""Teaching summary: what is missing in the taught grasps, and how well an object differs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cell.learning.parallel import one_blas_thread
from recognition.grasp import DRAWING_SOURCE, Grasp, by_label, series_of
from recognition.recognizer import Posterior, Trainer
from recognition.statistics.calibration import blocked_folds

_ENOUGH_GRASPS = 10
"""Least number of grasps of an object for sure names within a series."""
_MISSED = "about 1 of 6"
"""Share of single grasps of taught objects that are UNKNOWN, and of others that get a name. Two to
eight similar objects were taught with three or four grasps
(docs/decisions/0006-parts-of-the-recognizer.md)."""
_FOLDS = 2
"""Parts of the grasps that are left out in turn: the minimum, because each costs a training."""
_OPENING_GRASPS = 3
"""Least number of grasps of each object with a known opening: with less none uses the opening."""
_ENOUGH_OBJECTS = 4
"""Least number of objects for an estimate of how a new object differs."""


def teaching_notes(grasps: Sequence[Grasp]) -> tuple[str, ...]:
    """Return notes for the user on labelled grasps: limits of the teaching, and what is missing.

    Raises ValueError if a grasp has no label.
    """
    members = by_label(grasps)
    notes = _amount_note(members), _series_note(members), zero_note(grasps), _opening_note(members)
    return tuple(note for note in notes if note)


def _first(texts: Sequence[str]) -> str:
    """Return the first five texts, and the number of the others."""
    return ", ".join(texts[:5]) + (f" and {len(texts) - 5} more" if len(texts) > 5 else "")


def _amount_note(members: Mapping[str, Sequence[Grasp]]) -> str:
    few = {label: len(group) for label, group in members.items() if len(group) < _ENOUGH_GRASPS}
    drawn = [
        label
        for label, group in members.items()
        if all(grasp.source == DRAWING_SOURCE for grasp in group)
    ]
    needs = []
    if few:
        counted = _first([f"{label} {n}" for label, n in few.items()])
        needs.append(f"{_ENOUGH_GRASPS} grasps of each object (now {counted}), better 20")
    if len(members) < _ENOUGH_OBJECTS:
        needs.append(f"{_ENOUGH_OBJECTS} objects (now {len(members)})")
    if drawn:
        needs.append(f"real grasps of drawn objects ({_first(drawn)})")
    if not needs:
        return ""
    return (
        f"teach {'; '.join(needs)}. Until then {_MISSED} taught objects is UNKNOWN, and "
        f"{_MISSED} similar untaught ones gets a name (simulated cell)"
    )


def _series_note(members: Mapping[str, Sequence[Grasp]]) -> str:
    again = [label for label, group in members.items() if len(series_of(group)) > 1]
    if not again:
        return (
            "each object was taught in one series, so with one individual: if a label is a "
            "kind, for example of fruit, teach several individuals (`teach --series NAME`). On "
            "another day, with another placing or on another cell expect UNKNOWN and wrong "
            "names; measure the zero (`tactile-cell hand zero`) or gauge with two objects "
            "(`tactile-cell model calibrate --gauge LABEL --gauge OTHER`)"
        )
    if once := len(members) - len(again):
        return (
            f"taught in several series: {_first(again)}; in one: {once} of {len(members)}. "
            "Grasps of another day are most similar to those taught on another day, so the others "
            "may be named as one of these: teach all objects again, or omit the further series "
            "(`tactile-cell model evaluate --split series` measures it)"
        )
    return ""


def zero_note(grasps: Sequence[Grasp]) -> str:
    """Return a note where some grasps have a self-zero and some have none; else ""."""
    without = sum(grasp.zero is None for grasp in grasps)
    if without in (0, len(grasps)):
        return ""
    return (
        f"{without} of {len(grasps)} grasps have no self-zero, so the model "
        "uses none and answers allow for any drift on another day: forget their objects, or "
        "begin a new data set, and teach after a self-zero (config `self_zero`, "
        "`tactile-cell hand zero`)"
    )


def _opening_note(members: Mapping[str, Sequence[Grasp]]) -> str:
    counts = {
        label: sum(bool(np.isfinite(grasp.aperture_m).any()) for grasp in group)
        for label, group in members.items()
    }
    few = [label for label, n in counts.items() if n < _OPENING_GRASPS]
    if len(few) in (0, len(counts)):
        return ""
    return (
        f"{_first(few)}: fewer than {_OPENING_GRASPS} grasps with a known opening, so the model "
        "uses touch alone: teach them again, or leave them out (`--object`)"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """How well a taught object differs from the others, by grasps that were left out in turn.

    Both values are None for a single object, or if there are too few grasps.
    """

    nearest: str | None
    """The other object that is most similar to its grasps."""
    mistaken_share: float | None
    """Share of its grasps that are more similar to another object."""


@one_blas_thread()
def separation(grasps: Sequence[Grasp], label: str, trainer: Trainer) -> Separation:
    """Return how well an object differs from all others, by two trainings with half of the grasps.

    The taught grasps of an object must be in the order of time.
    """
    names = sorted({grasp.label for grasp in grasps})
    none = Separation(nearest=None, mistaken_share=None)
    folds = blocked_folds(np.array([names.index(grasp.label) for grasp in grasps]), _FOLDS)
    answers: list[Posterior] = []
    for held_out in folds if len(names) > 1 else ():
        taught = [grasp for grasp, out in zip(grasps, held_out, strict=True) if not out]
        tested = [g for g, out in zip(grasps, held_out, strict=True) if out and g.label == label]
        try:
            recognizer = trainer.fit(taught)
        except ValueError:  # too few grasps remain
            return none
        answers += [recognizer.posterior(grasp) for grasp in tested]
    others = [name for name in answers[0].labels if name != label] if answers else []
    if not others:
        return none

    def likeness(name: str) -> float:
        return sum(float(answer.probability[answer.labels.index(name)]) for answer in answers)

    return Separation(
        nearest=max(others, key=likeness),
        mistaken_share=sum(answer.best != label for answer in answers) / len(answers),
    )
