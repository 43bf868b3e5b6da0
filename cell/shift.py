"""The recogniser of a shift: as it was taught, and what the shift's grasps say of the sensors."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from cell.collect import GraspRecord
from gripper.state import GraspResult
from recognition.drift import NO_DRIFT, Drift
from recognition.drift_following import DriftBelief
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.shift import Following

_KEPT = 40
"""Sequences that a recogniser taught anew is shown again."""


class Shift:
    """Follows the drift of the sensors from one identification to the next.

    Recognisers that cannot follow are passed through. The same grasps in the same order lead to the
    same recogniser.

    Parameters
    ----------
    taught
        The recogniser as it was taught or gauged.
    follow
        Whether the drift is followed.

    Attributes
    ----------
    taught
        The recogniser without what the shift has shown.
    recognizer
        The one to ask now.
    """

    def __init__(self, taught: Recognizer, *, follow: bool = True) -> None:
        self.taught = taught
        self.recognizer = taught
        self._follow = follow and isinstance(taught, Following)
        self._recent: deque[list[Grasp]] = deque(maxlen=_KEPT)
        self._said = False

    @property
    def follows(self) -> bool:
        """Whether it learns from what it is shown."""
        return self._follow

    @property
    def belief(self) -> DriftBelief | None:
        """What is believed of the drift; None where it is not followed."""
        return self.recognizer.belief if isinstance(self.recognizer, Following) else None

    @property
    def drift(self) -> Drift:
        """What has drifted since teaching, as far as that is likely."""
        return NO_DRIFT if self.belief is None else self.belief.present

    def answered(self, records: Sequence[GraspRecord]) -> str:
        """Learn from the grasps of one identification; return what an operator must know, once.

        Grasps whose ramp ended before its force, or that held nothing, teach nothing.
        """
        return self.seen([record.grasp for record in records if _whole(record)])

    def seen(self, grasps: Sequence[Grasp]) -> str:
        """Learn from whole grasps of one object, whatever it was; otherwise as `answered`."""
        if not self._follow or not grasps:
            return ""
        self._recent.append(list(grasps))
        self._learn(grasps)
        return self._news()

    def retaught(self, taught: Recognizer) -> "Shift":
        """Return the same shift for a recogniser that was taught anew meanwhile."""
        again = Shift(taught, follow=self._follow)
        for grasps in self._recent:
            again._recent.append(grasps)
            again._learn(grasps)
        again._said = self._said
        return again

    def forget(self) -> None:
        """Begin anew with the recogniser as it was taught, as after work on the sensors."""
        self.recognizer = self.taught
        self._recent.clear()
        self._said = False

    def _learn(self, grasps: Sequence[Grasp]) -> None:
        if isinstance(self.recognizer, Following):
            self.recognizer = self.recognizer.following(grasps)

    def _news(self) -> str:
        belief = self.belief
        if belief is None or belief.likely == self._said:
            return ""
        self._said = belief.likely
        if belief.likely:
            return f"the sensors have drifted: {drift_text(belief.drift)}: gauge the cell"
        return f"the sensors are as expected again: {drift_text(belief.expected)}"


def drift_text(drift: Drift) -> str:
    """Say a drift, for people."""
    offset_mm = drift.aperture_offset_m * 1e3
    return f"gain about {drift.gain:.2f}, opening about {offset_mm:+.1f} mm since teaching"


def drift_values(belief: DriftBelief) -> dict[str, Any]:
    """Return what was believed of the drift when an answer was given, as plain data."""
    return {
        "gain": belief.present.gain,
        "aperture_mm": belief.present.aperture_offset_m * 1e3,
        "unchanged": belief.unchanged,
        "n_objects": belief.n_objects,
    }


def _whole(record: GraspRecord) -> bool:
    outcome = record.outcome
    return outcome.result is GraspResult.FORCE_REACHED and not outcome.ended_early
