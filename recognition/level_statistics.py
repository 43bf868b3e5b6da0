"""What a level check learns from grasps: their common force, their spread, what noise does."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.contact import estimate_baseline
from recognition.errors import ContactError, QuadricError
from recognition.grasp import Grasp
from recognition.level import (
    FULL_SCALE_COUNTS,
    LevelSettings,
    disturbed_levels,
    frames_at,
    grip_level,
)
from recognition.thresholds import Levels

_PRIOR_GRASPS = 4.0  # weight, in grasps, of the pooled spread against an object's own
_LEAST_SPREAD = 0.02  # standard deviation of a level's logarithm that no teaching goes below
_DEFAULT_SPREAD = 0.08  # pooled spread where every object was touched once: the paper's noise
_DRAWS = 12
_NOISE_GRASPS = 30


def common_force_n(grasps: Sequence[Grasp]) -> float | None:
    """Return the largest force in N that every grasp reached, None where one is not recorded."""
    reached = [
        float(np.max(g.force_n, initial=-np.inf, where=np.isfinite(g.force_n))) for g in grasps
    ]
    least = min(reached)
    return least if np.isfinite(least) and least > 0.0 else None


def averaged_noise(grasp: Grasp, settings: LevelSettings) -> float:
    """Return the noise of a taxel's height in the frames that the level is taken from.

    Of their mean, that is, less the baseline. It is a standard deviation in counts of 255, the
    median over the pads. Raises ContactError where the ramp never came near the force of the
    settings.
    """
    n_frames = len(frames_at(grasp, settings.force_n, settings))
    baseline = estimate_baseline(grasp)
    share = np.sqrt(1.0 / n_frames + 1.0 / np.maximum(baseline.quiet_frames, 1))
    noise = float(np.median(baseline.noise_counts * share))
    return noise * FULL_SCALE_COUNTS / grasp.pads.adc_max


def level_noise_per_count(grasp: Grasp, settings: LevelSettings, rng: np.random.Generator) -> float:
    """Return the part of the level by which noise moves it, for each count of `averaged_noise`.

    The averaged frames are disturbed a dozen times by as much noise as they have, and the surface
    is found anew, its patch too. Raises ContactError or QuadricError where they carry none.
    """
    noise = averaged_noise(grasp, settings)
    counts = noise * grasp.pads.adc_max / FULL_SCALE_COUNTS
    draws = rng.normal(0.0, counts, (_DRAWS, grasp.pads.n_taxels))
    levels = disturbed_levels(grasp, draws, settings)
    return float(np.std(levels) / abs(np.mean(levels))) / noise


def usual_noise(grasps: Sequence[Grasp], settings: LevelSettings) -> tuple[float, float]:
    """Return median `averaged_noise` and the root mean square of `level_noise_per_count`.

    About `_NOISE_GRASPS` of the grasps, evenly taken, are asked. Those without a surface are left
    out; both are 0 where all are.
    """
    found, rng = [], np.random.default_rng(0)
    for grasp in grasps[:: -(-len(grasps) // _NOISE_GRASPS)]:
        try:
            per_count = level_noise_per_count(grasp, settings, rng)
            found.append((averaged_noise(grasp, settings), per_count))
        except (ContactError, QuadricError):
            continue  # documented: tells nothing of the level
    if not found:
        return 0.0, 0.0
    counts, per_count = np.array(found).T
    # A patch that changes is rare, and moves the level most: a median would leave it out.
    return float(np.median(counts)), float(np.sqrt(np.mean(per_count**2)))


def log_statistics(
    values: Sequence[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and spread of log|level|; each spread is drawn towards the pooled one."""
    logs = [np.log(np.abs(one)) for one in values]
    counts = np.array([len(one) for one in logs])
    mean = np.array([one.mean() if len(one) else np.nan for one in logs])
    squares = np.array([np.sum((one - one.mean()) ** 2) if len(one) else 0.0 for one in logs])
    freedom = np.maximum(counts - 1, 0)
    pooled = float(squares.sum() / freedom.sum()) if freedom.sum() else _DEFAULT_SPREAD**2
    variance = (squares + _PRIOR_GRASPS * pooled) / (freedom + _PRIOR_GRASPS)
    # the mean itself is known from a few grasps only
    variance = variance * (1.0 + 1.0 / np.maximum(counts, 1))
    spread = np.sqrt(np.maximum(variance, _LEAST_SPREAD**2))
    return mean, np.where(counts > 0, spread, np.nan)


def level_or_none(grasp: Grasp, settings: LevelSettings) -> float | None:
    """Return the level of a grasp, None where it carries no surface."""
    try:
        value = grip_level(grasp, settings)
    except (ContactError, QuadricError):
        return None  # the caller answers unknown, or leaves the grasp out of the teaching
    return value if value != 0.0 else None


def strangeness(levels: Levels, value: float) -> float:
    """Return 0 inside a band, 1/2 at the edge of its margin, towards 1 beyond."""
    edge = np.where(value < levels.low, np.abs(levels.low), np.abs(levels.high))
    outside = levels.distance(value) / (levels.margin * edge)
    nearest = float(np.nanmin(outside))
    return nearest**2 / (1.0 + nearest**2)
