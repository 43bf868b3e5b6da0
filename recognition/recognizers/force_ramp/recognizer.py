"""Default recogniser `force_ramp`: patches, their growth along the ramp, and the opening."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, unique
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from recognition.drift.drift import NO_DRIFT, Drift
from recognition.drift.estimate import DriftEstimate, DriftMeasurement
from recognition.features.aperture import aperture_features, sizes_mm
from recognition.features.footprint import PadGrid, pad_grid
from recognition.features.groups import FEATURE_VERSION, FeatureView, check_version, features_of
from recognition.grasp import CELL_SOURCE, Grasp, by_label
from recognition.ramp.levels import Levels, load_levels
from recognition.ramp.ramp import Rest, learn_rest
from recognition.recognizer import Posterior
from recognition.recognizers.force_ramp.view import View, fit_view
from recognition.statistics.fusion import fuse

MIN_GRASPS = 3
"""Fewest grasps of an object: two to see how they vary, one to check the estimate on."""
_SOON_MS = 3_600_000
"""Time in ms from a taught grasp within which the sensors are trusted to be as they were taught."""
_SLOPE_STEPS = (0.1, 0.5)
"""Steps of the central difference for slopes: of the logarithm of a gain, of the opening in mm."""
_SLOPE_GRASPS = 100
"""About as many grasps show how a drift changes the features in the mean."""
_LEAST_PROBABILITY = 0.02
"""Objects with less probability are not worth a measurement of the drift."""
_NEW_SHARE = 0.1
"""Probability of a new object where most of the objects are taken to be taught ones."""
_ROUNDS = 3
"""Rounds of a measurement, each about the drift that the one before has found: features are linear
in a drift only near it."""


@unique
class Occasion(Enum):
    """When and where a grasp was taken: how far the sensors count as being as they were taught."""

    SOON = "within an hour of teaching"
    GAUGED = "the drift was gauged"
    LATER = "at another time than the teaching"
    ELSEWHERE = "on another cell than the teaching"

    @property
    def trust(self) -> float:
        """Weight of the discriminant without drift; with 1 the zero of the opening holds."""
        return _TRUST[self]


_TRUST = {
    Occasion.SOON: 1.0,
    Occasion.GAUGED: 0.6,
    Occasion.LATER: 0.25,
    Occasion.ELSEWHERE: 0.25,
}
"""Chosen on grasps with made-up drifts and on two pairs of simulated cells: less at another time
names fewer grasps wrongly UNKNOWN, and finds fewer new objects."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForceRamp:
    """A taught recogniser with two views: touch and opening, and touch alone."""

    labels: tuple[str, ...]
    """The taught objects, sorted."""
    rest: Rest
    """The untouched pads."""
    touch: View
    """The view of touch alone, for grasps whose opening is unknown."""
    both: View | None
    """The view of touch and opening; None where the opening is not used or was never known."""
    taught_ms: NDArray[np.int64]
    """(C,) int64: time of the last taught grasp of each object."""
    taught_on: tuple[str, ...]
    """Sources of the taught grasps that name a cell; empty where none does."""
    drawn_m: NDArray[np.float64]
    """(C, k) float64: thicknesses of each object along the closing axis by its drawing in m, NaN
    behind them."""
    drift_estimate: DriftEstimate
    """The drift since teaching."""
    gauged: bool = False
    """Whether the expected drift was measured on a known object."""
    mostly_taught: bool = False
    """Whether most of the grasped objects are taken to be taught ones when the drift is tracked."""
    caution: float = 1.0
    """The odds of a new object are multiplied by it."""

    def occasion(self, grasp: Grasp) -> Occasion:
        """Return when and where a grasp was taken, seen from the teaching."""
        if self.gauged:
            return Occasion.GAUGED
        if self.taught_on and _on_cell(grasp) and grasp.source not in self.taught_on:
            return Occasion.ELSEWHERE
        apart_ms = int(np.abs(self.taught_ms - grasp.start_ms).min())
        return Occasion.SOON if apart_ms <= _SOON_MS else Occasion.LATER

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp. Raises ValueError for pads other than the taught ones.

        A grasp that never touched both pads gives even probabilities and is surely unknown.
        """
        levels = load_levels([grasp], self.rest)
        if not levels.touched[0]:
            return Posterior.uninformed(self.labels)
        view, opening = self._view(levels)
        drift = self.drift_estimate.present
        undone = drift.undo_levels(levels, self.rest.gripping)
        occasion = self.occasion(grasp)
        probability, unknown = view.probabilities(
            self._features(undone, opening=opening),
            _sizes_mm(undone, opening=opening),
            trust=occasion.trust,
            caution=self.caution,
        )
        drawn_m = self.drawn_m[int(probability[0].argmax())]
        drawn_m = drawn_m[np.isfinite(drawn_m) & (occasion.trust == 1.0)]
        return Posterior(
            labels=self.labels,
            probability=probability[0],
            unknown=float(unknown[0]),
            dependence=view.dependence,
            occasion=occasion.value,
            drawn_m=tuple(drawn_m.tolist()),
        )

    # Drift

    def gauge(self, label: str, grasps: Sequence[Grasp]) -> DriftEstimate:
        """Return the drift since teaching, measured on a few grasps of one taught object.

        Raises ValueError where the object was not taught, or no grasp touched both pads.
        """
        if label not in self.labels:
            raise ValueError(
                f"{label!r} was not taught: gauge with one of {', '.join(self.labels)}"
            )
        levels = self._touched(grasps)
        if levels is None:
            raise ValueError("no gauge grasp touched both pads: grasp the gauge object again")
        before = self._untracked(NO_DRIFT)
        measured = self._measured(levels, label, 1.0, before)
        return before.after([replace(measured, probability=1.0)])

    def with_drift(self, found: DriftEstimate) -> "ForceRamp":
        """Return a copy that expects the gauged drift."""
        return self.expecting(found.drift, gauged=True)

    def expecting(self, drift: Drift, *, gauged: bool) -> "ForceRamp":
        """Return a copy that expects a drift and has tracked no grasps."""
        return replace(self, drift_estimate=self._untracked(drift), gauged=gauged)

    def with_drift_of(self, other: "ForceRamp") -> "ForceRamp":
        """Return a copy that has tracked what another recogniser of the same cell has."""
        return replace(self, drift_estimate=other.drift_estimate, gauged=other.gauged)

    def expecting_taught_objects(self) -> "ForceRamp":
        """Return a copy that tracks drift as if most of the grasped objects were taught ones."""
        return replace(self, mostly_taught=True)

    def track_drift(self, grasps: Sequence[Grasp]) -> "ForceRamp":
        """Return a copy whose drift estimate includes grasps of one object, whatever it was.

        Grasps that missed change nothing. Raises ValueError for pads other than the taught ones.
        """
        levels = self._touched(grasps)
        if levels is None or len(self.labels) == 1:
            return self
        fused = fuse([self.posterior(grasp) for grasp in grasps])
        measured = [
            self._measured(levels, label, p, self.drift_estimate)
            for label, p in zip(self.labels, fused.probability.tolist(), strict=True)
            if p >= _LEAST_PROBABILITY
        ]
        return replace(self, drift_estimate=self.drift_estimate.after(measured))

    def _untracked(self, expected: Drift) -> DriftEstimate:
        return _before(self.rest, len(self.labels), expected)

    def _touched(self, grasps: Sequence[Grasp]) -> Levels | None:
        """Return the grasps that touched both pads as levels; None where there is none."""
        levels = load_levels(grasps, self.rest) if grasps else None
        return levels.take(levels.touched) if levels is not None and levels.touched.any() else None

    def _measured(
        self, levels: Levels, label: str, probability: float, before: DriftEstimate
    ) -> DriftMeasurement:
        """Return the drift that grasps show if they are of one taught object.

        The probability of the object is lowered by that of a new one, as the grasps look with the
        drift undone: a drift explains little of what sets a new object apart.
        """
        view, opening = self._view(levels)
        column, about = self.labels.index(label), before.mean
        for _ in range(_ROUNDS):
            undone = before.drift_of(about).undo_levels(levels, self.rest.gripping)
            step, covariance = view.drift_step(self._features(undone, opening=opening), column)
            found = DriftMeasurement(
                label=label,
                probability=probability,
                values=about[: len(step)] + step,
                covariance=covariance,
            )
            about = before.after([replace(found, probability=1.0)]).mean
        undone = before.drift_of(about).undo_levels(levels, self.rest.gripping)
        features = self._features(undone, opening=opening)
        _, new = view.probabilities(
            features,
            _sizes_mm(undone, opening=opening),
            trust=Occasion.SOON.trust,
            caution=self.caution,
        )
        taught = 1.0 - (_NEW_SHARE if self.mostly_taught else float(np.median(new)))
        return replace(found, probability=taught * probability)

    def _view(self, levels: Levels) -> tuple[View, bool]:
        """Return the view for grasps, and whether it has the opening."""
        if self.both is not None and np.all(np.isfinite(sizes_mm(levels))):
            return self.both, True
        return self.touch, False

    def _features(self, levels: Levels, *, opening: bool) -> NDArray[np.float64]:
        return features_of(levels, _grids(self.rest), FeatureView.FORCE_RAMP, opening=opening)

    # Files

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was learnt as plain arrays; tracked grasps become the expected drift."""
        expected = self.drift_estimate.present
        arrays = {
            "feature_version": np.array(FEATURE_VERSION),
            "labels": np.array(self.labels),
            "has_both": np.array(self.both is not None),
            "taught_ms": self.taught_ms,
            "drawn_m": self.drawn_m,
            "taught_on": np.array(self.taught_on, dtype=np.str_),
            "drift_gains": np.array(expected.gains),
            "drift_aperture_offset_m": np.array(expected.aperture_offset_m),
            "gauged": np.array(self.gauged),
            **self.rest.to_arrays(),
            **self.touch.to_arrays("touch_"),
        }
        if self.both is not None:
            arrays |= self.both.to_arrays("both_")
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises ValueError, naming what is missing or does not fit."""
        try:
            check_version(arrays)
            rest = Rest.from_arrays(arrays)
            expected = Drift(
                gains=tuple(arrays["drift_gains"].tolist()),
                aperture_offset_m=float(arrays["drift_aperture_offset_m"]),
            )
            return cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                rest=rest,
                touch=View.from_arrays(arrays, "touch_"),
                both=View.from_arrays(arrays, "both_") if bool(arrays["has_both"]) else None,
                taught_ms=arrays["taught_ms"],
                taught_on=tuple(str(source) for source in arrays["taught_on"]),
                drawn_m=arrays["drawn_m"].reshape(len(arrays["labels"]), -1),
                drift_estimate=_before(rest, len(arrays["labels"]), expected),
                gauged=bool(arrays["gauged"]),
            )
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceRampTrainer:
    """Teaches the default recogniser."""

    name: ClassVar[str] = "force_ramp"
    use_aperture: bool = True

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""
        return self.use_aperture

    def fit(self, grasps: Sequence[Grasp]) -> ForceRamp:
        """Teach the recogniser with labelled grasps.

        Grasps that never touched both pads are left out. A single object is taught to be separated
        from all others. Raises ValueError where an object has fewer than
        ``MIN_GRASPS`` grasps left.
        """
        members = by_label(grasps)
        ordered = [g for group in members.values() for g in group]
        rest = learn_rest(ordered)
        levels = load_levels(ordered, rest)
        touched = levels.touched
        names = np.array([g.label for g in ordered])
        labels, classes = np.unique(names[touched], return_inverse=True)
        pressed = {label: int(np.sum(names[touched] == label)) for label in members}
        few = {label: n for label, n in pressed.items() if n < MIN_GRASPS}
        if few or not pressed:
            raise ValueError(
                f"grasps that touched both pads, by object: {few}; each object needs at least "
                f"{MIN_GRASPS}, or its variation is not known: teach more, and press harder"
            )
        levels = levels.take(touched)
        known = np.all(np.isfinite(sizes_mm(levels)), axis=1)
        both = None
        if self.use_aperture and np.all(
            np.bincount(classes[known], minlength=len(labels)) >= MIN_GRASPS
        ):
            both = _taught(levels.take(known), classes[known], rest, opening=True)
        return ForceRamp(
            labels=tuple(labels.tolist()),
            rest=rest,
            touch=_taught(levels, classes, rest, opening=False),
            both=both,
            taught_ms=np.array([group[-1].start_ms for group in members.values()]),
            taught_on=tuple(sorted({g.source for g in ordered if _on_cell(g)})),
            drawn_m=_drawn_m(list(members.values())),
            drift_estimate=_before(rest, len(labels), NO_DRIFT),
        )


def _taught(levels: Levels, classes: NDArray[np.int64], rest: Rest, *, opening: bool) -> View:
    grids, n_pads = _grids(rest), len(rest.gripping)

    def features(drifted: Levels) -> NDArray[np.float64]:
        return features_of(drifted, grids, FeatureView.FORCE_RAMP, opening=opening)

    around = _before(rest, int(classes.max()) + 1, NO_DRIFT)
    steps = np.diag([_SLOPE_STEPS[0]] * n_pads + [_SLOPE_STEPS[1]])[: n_pads + opening]
    some = levels.take(np.arange(0, len(levels), -(-len(levels) // _SLOPE_GRASPS)))
    slopes = [
        features(around.drift_of(-step).undo_levels(some, rest.gripping)).mean(axis=0)
        - features(around.drift_of(step).undo_levels(some, rest.gripping)).mean(axis=0)
        for step in steps
    ]
    slopes_of_one = np.array(slopes) / (2.0 * steps.sum(axis=1)[:, None])
    sizes = _sizes_mm(levels, opening=opening)
    n_opening = aperture_features(levels).shape[1] if opening else 0
    return fit_view(
        features(levels), sizes, classes, slopes_of_one, n_pads=n_pads, n_opening=n_opening
    )


def _sizes_mm(levels: Levels, *, opening: bool) -> NDArray[np.float64]:
    """Return the sizes of grasps in mm, (n, 2), or (n, 0) where the opening is not used."""
    return sizes_mm(levels) if opening else np.zeros((len(levels), 0))


def _drawn_m(members: Sequence[Sequence[Grasp]]) -> NDArray[np.float64]:
    """Return the different thicknesses of each object by its drawing, (C, k), to 0.1 mm."""
    drawn_m = [np.unique(np.round([g.thickness_m for g in group], 4)) for group in members]
    longest = max(len(sizes_m) for sizes_m in drawn_m)
    return np.stack([np.pad(m, (0, longest - len(m)), constant_values=np.nan) for m in drawn_m])


def _on_cell(grasp: Grasp) -> bool:
    """Return whether the source of a grasp names the cell that took it."""
    return grasp.source.startswith(CELL_SOURCE)


def _before(rest: Rest, n_labels: int, expected: Drift) -> DriftEstimate:
    """Return the estimate of the drift before any grasp."""
    return DriftEstimate.before(
        rest.gripping, rest.pads.n_pads, n_labels=n_labels, expected=expected
    )


def _grids(rest: Rest) -> list[PadGrid]:
    """Return the positions of the taxels of the gripping pads."""
    return [pad_grid(rest.pads, pad) for pad in rest.gripping]
