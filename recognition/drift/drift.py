"""Drift of the sensors since teaching: gain of each pad, zero of the opening.

Between days the gain of a pad moves by tens of per cent and the zero of the opening by millimetres.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp

_GAIN_RANGE = (0.2, 5.0)
"""Gains that are accepted: beyond them pads are to be replaced, not corrected."""
_MAX_OFFSET_M = 0.1
"""Largest offset of the opening that is accepted, in m: the stroke of a gripper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Drift of the sensors since teaching.

    Raises ValueError where a value is outside of its range.
    """

    gains: tuple[float, ...] = (1.0,)
    """Counts above rest over those of the taught sensor, 0.2 to 5. One value for each pad in the
    order of the layout, or a single one for all pads."""
    aperture_offset_m: float = 0.0
    """Increase of the reading of the opening in m, at most 0.1 in both directions."""

    def __post_init__(self) -> None:
        low, high = _GAIN_RANGE
        if not self.gains or not all(low <= gain <= high for gain in self.gains):
            raise ValueError(f"gain is {self.gains}, must be from {low} to {high}")
        if not abs(self.aperture_offset_m) <= _MAX_OFFSET_M:
            raise ValueError(
                f"the offset of the opening is {self.aperture_offset_m * 1e3:.1f} mm, "
                f"must be within {_MAX_OFFSET_M * 1e3:.0f} mm of 0"
            )

    @property
    def gain(self) -> float:
        """Geometric mean of the gains."""
        return float(np.exp(np.mean(np.log(self.gains))))

    def gains_of(self, pads: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the gain of each of some pads, by their numbers in the layout."""
        return np.array([self.gains[pad if len(self.gains) > 1 else 0] for pad in pads])

    def apply(self, grasp: Grasp) -> Grasp:
        """Return the grasp as a sensor with this drift would have recorded it.

        Counts are scaled, rounded and clipped to full scale, and the opening is shifted. The copy
        has no self-zero, because that was measured before the drift. Raises ValueError if the
        numbers of pads and gains differ.
        """
        return replace(self._moved(grasp, 1), zero=None)

    def undo(self, grasp: Grasp) -> Grasp:
        """Return a grasp recorded under this drift as the taught sensor would have recorded it.

        Counts that were clipped at full scale stay clipped. Raises as `apply`.
        """
        return self._moved(grasp, -1)

    def _moved(self, grasp: Grasp, sign: Literal[1, -1]) -> Grasp:
        n_pads = len(grasp.pads.pad_shape)
        if len(self.gains) not in (1, n_pads):
            raise ValueError(f"{len(self.gains)} gains do not fit the {n_pads} pads of the grasp")
        gains = self.gains_of(tuple(grasp.pads.taxel_pad.tolist()))
        counts = np.clip(np.rint(grasp.counts * gains**sign), 0, grasp.pads.adc_max)
        aperture_m = grasp.aperture_m + sign * self.aperture_offset_m
        return replace(grasp, counts=counts.astype(np.uint16), aperture_m=aperture_m)


def drift_text(drift: Drift) -> str:
    """Return a drift as text for people: ``gain 0.70, opening -4.0 mm``.

    Where the gains of the pads differ, the smallest and the largest are named.
    """
    low, high = (f"{gain:.2f}" for gain in (min(drift.gains), max(drift.gains)))
    gain = low if low == high else f"{low} to {high}"
    return f"gain {gain}, opening {drift.aperture_offset_m * 1e3:+.1f} mm"
