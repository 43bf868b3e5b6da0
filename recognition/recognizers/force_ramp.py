"""The default recogniser: shape of the patches, their growth along the ramp, and the opening."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.features import FEATURE_VERSION, feature_groups
from recognition.features_footprint import PadGrid, pad_grid
from recognition.grasp import Grasp
from recognition.ramp import Rest, learn_rest
from recognition.ramp_levels import Levels, load_levels
from recognition.recognizer import Posterior
from recognition.recognizers._view import View, fit_view
from recognition.splits import by_label

_SINGLE_GROUPS = ("surface",)
"""With one object nothing says which features separate: few and plain ones do best."""
MIN_GRASPS = 3
"""Fewest grasps of an object: two to see how they vary, one to check the estimate on."""
_TACTILE_GROUPS = ("patch", "pose", "pads", "growth", "profile", "surface")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForceRamp:
    """A taught recogniser with two views: touch and opening, and touch alone.

    Attributes
    ----------
    labels
        The taught objects, sorted.
    rest
        The untouched pads.
    touch
        The view of touch alone, for grasps whose opening is unknown.
    both
        The view of touch and opening; None where the opening is not used or was never known.
    """

    labels: tuple[str, ...]
    rest: Rest
    touch: View
    both: View | None

    def posterior(self, grasp: Grasp) -> Posterior:
        """Say what the grasp tells; ValueError for pads other than the taught ones.

        A grasp that never touched both pads tells nothing: even probabilities, surely unknown.
        """
        levels = load_levels([grasp], self.rest)
        if not levels.touched[0]:
            even = np.full(len(self.labels), 1.0 / len(self.labels))
            return Posterior(labels=self.labels, probability=even, unknown=1.0)
        tactile, aperture = _features(levels, _grids(self.rest), len(self.labels))
        view, features = self.touch, tactile
        if self.both is not None and np.all(np.isfinite(aperture)):
            view, features = self.both, _joined(tactile, aperture, len(self.labels))
        return Posterior(
            labels=self.labels,
            probability=view.probability(features)[0],
            unknown=float(view.unknown(features)[0]),
            dependence=view.dependence,
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was learnt as plain arrays."""
        arrays = {
            "feature_version": np.array(FEATURE_VERSION),
            "labels": np.array(self.labels),
            "has_both": np.array(self.both is not None),
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
            if int(arrays["feature_version"]) != FEATURE_VERSION:
                raise ValueError(
                    f"the model has features of version {int(arrays['feature_version'])}, "
                    f"here is {FEATURE_VERSION}: train again"
                )
            return cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                rest=Rest.from_arrays(arrays),
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
        """Learn from labelled grasps.

        Grasps that never touched both pads teach nothing and are left out. A single object is
        taught to be told from all others. Raises ValueError where an object has fewer than
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
        tactile, aperture = (part[touched] for part in _features(levels, _grids(rest), len(labels)))
        known = np.all(np.isfinite(aperture), axis=1)
        both = None
        if self.use_aperture and np.all(
            np.bincount(classes[known], minlength=len(labels)) >= MIN_GRASPS
        ):
            both = fit_view(
                _joined(tactile, aperture, len(labels))[known],
                classes[known],
                len(labels),
                n_second=tactile.shape[1] if len(labels) > 1 else None,
            )
        return ForceRamp(
            labels=tuple(labels.tolist()),
            rest=rest,
            touch=fit_view(tactile, classes, len(labels)),
            both=both,
        )


def _grids(rest: Rest) -> list[PadGrid]:
    return [pad_grid(rest.pads, pad) for pad in rest.gripping]


def _features(
    levels: Levels, grids: Sequence[PadGrid], n_labels: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the tactile features and those of the opening, (n, F) each."""
    groups = feature_groups(levels, grids)
    wanted = _TACTILE_GROUPS if n_labels > 1 else _SINGLE_GROUPS
    tactile = [groups[name] for name in wanted if name in groups]
    return np.concatenate(tactile, axis=1), groups["aperture"]


def _joined(
    tactile: NDArray[np.float64], aperture: NDArray[np.float64], n_labels: int
) -> NDArray[np.float64]:
    """Return the features of the view that has the opening too; of one object, it alone."""
    return np.concatenate([tactile, aperture], axis=1) if n_labels > 1 else aperture
