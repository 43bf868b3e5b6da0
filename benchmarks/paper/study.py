"""Everything behind the page that puts the paper's figures beside ours, as plain values."""

import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.contenders import Contender, contenders
from benchmarks.paper.effort import Effort, Spread
from benchmarks.paper.grasps import PAPER_NOISE, Indentation, Touch, indent, press, record
from benchmarks.paper.level_trials import (
    CONDITIONS,
    FORCES,
    LABELS,
    READINGS,
    Lesson,
    Outcome,
    classify,
    lesson_levels,
    noise_patch_levels,
    repeated_levels,
)
from recognition.quadric.eigen import Reading, eigenvalues
from recognition.quadric.level import DEFAULT_LEVEL, grip_surfaces
from recognition.quadric.trajectory import PAPER_SWEEP, Trajectory, sweep
from simulator.world.shapes import ObjectPose

NOISE_SHARES = (0.0, 0.02, 0.04, 0.06, 0.08, 0.10, 0.12, 0.16, 0.20)
"""Noise of the accuracy curve: its largest value as a part of full scale."""
TRAIL_SHARES = tuple(round(0.01 * i, 2) for i in range(21))
"""Noise of figure 4; fewer of them at little effort."""
TOUCH_N = 6.0
"""Force in N of the one touch behind figures 3 and 4."""

