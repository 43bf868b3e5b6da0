"""The paper's level check in trials: a few grasps teach levels, the others are named.

The rule is that of Algorithm 1. Each threshold is in the middle between neighbouring bands of the
taught levels; if bands overlap, in the middle of the overlap. A value between two thresholds
belongs to the object there. So every grasp with a surface gets a name.
"""

import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._measure import repeats, share
from benchmarks.paper.grasps import (
    COMMON_N,
    PAPER_NOISE,
    REST_FRAMES,
    Touch,
    press,
    random_grasp,
    record,
)
from cell.report.paper_table import TABLE_1_LABELS as LABELS
from recognition.errors import ContactError, QuadricError
from recognition.evaluation.metrics import confusion_matrix
from recognition.grasp import Grasp
from recognition.quadric.eigen import Reading, eigenvalues, smallest_eigenvalue
from recognition.quadric.level import DEFAULT_LEVEL, grip_surfaces
from recognition.quadric.thresholds import LevelBands, check_level, find_thresholds
from recognition.quadric.trajectory import PAPER_SWEEP, sweep
from recognition.recognizers import make_trainer
from simulator.world.shapes import ObjectPose

Array = NDArray[np.float64]
READINGS = (Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM)
TOUCH_N, SEED = 6.0, 2008
"""Force in N of the one touch behind figures 3 and 4, and seed of all that is random."""
NOISE_SHARES = (0.0, PAPER_NOISE, 0.20)
"""Noise with thresholds adjusted to it or not: its largest value as a part of full scale."""
TRAIL_SHARES = tuple(round(0.01 * i, 2) for i in range(21))
"""Noise of figure 4; fewer at little effort."""


class View(NamedTuple):
    """One way to take a level."""

    force_n: float | None
    """Force in N; None for each grasp's own full force."""
    filtered: bool
    """Whether the frames near the force are averaged before the surface is fitted."""
    peak_share: float = DEFAULT_LEVEL.peak_share
    """Least height of a loaded taxel as a share of the largest; 0: the noise alone is the limit,
    which falls as more frames are averaged."""


VIEWS = {
    "own, one frame": View(None, filtered=False),
    "own": View(None, filtered=True),
    "common, one frame": View(COMMON_N, filtered=False),
    "common": View(COMMON_N, filtered=True),
    "own, noise patch": View(None, filtered=True, peak_share=0.0),
}
"""Views by name; the last one is of repeated touches alone."""
Condition = tuple[str, int]
"""Name of a view, and place of a reading."""


def one_frame(grasp: Grasp, force_n: float | None) -> Grasp:
    """Return the frames before contact and the one frame at a force: nothing is averaged."""
    wanted_n = float(np.max(grasp.force_n)) if force_n is None else force_n
    frames = [*range(REST_FRAMES), int(np.argmin(np.abs(grasp.force_n - wanted_n)))]
    names = "counts", "t_s", "aperture_m", "force_n"
    return replace(grasp, **{name: getattr(grasp, name)[frames] for name in names})


def levels_of(grasp: Grasp, n_views: int = len(VIEWS) - 1) -> Array:
    """Return the grasp's levels (views, readings); NaN where it carries no surface."""
    values = np.full((n_views, len(READINGS)), np.nan)
    for row, view in zip(values, VIEWS.values(), strict=False):
        seen = grasp if view.filtered else one_frame(grasp, view.force_n)
        force_n = view.force_n if view.filtered else None
        settings = replace(DEFAULT_LEVEL, force_n=force_n, peak_share=view.peak_share)
        try:
            surfaces = grip_surfaces(seen, settings)
        except (ContactError, QuadricError):
            continue  # documented: no level
        sizes, signed = (
            [float(smallest_eigenvalue(one, reading).value) for one in surfaces]
            for reading in READINGS
        )
        # Over both pads as the level check does: magnitudes in ratio, signed values plainly.
        row[:] = np.exp(np.mean(np.log(sizes))), np.mean(signed)
    return values


def lesson(task: tuple[int, float, int]) -> Array:
    """Return levels (objects, n, views, readings) of random grasps: seed, noise share, n."""
    seed, noise_share, n = task
    rng = np.random.default_rng([seed, round(1e4 * noise_share)])
    return np.array(
        [[levels_of(random_grasp(label, rng, noise_share)) for _ in range(n)] for label in LABELS]
    )


def repeated(task: tuple[Touch, float, int, int]) -> Array:
    """Return levels (n, views, readings) of one touch under new noise: touch, share, n, seed."""
    touch, noise_share, n, seed = task
    rng = np.random.default_rng([seed, round(1e4 * noise_share), LABELS.index(touch.label)])
    return np.array([levels_of(record(touch, rng, noise_share), len(VIEWS)) for _ in range(n)])


def name_by_threshold(levels: LevelBands, values: Array) -> NDArray[np.int64]:
    """Return for each value the object by its thresholds; -1 for NaN."""
    ascending = np.maximum.accumulate(levels.threshold)
    named = levels.order[np.searchsorted(ascending, values)]
    return np.where(np.isfinite(values), named, -1)


RECOGNIZERS = (
    *(("force_ramp", False), ("force_ramp", True), ("shrinkage_lda", False)),
    *(("shrinkage_lda", True), ("level_check", False)),
)
"""Recognisers of the product, and whether they use the opening."""


class Outcome(NamedTuple):
    """How tested levels were named."""

    counts: NDArray[np.int64]
    """(objects, objects + 1) int64: row: held; column: named by thresholds alone; the last one: no
    surface, so no name."""
    windows_named: int
    windows_right: int
    """With the windows kept (no name inside an overlap or beyond every band): how many were named,
    and how many of those right."""

    @property
    def trials(self) -> tuple[int, int]:
        """Trials with the right name, and all."""
        return int(np.trace(self.counts)), int(self.counts.sum())

    @property
    def share(self) -> float:
        """Share of right names."""
        return self.trials[0] / self.trials[1]

    def __str__(self) -> str:
        return share(*self.trials)


