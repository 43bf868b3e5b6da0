"""Level of a grasp: the paper's one number, the smallest eigenvalue of its surface at a force.

The number is close to j^2 over the fitted peak height in counts. It changes with the grip force, so
levels are comparable only at equal force. This is near the end of the ramp, at one force, or along
its steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from recognition.errors import ContactError, QuadricError, RecognitionError
from recognition.grasp import Grasp, PadArray
from recognition.quadric.quadric import LevelBands, fit_height_field, smallest_eigenvalue
from recognition.ramp.ramp import find_ramp, own_rest

_TOLERANCE = 0.1
"""Largest relative difference of frames near a force or load."""
_PEAK_SHARE = 0.4
"""Least height of a loaded taxel as a share of the pad's largest. Without it the threshold falls
with the number of averaged frames. Taxels at the edge of the patch then appear and disappear with
the remaining noise and change the fitted surface."""
_RIM = 1
"""Rings of unloaded taxels that the fit includes."""
_LEAST_SHARE = 0.05
"""Least load of a touched second pad, as a share of the first pad's."""
_LOADED_SIGMAS = 4.0
"""Threshold of a loaded taxel in standard deviations of the mean."""
_LEAST_HEIGHT = 0.004
"""Least height of a loaded taxel as a share of full scale: one count of 255."""
ROUNDING_COUNTS = 12.0**-0.5
"""Standard deviation of rounding to whole counts: the least noise of a taxel."""
_NEIGHBOURS = np.ones((3, 3), dtype=np.int64)
"""Neighbours, also over a corner, are connected."""
FULL_SCALE_COUNTS = 255.0
"""Full scale of the fitted heights: counts of the paper's 8-bit converter, for pads of any kind."""

_PRIOR_GRASPS = 4.0
"""Weight, in grasps, of the pooled spread against an object's own."""
_LEAST_SPREAD = 0.02
"""Least standard deviation of a level's logarithm, also for very similar taught grasps."""
_DEFAULT_SPREAD = 0.08
"""Pooled spread with one grasp of every object: the noise of the paper's levels."""
_DRAWS = 12
"""Number of random disturbances that show the effect of noise on a level."""
_NOISE_GRASPS = 30
"""About the number of disturbed taught grasps; more would change the result little."""


