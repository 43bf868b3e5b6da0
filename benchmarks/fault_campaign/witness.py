"""What looks at the data: a recogniser that knows what was scanned, a reader of recordings."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.fault_campaign.invariants import InvariantBroken
from cell.errors import CellError
from cell.recording import read_recording
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from simulator.faults import InjectedFault

_FIRST_CHUNK_BYTES = 1024
_SPOILING = ("taxels.off", "taxels.stuck", "taxels.saturated")
_SPOILED_SHARE = 0.4
_KNOWN_AFTER_S = 0.4
_FROZEN_FRAMES = 15
"""So many identical frames in a row cannot be a grip that changes."""


class FrameWitness:
    """A recogniser that is always sure, and looks whether its grasps are what the unit scanned.

    Parameters
    ----------
    scanned
        Returns every scan that the unit has latched, as bytes.
    spoiled
        Returns which faults have spoiled the scans themselves for a while.
    """

    name, labels, uses_aperture = "witness", ("ball", "box"), False

    def __init__(self, scanned: Callable[[], set[bytes]], spoiled: Callable[[], list[str]]) -> None:
        self._scanned = scanned
        self._spoiled = spoiled

    def posterior(self, grasp: Grasp) -> Posterior:
        """Answer with certainty; InvariantBroken for data that no answer may come from."""
        scanned = self._scanned()
        frames = [counts.astype(np.uint8).tobytes() for counts in grasp.counts]
        strange = sum(frame not in scanned for frame in frames)
        if strange:
            raise InvariantBroken(
                f"{strange} of {len(frames)} frames of a grasp were never scanned"
            )
        alike = longest = 1
        for before, frame in itertools.pairwise(frames):
            alike = alike + 1 if frame == before else 1
            longest = max(longest, alike)
        if longest >= _FROZEN_FRAMES:
            raise InvariantBroken(f"a label from a grasp with {longest} identical frames in a row")
        if self._spoiled():
            raise InvariantBroken(f"a label in spite of {', '.join(self._spoiled())}")
        return Posterior(labels=self.labels, probability=np.array([0.999, 0.001]), unknown=0.001)


def spoiling(faults: Sequence[InjectedFault], now_s: float) -> list[str]:
    """Return the faults that have made so many taxels wrong for so long that no label may come."""
    return [
        fault.text
        for fault in faults
        if fault.entry.name in _SPOILING
        and fault.began_s is not None
        and now_s - fault.began_s > _KNOWN_AFTER_S
        and (fault.entry.name == "taxels.saturated" or fault.value >= _SPOILED_SHARE)
    ]


def recording_faults(path: Path, *, whole: bool) -> list[str]:
    """Return what is wrong with a recording: one that was closed, or what a kill has left."""
    try:
        recording = read_recording(path)
    except CellError as error:
        # A host that was killed before its first chunk was written leaves no recording.
        small = path.stat().st_size <= _FIRST_CHUNK_BYTES
        return [] if small and not whole else [f"the recording cannot be read: {error}"]
    if whole and not recording.complete:
        return [f"a recording that was closed is not complete: {recording.lost_reason}"]
    return []
