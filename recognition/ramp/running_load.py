"""Load of the gripping pads while a ramp still runs: at each frame, from earlier frames only."""

from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from recognition.grasp import Grasp
from recognition.ramp.ramp import QUIET_FRAMES, Rest

_SMOOTHING_FRAMES = 5
"""Span of the running mean in frames, so that single noisy frames do not reach a level."""


def load_so_far(grasp: Grasp, rest: Rest) -> NDArray[np.float64]:
    """Return the load in counts at each frame, (n_frames,), from that frame and earlier ones.

    The load is the running mean of the gripping pads' total above the first frames of the grasp. In
    these first frames it is minus infinity. Raises ValueError for pads other than the taught ones.
    """
    rest.check(grasp.pads)
    total = grasp.counts[:, _taxels(rest)].sum(axis=1, dtype=np.float64)
    behind = (_SMOOTHING_FRAMES - 1) // 2
    smooth = uniform_filter1d(total, _SMOOTHING_FRAMES, mode="nearest", origin=behind)
    load: NDArray[np.float64] = smooth - total[:QUIET_FRAMES].mean()
    load[: QUIET_FRAMES - 1] = -np.inf
    return load


class RunningLoad:
    """Load of `load_so_far`, updated frame by frame in a few microseconds."""

    def __init__(self, rest: Rest) -> None:
        self._taxels = _taxels(rest)
        self._first: list[float] = []
        self._recent: deque[float] = deque(maxlen=_SMOOTHING_FRAMES)

    def push(self, counts: NDArray[np.uint16]) -> float:
        """Take the next frame, (n_taxels,), and return the load in counts."""
        total = float(counts[self._taxels].sum(dtype=np.float64))
        if not self._first:
            self._recent.extend([total] * _SMOOTHING_FRAMES)
        self._recent.append(total)
        if len(self._first) < QUIET_FRAMES:
            self._first.append(total)
            if len(self._first) < QUIET_FRAMES:
                return -np.inf
        return sum(self._recent) / _SMOOTHING_FRAMES - sum(self._first) / QUIET_FRAMES


def _taxels(rest: Rest) -> NDArray[np.int64]:
    return np.concatenate([rest.pads.taxels_of(pad) for pad in rest.gripping])