def main_patch(
    height: NDArray[np.float64], pads: PadArray, pad: int, threshold: float, *, rim: int = 0
) -> NDArray[np.int64]:
    """Return the taxels of the most loaded patch of a pad, indices among all, ascending.

    Raises ContactError if no taxel exceeds the threshold; the message names the largest height.

    Parameters
    ----------
    height : (n_taxels,) float64
        Baseline-corrected counts of all taxels.
    pads, pad
        Positions of the taxels, and number of the pad.
    threshold
        Taxels above it are loaded; neighbours, also over a corner, make one patch.
    rim
        Rings of taxels around each patch that are added with their own heights. They show the end
        of the contact; without them small contacts have no surface.
    """
    taxels = pads.taxels_of(pad)
    grid = height[taxels].reshape(pads.pad_shape[pad])
    loaded = grid > threshold
    label, n_patches = ndimage.label(loaded, structure=_NEIGHBOURS)
    if not n_patches:
        raise ContactError(
            f"it is not touched: largest height {float(grid.max()):.3g} counts, threshold "
            f"{threshold:.3g}; grip harder or tare again"
        )
    patches = []
    for index in range(1, n_patches + 1):
        core = label == index
        wide = ndimage.binary_dilation(core, _NEIGHBOURS, iterations=rim) if rim else core
        patches.append(taxels[np.flatnonzero((core | (wide & ~loaded)).ravel())])
    return max(patches, key=lambda patch: float(height[patch].sum()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanFrames:
    """The mean of a grasp's frames near the force of its level."""

    pads: PadArray
    touched: dict[int, float]
    """The touched gripping pads, and the height in counts above which a taxel is loaded."""
    height: NDArray[np.float64]
    """(n_taxels,) float64: counts above rest; 0 on the pads that do not grip."""
    noise: float
    """Standard deviation of a height in counts of 255: the mean of the gripping pads."""

    @classmethod
    def of(cls, grasp: Grasp, force_n: float | None = None) -> "MeanFrames":
        """Return that mean, near a force in N or near the full one.

        Raises ContactError if the ramp never came near the force, or is too short.
        """
        frames = frames_at(grasp, force_n)
        rest = own_rest(grasp)
        ramp, adc_max = find_ramp(grasp, rest), grasp.pads.adc_max
        noise = np.maximum(ramp.noise_counts, ROUNDING_COUNTS) / np.sqrt(len(frames))
        loaded = np.maximum(_LOADED_SIGMAS * noise, _LEAST_HEIGHT * adc_max).tolist()
        noise *= np.sqrt(1.0 + len(frames) / ramp.n_quiet)
        height, loads = np.zeros(grasp.pads.n_taxels), []
        for pad, rise, least in zip(rest.gripping, ramp.rise, loaded, strict=True):
            height[grasp.pads.taxels_of(pad)] = mean = rise[frames].mean(axis=0)
            loads.append(float(mean[mean > least].sum()))
        touched = {
            pad: least
            for pad, least, load in zip(rest.gripping, loaded, loads, strict=True)
            if load > _LEAST_SHARE * max(loads)
        }
        return cls(
            pads=grasp.pads,
            touched=touched,
            height=height,
            noise=float(noise.mean()) * FULL_SCALE_COUNTS / adc_max,
        )

    def surfaces(self, disturbance: ArrayLike = 0.0) -> list[NDArray[np.float64]]:
        """Return the surface of each gripping pad that has one, with disturbed heights.

        Raises QuadricError if there is none.
        """
        pads, height = self.pads, self.height + np.asarray(disturbance)
        to_8_bit = FULL_SCALE_COUNTS / pads.adc_max
        surfaces, refused = [], []
        for pad, loaded in self.touched.items():
            least = _PEAK_SHARE * float(height[pads.taxels_of(pad)].max())
            try:
                patch = main_patch(height, pads, pad, max(loaded, least), rim=_RIM)
                surface = fit_height_field(pads.taxel_xy_m[patch], to_8_bit * height[patch])
                if smallest_eigenvalue(surface).degenerate:
                    raise QuadricError("the matrix is singular to rounding")
            except RecognitionError as error:
                refused.append(f"pad {pad}: {error}")
            else:
                surfaces.append(surface)
        if not surfaces:
            reasons = "; ".join(refused) or "none is touched"
            raise QuadricError(f"no pad carries a surface: {reasons}")
        return surfaces

    def level(self, disturbance: ArrayLike = 0.0) -> float:
        """Return the smallest magnitude, the geometric mean of the pads; raises as `surfaces`."""
        smallest = [
            float(smallest_eigenvalue(surface).value) for surface in self.surfaces(disturbance)
        ]
        return float(np.exp(np.mean(np.log(smallest))))


def level_of(grasp: Grasp, force_n: float | None = None) -> tuple[float, MeanFrames] | None:
    """Return the level of a grasp, and the mean that gives it; None if it has no surface.

    Frames near a force in N, or near the full one, are averaged: the noise filter before the
    surface. The loaded patch of each gripping pad is fitted in the form (7), and the smallest
    eigenvalues of the pads are averaged geometrically.
    """
    try:
        mean = MeanFrames.of(grasp, force_n)
        return mean.level(), mean
    except RecognitionError:
        return None


def frames_at(grasp: Grasp, force_n: float | None = None) -> NDArray[np.int64]:
    """Return the frames near a force in N; near the full force for None.

    Without recorded forces they are near the full load: the total load between its least and its
    largest value, smoothed over three frames. The frame nearest to the full one is always included.

    Raises ContactError if the ramp never came near the force.
    """
    known = np.isfinite(grasp.force_n)
    if known.any():
        # Frames without a force are infinitely far.
        reached, full = np.where(known, grasp.force_n, np.inf), float(grasp.force_n[known].max())
    else:
        total = grasp.counts.sum(axis=1, dtype=np.float64)
        reached = ndimage.median_filter(total, 3, mode="nearest")
        reached, force_n = reached - reached.min(), None
        full = float(reached.max())
    target = full if force_n is None else force_n
    distance = np.abs(reached - target)
    limit = _TOLERANCE * target
    if force_n is None:
        limit = max(limit, float(distance.min()))
    frames = np.flatnonzero(distance <= limit)
    if len(frames) == 0:
        raise ContactError(
            f"no frame within {limit:.3g} N of {target:.3g} N; the ramp reached {full:.3g} N"
        )
    return frames


def common_force_n(grasps: Sequence[Grasp]) -> float | None:
    """Return the largest force in N that every grasp reached, None if one is not recorded."""
    reached = [
        float(np.max(g.force_n, initial=-np.inf, where=np.isfinite(g.force_n))) for g in grasps
    ]
    least = min(reached)
    return least if np.isfinite(least) and least > 0.0 else None


def noise_per_count(mean: MeanFrames, rng: np.random.Generator) -> float:
    """Return the relative change of the level by noise, for each count of `MeanFrames.noise`.

    The mean is disturbed a dozen times by its own amount of noise. Patch and surface are then
    computed again. NaN if they are lost.
    """
    pads = mean.pads
    counts = mean.noise * pads.adc_max / FULL_SCALE_COUNTS
    try:
        levels = [mean.level(draw) for draw in rng.normal(0.0, counts, (_DRAWS, pads.n_taxels))]
    except RecognitionError:
        return float("nan")
    return float(np.std(levels) / abs(np.mean(levels))) / mean.noise


def usual_noise(means: Sequence[MeanFrames]) -> tuple[float, float]:
    """Return the median of `MeanFrames.noise` and the root mean square of `noise_per_count`.

    About `_NOISE_GRASPS` of the means, evenly selected, are used.
    """
    some, rng = means[:: -(-len(means) // _NOISE_GRASPS)], np.random.default_rng(0)
    squares = np.square([noise_per_count(mean, rng) for mean in some])
    # A changed patch is rare, but changes the level most: a median would ignore it.
    per_count = np.sqrt(np.mean(squares[np.isfinite(squares)])) if np.isfinite(squares).any() else 0
    return float(np.median([mean.noise for mean in some])), float(per_count)


def log_statistics(
    values: Sequence[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and spread of log|level|; each spread is shrunk towards the pooled one."""
    logs = [np.log(np.abs(level)) for level in values]
    counts = np.array([len(log) for log in logs])
    mean = np.array([log.mean() if len(log) else np.nan for log in logs])
    squares = np.array([np.sum((log - log.mean()) ** 2) if len(log) else 0.0 for log in logs])
    freedom = np.maximum(counts - 1, 0)
    pooled = float(squares.sum() / freedom.sum()) if freedom.sum() else _DEFAULT_SPREAD**2
    variance = (squares + _PRIOR_GRASPS * pooled) / (freedom + _PRIOR_GRASPS)
    # Few grasps give the mean with an error.
    variance = variance * (1.0 + 1.0 / np.maximum(counts, 1))
    spread = np.sqrt(np.maximum(variance, _LEAST_SPREAD**2))
    return mean, np.where(counts > 0, spread, np.nan)


def level_novelty(levels: LevelBands, value: float) -> float:
    """Return 0 inside a band, 1/2 at the edge of its margin, towards 1 beyond."""
    edge = np.where(value < levels.low, np.abs(levels.low), np.abs(levels.high))
    nearest = float(np.nanmin(levels.distance(value) / (levels.margin * edge)))
    return nearest**2 / (1.0 + nearest**2)
