"""The page of a recording or of an archive: one HTML file without script, fonts or network.

A page has tiles, a legend and sections. A section is a title with the values of some blocks; the
template draws each block. It escapes all texts: markup in a label has no effect.

Each figure is drawn by one function, for a page or for a file of its own. matplotlib draws in the
colours of the light page. The style sheet inverts the lightness of figures on a dark page.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cell.errors import ReportError
from cell.files import write_atomically
from cell.installation import extra
from cell.recording.reader import Rows
from gripper.values.state import GripperPhase
from recognition.evaluation.evaluation import wilson_interval
from recognition.grasp import Grasp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (
    "#2f6fdb", "#e07a1f", "#17966d", "#b0449a", "#937317", "#d13b4d", "#6157cf", "#2b8ca3",
    "#7b8190", "#9d5a33",
)  # fmt: skip
"""Colours of objects, also in the style sheet; more objects use them again."""
INK, MUTED = "#1b1f27", "#667085"
"""Colours of text and of muted text."""
KINDS = (".png", ".svg")
"""Endings of pictures."""
N_SHADES = 12
"""Shades of a taxel between zero and full scale."""

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "tactile-cell",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "figure.facecolor": "none",
    "grid.color": MUTED,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.6,
    "path.simplify_threshold": 0.4,
}
_MAX_PERIODS = 1500
"""Most periods of a grasp in a figure; more are thinned out."""
_FILL = 0.92
"""Side of a drawn taxel as a share of the pitch: a thin gap separates the taxels."""


def drawing() -> Any:
    """Return a context in which figures have the style of the pages.

    Raises MissingExtraError without matplotlib.
    """
    with extra("report", needed_by="a figure"):
        from matplotlib import rc_context  # noqa: PLC0415
    return rc_context(_STYLE)


def new_figure(width_in: float, height_in: float) -> "Figure":
    """Return an empty figure, size in inches. Call it within `drawing`."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    return Figure(figsize=(width_in, height_in), layout="constrained")


def colour(index: int) -> str:
    """Return a colour by its number, for example the place of an object."""
    return COLOURS[index % len(COLOURS)]


def picture(figure: "Figure", description: str) -> str:
    """Return a figure as an element of a page, which contains it whole."""
    file = io.BytesIO()
    with drawing():
        figure.savefig(file, format="svg", metadata={"Date": None})
    source = f"data:image/svg+xml;base64,{base64.b64encode(file.getvalue()).decode()}"
    return f'<img class="plot" alt="{escape(description)}" src="{source}"/>'


def write_picture(path: Path, figure: "Figure") -> None:
    """Write a picture. Raises ReportError for another ending, or where the disk refuses."""
    if path.suffix not in KINDS:
        raise ReportError(f"{path}: the name of a picture ends in {' or '.join(KINDS)}")
    write_atomically(
        path,
        lambda file: figure.savefig(file, format=path.suffix[1:], dpi=150, facecolor="white"),
        error=ReportError,
        what="picture",
    )


