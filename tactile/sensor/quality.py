"""The quality of samples, judged frame by frame: frozen, stuck, dead or drifted taxels. Pure.

`tactile.sensor.tare` judges untouched frames once, during the tare; this module judges all later
frames.
"""

import numpy as np
from numpy.typing import NDArray

from tactile.errors import FrameTimeout
from tactile.layout import TaxelLayout
from tactile.sensor.filters import Mask, Neighbourhood, Values
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import TareResult
from tactile.source import COUNTER_MASK, TactileFrame

_JUMP_SHARE, _DROP_SHARE, _CALM_SHARE = 0.5, 0.25, 0.1
"""Shares of the full scale. A taxel is broken if it jumps to full scale from below the first, or to
0 from above the second, while its neighbours change by less than the third. It is not a touch,
because the foam spreads every force over the neighbours."""
_CONSECUTIVE = 2
"""Largest difference of the counters of two frames that are compared for jumps."""
_FALLS = 2.0
"""Time in `SensorSettings.frozen_s` within which samples follow a falling set-point."""
_ROUNDING_S = 1e-3
"""Allowance in s for the jitter of the frames' times."""
_DRIFT_SIGMA = 6.0
"""Random difference of a pad's median from its zero, in standard deviations."""
_MEDIAN_SPREAD = 1.25
"""Standard deviation of a median over that of a mean, for normal noise."""


