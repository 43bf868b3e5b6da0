"""Default recogniser `force_ramp`: patches, their growth along the ramp, and the opening."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.drift.drift import CERTAIN, DriftGrid, GaugeResult, drift_grid, estimate_drift
from recognition.drift.tracking import (
    DriftEstimate,
    DriftTrack,
    ObjectDriftEvidence,
    bounded_log_likelihood,
)
from recognition.features.aperture import aperture_features
from recognition.features.groups import FEATURE_VERSION, check_version
from recognition.features.taxel_gain import TaxelGains, learn_taxel_gains
from recognition.grasp import Grasp, by_label
from recognition.ramp.levels import Levels, load_levels
from recognition.ramp.ramp import Rest, learn_rest
from recognition.recognizer import Posterior
from recognition.recognizers.force_ramp.training_set import (
    FeatureRows,
    make_feature_rows,
    make_training_set,
    pad_grids,
    tactile_by_gain,
)
from recognition.recognizers.force_ramp.view import View, fit_view

MIN_GRASPS = 3
"""Fewest grasps of an object: two to see how they vary, one to check the estimate on."""
_GAUGED_SHARE = 0.1
"""Prior probability of a drift other than the gauged one: a gauge may err, and drifts go on."""
_GAUGED_LOG_GAIN_SD = 0.1
"""Least standard deviation of the logarithm of the gain about the gauged one."""
_GAUGED_OFFSET_SD_MM = 1.0
"""The same of the offset of the opening, in mm."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForceRamp:
    """A taught recogniser with two views: touch and opening, and touch alone.

    Attributes
    ----------
    labels
        The taught objects, sorted.
    rest
        The untouched pads.
    taxel_gains
        Gain of each taxel against its neighbours.
    touch
        The view of touch alone, for grasps whose opening is unknown.
    both
        The view of touch and opening; None where the opening is not used or was never known.
    grid
        Possible drifts of the sensors since teaching.
    track
        Drift evidence of the grasps since teaching; None before the first. A model file keeps the
        `grid` that they led to, not the grasps.
    """

    labels: tuple[str, ...]
    rest: Rest
    taxel_gains: TaxelGains
    touch: View
    both: View | None
    grid: DriftGrid
    track: DriftTrack | None = None

    @property
    def drift_estimate(self) -> DriftEstimate:
        """The drift that the tracked grasps show."""
        return (self.track or DriftTrack(prior=self.grid)).drift_estimate

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp. Raises ValueError for pads other than the taught ones.

        A grasp that never touched both pads gives even probabilities and is surely unknown.
        """
        levels = self.taxel_gains.undo(load_levels([grasp], self.rest))
        if not levels.touched[0]:
            return Posterior.uninformed(self.labels)
        view, grid = self._view(levels)
        rows = self._rows(levels, view, grid)
        probability, unknown = view.probabilities(rows, grid)
        return Posterior(
            labels=self.labels,
            probability=probability[0],
            unknown=float(unknown[0]),
            dependence=view.dependence,
        )

    def gauge(self, label: str, grasps: Sequence[Grasp]) -> GaugeResult:
        """Return the drift since teaching, measured on a few grasps of one taught object.

        Raises ValueError where the object was not taught, or no grasp touched both pads.
        """
        if label not in self.labels:
            raise ValueError(
                f"{label!r} was not taught: gauge with one of {', '.join(self.labels)}"
            )
        if not grasps:
            raise ValueError("no gauge grasps: grasp the gauge object about three times")
        levels = self.taxel_gains.undo(load_levels(grasps, self.rest))
        levels = levels.take(levels.touched)
        if len(levels) == 0:
            raise ValueError("no gauge grasp touched both pads: grasp the gauge object again")
        grid = drift_grid(share=1.0)
        view, grid = self._view(levels, grid)
        rows = self._rows(levels, view, grid)
        if view.drift_discriminant is None:
            raise ValueError("one object alone does not show what a drift is: teach another one")
        column = self.labels.index(label)
        likelihood = [
            view.drift_discriminant.log_likelihood(tactile, aperture, column)
            for tactile, aperture in zip(rows.tactile, rows.aperture, strict=True)
        ]
        return estimate_drift(np.array(likelihood), grid)

    def with_drift(self, found: GaugeResult) -> "ForceRamp":
        """Return a copy that expects the gauged drift, and little more of it."""
        grid = drift_grid(
            found.drift,
            share=_GAUGED_SHARE,
            log_gain_sd=max(_GAUGED_LOG_GAIN_SD, found.log_gain_sd),
            offset_sd_mm=max(_GAUGED_OFFSET_SD_MM, found.offset_sd_m * 1e3),
        )
        return replace(self, grid=grid, track=None)

    def expecting_taught_objects(self) -> "ForceRamp":
        """Return a copy that tracks drift as if most of the grasped objects were taught ones."""
        return replace(self, track=DriftTrack(prior=self.grid, mostly_taught=True))

    def track_drift(self, grasps: Sequence[Grasp]) -> "ForceRamp":
        """Return a copy whose drift estimate includes grasps of one object, whatever it was.

        Several objects in turn show the drift together; the same one again counts once. Grasps that
        missed change nothing. Raises ValueError for pads other than the taught ones.
        """
        levels = self.taxel_gains.undo(load_levels(grasps, self.rest)) if grasps else None
        if levels is None or not np.any(levels.touched) or len(self.labels) == 1:
            return self
        levels = levels.take(levels.touched)
        view, grid = self._view(levels)
        rows = self._rows(levels, view, grid)
        found = ObjectDriftEvidence(
            view="touch" if view is self.touch else "both",
            positions=view.likelihood.discriminant.project(rows.middle),
            log_likelihood=bounded_log_likelihood(
                view.likelihood.drift_log_likelihood(rows), view.drift_bias
            ),
        )
        track = (self.track or DriftTrack(prior=self.grid)).after(found)
        return replace(self, grid=track.grid, track=track)

    def _rows(self, levels: Levels, view: View, grid: DriftGrid) -> FeatureRows:
        n, opening = len(self.labels), view is self.both
        grids = pad_grids(self.rest)
        by_gain = tactile_by_gain(levels, grids, n, grid)
        return make_feature_rows(by_gain, levels, grids, n, grid, opening=opening)

    def _view(self, levels: Levels, grid: DriftGrid | None = None) -> tuple[View, DriftGrid]:
        grid = self.grid if grid is None else grid
        if self.both is not None and np.all(np.isfinite(aperture_features(levels))):
            return self.both, grid
        return self.touch, grid.gain_only

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was learnt as plain arrays."""
        arrays = {
            "feature_version": np.array(FEATURE_VERSION),
            "labels": np.array(self.labels),
            "has_both": np.array(self.both is not None),
            **self.rest.to_arrays(),
            **self.taxel_gains.to_arrays(),
            **self.grid.to_arrays("drift_"),
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
            return cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                rest=rest,
                taxel_gains=TaxelGains.from_arrays(arrays, len(rest.gripping)),
                grid=DriftGrid.from_arrays(arrays, "drift_"),
                touch=View.from_arrays(arrays, "touch_"),
                both=View.from_arrays(arrays, "both_") if bool(arrays["has_both"]) else None,
            )
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceRampTrainer:
    """Teaches the default recogniser."""

    use_aperture: bool = True

    @property
    def name(self) -> str:
        """Name in tables, models and on the command line."""
        return "force_ramp"

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
        levels, grids, n = levels.take(touched), pad_grids(rest), len(labels)
        taxel_gains = learn_taxel_gains(levels, grids)
        levels = taxel_gains.undo(levels)
        known = np.all(np.isfinite(aperture_features(levels)), axis=1)
        grid = drift_grid() if n > 1 else CERTAIN
        by_gain = tactile_by_gain(levels, grids, n, grid)
        both = None
        if self.use_aperture and np.all(np.bincount(classes[known], minlength=n) >= MIN_GRASPS):
            training = make_training_set(
                levels.take(known),
                by_gain[known],
                grids,
                classes[known],
                grid=grid,
                opening=True,
            )
            both = fit_view(training)
        touch = make_training_set(
            levels, by_gain, grids, classes, grid=grid.gain_only, opening=False
        )
        return ForceRamp(
            labels=tuple(labels.tolist()),
            rest=rest,
            taxel_gains=taxel_gains,
            touch=fit_view(touch),
            both=both,
            grid=grid,
        )
