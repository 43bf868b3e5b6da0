"""The comparison of the force in the messages with that in the frames, and the unit's table.

Both come from the same taxels: the messages from fast scans that the unit sums by the host's table
and zero, the frames from the host's own calibration. A table of another pad, a zero that was lost
or a unit that counts wrongly shows as a difference that stays.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile.errors import ForceContradicted
from tactile.frames.force_message import TABLE_NODES, ForceMessage, encode_table
from tactile.layout import TaxelLayout
from tactile.sensor.calibration import Calibration

_LIMIT_N, _LIMIT_SHARE = 0.7, 0.15
"""Difference in N, or as a share of the force if that is more, that is one. In the simulated cell,
both layouts, five objects, ramps of 6 N/s to 1.5, 4 and 9 N, six frames in a row have differed by
up to 0.6 N while the force grew, and in a hold by up to 0.2 N."""
_LIMIT_SIGMAS = 15.0
"""The same in standard deviations of one taxel, where that is more: frames leave out taxels below
a threshold by noise. At 0.1 N of noise frames have shown 0.8 N less."""
_UNSEEN = 2.0
"""Factor on it where the frames show no touch: then all taxels are below the threshold. Six frames
in a row have shown none at 0.8 N, at 0.1 N of noise at 1.2 N."""
_FRAMES = 6
"""Frames in a row that must show it: 0.12 s at 50 Hz."""
_KEPT = 64
"""Messages kept: 0.13 s at 500 a second, 0.32 s at 200: more than the mean of the frames spans."""


def force_table(layout: TaxelLayout, calibration: Calibration) -> bytes:
    """Return object 0x2141, the table of counts to force of both gripping pads."""
    table_n = np.empty((2, TABLE_NODES))
    for node in range(TABLE_NODES):
        counts = np.full(layout.n_taxels, layout.adc_max * node / (TABLE_NODES - 1))
        force_n = calibration.force_n(counts)
        for finger, pad in enumerate(layout.gripping_pads):
            table_n[finger, node] = force_n[layout.taxels_of(pad)].mean()
    return encode_table(table_n)


class ForceCheck:
    """Comparison of messages and frames over the time that a frame's mean spans.

    Parameters
    ----------
    mean_frames
        Frames over which the frames' force is a mean.
    """

    def __init__(self, mean_frames: int) -> None:
        self._frames_s: deque[float] = deque(maxlen=mean_frames + 1)
        self._messages: deque[ForceMessage] = deque(maxlen=_KEPT)
        self._limit_n = _LIMIT_N
        self._differs = 0

    def add(self, message: ForceMessage) -> None:
        """Add a message."""
        self._messages.append(message)

    def reset(self, taxel_noise_n: float) -> None:
        """Forget messages and frames: a new zero, with this noise of one taxel in N."""
        self._limit_n = max(_LIMIT_N, _LIMIT_SIGMAS * taxel_noise_n)
        self._messages.clear()
        self._frames_s.clear()
        self._differs = 0

    def compare(self, t_s: float, frame_n: tuple[float, float]) -> None:
        """Compare the force of a frame at ``t_s`` s, in N on both fingers, with the messages'.

        Raises
        ------
        ForceContradicted
            When they have differed for several frames in a row.
        """
        self._frames_s.append(t_s)
        while self._messages and self._messages[0].t_s < self._frames_s[0]:
            self._messages.popleft()
        within = [message.force_n for message in self._messages if message.t_s <= t_s]
        if not within:
            return
        mean_n: NDArray[np.float64] = np.mean(within, axis=0)
        least_n = self._limit_n * np.where(np.equal(frame_n, 0.0), _UNSEEN, 1.0)
        allowed_n = np.maximum(least_n, _LIMIT_SHARE * np.maximum(mean_n, frame_n))
        finger = int(np.argmax(np.abs(mean_n - frame_n) - allowed_n))
        if abs(mean_n[finger] - frame_n[finger]) <= allowed_n[finger]:
            self._differs = 0
            return
        self._differs += 1
        if self._differs >= _FRAMES:
            raise ForceContradicted(
                f"the force messages show {mean_n[finger]:.2f} N on finger {finger}, the frames "
                f"{frame_n[finger]:.2f} N; a difference of {allowed_n[finger]:.2f} N is allowed: "
                "table, zero or pads are wrong, so neither is used; the grip is kept. Look at the "
                "pads and the calibration, then start the link again"
            )
