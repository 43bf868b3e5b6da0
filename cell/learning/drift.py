"""Drift tracking: the drift of the sensors, followed from one identification to the next."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from cell.control.records import GraspRecord
from cell.errors import ModelError
from gripper.state import GraspResult
from recognition.drift.drift import NO_DRIFT, Drift, drift_text, drift_values
from recognition.drift.estimate import DriftEstimate, DriftTracking
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers.force_ramp.recognizer import ForceRamp

_KEPT_SEQUENCES = 40
"""Sequences of grasps that a newly trained recogniser is given again; it counts the last 20."""


def gaugeable(recognizer: Recognizer, trainer_name: str) -> ForceRamp:
    """Return a recogniser that can be gauged. Raises ModelError for one of another kind."""
    if not isinstance(recognizer, ForceRamp):
        raise ModelError(f"a model of {trainer_name} cannot be gauged; train one of force_ramp")
    return recognizer


class DriftTracker:
    """Recogniser whose expected drift follows the grasps of each identification.

    A recogniser that cannot follow a drift stays as it is. The same grasps in the same order lead
    to the same recogniser.

    Parameters
    ----------
    taught
        The recogniser as it was taught or gauged.
    follow
        Whether the drift is followed.

    Attributes
    ----------
    taught
        The recogniser without the followed drift.
    recognizer
        The recogniser that expects the followed drift.
    """

    def __init__(self, taught: Recognizer, *, follow: bool = True) -> None:
        self.taught = taught
        self.recognizer = taught
        self._follow = follow and isinstance(taught, DriftTracking)
        self._recent: deque[list[Grasp]] = deque(maxlen=_KEPT_SEQUENCES)
        self._reported = False

    @property
    def follows(self) -> bool:
        """Whether the drift is followed."""
        return self._follow

    @property
    def drift_estimate(self) -> DriftEstimate | None:
        """Estimate of the drift; None for a recogniser without one."""
        return (
            self.recognizer.drift_estimate if isinstance(self.recognizer, DriftTracking) else None
        )

    @property
    def drift(self) -> Drift:
        """Drift since teaching where one is likely, otherwise the expected one."""
        return NO_DRIFT if self.drift_estimate is None else self.drift_estimate.present

    def add_records(self, records: Sequence[GraspRecord]) -> str:
        """Follow the grasps of one identification; return a remark as `add_grasps`.

        Grasps whose ramp ended before its force, or that held nothing, are left out.
        """
        return self.add_grasps([record.grasp for record in records if _whole(record)])

    def add_grasps(self, grasps: Sequence[Grasp]) -> str:
        """Follow whole grasps of one object, taught or not.

        Returns a remark for the operator when the drift becomes likely or stops being so, otherwise
        an empty text.
        """
        if not self._follow or not grasps:
            return ""
        self._recent.append(list(grasps))
        self._update(grasps)
        return self._remark()

    def continued_with(self, taught: Recognizer) -> "DriftTracker":
        """Return a tracker of a newly trained recogniser that has followed the same grasps."""
        again = DriftTracker(taught, follow=self._follow)
        for grasps in self._recent:
            again._recent.append(grasps)
            again._update(grasps)
        again._reported = self._reported
        return again

    def reset(self) -> None:
        """Begin anew with the recogniser as it was taught, as after work on the sensors."""
        self.recognizer = self.taught
        self._recent.clear()
        self._reported = False

    def _update(self, grasps: Sequence[Grasp]) -> None:
        if isinstance(self.recognizer, DriftTracking):
            self.recognizer = self.recognizer.track_drift(grasps)

    def _remark(self) -> str:
        estimate = self.drift_estimate
        if estimate is None or estimate.likely == self._reported:
            return ""
        self._reported = estimate.likely
        if estimate.likely:
            shown = drift_text(estimate.drift)
            return f"the sensors have drifted since teaching: {shown}: gauge the cell"
        return f"the sensors are as expected again: {drift_text(estimate.expected)}"


def estimate_values(estimate: DriftEstimate) -> dict[str, Any]:
    """Return the estimate of the drift as plain data."""
    return {
        **drift_values(estimate.present),
        "unchanged": estimate.unchanged,
        "n_objects": estimate.n_objects,
    }


def _whole(record: GraspRecord) -> bool:
    outcome = record.outcome
    return outcome.result is GraspResult.FORCE_REACHED and not outcome.ended_early
