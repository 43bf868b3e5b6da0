"""The paper's figures 2 to 4, its claims and Table 1, on the physics of the simulated cell.

A few grasps teach levels, the others are named. The rule is that of Algorithm 1. Each threshold is
in the middle between neighbouring bands of the taught levels; if bands overlap, in the middle of
the overlap. A value between two thresholds belongs to the object there. So every grasp with a
surface gets a name.

Prints claims and tables, which docs/developers/paper.md quotes, and writes them with
the figures into out/paper/paper.html; with little effort into out/paper-small.
"""

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from html import escape
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._measure import line, repeats, share
from benchmarks.paper.grasps import (
    COMMON_N,
    PAPER_NOISE,
    REST_FRAMES,
    Touch,
    press,
    random_grasp,
    record,
)
from cell.errors import ReportError
from cell.files import write_text
from cell.report.confusion import TABLE_1, TABLE_1_LABELS as LABELS
from cell.report.figures import INK, MUTED, colour, drawing, new_figure, picture
from cell.report.page import page_template
from recognition.errors import ContactError, QuadricError
from recognition.evaluation.metrics import confusion_matrix, wilson_interval
from recognition.grasp import Grasp
from recognition.quadric.eigen import Reading, eigenvalues, smallest_eigenvalue
from recognition.quadric.level import DEFAULT_LEVEL, grip_surfaces
from recognition.quadric.thresholds import LevelBands, check_level, find_thresholds
from recognition.quadric.trajectory import PAPER_SWEEP, sweep
from recognition.recognizers import make_trainer
from simulator.world.shapes import ObjectPose
from simulator.world.taxels import resistance_mohm

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


FIGURE_2 = ((2.0, 650.0), (4.0, 250.0), (6.0, 100.0), (8.0, 50.0))
"""Points of the paper's figure 2: force in N and resistance in kOhm."""
_SAME, _NEAR = 1.01, 1.15
"""A value that changes by less than this factor counts as unchanged, or as nearly."""
_NO_EFFECT = 0.02
"""A share of right names that changes by less counts as unchanged."""

CLAIMS = (
    ("Fig. 2, eq. (11)", "650 / 250 / 100 / 50 kOhm at 2 / 4 / 6 / 8 N"),
    ("section 3", "smallest eigenvalue of the order 10⁻³, largest 10²"),
    ("Fig. 3", "independent of translation in x and y"),
    ("Fig. 3", "independent of rotation about any axis"),
    ("Fig. 3", "both together, as in Algorithm 1"),
    ("Fig. 3", "independent of scale"),
    ("Fig. 3", "the objects' trajectories are separate levels"),
    ("section 4.1", "noise up to 8 % of full scale does not affect the classification"),
    ("section 4.1", "above 8 % the levels cross and the check fails"),
    ("section 4.1", "a noise filter before the surface is fitted reduces the effect"),
    ("section 4.2", "thresholds have to be adjusted to the noise"),
    ("Table 1", "48 of 50 right"),
    ("Table 1", "cylinder and ball are the pair that is confused"),
    ("section 4.2", "the box is safe, its level has no close neighbour"),
    ("sections 1 and 5", "the object is named whatever the force, without any other reference"),
)
"""Claims of the paper in its order, each with its place."""
PARTS = {
    "translation in x and y": np.s_[:, :, 0, :, 0],
    "rotation about all axes": np.s_[:, :, 0, 20, :],
    "translation and rotation": np.s_[:, :, 0],
    "scale 1 to 4": np.s_[:, :, :, 20, 0],
    "all three": np.s_[:, :],
}
"""What is varied, and its part of the printed grid: scale 1 and angle 0 are its first, translation
0 is its middle."""

Row = Sequence[str]


class Finding(NamedTuple):
    """What was found about a claim."""

    text: str
    holds: bool
    in_part: bool = False

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        return "holds" if self.holds else "in part" if self.in_part else "does not hold"


