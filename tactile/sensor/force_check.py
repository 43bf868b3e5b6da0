"""Comparison of the force in the messages with that in the frames.

Both come from the same taxels. For the messages the unit sums fast scans by the host's table and
zero; for the frames the host uses its own calibration. A table of another pad, a lost zero or an
error of the unit causes a lasting difference. Each frame is compared with the messages around its
scan; a change from the earlier to the later of them may differ too. Cumulative sums (CUSUM,
Page 1954) of what is beyond the limits find large differences within two frames, small ones later.
"""

from collections import deque
from collections.abc import Sequence
from math import inf, isinf

import numpy as np
from numpy.typing import NDArray

from tactile.errors import ForceContradicted
from tactile.layout import TaxelLayout
from tactile.source import ForceMessage, mean_centre_taxels

Array = NDArray[np.float64]
Pair = Sequence[float]
"""Values of finger 0 and finger 1, or along and across the fingers."""

_BEFORE_S, _AFTER_S = 0.0065, 0.0055
"""Times in s before and after the first message of a frame's burst: messages received between them
are compared with the frame. The force of a message is 1.5 ms old."""
_REFERENCE_SIGMAS, _DECISION_SIGMAS = 1.0, 6.0
"""CUSUM in standard deviations of one frame: what each frame subtracts from the sum of the
differences beyond their limits, and the sum that counts. With the limits this gives less than one
false alarm in a hundred hours of a hold. A difference of 2 standard deviations beyond its limit is
found after 7 frames."""
_OUTLIER_SIGMAS = 4.5
"""Largest part of one frame in the sum in standard deviations. A part that leaves between two
messages differs in one frame only."""
_LEAST_N, _LEAST_SHARE = 0.05, 0.04
"""Difference in N, plus a share of the force, that is allowed without noise. In the simulated cell
(fine and coarse pads, balls, boxes and cylinders, ramps of 6 and 20 N/s to 1.5, 6 and 14 N) the
mean of 25 frames differed by up to 0.13 N at 6 N and 0.26 N at 14 N."""
_BELOW_SIGMAS = 13.0
"""Further allowed deficit of the frames in standard deviations of one taxel, because they leave out
taxels below a threshold. At 0.045 N of noise six frames had a deficit of 0.65 N."""
_CENTRE_TAXELS = 0.3
"""Distance of the centres in pitches that is allowed without noise."""
_CENTRE_N_TAXELS = 1.0
"""Noise of that distance for one frame times the grip force, in N times pitches: up to 0.8 on a
cylinder of 4 mm in the simulated cell with twice its usual noise."""
_CENTRE_BOTH = 1.5
"""Noise of frame and messages together over that of the frame's taxels, for a part on many taxels.
Simulated cell, pads on each other, 4 to 12 N, once and twice the usual noise: 1.2 to 1.5."""
_CENTRE_LEAST_N, _CENTRE_LEAST_SIGMAS = 1.0, 20.0
"""Least grip force in N for the comparison of centres, or in standard deviations of one taxel if
that is more. With less force a frame may show a few random taxels of a pad."""
_SPREAD_TAXELS = 4.0
"""Distance in pitches of the centre of the force below the threshold from that of the whole force:
for a spread load, frames and messages leave out different taxels."""
_STORED = 64
"""Number of stored messages: 0.13 s at 500 a second, more than a burst takes."""
_ADVICE = (
    "table, zero or pads are wrong, so neither is used; the grip is kept. Look at the pads and the "
    "calibration, then start the link again"
)


class ForceCentres:
    """Centre of the grip force: the mean of both pads' centres, each weighted by its taxels.

    It is measured from the pads' middle in pitches of their taxels, as in the force messages.
    """

    def __init__(self, layout: TaxelLayout) -> None:
        self._pads = tuple(
            (taxels, layout.taxel_xy_m[taxels] / (pad.pitch_x_m, pad.pitch_y_m))
            for taxels in layout.gripping_taxels
            for pad in (layout.pads[layout.taxel_pad[taxels.start]],)
        )

    def of(self, force_n: Array) -> tuple[float, float] | None:
        """Return the centre along and across the fingers; None if a pad has no force.

        Parameters
        ----------
        force_n : (n_taxels,) float64
            Normal force on each taxel in N.
        """
        centre = np.zeros(2)
        for taxels, place in self._pads:
            weights = force_n[taxels]
            total_n = float(weights.sum())
            if not total_n > 0.0:
                return None
            centre += 0.5 * (weights @ place) / total_n
        return float(centre[0]), float(centre[1])

    def noise(self, force_n: Array, noise_n: Array) -> tuple[float, float]:
        """Return the standard deviation of that centre along and across the fingers.

        It is infinite where there is no centre.

        Parameters
        ----------
        force_n : (n_taxels,) float64
            Normal force on each taxel in N.
        noise_n : (n_taxels,) float64
            Its standard deviation in N; 0 for a taxel that is left out.
        """
        variance = np.zeros(2)
        for taxels, place in self._pads:
            total_n = float(force_n[taxels].sum())
            if not total_n > 0.0:
                return inf, inf
            lever = place - force_n[taxels] @ place / total_n
            variance += 0.25 * (noise_n[taxels] ** 2 @ lever**2) / total_n**2
        along, across = np.sqrt(variance)
        return float(along), float(across)


