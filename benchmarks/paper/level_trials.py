"""The paper's level check in trials: a few grasps teach levels, the others are named.

The rule is that of Algorithm 1. Each threshold is in the middle between neighbouring bands of the
taught levels; if bands overlap, in the middle of the overlap. A value between two thresholds
belongs to the object there. So every grasp with a surface gets a name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.grasps import COMMON_N, PAPER_NOISE, REST_FRAMES, Touch, random_grasp, record
from cell.report.paper_table import TABLE_1_LABELS
from recognition.errors import ContactError, QuadricError
from recognition.grasp import Grasp
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.level import DEFAULT_LEVEL, grip_level, grip_surfaces
from recognition.quadric.thresholds import LevelBands, check_level, find_thresholds

LABELS = TABLE_1_LABELS
READINGS = (Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM)
FORCES: tuple[float | None, ...] = (None, COMMON_N)
"""Where on the ramp a level is taken: at each grasp's own full force, or at a common one in N."""
FILTERED = (False, True)
"""One frame alone, or the mean of all frames within a tenth of the force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """One way to take a level."""

    reading: Reading
    """Which eigenvalue."""
    force_n: float | None
    """Force in N; None for each grasp's own full force."""
    filtered: bool
    """Whether the frames near the force are averaged before the surface is fitted."""


CONDITIONS = tuple(
    Condition(reading=reading, force_n=force_n, filtered=filtered)
    for force_n in FORCES
    for filtered in FILTERED
    for reading in READINGS
)
"""All ways, in the order of the last axis of the arrays of levels."""


def one_frame(grasp: Grasp, force_n: float | None) -> Grasp:
    """Return the frames before contact and the one frame at a force: nothing is averaged."""
    wanted_n = float(np.max(grasp.force_n)) if force_n is None else force_n
    at = int(np.argmin(np.abs(grasp.force_n - wanted_n)))
    frames = [*range(REST_FRAMES), at]
    return replace(
        grasp,
        counts=grasp.counts[frames],
        t_s=grasp.t_s[frames],
        aperture_m=grasp.aperture_m[frames],
        force_n=grasp.force_n[frames],
    )


def levels_of(grasp: Grasp) -> NDArray[np.float64]:
    """Return the grasp's level under each of `CONDITIONS`; NaN where it carries no surface."""
    values = np.full(len(CONDITIONS), np.nan)
    for number in range(0, len(CONDITIONS), len(READINGS)):
        condition = CONDITIONS[number]
        seen, force_n = grasp, condition.force_n
        if not condition.filtered:
            seen, force_n = one_frame(grasp, force_n), None
        try:
            surfaces = grip_surfaces(seen, replace(DEFAULT_LEVEL, force_n=force_n))
        except (ContactError, QuadricError):
            continue  # documented: no level
        for offset, reading in enumerate(READINGS):
            each = [float(smallest_eigenvalue(one, reading).value) for one in surfaces]
            # Over both pads as the level check does: magnitudes in ratio, signed values plainly.
            values[number + offset] = (
                np.exp(np.mean(np.log(each)))
                if reading is Reading.SMALLEST_MAGNITUDE
                else np.mean(each)
            )
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class Lesson:
    """One teaching and its test."""

    seed: int
    """Of all that is random in it."""
    noise_share: float
    """Largest noise as a part of full scale."""
    n_taught: int
    n_tested: int
    """Grasps of each object."""


def lesson_levels(lesson: Lesson) -> NDArray[np.float64]:
    """Return the levels of a lesson's grasps, (objects, taught + tested, conditions)."""
    rng = np.random.default_rng([lesson.seed, round(1e4 * lesson.noise_share)])
    return np.array(
        [
            [
                levels_of(random_grasp(label, rng, lesson.noise_share))
                for _ in range(lesson.n_taught + lesson.n_tested)
            ]
            for label in LABELS
        ]
    )


def repeated_levels(task: tuple[Touch, float, int, int]) -> NDArray[np.float64]:
    """Return levels (n, conditions) of one touch, recorded n times under new noise.

    The task is the touch, the noise as a part of full scale, the number n and a seed.
    """
    touch, noise_share, n, seed = task
    rng = np.random.default_rng([seed, round(1e4 * noise_share), LABELS.index(touch.label)])
    return np.array([levels_of(record(touch, rng, noise_share)) for _ in range(n)])


def noise_patch_levels(task: tuple[Touch, float, int, int]) -> NDArray[np.float64]:
    """Return min |λ| (n, forces) of averaged frames on the patch of all taxels above the noise.

    The level check counts a taxel as loaded from a part of the largest height on. Here the noise
    alone is its threshold. It falls as more frames are averaged, so taxels at the edge appear and
    disappear. The task is that of `repeated_levels`.
    """
    touch, noise_share, n, seed = task
    rng = np.random.default_rng([seed, round(1e4 * noise_share), LABELS.index(touch.label)])
    values = np.full((n, len(FORCES)), np.nan)
    for row in values:
        grasp = record(touch, rng, noise_share)
        for place, force_n in enumerate(FORCES):
            settings = replace(DEFAULT_LEVEL, force_n=force_n, peak_share=0.0)
            try:
                row[place] = grip_level(grasp, settings)
            except (ContactError, QuadricError):
                continue  # documented: no level
    return values


def name_by_threshold(levels: LevelBands, values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return for each value the object by its thresholds; -1 for NaN."""
    ascending = np.maximum.accumulate(levels.threshold)
    named = levels.order[np.searchsorted(ascending, values)]
    return np.where(np.isfinite(values), named, -1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """How tested levels were named."""

    counts: NDArray[np.int64]
    """(objects, objects + 1) int64: row: held; column: named by thresholds alone; the last one: no
    surface, so no name."""
    windows_named: int
    windows_right: int
    """With the windows kept (no name inside an overlap or beyond every band): how many were named,
    and how many of those right."""
    closed: float
    """Share of the teachings in which at least one window was closed."""

    @property
    def n(self) -> int:
        """Number of trials."""
        return int(self.counts.sum())

    @property
    def n_right(self) -> int:
        """Trials with the right name."""
        return int(np.trace(self.counts))


def classify(
    taught: Sequence[NDArray[np.float64]], tested: Sequence[NDArray[np.float64]]
) -> Outcome:
    """Name tested levels, (objects, n) for each teaching, by the levels taught in it."""
    n = len(LABELS)
    counts = np.zeros((n, n + 1), dtype=np.int64)
    named = right = closed = 0
    for taught_one, tested_one in zip(taught, tested, strict=True):
        levels = find_thresholds(list(taught_one), margin=PAPER_NOISE)
        closed += bool(levels.closed)
        for held, values in enumerate(tested_one):
            found = name_by_threshold(levels, values)
            counts[held] += np.bincount(np.where(found < 0, n, found), minlength=n + 1)
            by_windows = [check_level(levels, float(v)) for v in values if np.isfinite(v)]
            named += sum(one is not None for one in by_windows)
            right += sum(one == held for one in by_windows)
    return Outcome(
        counts=counts,
        windows_named=named,
        windows_right=right,
        closed=closed / max(len(taught), 1),
    )