class QualityWatch:
    """Watch over the raw frames from one tare to the next."""

    def __init__(self, hood: Neighbourhood, limits: SensorSettings) -> None:
        self._hood = hood
        self._layout: TaxelLayout = hood.layout
        self._limits = limits
        gripping = np.isin(self._layout.taxel_pad, self._layout.gripping_pads)
        self._outer_taxels = np.flatnonzero(~gripping)
        """Taxels that no grasp presses: their common change is drift."""
        self._aim = (0.0, 0.0)
        self.restart(None)

    def restart(self, tare: TareResult | None, last: TactileFrame | None = None) -> None:
        """Start again with a zero and its last frame, or without."""
        n = self._layout.n_taxels
        self._tare = tare
        self.last = last
        """The frame before, None at the start."""
        self._changed_s = 0.0 if last is None else last.t_s
        self._aimed_s: float | None = None
        self._aim_at_change = self._aim
        self._repeats = np.zeros(n, dtype=np.int64)
        self._broken = np.zeros(n, dtype=np.bool_)
        self.bad: Mask = self._broken.copy() if tare is None else tare.health.bad
        """Taxels that do not measure, (n_taxels,) bool."""
        # A force only raises counts: a taxel that rests high and reads 0 does not measure.
        offset_counts = np.zeros(n) if tare is None else tare.offset_counts
        self._rests_high = offset_counts > _DROP_SHARE * self._layout.adc_max

    def aim(self, force_n: float, aperture_m: float) -> None:
        """Set the set-point of the force in N, 0 for none, and the opening between the pads in m.

        The first set-point is the present force: it is not a change.
        """
        if self._aim[0] == 0.0:
            self._aim_at_change = (force_n, self._aim_at_change[1])
        self._aim = (force_n, aperture_m)

    def step(self, frame: TactileFrame, *, touched: bool) -> None:
        """Take the next frame; ``touched`` is whether the last one had a touch.

        Raises FrameTimeout when the samples are frozen.
        """
        last, self.last = self.last, frame
        if last is None:
            self._changed_s, self._aim_at_change = frame.t_s, self._aim
            return
        same = frame.counts == last.counts
        saturated = frame.counts >= self._layout.adc_max
        self._repeats = np.where(same & ~saturated, self._repeats + 1, 0)
        if (frame.counter - last.counter) & COUNTER_MASK <= _CONSECUTIVE:
            self._look_for_jumps(last.counts, frame.counts, saturated)
        self.bad = self._broken.copy()
        if self._tare is not None:
            self.bad |= self._tare.health.bad
            self.bad |= (frame.counts == 0) & self._rests_high
            if self._tare.health.lively:
                self.bad |= self._repeats >= self._limits.stuck_frames
        if self._tare is None or not same.all():
            self._changed_s, self._aim_at_change = frame.t_s, self._aim
            self._aimed_s = None
            return
        self._check_frozen(frame.t_s, touched=touched)

    def _check_frozen(self, now_s: float, *, touched: bool) -> None:
        limits = self._limits
        frozen_s = now_s - self._changed_s
        if frozen_s < limits.frozen_s - _ROUNDING_S:
            return
        if self._tare is not None and self._tare.health.noisy:
            why = f"allowed are {limits.frozen_s:g} s"
        else:
            force_n = abs(self._aim[0] - self._aim_at_change[0])
            width_m = abs(self._aim[1] - self._aim_at_change[1]) if touched else 0.0
            if force_n < limits.force_step_n and width_m < limits.width_step_m:
                return
            # Friction delays a falling force, and a frame is older than the set-point.
            self._aimed_s = now_s if self._aimed_s is None else self._aimed_s
            falls = self._aim[0] < self._aim_at_change[0]
            if falls and now_s - self._aimed_s < _FALLS * limits.frozen_s - _ROUNDING_S:
                return
            why = f"while the force changed by {force_n:.1f} N, the width by {1e3 * width_m:.1f} mm"
        raise FrameTimeout(
            f"all samples have been identical for {frozen_s:.3f} s, {why}: the unit sends frames "
            "but measures nothing; restart it, then close and start the sensor and tare again"
        )

    def _look_for_jumps(
        self, before: NDArray[np.uint16], now: NDArray[np.uint16], saturated: Mask
    ) -> None:
        """Find taxels that jumped to full scale or to 0 while their neighbours were calm."""
        full = self._layout.adc_max
        jumped = saturated & (before < _JUMP_SHARE * full)
        dropped = (now == 0) & (before > _DROP_SHARE * full)
        odd = jumped | dropped
        if not odd.any():
            return
        change = np.abs(now.astype(np.int64) - before)
        calm = self._hood.highest_neighbour(change) < _CALM_SHARE * full
        self._broken |= odd & calm & ~self._hood.highest_neighbour(odd)

    def drift_outside(self, tared: Values, void: Mask) -> str:
        """Return a message if the pads that no grasp presses are not at their zero, else "".

        Parameters
        ----------
        tared : (n_taxels,) float64
            Tared counts, averaged.
        void : (n_taxels,) bool
            Taxels that are bad or at full scale; they are ignored.
        """
        return self._drift_of(self._outer_taxels, "the pads beside the grip", tared, void)

    def drift_anywhere(self, tared: Values, void: Mask) -> str:
        """Return a message if a pad is not at its zero without a grip, else "".

        Half of a pad's taxels may be touched. Parameters as `drift_outside`.
        """
        for n, pad in enumerate(self._layout.pads):
            taxels = np.flatnonzero(self._layout.taxel_pad == n)
            if drift := self._drift_of(taxels, f"pad {pad.name}", tared, void):
                return drift
        return ""

    def _drift_of(self, taxels: NDArray[np.int64], what: str, tared: Values, void: Mask) -> str:
        tare, good = self._tare, taxels[~void[taxels]]
        if tare is None or 2 * len(good) <= len(taxels):
            return ""
        drift = float(np.median(tared[good]))
        # Noise alone may move the median further than the limit.
        share = np.sqrt((1.0 / self._limits.mean_frames + 1.0 / tare.n_frames) / len(good))
        spread = float(_MEDIAN_SPREAD * np.median(tare.noise_counts[good]) * share)
        limit = max(self._limits.drift_share * self._layout.adc_max, _DRIFT_SIGMA * spread)
        if abs(drift) <= limit:
            return ""
        return (
            f"the zero of {what} has drifted by {drift:+.1f} counts, allowed are {limit:.1f}: let "
            "the sensor come to an even temperature, clear the pads, then start the cell to take "
            "a new zero"
        )
