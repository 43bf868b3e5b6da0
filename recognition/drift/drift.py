"""Drift of the sensors since teaching: gain of the pads, zero of the opening.

Between days the gain of a pad moves by tens of per cent and the zero of the opening by millimetres.
A `Drift` has both values. Where it is unknown, a `DriftGrid` lists possible drifts with their
probability: a recogniser sums over them. A `GaugeResult` is a drift measured on a known object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.grasp import Grasp
from recognition.ramp.levels import Levels
from recognition.recognizer import DEPENDENCE

_GAIN_RANGE = (0.2, 5.0)
"""Gains that are accepted: beyond them pads are to be replaced, not corrected."""
_MAX_OFFSET_M = 0.1
"""Largest offset of the opening that is accepted, in m: the stroke of a gripper."""
_LOG_GAIN_SD = 0.3
"""Standard deviation of the logarithm of the gain of a drift: tens of per cent."""
_OFFSET_SD_MM = 3.0
"""Standard deviation of the offset of the opening of a drift, in mm."""
_DRIFT_PROBABILITY = 0.003
"""Prior probability that a grasp was taken under any drift at all (docs/explanations/drift.md)."""
_LOG_GAINS = np.linspace(-0.6, 0.6, 13)
"""Logarithms of the gains of a grid: two standard deviations, in steps of 10 %."""
_OFFSETS_MM = np.linspace(-8.0, 8.0, 33)
"""Offsets of the opening of a grid in mm: more than two standard deviations, in steps of 0.5 mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Drift of the sensors since teaching.

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

        Counts that the full scale cut off stay cut off.
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
    """Return the drift that a text gives, as ``gain=0.7,aperture_mm=-4``; either may be left out.

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
    """Possible drifts and their probability.

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
    share: float = _DRIFT_PROBABILITY,
    log_gain_sd: float = _LOG_GAIN_SD,
    offset_sd_mm: float = _OFFSET_SD_MM,
) -> DriftGrid:
    """Return a grid with all but `share` of the probability at its centre.

    The share is spread as a normal distribution of the logarithm of the gain and of the offset.
    """
    narrow_gain = min(1.0, log_gain_sd / _LOG_GAIN_SD)
    narrow_offset = min(1.0, offset_sd_mm / _OFFSET_SD_MM)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class GaugeResult:
    """Drift measured on grasps of one known object, the gauge.

    Attributes
    ----------
    drift
        Mean of the posterior.
    log_gain_sd
        Standard deviation of the posterior of the logarithm of the gain.
    offset_sd_m
        Standard deviation of the posterior of the offset of the opening in m; that of the prior
        where the opening is not used.
    n_grasps
        Number of grasps that touched both pads.
    """

    drift: Drift
    log_gain_sd: float
    offset_sd_m: float
    n_grasps: int


def estimate_drift(log_likelihood: NDArray[np.float64], grid: DriftGrid) -> GaugeResult:
    """Return mean and spread of the drift after some grasps of a known object.

    Parameters
    ----------
    log_likelihood : (n, G, O)
        Of each grasp under each drift of the grid, given what was held.
    grid
        Possible drifts, without the grasps.

    Raises
    ------
    ValueError
        There is no grasp.
    """
    n = len(log_likelihood)
    if n == 0:
        raise ValueError("no gauge grasp touched both pads: grasp the gauge object again")
    total = grid.log_prior + log_likelihood.sum(axis=0) / (1.0 + (n - 1) * DEPENDENCE)
    p = np.exp(total - logsumexp(total))
    log_gain, log_gain_sd = _moments(np.log(grid.gains), p.sum(axis=1))
    offset_mm, offset_sd_mm = _moments(grid.offsets_mm, p.sum(axis=0))
    return GaugeResult(
        drift=Drift(gain=float(np.exp(log_gain)), aperture_offset_m=offset_mm * 1e-3),
        log_gain_sd=log_gain_sd,
        offset_sd_m=offset_sd_mm * 1e-3,
        n_grasps=n,
    )


def _moments(values: NDArray[np.float64], p: NDArray[np.float64]) -> tuple[float, float]:
    mean = float(p @ values)
    return mean, float(np.sqrt(p @ (values - mean) ** 2))
