"""Level of a grasp: the paper's one number, the smallest eigenvalue of its surface at a force.

The number is close to j^2 over the fitted peak height in counts. It changes with the grip force, so
levels are comparable only at equal force. This is near the end of the ramp, at one force, or along
its steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import ContactError, QuadricError
from recognition.grasp import Grasp, PadArray
from recognition.quadric.contact import estimate_baseline, main_patch, noise_threshold
from recognition.quadric.eigen import smallest_eigenvalue
from recognition.quadric.quadric import fit_height_field
from recognition.quadric.thresholds import LevelBands

_TOLERANCE = 0.1
"""Largest relative difference of frames near a force or load."""
_PEAK_SHARE = 0.4
"""Least height of a loaded taxel as a share of the pad's largest. Without it the threshold falls
with the number of averaged frames. Taxels at the edge of the patch then appear and disappear with
the remaining noise and change the fitted surface."""
_RIM = 1
"""Rings of unloaded taxels that the fit includes."""
FULL_SCALE_COUNTS = 255.0
"""Full scale of the fitted heights: counts of the paper's 8-bit converter, for pads of any kind."""

_PRIOR_GRASPS = 4.0
"""Weight, in grasps, of the pooled spread against an object's own."""
_LEAST_SPREAD = 0.02
"""Least standard deviation of a level's logarithm, also for very similar taught grasps."""
_DEFAULT_SPREAD = 0.08
"""Pooled spread with one grasp of every object: the noise of the paper's levels."""
_LEAST_SHARE = 0.05
"""Least load of a touched second pad, as a share of the first pad's."""
_DRAWS = 12
"""Number of random disturbances that show the effect of noise on a level."""
_NOISE_GRASPS = 30
"""About the number of disturbed taught grasps; more would change the result little."""