_CURVES = tuple(i for i, c in enumerate(CONDITIONS) if c.reading is READINGS[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Invariance:
    """Largest over smallest magnitude of an object's value over a part of the sweep."""

    name: str
    """What is varied."""
    ratio: Mapping[Reading, NDArray[np.float64]]
    """mapping of reading to (objects,) float64: 1 where nothing changes."""
    overlaps: Mapping[Reading, int]
    """mapping of reading to int: pairs of objects, of 10, whose values overlap."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisePoint:
    """Accuracy at one noise: outcomes by condition, thresholds taught at that noise or at none."""

    noise_share: float
    adjusted: Mapping[int, Outcome]
    fixed: Mapping[int, Outcome]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperStudy:
    """What the page shows."""

    effort: Effort
    """How many trials."""
    indentation: Indentation
    """Figure 2."""
    trajectories: Mapping[Reading, Trajectory]
    """Figure 3: the printed sweep, by reading."""
    eigenvalues: NDArray[np.float64]
    """(objects, 4) float64: all eigenvalues of the touches behind it, by falling magnitude."""
    invariance: tuple[Invariance, ...]
    """What each part of the sweep changes."""
    noise_trails: NDArray[np.float64]
    """(noise, objects, iterations, conditions) float64: figure 4: levels of one touch each under
    rising noise, at `trail_shares`."""
    trail_shares: tuple[float, ...]
    """Noise of figure 4."""
    tables: Mapping[int, Outcome]
    """Outcomes at the paper's noise by condition."""
    repeated: Mapping[int, Outcome]
    """Outcomes by condition where only the noise is new."""
    noise_patch: Mapping[float | None, Outcome]
    """The same by force for averaged frames on the patch of all taxels above the noise, min |λ|."""
    curve: tuple[NoisePoint, ...]
    """Accuracy over noise."""
    contenders: tuple[Contender, ...]
    """Other recognisers at the paper's noise."""


def one_touch(label: str) -> Touch:
    """Return the touch of an object behind figures 3 and 4: centred, not turned."""
    return press(label, ObjectPose(), TOUCH_N)


def study(effort: Effort, *, workers: int = 1) -> PaperStudy:
    """Run all trials; ``workers`` processes share them, 1 does all in this one."""
    if workers <= 1:
        return _study(effort, lambda work, tasks: [work(task) for task in tasks])
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        return _study(effort, lambda work, tasks: list(pool.map(work, tasks)))


def _study(effort: Effort, spread: Spread) -> PaperStudy:
    touches = [one_touch(label) for label in LABELS]
    quiet = np.random.default_rng(effort.seed)
    surfaces = np.array(
        [grip_surfaces(record(touch, quiet, 0.0), DEFAULT_LEVEL)[0] for touch in touches]
    )
    by_size = np.argsort(-np.abs(eigenvalues(surfaces)), axis=1)
    shares = TRAIL_SHARES[:: effort.every]
    trails = spread(
        repeated_levels,
        [(touch, share, effort.iterations, effort.seed) for share in shares for touch in touches],
    )
    return PaperStudy(
        effort=effort,
        indentation=indent(np.linspace(0.0, 9.0, 37)),
        trajectories={
            reading: sweep(surfaces, replace(PAPER_SWEEP, reading=reading)) for reading in READINGS
        },
        eigenvalues=np.take_along_axis(eigenvalues(surfaces), by_size, axis=1),
        invariance=_invariance(surfaces),
        trail_shares=shares,
        noise_trails=np.array(trails).reshape(
            len(shares), len(LABELS), effort.iterations, len(CONDITIONS)
        ),
        tables=_tables(effort, spread),
        repeated=dict(enumerate(_repeated(repeated_levels, effort, spread, touches))),
        noise_patch=dict(
            zip(FORCES, _repeated(noise_patch_levels, effort, spread, touches), strict=True)
        ),
        curve=_curve(effort, spread),
        contenders=contenders(effort, spread),
    )


def _invariance(surfaces: NDArray[np.float64]) -> tuple[Invariance, ...]:
    """Vary one part of the printed grid at a time, then two, then all."""
    parts = {
        "translation in x and y": "t",
        "rotation about all axes": "r",
        "translation and rotation": "tr",
        "scale 1 to 4": "s",
        "all three": "str",
    }
    found = []
    for name, varied in parts.items():
        ratio, overlaps = {}, {}
        for reading in READINGS:
            grid = replace(
                PAPER_SWEEP,
                reading=reading,
                scale=PAPER_SWEEP.scale if "s" in varied else np.ones(1),
                translation=PAPER_SWEEP.translation if "t" in varied else np.zeros(1),
                angle_rad=PAPER_SWEEP.angle_rad if "r" in varied else np.zeros(1),
            )
            spread = np.abs(sweep(surfaces, grid).spread)
            spread.sort(axis=1)
            ratio[reading] = spread[:, 1] / spread[:, 0]
            overlaps[reading] = sum(
                bool(a[0] <= b[1] and b[0] <= a[1]) for a, b in combinations(spread, 2)
            )
        found.append(Invariance(name=name, ratio=ratio, overlaps=overlaps))
    return tuple(found)


def _lessons(
    effort: Effort, share: float, n_lessons: int, n_tested: int, *, first: int
) -> list[Lesson]:
    return [
        Lesson(
            seed=effort.seed + first + number,
            noise_share=share,
            n_taught=effort.n_taught,
            n_tested=n_tested,
        )
        for number in range(n_lessons)
    ]


def _tables(effort: Effort, spread: Spread) -> dict[int, Outcome]:
    lessons = _lessons(effort, PAPER_NOISE, effort.table_lessons, effort.table_tested, first=0)
    found = spread(lesson_levels, lessons)
    return {c: _outcome(found, found, effort.n_taught, c) for c in range(len(CONDITIONS))}


def _repeated(
    levels: Callable[[Any], NDArray[np.float64]],
    effort: Effort,
    spread: Spread,
    touches: list[Touch],
) -> list[Outcome]:
    """Return the outcomes by the last axis of the levels, only the noise new."""
    n = effort.n_taught + effort.repeats
    found = spread(levels, [(touch, PAPER_NOISE, n, effort.seed + 500) for touch in touches])
    together = [np.array(found)]
    places = range(together[0].shape[-1])
    return [_outcome(together, together, effort.n_taught, place) for place in places]


def _curve(effort: Effort, spread: Spread) -> tuple[NoisePoint, ...]:
    n_lessons, points = effort.curve_lessons, []
    shares = NOISE_SHARES[:: effort.every]
    lessons = [
        lesson
        for share in shares
        for lesson in _lessons(effort, share, n_lessons, effort.curve_tested, first=1000)
    ]
    found = spread(lesson_levels, lessons)
    silent = found[:n_lessons]
    for number, share in enumerate(shares):
        here = found[number * n_lessons : (number + 1) * n_lessons]
        points.append(
            NoisePoint(
                noise_share=share,
                adjusted={c: _outcome(here, here, effort.n_taught, c) for c in _CURVES},
                fixed={c: _outcome(silent, here, effort.n_taught, c) for c in _CURVES},
            )
        )
    return tuple(points)


def _outcome(
    taught: list[NDArray[np.float64]],
    tested: list[NDArray[np.float64]],
    n_taught: int,
    condition: int,
) -> Outcome:
    return classify(
        [one[:, :n_taught, condition] for one in taught],
        [one[:, n_taught:, condition] for one in tested],
    )