class Section(NamedTuple):
    """A part of the page."""

    title: str
    rows: Sequence[Row] = ()
    """Lines of a table, the first one its head."""
    svg: str = ""


def bands(study: PaperStudy, part: str) -> Array:
    """Return least and largest magnitude (2, readings, objects) over a part of the grid."""
    values = study.swept[PARTS[part]].reshape(*study.swept.shape[:2], -1)
    return np.sort(np.abs([values.min(axis=2), values.max(axis=2)]), axis=0)


def overlaps(low_high: Array, reading: int = 0) -> int:
    """Return the number of pairs of objects, of 10, whose bands overlap."""
    (low, high), pairs = low_high[:, reading], combinations(range(len(LABELS)), 2)
    return sum(bool(low[a] <= high[b] and low[b] <= high[a]) for a, b in pairs)


def of_levels(study: PaperStudy) -> list[Finding]:
    """Return what was found about the sensor and about figure 3."""
    force_n, quoted = np.array(FIGURE_2).T
    kohm, sizes = 1e3 * resistance_mohm(force_n), np.abs(study.eigenvalues)
    small, large = 1e3 * sizes[:, -1], sizes[:, 0]
    near = np.all((kohm / quoted < _NEAR) & (quoted / kohm < _NEAR))
    orders = np.all((small > 0.1) & (small < 10) & (large > 10) & (large < 1e3))
    sizes_text = f"{small.min():.1f} to {small.max():.1f} · 10⁻³, max abs(λ) {large.min():.0f} to"
    found = [
        Finding(" / ".join(f"{one:.0f}" for one in kohm) + " kOhm", bool(near), in_part=True),
        Finding(f"min abs(λ) {sizes_text} {large.max():.0f}", bool(orders), in_part=True),
    ]
    for part in list(PARTS)[:4]:
        low, high = bands(study, part)
        here, other = (high / low).max(axis=1)
        text = f"largest over smallest {here:.3f}; algebraic minimum {other:.3f}"
        found.append(Finding(text, bool(max(here, other) <= _SAME), bool(here <= _NEAR)))
    whole, part = (overlaps(bands(study, one)) for one in ("all three", "translation and rotation"))
    text = f"{whole} of 10 pairs of bands overlap; without the loop over scale {part}"
    return [*found, Finding(text, whole == 0, part <= 2)]


def of_noise(study: PaperStudy) -> list[Finding]:
    """Return what was found about noise and its filter."""
    one, mean, fixed = ("common, one frame", 0), ("common", 0), study.fixed[PAPER_NOISE]
    silent, paper, loud = (study.adjusted[noise] for noise in NOISE_SHARES)
    again, averaged, by_noise = (
        study.again[f"own{view}", 0] for view in (", one frame", "", ", noise patch")
    )
    lost, beyond = (a[mean].share - b[mean].share for a, b in ((silent, paper), (paper, loud)))
    gained = averaged.share - again.share, by_noise.share - again.share
    return [
        Finding(
            f"filtered {silent[mean]} without noise, {paper[mean]} at 8 %; from one frame "
            f"{silent[one]} and {paper[one]}",
            lost < _NO_EFFECT,
            lost < 0.1,
        ),
        Finding(f"at 20 % {loud[mean]} filtered, {loud[one]}", False, beyond > _NO_EFFECT),
        Finding(
            f"same touch, 8 %: {again} from one frame, {averaged} filtered, {by_noise} where the "
            "patch has all taxels above the lower noise",
            min(gained) > _NO_EFFECT,
            max(gained) > _NO_EFFECT,
        ),
        Finding(
            f"one frame at 8 %: {paper[one]} adjusted, {fixed[one]} with those taught without it",
            paper[one].share - fixed[one].share > _NO_EFFECT,
        ),
    ]


