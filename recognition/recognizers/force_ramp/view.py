"""View of the default recognizer: one discriminant, its temperature and its limit of novelty.

A view answers under each hypothesis of the drift. Distances are divided by the deviation of a grasp
in the directions in which objects do not differ. On another day grasps deviate in all directions, a
new object mostly in those that separate objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from recognition.features import PadGrid, aperture_features, sizes_mm, touch_features
from recognition.ramp.levels import Levels, stack_levels
from recognition.recognizers.force_ramp.view_settings import SETTINGS
from recognition.records import ArrayRecord
from recognition.statistics.calibration import check_temperature
from recognition.statistics.class_spread import ClassSpread
from recognition.statistics.lda import LinearDiscriminant
from recognition.statistics.taught_sizes import TaughtSizes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Features of n grasps under G gains and O offsets of the opening."""

    touch: NDArray[np.float64]
    """(n, G, Ft) float64: of the taxels."""
    opening: NDArray[np.float64]
    """(n, O, Fo) float64: of the opening; Fo is 0 and O is 1 if it is not used."""
    sizes_mm: NDArray[np.float64]
    """(n, O, k) float64: sizes by the opening; k is 0 if it is not used."""
    slack_mm: NDArray[np.float64]
    """(O,) float64: tolerance of a size for other placings of an object, in mm."""


def describe(
    levels: Levels,
    grids: Sequence[PadGrid],
    *,
    opening: bool,
    log_gains: NDArray[np.float64],
    offsets_mm: NDArray[np.float64],
    slack_mm: NDArray[np.float64] | None = None,
) -> Features:
    """Return features of grasps with each of some drifts undone.

    Parameters
    ----------
    levels
        The n grasps.
    log_gains : (G,) or (G, P)
        Logarithms of gains, common to the pads or of each.
    offsets_mm : (O,)
        Offsets of the opening in mm; without effect if it is not used.
    slack_mm : (O,)
        As `Features.slack_mm`; None for none.
    """

    def by_drift(values: NDArray[np.float64]) -> NDArray[np.float64]:
        n_drifts = len(values) // len(levels)
        return values.reshape(n_drifts, len(levels), values.shape[1]).swapaxes(0, 1)

    pressed = stack_levels([levels.without_drift(gain, 0.0) for gain in log_gains])
    touch = by_drift(touch_features(pressed, grids, opening=opening))
    if not opening:
        none = np.zeros((len(levels), 1, 0))
        return Features(touch=touch, opening=none, sizes_mm=none, slack_mm=np.zeros(1))
    moved = stack_levels([levels.without_drift(0.0, offset) for offset in offsets_mm])
    return Features(
        touch=touch,
        opening=by_drift(aperture_features(moved)),
        sizes_mm=by_drift(sizes_mm(moved)),
        slack_mm=np.zeros(len(offsets_mm)) if slack_mm is None else slack_mm,
    )


