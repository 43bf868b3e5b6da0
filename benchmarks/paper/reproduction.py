"""The paper's claims about grasps and its Table 1, on the physics of the simulated cell.

No servos, no buses, no time: a rigid object is pressed by both gripping pads with equal force at
each step of a ramp; the taxels' forces go through equation (11), the noise and the converter. The
other pads touch nothing and are left out.

A few grasps teach levels, the others are named. The rule is that of Algorithm 1. Each threshold is
in the middle between neighbouring bands of the taught levels; if bands overlap, in the middle of
the overlap. A value between two thresholds belongs to the object there. So every grasp with a
surface gets a name.

docs/developers/paper.md quotes what it prints.
"""

import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.optimize.elementwise import find_root

from benchmarks._measure import line, repeats, share
from cell.report.confusion import TABLE_1_LABELS as LABELS
from recognition.evaluation.evaluation import confusion_matrix, wilson_interval
from recognition.grasp import Grasp, PadArray
from recognition.quadric.level import MeanFrames, level_of
from recognition.quadric.quadric import PAPER_SWEEP, LevelBands, Reading, find_thresholds, sweep
from recognition.recognizers import make_trainer
from simulator.world.pads import Foam, PressureGrid, ideal_counts, noise_counts, resistance_mohm
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose, posed_heights, resting_pose
from tactile.layout import paper_layout

FULL_N = (4.0, 8.0)
"""Range of the force at the end of a ramp in N: "a different force"."""
COMMON_N = 4.0
"""Force in N that every ramp passes."""
OFFSET_M = 2e-3
"""Largest offset along and across the fingers in m."""
PAPER_NOISE = 0.08
"""Upper end of the paper's noise as a part of full scale: 20.4 of 255 counts."""
REST_FRAMES = 10
"""Frames before contact."""

_STEP_N, _PERIOD_S, _HOLD_FRAMES = 0.1, 0.02, 15
"""Growth of the force in a frame, which is 5 N/s at 50 frames a second."""
_KNOTS = 12
"""Forces at which the contact is solved."""
_APERTURE_SD_M = 0.2e-3

