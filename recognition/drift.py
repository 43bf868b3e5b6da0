"""Drift of the sensors since teaching: gain of the pads, zero of the opening.

Between days the gain of a pad moves by tens of per cent and the zero of the opening by millimetres.
A `Drift` says by how much. Where it is not known, `DriftGrid` lists what it may be and how likely
that is: a recogniser sums over it, so that a drift costs little and a grasp without drift as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.grasp import Grasp
from recognition.ramp_levels import Levels

_GAIN_RANGE = (0.2, 5.0)
_MAX_OFFSET_M = 0.1
_LOG_GAINS = np.linspace(-0.6, 0.6, 13)
_OFFSETS_MM = np.linspace(-8.0, 8.0, 33)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """What changed since teaching.

    Attributes
    ----------
    gain
        Counts above rest are this many times those of the taught sensor, 0.2 to 5.
    aperture_offset_m
        The opening reads this much more than it did, in m, at most 0.1 either way.

    Raises
    ------
    ValueError
        A value is outside of its range.
    """

    gain: float = 1.0
    aperture_offset_m: float = 0.0

    def __post_init__(self) -> None:
        low, high = _GAIN_RANGE
        if not low <= self.gain <= high:
            raise ValueError(f"gain is {self.gain}, must be from {low} to {high}")
        if not abs(self.aperture_offset_m) <= _MAX_OFFSET_M:
            raise ValueError(
                f"the offset of the opening is {self.aperture_offset_m * 1e3:.1f} mm, "
                f"must be within {_MAX_OFFSET_M * 1e3:.0f} mm of 0"
            )

    def apply(self, grasp: Grasp) -> Grasp:
        """Return the grasp as a sensor with this drift would have recorded it.

        Counts are scaled, rounded and clipped to full scale, the opening is moved.
        """
        counts = np.clip(np.rint(grasp.counts * self.gain), 0, grasp.pads.adc_max)
        return replace(
            grasp,
            counts=counts.astype(np.uint16),
            aperture_m=grasp.aperture_m + self.aperture_offset_m,
        )

    def undo(self, grasp: Grasp) -> Grasp:
        """Return a grasp recorded under this drift as the taught sensor would have recorded it.

        What the full scale cut off stays cut off.
        """
        counts = np.clip(np.rint(grasp.counts / self.gain), 0, grasp.pads.adc_max)
        return replace(
            grasp,
            counts=counts.astype(np.uint16),
            aperture_m=grasp.aperture_m - self.aperture_offset_m,
        )


NO_DRIFT = Drift()
"""The sensors as they were taught."""


def parse_drift(text: str) -> Drift:
    """Return the drift that the text names, as ``gain=0.7,aperture_mm=-4``; either may be left out.

    Raises ValueError, naming what is accepted, for any other text and for values out of range.
    """
    values: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = (piece.strip() for piece in part.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if name not in ("gain", "aperture_mm") or name in values or not np.isfinite(value):
            raise ValueError(
                f"drift {text!r} is not understood: give gain=NUMBER and aperture_mm=NUMBER, "
                "for example gain=0.7,aperture_mm=-4"
            )
        values[name] = value
    return Drift(
        gain=values.get("gain", 1.0), aperture_offset_m=values.get("aperture_mm", 0.0) * 1e-3
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriftGrid:
    """What the drift may be.

    Attributes
    ----------
    gains : (G,) float64
        Gains.
    offsets_mm : (O,) float64
        Offsets of the opening in mm.
    log_prior : (G, O) float64
        Logarithm of the probability of each pair; they sum to 1.
    """

    gains: NDArray[np.float64]
    offsets_mm: NDArray[np.float64]
    log_prior: NDArray[np.float64]

    @property
    def likeliest(self) -> Drift:
        """The drift that is likeliest."""
        gain, offset = np.unravel_index(int(np.argmax(self.log_prior)), self.log_prior.shape)
        return Drift(
            gain=float(self.gains[gain]), aperture_offset_m=float(self.offsets_mm[offset]) * 1e-3
        )

    @property
    def gain_only(self) -> "DriftGrid":
        """The same without the opening."""
        prior = np.asarray(logsumexp(self.log_prior, axis=1, keepdims=True), dtype=np.float64)
        return DriftGrid(gains=self.gains, offsets_mm=np.zeros(1), log_prior=prior)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {
            f"{prefix}gains": self.gains,
            f"{prefix}offsets_mm": self.offsets_mm,
            f"{prefix}log_prior": self.log_prior,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(
            gains=arrays[f"{prefix}gains"],
            offsets_mm=arrays[f"{prefix}offsets_mm"],
            log_prior=arrays[f"{prefix}log_prior"],
        )


CERTAIN = DriftGrid(gains=np.ones(1), offsets_mm=np.zeros(1), log_prior=np.zeros((1, 1)))
"""There is no drift."""


def drift_grid(
    centre: Drift = NO_DRIFT,
    *,
    share: float = 0.003,
    log_gain_sd: float = 0.3,
    offset_sd_mm: float = 3.0,
) -> DriftGrid:
    """Return a grid with all but `share` of the probability at its centre.

    The share is spread as a normal distribution of the logarithm of the gain and of the offset.
    """
    narrow_gain = min(1.0, log_gain_sd / 0.3)
    narrow_offset = min(1.0, offset_sd_mm / 3.0)
    log_gains, offsets = narrow_gain * _LOG_GAINS, narrow_offset * _OFFSETS_MM
    spread = np.exp(
        -0.5 * (log_gains / log_gain_sd)[:, None] ** 2 - 0.5 * (offsets / offset_sd_mm) ** 2
    )
    prior = share * spread / spread.sum()
    prior[len(log_gains) // 2, len(offsets) // 2] += 1.0 - share
    return DriftGrid(
        gains=centre.gain * np.exp(log_gains),
        offsets_mm=centre.aperture_offset_m * 1e3 + offsets,
        log_prior=np.log(prior),
    )


def undo_gains(levels: Levels, gains: Sequence[float] | NDArray[np.float64]) -> Levels:
    """Return n * G rows: each of n grasps with each of G gains undone, grasp by grasp."""
    gains = np.asarray(gains, dtype=np.float64)
    k, n = len(gains), len(levels)
    factor = np.tile(1.0 / gains, n)[:, None, None]
    rows = np.repeat(np.arange(n), k)
    taken = levels.take(rows)
    return replace(
        taken,
        maps=tuple(m * factor for m in taken.maps),
        noise=taken.noise * factor,
        timed_load=taken.timed_load * factor,
    )