def classify(taught: Sequence[Array], tested: Sequence[Array]) -> Outcome:
    """Name tested levels, (objects, n) for each teaching, by the levels taught in it."""
    n = len(LABELS)
    counts, named, right = np.zeros((n, n + 1), dtype=np.int64), 0, 0
    for taught_one, tested_one in zip(taught, tested, strict=True):
        levels = find_thresholds(list(taught_one), margin=PAPER_NOISE)
        for held, values in enumerate(tested_one):
            found = name_by_threshold(levels, values)
            counts[held] += np.bincount(np.where(found < 0, n, found), minlength=n + 1)
            by_windows = [check_level(levels, float(v)) for v in values if np.isfinite(v)]
            named += sum(one is not None for one in by_windows)
            right += sum(one == held for one in by_windows)
    return Outcome(counts, named, right)


def outcomes(
    taught: Sequence[Array], tested: Sequence[Array], n_taught: int
) -> dict[Condition, Outcome]:
    """Teach with the first levels of one and name the further ones of the other, each way."""
    return {
        (view, reading): classify(
            [one[:, :n_taught, v, reading] for one in taught],
            [one[:, n_taught:, v, reading] for one in tested],
        )
        for v, view in enumerate(list(VIEWS)[: taught[0].shape[2]])
        for reading in range(len(READINGS))
    }


def try_recognizer(task: tuple[str, bool], effort: float) -> NDArray[np.int64]:
    """Teach and test a recogniser (name, with the opening or not); counts, named by likeliest."""
    name, use_aperture = task
    counts = np.zeros((len(LABELS), len(LABELS)), dtype=np.int64)
    for number in range(repeats(3, effort)):
        rng = np.random.default_rng([SEED, 7, number])
        taught, tested = (
            [
                random_grasp(label, rng, PAPER_NOISE, start_ms=i)
                for label in LABELS
                for i in range(n)
            ]
            for n in (repeats(20, effort, least=4), repeats(100, effort, least=4))
        )
        recognizer = make_trainer(name, use_aperture=use_aperture).fit(taught)
        answers = [recognizer.posterior(grasp).best for grasp in tested]
        counts += confusion_matrix([grasp.label for grasp in tested], answers, LABELS)
    return counts


class PaperStudy(NamedTuple):
    """All figures."""

    eigenvalues: Array
    """(objects, 4): of one touch of each object, the largest magnitude first."""
    swept: Array
    """(readings, objects, scales, translations, angles): of the printed grid."""
    trails: Array
    """(noise shares, objects, recordings, views, readings): levels of one touch of each object."""
    table: Mapping[Condition, Outcome]
    """Any pose at the paper's noise."""
    again: Mapping[Condition, Outcome]
    """The same touch again, only the noise new."""
    adjusted: Mapping[float, Mapping[Condition, Outcome]]
    fixed: Mapping[float, Mapping[Condition, Outcome]]
    """Any pose by noise share: thresholds taught at the same noise, and without noise."""
    recognizers: Mapping[tuple[str, bool], NDArray[np.int64]]
    """Counts by name and whether it uses the opening."""


def study(effort: float) -> PaperStudy:
    """Run all trials in two processes."""
    touches = [press(label, ObjectPose(), TOUCH_N) for label in LABELS]
    quiet = np.random.default_rng(SEED)
    surfaces = np.array([grip_surfaces(record(touch, quiet, 0.0))[0] for touch in touches])
    every = eigenvalues(surfaces)
    grid = len(PAPER_SWEEP.scale), len(PAPER_SWEEP.translation), len(PAPER_SWEEP.angle_rad)
    swept = [sweep(surfaces, replace(PAPER_SWEEP, reading=one)).value for one in READINGS]
    n_taught, n_trail = repeats(20, effort, least=4), repeats(10, effort, least=4)
    shares, seeds = TRAIL_SHARES[:: 1 if effort >= 1.0 else 4], range(repeats(4, effort))
    n_again, n_table, n_curve = (
        n_taught + repeats(n, effort, least=least) for n, least in ((1000, 10), (100, 4), (50, 3))
    )
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        trails = pool.map(repeated, [(t, one, n_trail, SEED) for one in shares for t in touches])
        again = pool.map(repeated, [(t, PAPER_NOISE, n_again, SEED + 500) for t in touches])
        lessons = [(SEED + i, PAPER_NOISE, n_table) for i in range(repeats(10, effort))]
        table = list(pool.map(lesson, lessons))
        curve = {
            one: list(pool.map(lesson, [(SEED + 1000 + i, one, n_curve) for i in seeds]))
            for one in NOISE_SHARES
        }
        counts = pool.map(partial(try_recognizer, effort=effort), RECOGNIZERS)
        same = np.array(list(again))
        return PaperStudy(
            eigenvalues=np.take_along_axis(every, np.argsort(-np.abs(every), axis=1), axis=1),
            swept=np.reshape(swept, (len(READINGS), len(LABELS), *grid)),
            trails=np.reshape(list(trails), (len(shares), len(LABELS), n_trail, len(VIEWS), -1)),
            table=outcomes(table, table, n_taught),
            again=outcomes([same], [same], n_taught),
            adjusted={noise: outcomes(one, one, n_taught) for noise, one in curve.items()},
            fixed={noise: outcomes(curve[0.0], one, n_taught) for noise, one in curve.items()},
            recognizers=dict(zip(RECOGNIZERS, counts, strict=True)),
        )