_LAYOUT = paper_layout()
_FOAM = Foam()
_GRIDS = tuple(PressureGrid(_LAYOUT.pads[pad], _FOAM) for pad in _LAYOUT.gripping_pads)
_TAXELS = np.concatenate(
    [np.arange(_LAYOUT.n_taxels)[_LAYOUT.taxels_of(pad)] for pad in _LAYOUT.gripping_pads]
)
_PADS = PadArray(
    pad_shape=np.array([_LAYOUT.pad_shape[pad] for pad in _LAYOUT.gripping_pads]),
    taxel_pad=np.repeat([0, 1], len(_TAXELS) // 2),
    taxel_xy_m=np.asarray(_LAYOUT.taxel_xy_m)[_TAXELS],
    adc_max=_LAYOUT.adc_max,
)
"""The inner pads of both fingers, 16 x 4 taxels of 8 bit each."""


class Touch(NamedTuple):
    """One object in one pose, pressed with rising force."""

    label: str
    """The object."""
    force_n: NDArray[np.float64]
    """(K,) float64: grip force in N, ascending from 0."""
    taxel_n: NDArray[np.float64]
    """(K, n_taxels) float64: force on each taxel in N."""
    aperture_m: NDArray[np.float64]
    """(K,) float64: opening between the undeformed pads in m."""


def random_pose(label: str, rng: np.random.Generator) -> ObjectPose:
    """Draw a pose: any turn, any roll in which the object rests, offsets up to `OFFSET_M`."""
    x_m, y_m = rng.uniform(-OFFSET_M, OFFSET_M, 2)
    turn, roll = rng.uniform(0.0, math.tau), rng.uniform(0.0, math.tau)
    pose = ObjectPose(x_m=x_m, y_m=y_m, rotation_rad=turn, roll_rad=roll)
    return resting_pose(PAPER_OBJECTS[label], pose)


def press(label: str, pose: ObjectPose, full_n: float) -> Touch:
    """Press one of the paper's objects with 0 to ``full_n`` N."""
    force_n = np.linspace(0.0, full_n, _KNOTS)
    taxels, aperture_m = [], 0.0
    for side, grid in enumerate(_GRIDS):
        x_m, y_m = np.broadcast_arrays(grid.x_m, grid.y_m)
        heights_m = posed_heights(PAPER_OBJECTS[label], pose, x_m, y_m)[side]
        lag_m = heights_m.max() - heights_m
        depth_m = _depths_m(lag_m[lag_m < _FOAM.thickness_m], force_n, grid.cell_area_m2)
        pressures_pa = (_FOAM.pressure_pa(deepest_m - lag_m) for deepest_m in depth_m)
        shares = grid.shares((slice(None), slice(None)))
        taxels.append(np.array([grid.taxel_force_n(map_pa, shares) for map_pa in pressures_pa]))
        aperture_m = aperture_m + heights_m.max() - depth_m
    return Touch(label, force_n, np.concatenate(taxels, axis=1), aperture_m)


def _depths_m(
    lag_m: NDArray[np.float64], force_n: NDArray[np.float64], cell_area_m2: float
) -> NDArray[np.float64]:
    """Return how deep the highest point is for each force, (K,)."""

    def excess_n(depth_m: NDArray[np.float64], wanted_n: NDArray[np.float64]) -> NDArray[Any]:
        return _FOAM.pressure_pa(depth_m[:, None] - lag_m).sum(axis=1) * cell_area_m2 - wanted_n

    return np.asarray(find_root(excess_n, (0.0, _FOAM.thickness_m), args=(force_n,)).x)


def record(
    touch: Touch, rng: np.random.Generator, noise_share: float, *, start_ms: int = 0
) -> Grasp:
    """Return the grasp that the converter makes of a touch: rest, ramp of 5 N/s, hold.

    The noise is the paper's, with ``noise_share`` of full scale as its largest value.
    """
    full_n = float(touch.force_n[-1])
    ramp_n = np.arange(_STEP_N, full_n, _STEP_N)
    force_n = np.concatenate([np.zeros(REST_FRAMES), ramp_n, np.full(_HOLD_FRAMES, full_n)])
    taxel_n = make_interp_spline(touch.force_n, touch.taxel_n, k=1)(force_n)
    counts = ideal_counts(taxel_n, _PADS.adc_max)
    noise = noise_counts(rng, counts.size, _PADS.adc_max, noise_share / PAPER_NOISE)
    counts += noise.reshape(counts.shape)
    aperture_m = np.interp(force_n, touch.force_n, touch.aperture_m)
    return Grasp(
        pads=_PADS,
        counts=np.rint(np.clip(counts, 0.0, _PADS.adc_max)).astype(np.uint16),
        t_s=_PERIOD_S * np.arange(len(force_n), dtype=np.float64),
        aperture_m=aperture_m + rng.normal(0.0, _APERTURE_SD_M),
        force_n=force_n,
        label=touch.label,
        source="simulated physics",
        start_ms=start_ms,
    )


def random_grasp(
    label: str, rng: np.random.Generator, noise_share: float, *, start_ms: int = 0
) -> Grasp:
    """Return a grasp in a random pose to a random full force."""
    touch = press(label, random_pose(label, rng), rng.uniform(*FULL_N))
    return record(touch, rng, noise_share, start_ms=start_ms)


Array = NDArray[np.float64]
TOUCH_N, SEED = 6.0, 2008
"""Force in N of one touch of each object, and seed of all that is random."""
NOISE_SHARES = (0.0, PAPER_NOISE, 0.20)
"""Noise with thresholds adjusted to it or not: its largest value as a part of full scale."""
VIEWS = ("common, one frame", "common", "own")
"""Ways to take a level: at a common force or at the grasp's full force, and whether the frames near
it are averaged before the surface is fitted."""
RECOGNIZERS = ("force_ramp", "level_check")
"""Recognizers of the product, by touch alone."""


def one_frame(grasp: Grasp, force_n: float) -> Grasp:
    """Return the frames before contact and the one frame at a force: nothing is averaged.

    It is there twice, because a single frame with another load is a spike for the recognizers.
    """
    at = int(np.argmin(np.abs(grasp.force_n - force_n)))
    frames = sorted([*range(REST_FRAMES), at, at])
    names = "counts", "t_s", "aperture_m", "force_n"
    return replace(grasp, **{name: getattr(grasp, name)[frames] for name in names})


def levels_of(grasp: Grasp) -> list[float]:
    """Return the grasp's level by each of `VIEWS`; NaN where it carries no surface."""
    views = level_of(one_frame(grasp, COMMON_N)), level_of(grasp, COMMON_N), level_of(grasp)
    return [np.nan if view is None else view[0] for view in views]


def lesson(task: tuple[int, float, int]) -> Array:
    """Return levels (objects, n, views) of random grasps: seed, noise share, n."""
    seed, noise_share, n = task
    rng = np.random.default_rng([seed, round(1e4 * noise_share)])
    return np.array(
        [[levels_of(random_grasp(label, rng, noise_share)) for _ in range(n)] for label in LABELS]
    )


def repeated(touch: Touch, n: int) -> Array:
    """Return levels (n, views) of one touch at the paper's noise, which is new each time."""
    rng = np.random.default_rng([SEED + 500, round(1e4 * PAPER_NOISE), LABELS.index(touch.label)])
    return np.array([levels_of(record(touch, rng, PAPER_NOISE)) for _ in range(n)])


def name_by_threshold(levels: LevelBands, values: Array) -> NDArray[np.int64]:
    """Return for each value the object by its thresholds; -1 for NaN."""
    ascending = np.maximum.accumulate(levels.threshold)
    named = levels.order[np.searchsorted(ascending, values)]
    return np.where(np.isfinite(values), named, -1)


class Outcome(NamedTuple):
    """How tested levels were named."""

    counts: NDArray[np.int64]
    """(objects, objects + 1) int64: row: held; column: named; the last one: no surface."""

    @property
    def share(self) -> float:
        """Share of right names."""
        return float(np.trace(self.counts) / self.counts.sum())

    def __str__(self) -> str:
        return share(int(np.trace(self.counts)), int(self.counts.sum()))


def classify(taught: Sequence[Array], tested: Sequence[Array]) -> Outcome:
    """Name tested levels, (objects, n) for each teaching, by the levels taught in it."""
    n = len(LABELS)
    counts = np.zeros((n, n + 1), dtype=np.int64)
    for taught_values, tested_values in zip(taught, tested, strict=True):
        levels = find_thresholds(list(taught_values))
        for held, values in enumerate(tested_values):
            names = name_by_threshold(levels, values)
            counts[held] += np.bincount(np.where(names < 0, n, names), minlength=n + 1)
    return Outcome(counts)


def outcomes(taught: Sequence[Array], tested: Sequence[Array], n_taught: int) -> dict[str, Outcome]:
    """Teach with the first levels of one and name the further ones of the other, by each view."""
    return {
        view: classify(
            [data[:, :n_taught, v] for data in taught], [data[:, n_taught:, v] for data in tested]
        )
        for v, view in enumerate(VIEWS)
    }


def try_recognizer(name: str, effort: float) -> str:
    """Teach and test a recognizer by touch alone; the share of right likeliest labels."""
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
        recognizer = make_trainer(name, use_aperture=False).fit(taught)
        answers = [recognizer.posterior(grasp).best for grasp in tested]
        counts += confusion_matrix([grasp.label for grasp in tested], answers, LABELS)
    return share(int(np.trace(counts)), int(counts.sum()))


FIGURE_2 = ((2.0, 650.0), (4.0, 250.0), (6.0, 100.0), (8.0, 50.0))
"""Points of the paper's figure 2: force in N and resistance in kOhm."""
_SAME, _NEAR = 1.01, 1.15
"""A value that changes by less than this factor counts as unchanged, or as nearly."""
_NO_EFFECT = 0.02
"""A share of right names that changes by less counts as unchanged."""
PARTS = {
    "translation in x and y": np.s_[:, :, 0, :, 0],
    "rotation about any axis": np.s_[:, :, 0, 20, :],
    "scale": np.s_[:, :, :, 20, 0],
}
"""What is varied, and its part of the printed grid: scale 1 and angle 0 are its first, translation
0 is its middle."""


def claim(where: str, paper: str, here: str, *, holds: bool, in_part: bool = False) -> None:
    """Print a claim of the paper, the figures for it, and the verdict."""
    verdict = "holds" if holds else "in part" if in_part else "does not hold"
    line(where, f"{paper} | {here} | {verdict}")


def still_surfaces(touches: Sequence[Touch]) -> Array:
    """Return the first pad's surface of each touch without noise, (n, 4, 4)."""
    quiet = np.random.default_rng(SEED)
    return np.array([MeanFrames.of(record(touch, quiet, 0.0)).surfaces()[0] for touch in touches])


def of_levels(touches: Sequence[Touch]) -> None:
    """Print the claims about the sensor and about figure 3."""
    surfaces = still_surfaces(touches)
    force_n, quoted = np.array(FIGURE_2).T
    kohm = 1e3 * resistance_mohm(force_n)
    sizes = np.sort(np.abs(np.linalg.eigvalsh(surfaces)), axis=1)
    claim(
        "Fig. 2, eq. (11)",
        "650 / 250 / 100 / 50 kOhm at 2 / 4 / 6 / 8 N",
        " / ".join(f"{value:.0f}" for value in kohm) + " kOhm",
        holds=bool(np.all((kohm / quoted < _NEAR) & (quoted / kohm < _NEAR))),
        in_part=True,
    )
    small, large = 1e3 * sizes[:, 0], sizes[:, -1]
    claim(
        "section 3",
        "smallest eigenvalue of the order 10⁻³, largest 10²",
        f"min abs(λ) {small.min():.1f} to {small.max():.1f} · 10⁻³, max abs(λ) "
        f"{large.min():.0f} to {large.max():.0f}",
        holds=bool(np.all((small > 0.1) & (small < 10) & (large > 10) & (large < 1e3))),
        in_part=True,
    )
    grid = len(PAPER_SWEEP.scale), len(PAPER_SWEEP.translation), len(PAPER_SWEEP.angle_rad)
    readings = (Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM)
    swept = [sweep(surfaces, replace(PAPER_SWEEP, reading=reading)) for reading in readings]
    values = np.abs(np.reshape(swept, (len(readings), len(touches), *grid)))
    for kind, part in PARTS.items():
        span = values[part]
        here, other = (span.max(axis=2) / span.min(axis=2)).max(axis=1)
        claim(
            "Fig. 3",
            f"independent of {kind}",
            f"largest over smallest {here:.3f}; algebraic minimum {other:.3f}",
            holds=bool(max(here, other) <= _SAME),
            in_part=bool(here <= _NEAR),
        )


def of_noise(curve: dict[float, list[Array]], n_taught: int) -> None:
    """Print the claims about noise, from the lessons at each noise."""
    silent, paper, loud = (outcomes(lessons, lessons, n_taught) for lessons in curve.values())
    fixed = outcomes(curve[0.0], curve[PAPER_NOISE], n_taught)[VIEWS[0]]
    frame, mean = VIEWS[:2]
    lost, beyond = (a[mean].share - b[mean].share for a, b in ((silent, paper), (paper, loud)))
    claim(
        "section 4.1",
        "noise up to 8 % does not affect the classification",
        f"at {COMMON_N:g} N, filtered: {silent[mean]} without noise, {paper[mean]} at 8 %",
        holds=lost < _NO_EFFECT,
        in_part=lost < 0.1,
    )
    claim(
        "section 4.1",
        "above 8 % the check fails",
        f"at 20 %: {loud[mean]} filtered, {loud[frame]} from one frame",
        holds=False,
        in_part=beyond > _NO_EFFECT,
    )
    claim(
        "section 4.2",
        "thresholds have to be adjusted to the noise",
        f"one frame at 8 %: {paper[frame]} adjusted, {fixed} with those taught without noise",
        holds=paper[frame].share - fixed.share > _NO_EFFECT,
    )


def of_names(table: dict[str, Outcome], still: Outcome) -> None:
    """Print the claims about Table 1, from grasps in any pose and from the same touch again."""
    common, own = table["common"], table["own"]
    low, high = wilson_interval(48, 50)
    counts, rows = common.counts, common.counts.sum(axis=1)
    mixed = sorted(
        ((counts[a, b] + counts[b, a]) / (rows[a] + rows[b]), LABELS[a], LABELS[b])
        for a, b in combinations(range(len(LABELS)), 2)
    )[:-3:-1]
    claim(
        "Table 1",
        "48 of 50 right",
        f"any pose: {common} at {COMMON_N:g} N, {own} at each grasp's full force; same touch, new "
        f"noise: {still} filtered",
        holds=low <= common.share <= high,
        in_part=still.share >= low,
    )
    claim(
        "Table 1",
        "cylinder and ball are the confused pair",
        ", ".join(f"{a} with {b} ({100 * part:.0f} %)" for part, a, b in mixed),
        holds=any({a, b} == {"cylinder", "ball"} for _, a, b in mixed),
    )
    claim(
        "sections 1, 5",
        "the object is named at any force",
        f"{own} at each grasp's own force, {common} at a common one",
        holds=own.share > common.share - _NO_EFFECT,
    )


def main(effort: float = 1.0) -> None:
    """Run all trials in two processes, and print each claim with its verdict."""
    touches = [press(label, ObjectPose(), TOUCH_N) for label in LABELS]
    n_taught = repeats(20, effort, least=4)
    n_again, n_table, n_curve = (
        n_taught + repeats(n, effort, least=least) for n, least in ((1000, 10), (100, 4), (50, 3))
    )
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        again = pool.map(partial(repeated, n=n_again), touches)
        lessons = [(SEED + i, PAPER_NOISE, n_table) for i in range(repeats(10, effort))]
        any_pose = pool.map(lesson, lessons)
        seeds = range(SEED + 1000, SEED + 1000 + repeats(4, effort))
        curve = {
            noise: list(pool.map(lesson, [(seed, noise, n_curve) for seed in seeds]))
            for noise in NOISE_SHARES
        }
        shares = pool.map(partial(try_recognizer, effort=effort), RECOGNIZERS)
        table, same = list(any_pose), np.array(list(again))
        line("compared", f"the paper with {len(table) * (n_table - n_taught)} trials an object")
        of_levels(touches)
        of_noise(curve, n_taught)
        of_names(outcomes(table, table, n_taught), outcomes([same], [same], n_taught)["own"])
        for name, text in zip(RECOGNIZERS, shares, strict=True):
            line(name, f"any pose, touch alone: {text}")