def of_names(study: PaperStudy) -> list[Finding]:
    """Return what was found about Table 1."""
    common, own = study.table["common", 0], study.table["own", 0]
    same, still = study.again["own, one frame", 0], study.again["own", 0]
    low, high = wilson_interval(48, 50)
    table, rows = common.counts, common.counts.sum(axis=1)
    mixed = sorted(
        ((table[a, b] + table[b, a]) / (rows[a] + rows[b]), LABELS[a], LABELS[b])
        for a, b in combinations(range(len(LABELS)), 2)
    )[:-3:-1]
    box = int(table[2, 2]), int(rows[2])
    return [
        Finding(
            f"any pose: {common} at {COMMON_N:g} N, {own} at each grasp's full force; same touch, "
            f"new noise: {same} from one frame, {still} filtered",
            low <= common.share <= high,
            max(same.share, still.share) >= low,
        ),
        Finding(
            ", ".join(f"{a} with {b} ({100 * part:.0f} %)" for part, a, b in mixed),
            any({a, b} == {"cylinder", "ball"} for _, a, b in mixed),
        ),
        Finding(f"the box is named right in {share(*box)}", wilson_interval(*box)[0] > 0.9),
        Finding(
            f"{own} at each grasp's own force, {common} at a common one",
            own.share > common.share - _NO_EFFECT,
        ),
    ]


def claims(study: PaperStudy) -> list[Row]:
    """Return all claims, each with a verdict by a rule."""
    found = [*of_levels(study), *of_noise(study), *of_names(study)]
    return [(*claim, one.text, one.verdict) for claim, one in zip(CLAIMS, found, strict=True)]


def svg(name: str, draw: Callable[..., None], n_panels: int = 1) -> str:
    """Return a figure in the page's style; ``draw`` gets its panels."""
    with drawing():
        figure = new_figure(10.2, 4.0)
        draw(*np.atleast_1d(figure.subplots(1, n_panels)))
        return picture(figure, name)


def draw_resistance(axes: Any) -> None:
    """Draw figure 2: resistance of a taxel over force."""
    force_n = np.linspace(0.0, 9.0, 181)
    axes.plot(force_n, 1e3 * resistance_mohm(force_n), color=INK, label="equation (11)")
    axes.plot(*zip(*FIGURE_2, strict=True), "D", mfc="none", color=colour(5), label="paper")
    axes.set(yscale="log", xlabel="force / N", ylabel="resistance / kOhm")
    axes.legend()


def draw_trajectories(study: PaperStudy, whole: Any, part: Any) -> None:
    """Draw figure 3: min abs(λ) of each object over the printed grid, and over scale 1 alone."""
    for index, (label, values) in enumerate(zip(LABELS, 1e3 * study.swept[0], strict=True)):
        poses = values.reshape(len(values), -1)
        low, high = poses.min(axis=1), poses.max(axis=1)
        whole.fill_between(PAPER_SWEEP.scale, low, high, color=colour(index), alpha=0.4)
        part.plot(poses[0], color=colour(index), lw=0.7, label=label)
    whole.set(yscale="log", xlabel="scale; area: all poses", ylabel="min abs(λ) / 10⁻³")
    part.set(xlabel="evaluation at scale 1: translation, then rotation")
    part.legend()


def draw_noise(study: PaperStudy, *panels: Any) -> None:
    """Draw figure 4: levels of five touches under rising noise, and thresholds (dashed)."""
    n_shares = len(study.trails)
    percent = 100 * np.array(TRAIL_SHARES[:: 1 if n_shares == len(TRAIL_SHARES) else 4])
    for axes, view in zip(panels, ("common, one frame", "common"), strict=True):
        levels = 1e3 * study.trails[:, :, :, list(VIEWS).index(view), 0]
        for index, label in enumerate(LABELS):
            here, shade = np.ma.masked_invalid(levels[:, index]), colour(index)
            axes.fill_between(percent, here.min(axis=1), here.max(axis=1), color=shade, alpha=0.2)
            axes.plot(percent, np.ma.median(here, axis=1), color=shade, marker=".", label=label)
        complete = np.isfinite(levels).any(axis=2).all(axis=1)
        limits = np.array([find_thresholds(list(one)).threshold for one in levels[complete]])
        axes.plot(percent[complete], limits, color=MUTED, lw=0.8, ls="--")
        axes.axvline(100 * PAPER_NOISE, color=INK, lw=0.9, ls=":")
        axes.set(title=view, xlabel="largest noise / % of full scale", yscale="log")
    panels[0].set_ylabel(f"min abs(λ) at {COMMON_N:g} N / 10⁻³")
    panels[0].legend()


