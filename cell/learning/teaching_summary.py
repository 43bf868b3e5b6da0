"""Teaching summary: how much the taught grasps vary, and what is missing."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field, computed_field
from pydantic.dataclasses import dataclass

from cell.learning.blas import one_blas_thread
from recognition.grasp import DRAWING_SOURCE, Grasp, by_label, series_of
from recognition.recognizer import Posterior, Trainer
from recognition.statistics.calibration import blocked_folds

_ENOUGH_GRASPS = 10
"""Least number of grasps of an object for sure names within a series."""
_MISSED = "one in six"
"""Share of single grasps of taught objects that are UNKNOWN, and of others that get a name, after
two to eight similar objects were taught with three or four grasps
(docs/decisions/0006-parts-of-the-recogniser.md)."""
_FOLDS = 2
"""Parts of the grasps that are left out in turn: the minimum, because each costs a training."""
_ENOUGH_OBJECTS = 4
"""Least number of objects for an estimate of how a new object differs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TeachingSummary:
    """How much the taught grasps vary."""

    n_objects: int = Field(exclude=True)
    n_grasps: int = Field(exclude=True)
    """Number of objects and of their grasps."""
    few_grasps: Mapping[str, int]
    """Number of grasps of each object that has too few."""
    only_drawn: tuple[str, ...]
    """Objects that were taught only from drawings."""
    taught_again: tuple[str, ...]
    """Objects that were taught in several series, for example of two individuals or days."""
    longest_series_s: float
    """Duration of the longest series in s."""
    without_self_zero: int
    """Grasps without a self-zero while others have one: the model then uses no self-zero."""
    opening_sd_mm: float | None
    """Standard deviation in mm of the smallest opening over the grasps of an object, the median of
    all objects; None without a known opening."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user: limits of this teaching, and what is missing."""
        return tuple(
            note for note in (self._amount_note, self._series_note, self._zero_note) if note
        )

    @property
    def _amount_note(self) -> str:
        needs = []
        if self.few_grasps:
            counted = ", ".join(f"{label} {n}" for label, n in self.few_grasps.items())
            needs.append(f"{_ENOUGH_GRASPS} grasps of each object (now {counted}), better 20")
        if self.n_objects < _ENOUGH_OBJECTS:
            needs.append(f"{_ENOUGH_OBJECTS} objects (now {self.n_objects})")
        if self.only_drawn:
            needs.append(f"real grasps of drawn objects ({', '.join(self.only_drawn)}), or a gauge")
        if not needs:
            return ""
        return (
            f"teach {'; '.join(needs)}. Until then expect {_MISSED} of taught objects to be "
            f"UNKNOWN, and {_MISSED} of similar untaught objects to get a name (simulated cell)"
        )

    @property
    def _series_note(self) -> str:
        if not self.taught_again:
            return (
                "each object was taught in one series, so with one individual: if a label is a "
                "kind, for example of fruit, teach several individuals (`teach --series NAME`). On "
                "another day, with another placing or on another cell expect UNKNOWN and wrong "
                "names; measure the zero (`tactile-cell hand zero`) or gauge with two objects "
                "(`tactile-cell model calibrate --gauge LABEL --gauge OTHER`)"
            )
        once = self.n_objects - len(self.taught_again)
        if once:
            return (
                f"taught in several series: {', '.join(self.taught_again)}; in one: the {once} "
                "others. Grasps of another day are most similar to those taught on another day, so "
                "the others may be named as one of these: teach all objects again, or omit the "
                "further series (`tactile-cell model evaluate --split series` measures it)"
            )
        return ""

    @property
    def _zero_note(self) -> str:
        if not self.without_self_zero:
            return ""
        return (
            f"{self.without_self_zero} of {self.n_grasps} grasps have no self-zero, so the model "
            "uses none and answers allow for any drift on another day: teach their objects again "
            "after a self-zero (config `self_zero`, `tactile-cell hand zero`)"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ToldApart:
    """How well a taught object differs from the others, by grasps that were left out in turn."""

    nearest: str | None
    """The other object that is most similar to its grasps; None for a single object."""
    mistaken_share: float | None
    """Share of its grasps that are more similar to another object; None for a single object, or if
    there are too few grasps."""


@one_blas_thread()
def told_apart(grasps: Sequence[Grasp], label: str, trainer: Trainer) -> ToldApart:
    """Return how well an object differs from all others, by two trainings with half of the grasps.

    The taught grasps of an object must be in the order of time.
    """
    names = sorted({grasp.label for grasp in grasps})
    if len(names) < 2:
        return ToldApart(nearest=None, mistaken_share=None)
    folds = blocked_folds(np.array([names.index(grasp.label) for grasp in grasps]), _FOLDS)
    found: list[Posterior] = []
    for held_out in folds:
        taught = [grasp for grasp, out in zip(grasps, held_out, strict=True) if not out]
        tested = [g for g, out in zip(grasps, held_out, strict=True) if out and g.label == label]
        try:
            recognizer = trainer.fit(taught)
        except ValueError:  # too few grasps remain
            return ToldApart(nearest=None, mistaken_share=None)
        found += [recognizer.posterior(grasp) for grasp in tested]
    others = [name for name in found[0].labels if name != label] if found else []
    if not others:
        return ToldApart(nearest=None, mistaken_share=None)

    def likeness(name: str) -> float:
        return sum(float(one.probability[one.labels.index(name)]) for one in found)

    return ToldApart(
        nearest=max(others, key=likeness),
        mistaken_share=sum(one.best != label for one in found) / len(found),
    )


def summarise_teaching(grasps: Sequence[Grasp]) -> TeachingSummary:
    """Return how much labelled grasps vary. Raises ValueError if a grasp has no label."""
    members = by_label(grasps)
    series = {label: series_of(group) for label, group in members.items()}
    spreads_mm = [
        1e3 * float(np.std(smallest_m))
        for group in members.values()
        if len(smallest_m := [m for g in group if np.isfinite(m := _smallest_m(g))]) > 1
    ]
    without = sum(grasp.zero is None for grasp in grasps)
    return TeachingSummary(
        n_objects=len(members),
        n_grasps=len(grasps),
        few_grasps={k: len(group) for k, group in members.items() if len(group) < _ENOUGH_GRASPS},
        only_drawn=tuple(
            label
            for label, group in members.items()
            if all(g.source == DRAWING_SOURCE for g in group)
        ),
        taught_again=tuple(label for label, found in series.items() if len(found) > 1),
        longest_series_s=round(
            max(
                1e-3 * (one[-1].start_ms - one[0].start_ms) + float(one[-1].t_s[-1])
                for found in series.values()
                for one in found
            ),
            1,
        ),
        without_self_zero=without % len(grasps),
        opening_sd_mm=float(np.median(spreads_mm)) if spreads_mm else None,
    )


def _smallest_m(grasp: Grasp) -> float:
    known_m = grasp.aperture_m[np.isfinite(grasp.aperture_m)]
    return float(known_m.min()) if len(known_m) else float("nan")