class _TwoSidedSum:
    """Cumulative sums of a difference beyond its limits, one in each direction."""

    def __init__(self) -> None:
        self._sums = [0.0, 0.0]

    def limit_exceeded(self, apart: float, above: float, below: float, noise: float) -> float:
        """Add a difference; return the limit that the differences exceed by now, else 0.0."""
        for side, (beyond, limit) in enumerate([(apart - above, above), (-apart - below, below)]):
            step = min(beyond / noise, _OUTLIER_SIGMAS) - _REFERENCE_SIGMAS
            self._sums[side] = max(self._sums[side] + step, 0.0)
            if self._sums[side] > _DECISION_SIGMAS:
                return limit
        return 0.0


class ForceCheck:
    """Comparison of messages and frames by cumulative sums."""

    def __init__(self) -> None:
        self.messages: deque[ForceMessage] = deque(maxlen=_STORED)
        """The newest messages; add each one that arrives."""
        self.reset(0.0)

    def reset(self, taxel_noise_n: float) -> None:
        """Discard messages and sums: a new zero, with this noise of one taxel in N."""
        self._taxel_noise_n = taxel_noise_n
        self.messages.clear()
        self._fingers = _TwoSidedSum(), _TwoSidedSum()
        self._axes = _TwoSidedSum(), _TwoSidedSum()

    def compare(
        self,
        scanned_s: float,
        force_n: Pair,
        noise_n: float,
        *,
        centre_taxels: Pair | None = None,
        centre_noise_taxels: Pair = (0.0, 0.0),
        whole_n: Pair = (0.0, 0.0),
    ) -> None:
        """Compare a frame with the messages around its scan.

        Raises ForceContradicted if force or centre of this and earlier frames differ from those of
        the messages.

        Parameters
        ----------
        scanned_s
            Monotonic time of the scan of the frame in s.
        force_n, noise_n
            Force on each finger in N by the taxels that the messages show for certain: those above
            the threshold of the source and beside them. And the standard deviation of each in N.
        centre_taxels, centre_noise_taxels
            Centre of both pads in pitches, None without a touch, and its standard deviation by the
            noise of the taxels.
        whole_n
            Force on all taxels of each finger in N. With a load spread over a pad each taxel may be
            below the threshold.
        """
        began_s = scanned_s - _BEFORE_S
        while len(self.messages) > 1 and self.messages[1].t_s < began_s:
            self.messages.popleft()
        # The one before shows a change of the force where messages are rare.
        near = [message for message in self.messages if message.t_s <= scanned_s + _AFTER_S]
        messages = [message for message in near if message.t_s >= began_s]
        if not messages:
            return
        # With two values each, lists take a sixth of the time of arrays.
        message_n = _means_n(messages)
        half = max(1, len(near) // 2)
        # Where the force changes fast, so much may be between a scan and the messages around it.
        first_n, last_n = _means_n(near[:half]), _means_n(near[-half:])
        frame_n = [max(force_n[n], min(whole_n[n], message_n[n])) for n in (0, 1)]
        for n, finger in enumerate(self._fingers):
            changed_n, most_n = abs(last_n[n] - first_n[n]), max(frame_n[n], message_n[n])
            above_n = _LEAST_N + _LEAST_SHARE * most_n + changed_n
            below_n = above_n + _BELOW_SIGMAS * self._taxel_noise_n
            apart_n = frame_n[n] - message_n[n]
            if limit_n := finger.limit_exceeded(apart_n, above_n, below_n, noise_n):
                raise ForceContradicted(
                    f"the force messages show {message_n[n]:.2f} N on finger {n}, frames of the "
                    f"same time {frame_n[n]:.2f} N; a difference of {limit_n:.2f} N is allowed: "
                    f"{_ADVICE}"
                )
        grip_n, seen_n = 0.5 * sum(message_n), 0.5 * sum(force_n)
        least_n = max(_CENTRE_LEAST_N, _CENTRE_LEAST_SIGMAS * self._taxel_noise_n)
        if centre_taxels is None or min(seen_n, grip_n) < least_n:
            self._axes = _TwoSidedSum(), _TwoSidedSum()
            return
        # Messages without a centre, and a frame with one: the largest possible error.
        message_taxels = mean_centre_taxels(messages) or (inf, inf)
        by_force = _CENTRE_N_TAXELS / max(0.5 * sum(frame_n), _CENTRE_LEAST_N)
        hidden = max(0.0, 0.5 * sum(whole_n) - seen_n) / max(grip_n, _CENTRE_LEAST_N)
        allowed = _CENTRE_TAXELS + _SPREAD_TAXELS * hidden
        for n, axis in enumerate(self._axes):
            apart = message_taxels[n] - centre_taxels[n]
            noise = max(by_force, _CENTRE_BOTH * centre_noise_taxels[n])
            if axis.limit_exceeded(apart, allowed, allowed, noise):
                where = f"is {abs(apart):.2f} pitches of the taxels away from that in"
                if isinf(apart):
                    where = "is missing, though there is one in"
                raise ForceContradicted(
                    f"the centre of the force in the messages {where} the frames of the same time, "
                    f"{allowed:.2f} pitches are allowed: {_ADVICE}"
                )


def _means_n(messages: Sequence[ForceMessage]) -> list[float]:
    """Return the mean force in N on finger 0 and finger 1."""
    return [sum([message.force_n[n] for message in messages]) / len(messages) for n in (0, 1)]