class Scores(NamedTuple):
    """Scores of n grasps for K classes under G gains and O offsets of the opening."""

    classes: NDArray[np.int64]
    """(K,) int64: the classes, ascending."""
    scores: NDArray[np.float64]
    """(n, G, O, K) float64: log likelihoods up to a constant of the grasp."""
    novelty: NDArray[np.float64]
    """(n, G, O, 2) float64: logarithm of the squared distance to the nearest taught grasp. The
    second one adds that of the size from the likeliest object: a new object is often a little off
    in both."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassModel(ArrayRecord):
    """The classes in the space that separates them."""

    discriminant: LinearDiscriminant
    """The classes."""
    taught: NDArray[np.float32]
    """(n, r) float32: the taught grasps in the discriminant space."""
    taught_classes: NDArray[np.int64]
    """(n,) int64: class of each."""
    sizes: TaughtSizes
    """Sizes of the taught grasps; without dimensions if the opening is not used."""
    spread: ClassSpread | None = None
    """The covariance of each class, by touch alone: there the variation of an object separates it
    from others. With the opening it would only fit the series that taught."""

    def score(self, features: Features, *, likely: int | None = None, also: int = 0) -> Scores:
        """Return scores and novelty of grasps.

        With ``likely`` only so many classes count: those nearest under any drift. The nearest under
        each drift and the class ``also`` are added. None for all.
        """
        model = self.discriminant
        n_touch = features.touch.shape[2]
        touch = (features.touch - model.mean[:n_touch]) / model.scale[:n_touch]
        opening = (features.opening - model.mean[n_touch:]) / model.scale[n_touch:]
        parts = touch @ model.projection[:n_touch], opening @ model.projection[n_touch:]
        z = parts[0][:, :, None] + parts[1][:, None]
        shape, rank = z.shape[:3], z.shape[3]
        unit = np.ones(shape)
        n_outside = len(model.mean) - rank
        if n_outside:
            a, b = touch @ model.variation[:n_touch], opening @ model.variation[n_touch:]
            every = (touch**2).sum(-1)[:, :, None] + (opening**2).sum(-1)[:, None]
            every -= (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None]
            every -= 2.0 * (a @ b.transpose(0, 2, 1))
            outside = np.maximum(every - (z**2).sum(-1), 0.0) / n_outside
            unit = (1.0 + outside) ** (
                SETTINGS.outside_power * rank / (rank + SETTINGS.outside_axes)
            )
        lengths = (z**2).sum(axis=-1)
        distances = _squared_distances(parts, lengths, model.centres)
        classes, taught = np.arange(len(model.centres)), self.taught
        if likely is not None and likely < len(classes):
            every = (distances / unit[..., None]).reshape(-1, len(classes))
            close = np.argpartition(every.min(axis=0), likely)[:likely]
            classes = np.unique([*close, *every.argmin(axis=1), also])
            distances = distances[..., classes]
            taught = taught[np.isin(self.taught_classes, classes)]
        log_volume: NDArray[np.float64] | float = 0.0
        if self.spread is not None:
            plain = distances.reshape(-1, len(classes))
            by_class = self.spread.distances(z.reshape(-1, rank), plain, classes)
            distances = by_class.reshape(distances.shape)
            log_volume = self.spread.log_volume[classes]
        tails = np.log1p(distances / unit[..., None] / rank)
        scores = -0.5 * (rank + SETTINGS.freedom) * tails - log_volume
        nearest = _squared_distances(parts, lengths, taught.astype(np.float64)).min(axis=-1)
        novelty = np.log(nearest / unit / rank + SETTINGS.least_distance)
        novelty = np.stack([novelty, novelty], axis=-1)
        if features.sizes_mm.size:
            best = classes[scores.argmax(axis=-1)]
            off = self.sizes.distances(features.sizes_mm, features.slack_mm, best)
            novelty[..., 1] += np.log1p(off)
        return Scores(classes, scores, novelty)


def _squared_distances(
    parts: tuple[NDArray[np.float64], NDArray[np.float64]],
    lengths: NDArray[np.float64],
    others: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return (n, G, O, m) squared distances between sums of parts and others (m, r).

    The parts (n, G, r) and (n, O, r) are multiplied by the others before they are added. This is
    much less work than all sums. ``lengths`` (n, G, O) are the squared lengths of the sums.
    """
    of_touch, of_opening = (-2.0 * part @ others.T for part in parts)
    of_opening += (others**2).sum(axis=1)
    squared = of_touch[:, :, None] + of_opening[:, None]
    squared += lengths[..., None]
    return np.asarray(np.maximum(squared, 0.0, out=squared), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View(ArrayRecord):
    """One taught view: for grasps with the opening, or by touch alone."""

    model: ClassModel
    """The taught classes."""
    temperature: float
    """Log odds are divided by it."""
    limit: NDArray[np.float64]
    """(2,) float64: novelties at which a new object and a taught one are equally likely."""
    log_new: float
    """Log likelihood of a grasp of a new object."""
    placing_mm: float
    """Standard deviation of the opening on one object between placings in mm."""
    even_share: float
    """Share of even probabilities in an answer if the opening's zero is unknown. It limits the
    wrong names under simulated drifts of other days."""

    def __post_init__(self) -> None:
        check_temperature(self.temperature)

    def likelihood(
        self, features: Features, *, also: int = 0
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the likely classes (K,) with ``also``, and two values of grasps under each drift.

        These are log likelihoods (n, G, O, K), and the probability of a new object (n, G, O).
        """
        scored = self.model.score(features, likely=SETTINGS.likely, also=also)
        used = 1 + bool(features.sizes_mm.size)
        odds = SETTINGS.novelty_slope * (scored.novelty - self.limit)[..., :used].max(axis=-1)
        return scored.classes, scored.scores / self.temperature, expit(odds)
