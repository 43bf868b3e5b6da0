"""Comparison of the force in the messages with that in the frames.

Both come from the same taxels. For the messages the unit sums fast scans by the host's table and
zero; for the frames the host uses its own calibration. A table of another pad, a lost zero or an
error of the unit causes a lasting difference. Each frame is compared with the messages around its
scan, so a changing force causes no difference. The mean of more frames shows smaller differences.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isinf, sqrt

import numpy as np
from numpy.typing import NDArray

from tactile.errors import ForceContradicted
from tactile.layout import TaxelLayout
from tactile.source import ForceMessage, mean_centre_taxels

_BEFORE_S, _AFTER_S = 0.0065, 0.0055
"""Times in s before and after the first message of a frame's burst: messages received between them
are compared with the frame. The force of a message is 1.5 ms old."""
_WINDOWS = (2, 3, 6, 12, 25)
"""Numbers of frames whose mean difference is checked: from 40 ms to half a second at 50 Hz."""
_SIGMAS = 5.0
"""Least difference in standard deviations of that mean that counts. It gives less than one false
alarm in a hundred hours of a hold, for all windows together."""
_OUTLIER_SIGMAS = 4.0
"""Largest weight of the difference of one frame in standard deviations. A part that leaves between
two messages differs in one frame only."""
_LEAST_N, _LEAST_SHARE = 0.05, 0.04
"""Difference in N, plus a share of the force, that is allowed without noise. In the simulated cell
(fine and coarse pads, balls, boxes and cylinders, ramps of 6 and 20 N/s to 1.5, 6 and 14 N) the
mean of 25 frames differed by up to 0.13 N at 6 N and 0.26 N at 14 N."""
_BELOW_SIGMAS = 13.0
"""Further allowed deficit of the frames in standard deviations of one taxel, because they leave out
taxels below a threshold. At 0.045 N of noise six frames had a deficit of 0.65 N."""
_UNSEEN_N, _UNSEEN_SIGMAS = 1.4, 30.0
"""Largest force in N of which a frame may show nothing, or in standard deviations of one taxel if
that is more: then all taxels are below the threshold. Six frames in a row showed nothing at 0.8 N,
with 0.1 N of noise at 1.2 N."""
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
_KEPT = 64
"""Number of stored messages: 0.13 s at 500 a second, more than a burst takes."""
_ADVICE = (
    "table, zero or pads are wrong, so neither is used; the grip is kept. Look at the pads and the "
    "calibration, then start the link again"
)


class ForceCentres:
    """Centre of the grip force: the mean of both pads' centres, each weighted by its taxels."""

    def __init__(self, layout: TaxelLayout) -> None:
        self._taxels = tuple(np.flatnonzero(layout.taxel_pad == p) for p in layout.gripping_pads)
        self._xy_m = tuple(layout.position_m[taxels, :2] for taxels in self._taxels)

    def of(self, force_n: NDArray[np.float64]) -> tuple[float, float] | None:
        """Return the centre in the grip frame in m; None if a pad has no force.

        Parameters
        ----------
        force_n : (n_taxels,) float64
            Normal force on each taxel in N.
        """
        centre_m = np.zeros(2)
        for taxels, xy_m in zip(self._taxels, self._xy_m, strict=True):
            weights = force_n[taxels]
            total_n = float(weights.sum())
            if not total_n > 0.0:
                return None
            centre_m += 0.5 * (weights @ xy_m) / total_n
        return float(centre_m[0]), float(centre_m[1])

    def noise_m(
        self, force_n: NDArray[np.float64], noise_n: NDArray[np.float64]
    ) -> tuple[float, float]:
        """Return the standard deviation of that centre along and across the fingers in m.

        Parameters
        ----------
        force_n : (n_taxels,) float64
            Normal force on each taxel in N, with a centre.
        noise_n : (n_taxels,) float64
            Its standard deviation in N; 0 for a taxel that is left out.
        """
        variance_m2 = np.zeros(2)
        for taxels, xy_m in zip(self._taxels, self._xy_m, strict=True):
            total_n = float(force_n[taxels].sum())
            lever_m = xy_m - force_n[taxels] @ xy_m / total_n
            variance_m2 += 0.25 * (noise_n[taxels] ** 2 @ lever_m**2) / total_n**2
        return float(np.sqrt(variance_m2[0])), float(np.sqrt(variance_m2[1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameForces:
    """Force in one frame."""

    scanned_s: float
    """Monotonic time of its scan in s."""
    force_n: tuple[float, float]
    """Force on finger 0 and finger 1 in N."""
    centre_taxels: tuple[float, float] | None
    """Centre of both pads along and across the fingers in pitches; None without a touch."""
    noise_n: float
    """Standard deviation of each force in N."""
    centre_noise_taxels: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the centre by the noise of the taxels, in pitches."""
    whole_n: tuple[float, float] = (0.0, 0.0)
    """Force on all taxels of finger 0 and finger 1 in N. With a load spread over a pad each taxel
    may be below the threshold."""


class ForceCheck:
    """Comparison of messages and frames: each frame, and the mean of the last ones."""

    def __init__(self) -> None:
        self._messages: deque[ForceMessage] = deque(maxlen=_KEPT)
        self._pairs: deque[_Pair] = deque(maxlen=_WINDOWS[-1])
        self._taxel_noise_n = 0.0

    def add(self, message: ForceMessage) -> None:
        """Add a message."""
        self._messages.append(message)

    def reset(self, taxel_noise_n: float) -> None:
        """Discard messages and frames: a new zero, with this noise of one taxel in N."""
        self._taxel_noise_n = taxel_noise_n
        self._messages.clear()
        self._pairs.clear()

    def compare(self, frame: FrameForces) -> None:
        """Compare a frame with the messages around its scan.

        Raises ForceContradicted if force or centre of the last frames differ from those of the
        messages.
        """
        first_s, last_s = frame.scanned_s - _BEFORE_S, frame.scanned_s + _AFTER_S
        while self._messages and self._messages[0].t_s < first_s:
            self._messages.popleft()
        within = [message for message in self._messages if message.t_s <= last_s]
        if not within:
            return
        self._pairs.appendleft(_Pair.of(within, frame, self._taxel_noise_n))
        for finger in (0, 1):
            self._check_force(finger)
        self._check_centre()

    def _check_force(self, finger: int) -> None:
        """Raise ForceContradicted if the mean of the last frames differs from the messages'."""
        apart_n = above_n = below_n = noise_n = 0.0
        for n, pair in enumerate(self._pairs, 1):
            apart_n += pair.apart_n[finger]
            above_n += pair.above_n[finger]
            below_n += pair.below_n[finger]
            noise_n += pair.noise_n
            least_n = above_n if apart_n > 0.0 else below_n
            allowed_n = (least_n + _SIGMAS * noise_n / sqrt(n)) / n
            if n in _WINDOWS and abs(apart_n) / n > allowed_n:
                last = list(self._pairs)[:n]
                raise ForceContradicted(
                    f"the force messages show {_mean(p.message_n[finger] for p in last):.2f} N on "
                    f"finger {finger}, {n} frames of the same time "
                    f"{_mean(p.frame_n[finger] for p in last):.2f} N; a difference of "
                    f"{allowed_n:.2f} N is allowed: {_ADVICE}"
                )

    def _check_centre(self) -> None:
        """Raise ForceContradicted if the last frames have another centre than the messages."""
        apart = noise2 = np.zeros(2)
        below, force_n = 0.0, inf
        for n, pair in enumerate(self._pairs, 1):
            if pair.apart_taxels is None:
                return
            apart = apart + pair.apart_taxels
            noise2 = noise2 + np.square(pair.centre_noise_taxels)
            below += pair.below_share
            force_n = min(force_n, sum(pair.frame_n) / 2.0)
            noise = np.maximum(_CENTRE_N_TAXELS / force_n, _CENTRE_BOTH * np.sqrt(noise2 / n))
            allowed = _CENTRE_TAXELS + _SIGMAS * noise / sqrt(n)
            allowed += _SPREAD_TAXELS * max(below, 0.0) / n
            worst = int(np.argmax(np.abs(apart) / n - allowed))
            if n in _WINDOWS and abs(apart[worst]) / n > allowed[worst]:
                where = f"is {abs(apart[worst]) / n:.2f} pitches of the taxels away from that in"
                if isinf(apart[worst]):
                    where = "is missing, though there is one in"
                raise ForceContradicted(
                    f"the centre of the force in the messages {where} {n} frames of the same time, "
                    f"{allowed[worst]:.2f} pitches are allowed: {_ADVICE}"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Frame and messages of one scan, and their difference.

    ``apart_n`` is the force in the frame less that in the messages; ``above_n`` and ``below_n`` are
    its limits without noise. ``below_share`` is the share of the force on taxels of the frame that
    are below their threshold, with its noise.
    """

    frame_n: tuple[float, float]
    message_n: tuple[float, float]
    apart_n: tuple[float, float]
    above_n: tuple[float, float]
    below_n: tuple[float, float]
    noise_n: float
    apart_taxels: tuple[float, float] | None
    centre_noise_taxels: tuple[float, float]
    below_share: float

    @classmethod
    def of(
        cls, messages: Sequence[ForceMessage], frame: FrameForces, taxel_noise_n: float
    ) -> "_Pair":
        """Return the pair of a frame and the messages around its scan."""
        first_n = _mean(message.force_n[0] for message in messages)
        second_n = _mean(message.force_n[1] for message in messages)
        grip_n = 0.5 * (first_n + second_n)
        most_n = _OUTLIER_SIGMAS * frame.noise_n
        unseen_n = max(_UNSEEN_N, _UNSEEN_SIGMAS * taxel_noise_n)
        least_n = max(_CENTRE_LEAST_N, _CENTRE_LEAST_SIGMAS * taxel_noise_n)
        apart_n, above_n, below_n = [], [], []
        for active_n, whole_n, message_n in zip(
            frame.force_n, frame.whole_n, (first_n, second_n), strict=True
        ):
            frame_n = max(active_n, min(whole_n, message_n))
            above = _LEAST_N + _LEAST_SHARE * max(frame_n, message_n)
            below = above + _BELOW_SIGMAS * taxel_noise_n
            if frame_n == 0.0:
                below = max(below, unseen_n)
            apart_n.append(min(max(frame_n - message_n, -below - most_n), above + most_n))
            above_n.append(above)
            below_n.append(below)
        return cls(
            frame_n=frame.force_n,
            message_n=(first_n, second_n),
            apart_n=(apart_n[0], apart_n[1]),
            above_n=(above_n[0], above_n[1]),
            below_n=(below_n[0], below_n[1]),
            noise_n=frame.noise_n,
            apart_taxels=_centres_apart(messages, frame, grip_n, least_n),
            centre_noise_taxels=frame.centre_noise_taxels,
            below_share=(0.5 * (sum(frame.whole_n) - sum(frame.force_n)))
            / max(grip_n, _CENTRE_LEAST_N),
        )


def _centres_apart(
    messages: Sequence[ForceMessage], frame: FrameForces, message_n: float, least_n: float
) -> tuple[float, float] | None:
    """Return the distance of the centres in pitches; None if the force is too small."""
    light = min(sum(frame.force_n) / 2.0, message_n) < least_n
    if light or frame.centre_taxels is None:
        return None
    centre = mean_centre_taxels(messages)
    if centre is None:
        # Messages without a centre, and a frame with one: the largest possible error.
        return inf, inf
    return centre[0] - frame.centre_taxels[0], centre[1] - frame.centre_taxels[1]


def _mean(values: Iterable[float]) -> float:
    found = tuple(values)
    return sum(found) / len(found)
