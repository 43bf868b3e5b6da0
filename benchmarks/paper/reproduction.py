"""The paper's figures 2 to 4, its claims and Table 1, on the physics of the simulated cell.

Prints claims and tables, which docs/explanations/paper-reproduced.md quotes, and writes them with
the figures into out/paper/paper.html; with little effort into out/paper-small.
"""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._measure import line, share
from benchmarks.paper.grasps import COMMON_N, PAPER_NOISE
from benchmarks.paper.trials import LABELS, NOISE_SHARES, TRAIL_SHARES, VIEWS, PaperStudy, study
from cell.data.files import write_text
from cell.errors import ReportError
from cell.report.page import page_template
from cell.report.plots import INK, MUTED, colour, drawing, new_figure, to_svg
from recognition.evaluation.metrics import wilson_interval
from recognition.quadric.thresholds import find_thresholds
from recognition.quadric.trajectory import PAPER_SWEEP
from simulator.world.taxels import resistance_mohm

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


def bands(study: PaperStudy, part: str) -> NDArray[np.float64]:
    """Return least and largest magnitude (2, readings, objects) over a part of the grid."""
    values = study.swept[PARTS[part]].reshape(*study.swept.shape[:2], -1)
    return np.sort(np.abs([values.min(axis=2), values.max(axis=2)]), axis=0)


def overlaps(low_high: NDArray[np.float64], reading: int = 0) -> int:
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
        return to_svg(figure, name, name)


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
    table = study.table["common", 0].counts
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
    full = effort >= 1.0
    found = study(effort)
    line("compared", f"the paper with {found.table['common', 0].trials[1]} trials of its Table 1")
    parts = sections(found)
    for part in parts:
        line(part.title, "")
        for row in part.rows:
            line("", " | ".join(row))
    page = Path("out", "paper" if full else "paper-small", "paper.html")
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, html(parts), error=ReportError, what="page")
    line("page", str(page))