def timeline_figure(cycles: Rows) -> "Figure":
    """Draw force and set-point, goal current and opening over time, from the first period on.

    Unknown forces leave gaps.
    """
    every = slice(None, None, max(1, len(cycles) // _MAX_PERIODS))
    since_s = cycles.t_s - cycles.t_s[0]
    t_s, force_n = since_s[every], cycles.force_n[every]
    with drawing():
        figure = new_figure(6.4, 6.3)
        force, current, opening = figure.subplots(3, 1, sharex=True, height_ratios=[2.2, 1, 1])
        for finger in (0, 1):
            look: Any = {"color": colour(finger), "lw": 1.1, "alpha": 0.75}
            force.plot(t_s, force_n[:, finger], label=f"finger {finger}", **look)
        force.plot(t_s, force_n.mean(axis=1), color=colour(2), lw=2.0, label="grip")
        force.plot(t_s, cycles.setpoint_n[every], color=INK, lw=1.3, ls="--", label="set-point")
        force.set(ylabel="force / N", ylim=(np.fmin.reduce(force_n.ravel(), initial=0.0), None))
        force.legend(loc="upper left", ncols=4, handlelength=1.6, columnspacing=1.2)
        force.margins(y=0.22)
        current.plot(t_s, 1e3 * cycles.goal_current_a[every], color=colour(3))
        current.set(ylabel="goal current / mA")
        opening.plot(t_s, 1e3 * cycles.aperture_m[every], color=colour(6))
        opening.set(ylabel="opening / mm", xlabel="time / s")
        ramps = np.flatnonzero(cycles.phase == GripperPhase.RAMPING.name)
        for axes in (force, current, opening):
            axes.margins(x=0.01)
            for contact_s in since_s[ramps[:1]]:
                axes.axvline(contact_s, color=MUTED, lw=0.9, ls=":")
        figure.align_ylabels()
    return figure


def grasp_figure(grasp: Grasp, title: str) -> "Figure":
    """Draw loads of the gripping pads, opening and force over time, and the pads at most load.

    The load is counts above rest. Raises MissingExtraError without matplotlib.
    """
    counts = grasp.counts - grasp.rest_counts
    loads = np.array(
        [counts[:, grasp.pads.taxels_of(pad)].sum(axis=1) for pad in range(grasp.pads.n_pads)]
    )
    gripping = sorted(np.argsort(-np.ptp(loads, axis=1), kind="stable")[:2].tolist())
    largest = counts[int(loads[gripping].sum(axis=0).argmax())]
    with drawing():
        figure = new_figure(8.0, 5.0)
        figure.suptitle(title.replace("$", r"\$"))
        (load, opening), maps = figure.subplots(2, 2)
        for axes in maps:
            axes.set_axis_off()
        for number, (pad, axes) in enumerate(zip(gripping, maps, strict=False)):
            load.plot(grasp.t_s, loads[pad], label=f"pad {pad}", color=colour(number))
            taxels = grasp.pads.taxels_of(pad)
            xy_mm = 1e3 * grasp.pads.taxel_xy_m[taxels]
            points = axes.scatter(
                *xy_mm.T, c=largest[taxels], marker="s", vmin=0, vmax=largest.max(), clip_on=False
            )
            axes.set(aspect="equal", title=f"pad {pad}")
            figure.colorbar(points, ax=axes, label="counts above rest", shrink=0.5)
        load.set(xlabel="time / s", ylabel="sum of the counts above rest")
        load.legend()
        opening.plot(grasp.t_s, 1e3 * grasp.aperture_m, color=colour(6))
        opening.set(xlabel="time / s")
        opening.set_ylabel("opening / mm", color=colour(6))
        if grasp.commanded:
            force = opening.twinx()
            force.plot(grasp.t_s, grasp.force_n, color=colour(5))
            force.set_ylabel("commanded force / N", color=colour(5))
    return figure


def pad_svg(
    xy_mm: NDArray[np.float64], values: NDArray[np.float64], full: float, label: str
) -> str:
    """Return one pad as SVG: one path for each shade (classes ``s1`` to ``s12``).

    Parameters
    ----------
    xy_mm : (n, 2) float64
        Places of the taxels in mm.
    values : (n,) float64
        Their values; 0 or less has the lightest shade.
    full
        Value of the darkest shade.
    label
        Text for screen readers.
    """
    steps = [np.diff(np.unique(places.round(3))).min(initial=np.inf) for places in xy_mm.T]
    finite = [step for step in steps if np.isfinite(step)] or [1.0]
    pitch = np.array([step if np.isfinite(step) else finite[0] for step in steps])
    low = xy_mm.min(axis=0) - 0.5 * pitch
    width, height = np.ptp(xy_mm, axis=0) + pitch
    shades = np.clip(np.ceil(values / full * N_SHADES), 1, N_SHADES).astype(int)
    w, h = (_FILL * pitch).round(2)
    paths = []
    for shade in np.unique(shades):
        corners = (xy_mm[shades == shade] - 0.5 * np.array([w, h]) - low).round(2)
        d = "".join(f"M{x:.4g} {y:.4g}h{w:g}v{h:g}h-{w:g}z" for x, y in corners)
        paths.append(f'<path class="s{shade}" d="{d}"/>')
    return (
        f'<svg class="pad" viewBox="0 0 {width:.4g} {height:.4g}" role="img" '
        f'aria-label="{escape(label)}">{"".join(paths)}</svg>'
    )


DENSE_LABELS = 12
"""Most labels of a confusion table in normal size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """All values of a page."""

    title: str
    subtitle: str = ""
    tiles: Sequence[tuple[str, str, str]] = ()
    """The main results: value with unit, meaning, and basis in small print."""
    labels: Sequence[str] = ()
    """Objects or cells, in the order of their colours."""
    sections: Mapping[str, Mapping[str, Any]]
    """Sections by their keys: a `title`, a `lead` and blocks; one with empty blocks is left out."""


def write_report(path: Path | str, page: Page) -> None:
    """Write the page atomically: an older file stays until the new file is complete.

    Raises ReportError if it cannot be written or its name does not end with .html, and
    MissingExtraError without the extra ``report``.
    """
    if Path(path).suffix != ".html":
        raise ReportError(f"{path}: the name of a report must end with .html")
    data = render_report(page).encode("utf-8", errors="replace")
    write_atomically(Path(path), lambda file: file.write(data), error=ReportError, what="report")


def render_report(page: Page) -> str:
    """Return the page as HTML. Raises MissingExtraError without jinja2 or matplotlib."""
    sections = {
        key: section
        for key, section in page.sections.items()
        if any(block for name, block in section.items() if name not in ("title", "lead"))
    }
    place = {label: place for place, label in enumerate(page.labels)}
    with extra("report", needed_by="the report"):
        from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415
    environment = Environment(
        loader=PackageLoader("cell.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {
        "colours": COLOURS,
        "dense_labels": DENSE_LABELS,
        "n_shades": N_SHADES,
        "wilson": wilson_interval,
        "zip": zip,
    }
    environment.filters["percent"] = percent
    template = environment.get_template("report.html.j2")
    return template.render(page=page, sections=sections, place=place)


def percent(share: float) -> str:
    """Return a share in per cent; one of nearly 1 has digits, and is not rounded to 1."""
    if 0.99 < share < 1.0:
        return f"{100 * min(share, 0.9999):.2f} %"
    return f"{100 * share:.0f} %"
