"""Recognizer `level_check`, the paper's method: one scalar per grasp against taught levels.

It is the paper's reference, not the best of the cell. The scalar is close to the inverse of the
fitted peak height, so objects of any shape with similar pressure are confused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp, PadArray, by_label, keep_array
from recognition.quadric.level import (
    common_force_n,
    level_novelty,
    level_of,
    log_statistics,
    usual_noise,
)
from recognition.quadric.quadric import LevelBands, check_level, find_thresholds, with_noise
from recognition.ramp.ramp import learn_rest
from recognition.recognizer import UNKNOWN, Posterior
from recognition.records import TaughtRecord

_BAND_SIGMAS = 2.0
"""Bands are widened by this number of standard deviations of the noise beyond the taught one."""
_FLATTEN = 0.01
"""Share of the uniform distribution in each posterior: one scalar is never certain."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelCheckRecognizer(TaughtRecord):
    """Taught levels."""

    version: ClassVar[int] = 3
    labels: tuple[str, ...]
    """The taught objects, sorted."""
    pads: PadArray
    """The pads of the teaching."""
    force_n: float | None
    """Grip force in N of the levels: the largest that each taught grasp reached, because levels
    compare at equal force only. None without recorded forces: near the full load of each ramp."""
    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    """(n_labels,) float64: mean and standard deviation of the natural logarithm of the level's
    magnitude; NaN for an object if all its taught grasps had no surface."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """(n_labels,) float64: least and largest taught level; NaN likewise."""
    noise_counts: float
    """Noise of the taught grasps, see `recognition.quadric.level.MeanFrames`."""
    noise_per_count: float
    """Relative change of a level by noise, for each count."""

    def __post_init__(self) -> None:
        for name in ("mean", "spread", "low", "high"):
            keep_array(self, name, getattr(self, name), np.float64, (len(self.labels),))

    @property
    def levels(self) -> LevelBands:
        """Bands, thresholds and windows of the taught objects."""
        return find_thresholds(list(np.stack([self.low, self.high], axis=1)))

    def measure(self, grasp: Grasp) -> tuple[float, float] | None:
        """Return the level of a grasp and its additional noise; None if it has no surface.

        The noise is that over the taught grasps, as a share of the level, a standard deviation.
        Raises ValueError for pads other than the taught ones.
        """
        self.pads.check(grasp.pads)
        measured = level_of(grasp, self.force_n)
        if measured is None:
            return None
        value, mean = measured
        more_counts = np.sqrt(max(mean.noise**2 - self.noise_counts**2, 0.0))
        return value, self.noise_per_count * float(more_counts)

    def check(self, grasp: Grasp) -> str:
        """Return the object by the paper's rule under its noise; ``UNKNOWN`` in closed windows."""
        measured = self._adjusted(grasp)
        index = None if measured is None else check_level(measured[2], measured[0])
        return UNKNOWN if index is None else self.labels[index]

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp by its level; see `recognition.recognizer.Recognizer`.

        ``unknown`` is 0 inside a band, 1/2 at the edge of its margin and goes to 1 beyond. A grasp
        without a surface, or with too much noise, gives a uniform posterior and unknown 1. In a
        closed window the probability is shared. Additional noise widens spreads and bands.
        """
        measured = self._adjusted(grasp)
        if measured is None:
            return Posterior.uninformed(self.labels)
        value, more, adjusted = measured
        spread = np.hypot(self.spread, more)
        z = (np.log(abs(value)) - self.mean) / spread
        log_density = np.where(np.isnan(z), -np.inf, -0.5 * z**2 - np.log(spread))
        density = np.exp(log_density - log_density.max())
        probability = (1.0 - _FLATTEN) * density / density.sum() + _FLATTEN * (
            1.0 / len(self.labels)
        )
        return Posterior(
            labels=self.labels,
            probability=probability / probability.sum(),
            unknown=level_novelty(adjusted, value),
        )

    def _adjusted(self, grasp: Grasp) -> tuple[float, float, LevelBands] | None:
        """Return `measure` and the bands under that noise; None if they would cover everything."""
        measured = self.measure(grasp)
        if measured is None or _BAND_SIGMAS * measured[1] >= 1.0:
            return None
        return *measured, with_noise(self.levels, _BAND_SIGMAS * measured[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelCheckTrainer:
    """Teaches the levels."""

    name: ClassVar[str] = "level_check"
    use_aperture: bool = False
    """Accepted like by every trainer of this package. The paper's method does not use the opening,
    so both values teach the same and `uses_aperture` is always False."""

    @property
    def uses_aperture(self) -> bool:
        """The opening between the fingers is not used."""
        return False

    def fit(self, grasps: Sequence[Grasp]) -> LevelCheckRecognizer:
        """Teach the level of each label.

        An object without a surface in any grasp keeps its label without a level. Raises ValueError
        without grasps, for a grasp without a label, grasps from different pads, or if no grasp has
        a surface.
        """
        members = by_label(grasps)
        pads = learn_rest(grasps).pads
        force_n = common_force_n(grasps)
        measured = [
            [m for grasp in group if (m := level_of(grasp, force_n)) is not None]
            for group in members.values()
        ]
        values = [np.array([value for value, _ in group]) for group in measured]
        levels = find_thresholds(values)
        mean, spread = log_statistics(values)
        noise_counts, noise_per_count = usual_noise([m for group in measured for _, m in group])
        return LevelCheckRecognizer(
            labels=tuple(members),
            pads=pads,
            force_n=force_n,
            mean=mean,
            spread=spread,
            low=levels.low,
            high=levels.high,
            noise_counts=noise_counts,
            noise_per_count=noise_per_count,
        )