def gripping_pads(load: ArrayLike, pads: PadArray) -> tuple[int, ...]:
    """Return the one or two pads that hold the object, the most loaded one first.

    The second is the counterpart of the first: the same place in the other half of the list of pads
    (finger 0, then finger 1). If its shape differs, it is the most loaded other pad. Raises
    ContactError if no pad is loaded.

    Parameters
    ----------
    load : (n_pads,)
        Load of each pad in counts.
    """
    load = np.asarray(load, dtype=np.float64)
    first = int(np.argmax(load))
    if not load[first] > 0:
        raise ContactError(
            "no pad is loaded: nothing was gripped, or the ramp ended before contact"
        )
    if pads.n_pads == 1:
        return (first,)
    second = (first + pads.n_pads // 2) % pads.n_pads
    if pads.n_pads % 2 or not np.array_equal(pads.pad_shape[first], pads.pad_shape[second]):
        second = int(np.argsort(-load, kind="stable")[1])
    return (first, second) if load[second] > _LEAST_SHARE * load[first] else (first,)


def frames_near_full(grasp: Grasp) -> NDArray[np.int64]:
    """Return the frames of a ramp near its full force.

    It uses the commanded force if known. Else it uses the total load between its least and its
    largest value, smoothed over three frames. The nearest frame is always included.
    """
    known = np.isfinite(grasp.force_n)
    if known.any():
        # Frames without a force are infinitely far.
        reached = np.where(known, grasp.force_n, np.inf) / max(
            float(np.max(grasp.force_n[known])), 1e-9
        )
    else:
        total = grasp.counts.sum(axis=1, dtype=np.float64)
        padded = np.concatenate([total[:1], total, total[-1:]])
        total = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
        least = float(total.min())
        reached = (total - least) / max(float(total.max()) - least, 1e-9)
    distance = np.abs(reached - 1.0)
    return np.flatnonzero(distance <= max(_TOLERANCE, float(distance.min())))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanFrames:
    """The mean of a grasp's frames near the force of its level."""

    pads: PadArray
    height: NDArray[np.float64]
    """(n_taxels,) float64: counts above the baseline."""
    threshold: NDArray[np.float64]
    """(n_pads,) float64: height in counts above which a taxel is loaded."""
    noise: float
    """Standard deviation of a height in counts of 255: the median over the pads."""

    @classmethod
    def of(cls, grasp: Grasp, force_n: float | None) -> "MeanFrames":
        """Return that mean; arguments and errors as `frames_at`."""
        frames = frames_at(grasp, force_n)
        baseline, pads = estimate_baseline(grasp), grasp.pads
        share = np.sqrt(1.0 / len(frames) + 1.0 / np.maximum(baseline.quiet_frames, 1))
        noise = float(np.median(baseline.noise_counts * share))
        threshold = [
            noise_threshold(float(one), len(frames), pads.adc_max) for one in baseline.noise_counts
        ]
        return cls(
            pads=pads,
            height=grasp.counts[frames].mean(axis=0) - baseline.counts,
            threshold=np.array(threshold),
            noise=noise * FULL_SCALE_COUNTS / pads.adc_max,
        )

    def surfaces(self, disturbance: ArrayLike = 0.0) -> list[NDArray[np.float64]]:
        """Return the surface of each gripping pad that has one, with disturbed heights.

        Raises ContactError or QuadricError as `grip_level`.
        """
        pads, height = self.pads, self.height + np.asarray(disturbance)
        over = np.where(height > self.threshold[pads.taxel_pad], height, 0.0)
        load = np.bincount(pads.taxel_pad, weights=over, minlength=pads.n_pads)
        to_8_bit = FULL_SCALE_COUNTS / pads.adc_max
        found, refused = [], []
        for pad in gripping_pads(load, pads):
            least = _PEAK_SHARE * float(height[pads.taxels_of(pad)].max())
            threshold = max(float(self.threshold[pad]), least)
            patch = main_patch(height, pads, pad, threshold, rim=_RIM)
            try:
                surface = fit_height_field(pads.taxel_xy_m[patch], to_8_bit * height[patch])
            except QuadricError as error:
                refused.append(f"pad {pad}: {error}")
                continue
            if smallest_eigenvalue(surface).degenerate:
                refused.append(f"pad {pad}: the matrix is singular to rounding")
            else:
                found.append(surface)
        if not found:
            raise QuadricError("no pad carries a surface: " + "; ".join(refused))
        return found

    def level(self, disturbance: ArrayLike = 0.0) -> float:
        """Return the smallest magnitude, the geometric mean of the pads; raises as `surfaces`."""
        smallest = [
            float(smallest_eigenvalue(surface).value) for surface in self.surfaces(disturbance)
        ]
        return float(np.exp(np.mean(np.log(smallest))))


def grip_surfaces(grasp: Grasp, force_n: float | None = None) -> tuple[NDArray[np.float64], ...]:
    """Return the surface of each gripping pad that has one, the most loaded pad first.

    Surfaces are property matrices (4, 4), see `recognition.quadric.quadric`. Raises ContactError or
    QuadricError as `grip_level`.
    """
    return tuple(MeanFrames.of(grasp, force_n).surfaces())


def grip_level(grasp: Grasp, force_n: float | None = None) -> float:
    """Return the smallest eigenvalue of one grasp, at a force in N or near its full one.

    Frames near the force are averaged (the noise filter before the surface). The loaded patch of
    each gripping pad is fitted in the form (7), and the eigenvalues of the pads are averaged,
    magnitudes geometrically. Raises ContactError if no pad is touched, or the ramp never came near
    ``force_n``. Raises QuadricError if no gripping pad has a surface.
    """
    return MeanFrames.of(grasp, force_n).level()


def frames_at(grasp: Grasp, force_n: float | None) -> NDArray[np.int64]:
    """Return the frames near a force in N, near the full force for None.

    Grasps without recorded forces are used near their full load.

    Raises ContactError if the ramp never came near it.
    """
    known = np.isfinite(grasp.force_n)
    if force_n is None or not known.any():
        return frames_near_full(grasp)
    largest = float(np.max(grasp.force_n[known]))
    distance = np.where(known, np.abs(grasp.force_n - force_n), np.inf)
    frames = np.flatnonzero(distance <= _TOLERANCE * force_n)
    if len(frames) == 0:
        raise ContactError(
            f"no frame within {_TOLERANCE * force_n:.3g} N of {force_n:.3g} N; the ramp "
            f"reached {largest:.3g} N"
        )
    return frames


def common_force_n(grasps: Sequence[Grasp]) -> float | None:
    """Return the largest force in N that every grasp reached, None if one is not recorded."""
    reached = [
        float(np.max(g.force_n, initial=-np.inf, where=np.isfinite(g.force_n))) for g in grasps
    ]
    least = min(reached)
    return least if np.isfinite(least) and least > 0.0 else None


def level_noise_per_count(mean: MeanFrames, rng: np.random.Generator) -> float:
    """Return the relative change of the level by noise, for each count of `MeanFrames.noise`.

    The mean is disturbed a dozen times by its own amount of noise. Patch and surface are then
    computed again. Raises ContactError or QuadricError without a surface.
    """
    counts = mean.noise * mean.pads.adc_max / FULL_SCALE_COUNTS
    draws = rng.normal(0.0, counts, (_DRAWS, mean.pads.n_taxels))
    levels = [mean.level(draw) for draw in draws]
    return float(np.std(levels) / abs(np.mean(levels))) / mean.noise


def usual_noise(grasps: Sequence[Grasp], force_n: float | None) -> tuple[float, float]:
    """Return the median of `MeanFrames.noise` and the root mean square of `level_noise_per_count`.

    About `_NOISE_GRASPS` of the grasps, evenly selected, are used. Those without a surface are left
    out; both values are 0 if no grasp has one.
    """
    found, rng = [], np.random.default_rng(0)
    for grasp in grasps[:: -(-len(grasps) // _NOISE_GRASPS)]:
        try:
            mean = MeanFrames.of(grasp, force_n)
            found.append((mean.noise, level_noise_per_count(mean, rng)))
        except (ContactError, QuadricError):
            continue  # without a surface there is no level
    if not found:
        return 0.0, 0.0
    counts, per_count = np.array(found).T
    # A changed patch is rare, but changes the level most: a median would ignore it.
    return float(np.median(counts)), float(np.sqrt(np.mean(per_count**2)))


def log_statistics(
    values: Sequence[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and spread of log|level|; each spread is shrunk towards the pooled one."""
    logs = [np.log(np.abs(one)) for one in values]
    counts = np.array([len(one) for one in logs])
    mean = np.array([one.mean() if len(one) else np.nan for one in logs])
    squares = np.array([np.sum((one - one.mean()) ** 2) if len(one) else 0.0 for one in logs])
    freedom = np.maximum(counts - 1, 0)
    pooled = float(squares.sum() / freedom.sum()) if freedom.sum() else _DEFAULT_SPREAD**2
    variance = (squares + _PRIOR_GRASPS * pooled) / (freedom + _PRIOR_GRASPS)
    # Few grasps give the mean with an error.
    variance = variance * (1.0 + 1.0 / np.maximum(counts, 1))
    spread = np.sqrt(np.maximum(variance, _LEAST_SPREAD**2))
    return mean, np.where(counts > 0, spread, np.nan)


def level_or_none(grasp: Grasp, force_n: float | None = None) -> float | None:
    """Return the level of a grasp, None if it has no surface."""
    try:
        value = grip_level(grasp, force_n)
    except (ContactError, QuadricError):
        return None  # the caller answers unknown, or leaves the grasp out of the teaching
    return value if value != 0.0 else None


def level_novelty(levels: LevelBands, value: float) -> float:
    """Return 0 inside a band, 1/2 at the edge of its margin, towards 1 beyond."""
    edge = np.where(value < levels.low, np.abs(levels.low), np.abs(levels.high))
    outside = levels.distance(value) / (levels.margin * edge)
    nearest = float(np.nanmin(outside))
    return nearest**2 / (1.0 + nearest**2)