def sections(study: PaperStudy) -> list[Section]:
    """Return all parts of the page."""
    invariance: list[Row] = [("varied", "min abs(λ)", "pairs of 10", "algebraic minimum", "pairs")]
    for name in PARTS:
        low, high = bands(study, name)
        spans = [f"{one.min():.3f} to {one.max():.3f}" for one in high / low]
        pairs = [str(overlaps(np.array([low, high]), reading)) for reading in (0, 1)]
        invariance.append((name, spans[0], pairs[0], spans[1], pairs[1]))
    table, paper = study.table["common", 0].counts, [("held", *LABELS)]
    paper += [(label, *map(str, row)) for label, row in zip(LABELS, TABLE_1, strict=True)]
    confusion: list[Row] = [("held", *LABELS, "no surface", "right, 95 %")]
    for index, (label, row) in enumerate(zip(LABELS, table, strict=True)):
        shares = [f"{100 * n / row.sum():.1f}" for n in row]
        confusion.append((label, *shares, share(int(row[index]), int(row.sum()))))
    readings: list[Row] = [("reading", "poses", "force", "right", "with windows: named, right")]
    for poses, found in (("any", study.table), ("same touch", study.again)):
        for reading, name in enumerate(("min abs(λ)", "algebraic minimum")):
            for view in ("own", "common"):
                one = found[view, reading]
                named = one.windows_named / one.trials[1]
                of_those = one.windows_right / max(1, one.windows_named)
                windows = f"{100 * named:.0f} %, {100 * of_those:.0f} %"
                readings.append((name, poses, view, str(one), windows))
    recognizers: list[Row] = [("recogniser", "sees", "right")]
    for (name, opening), counts in study.recognizers.items():
        sees = "touch and opening" if opening else "touch alone"
        recognizers.append((name, sees, share(int(np.trace(counts)), int(counts.sum()))))
    trajectories = partial(draw_trajectories, study)
    head = ("where", "the paper", "here", "verdict")
    return [
        Section("Claims of the paper", [head, *claims(study)]),
        Section("Figure 2: resistance of a taxel", svg=svg("fig2", draw_resistance)),
        Section("Figure 3: trajectories", invariance, svg("fig3", trajectories, 2)),
        Section("Figure 4: levels under noise", svg=svg("fig4", partial(draw_noise, study), 2)),
        Section("Table 1 of the paper, per cent", paper),
        Section(f"Table 1: min abs(λ) at {COMMON_N:g} N, filtered, per cent", confusion),
        Section("Other readings, filtered", readings),
        Section("Recognisers on the same kind of grasps", recognizers),
    ]


def html(parts: Sequence[Section]) -> str:
    """Return the page, which needs no network and runs no script."""
    style, title = page_template("style.css.j2").render(), "The paper and the simulated cell"
    text = f"<!doctype html><meta charset='utf-8'><title>{title}</title><style>{style}</style>"
    text += f"<main><h1>{title}</h1>"
    for part in parts:
        rows = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in part.rows)
        table = "".join(f"<tr>{row}</tr>" for row in rows)
        text += f"<h2>{escape(part.title)}</h2>{part.svg}<table>{table}</table>"
    return text + "</main>"


def main(effort: float = 1.0) -> None:
    found = study(effort)
    line("compared", f"the paper with {found.table['common', 0].trials[1]} trials of its Table 1")
    parts = sections(found)
    for part in parts:
        line(part.title, "")
        for row in part.rows:
            line("", " | ".join(row))
    page = Path("out", "paper" if effort >= 1.0 else "paper-small", "paper.html")
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, html(parts), error=ReportError, what="page")
    line("page", str(page))
