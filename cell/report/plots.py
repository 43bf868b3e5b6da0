"""The plots of the pages: drawn by matplotlib, coloured by the style sheet of the page.

matplotlib uses placeholder colours, which become CSS variables. So one picture fits light and dark
themes. Text stays text in the font of the page.
"""

import io
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cell.data.recording_reader import RecordedCycles
from cell.installation import extra
from cell.report.data import Trajectories
from gripper.values.state import GripperPhase

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

N_COLOURS = 10
"""Colours of objects (CSS variables ``--c0`` to ``--c9``); more objects use them again."""

INK, MUTED, GRID, PAPER = "#010101", "#010102", "#010103", "#010104"
"""Placeholders of text, muted text, lines and background."""
_COLOURS = tuple(f"#0101{16 + i:02x}" for i in range(N_COLOURS))
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--line)",
    PAPER: "var(--card)",
    **{colour: f"var(--c{i})" for i, colour in enumerate(_COLOURS)},
}
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "tactile-cell",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.6,
    "path.simplify": True,
    "path.simplify_threshold": 0.4,
}


def new_figure(width_in: float, height_in: float) -> "Figure":
    """Return an empty figure, size in inches. Call it within `drawing`."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    return Figure(figsize=(width_in, height_in), layout="constrained")


def drawing() -> Any:
    """Return a context in which figures have the page's style.

    Raises MissingExtraError without matplotlib.
    """
    with extra("report", needed_by="the report"):
        from matplotlib import rc_context  # noqa: PLC0415
    return rc_context(_STYLE)


def to_svg(figure: "Figure", name: str, description: str) -> str:
    """Return the figure as SVG; a page may contain it several times with different names."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{name}-", text)
    text = re.sub(r' (?:width|height)="[0-9.]+pt"', "", text, count=2)
    text = re.sub(r"#0101[0-9a-f]{2}", lambda m: _VARIABLES.get(m.group(), m.group()), text)
    text = re.sub(r"\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg class="plot" role="img" aria-label="{description}" ', 1)


def colour(index: int) -> str:
    """Return the placeholder of a colour by its number, for example the place of an object."""
    return _COLOURS[index % N_COLOURS]


_MAX_PERIODS = 1500
"""Most periods of a grasp in a plot; more are thinned out."""
_MAX_BINS = 260
"""Most points of a sweep in a plot, about two pixels each."""


def timeline_figure(cycles: RecordedCycles, name: str) -> str:
    """Draw force and set-point, goal current and opening over time, from the first period on.

    Unknown forces leave gaps.
    """
    every = slice(None, None, max(1, len(cycles) // _MAX_PERIODS))
    since_s = cycles.t_s - cycles.t_s[0]
    t_s, force_n = since_s[every], cycles.force_n[every]
    ramps = np.flatnonzero(np.array(cycles.phase) == GripperPhase.RAMPING.name)
    contact_s = float(since_s[ramps[0]]) if len(ramps) else None
    with drawing():
        figure = new_figure(6.4, 6.3)
        force, current, opening = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1, 1]}
        )
        for finger in (0, 1):
            look: Any = {"color": colour(finger), "lw": 1.1, "alpha": 0.75}
            force.plot(t_s, force_n[:, finger], label=f"finger {finger}", **look)
        force.plot(t_s, force_n.mean(axis=1), color=colour(2), lw=2.0, label="grip")
        asked_n = cycles.setpoint_n[every]
        force.plot(t_s, asked_n, color=INK, lw=1.3, ls=(0, (4, 2)), label="set-point")
        force.set_ylabel("force / N")
        force.set_ylim(bottom=min(0.0, _least(force_n)))
        force.legend(loc="upper left", ncols=4, handlelength=1.6, columnspacing=1.2)
        force.margins(y=0.22)
        current.plot(t_s, 1e3 * cycles.goal_current_a[every], color=colour(3))
        current.set_ylabel("goal current / mA")
        opening.plot(t_s, 1e3 * cycles.aperture_m[every], color=colour(6))
        opening.set_ylabel("opening / mm")
        opening.set_xlabel("time / s")
        for axes in (force, current, opening):
            axes.margins(x=0.01)
            if contact_s is not None:
                axes.axvline(contact_s, color=MUTED, lw=0.9, ls=":")
        if contact_s is not None:
            opening.annotate(
                "contact",
                (contact_s, 0.92),
                xycoords=("data", "axes fraction"),
                xytext=(4, 0),
                textcoords="offset points",
                va="top",
                color=MUTED,
            )
        figure.align_ylabels()
        return to_svg(figure, name, "force, current and opening over time")


def _least(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.min()) if len(known) else 0.0


def sweep_figure(trajectories: Trajectories, colours: Mapping[str, int], name: str) -> str:
    """Draw the smallest eigenvalue over the poses of Algorithm 1: median and range.

    ``colours`` has the colour number of each label, as for `levels_figure`.
    """
    with drawing():
        figure = new_figure(6.4, 3.7)
        axes = figure.subplots()
        for item in trajectories.objects:
            share, low, middle, high = _envelope(item.sweep)
            if not len(share):
                continue
            axes.fill_between(share, low, high, color=colour(colours[item.label]), alpha=0.18, lw=0)
            axes.plot(share, middle, color=colour(colours[item.label]))
        _finish_levels(axes, [item.sweep for item in trajectories.objects])
        axes.set_xlabel("pose of Algorithm 1 (scale, then translation, then rotation) / %")
        axes.set_ylabel("smallest eigenvalue")
        return to_svg(figure, name, "eigenvalue trajectories of the objects over the sweep")


def _envelope(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    if not np.any(np.isfinite(values)):
        nothing = np.empty(0)
        return nothing, nothing, nothing, nothing
    parts = np.array_split(values, min(_MAX_BINS, len(values)))
    known = [part[np.isfinite(part)] for part in parts]
    rows = [
        (part.min(), np.median(part), part.max()) if len(part) else (np.nan,) * 3 for part in known
    ]
    low, middle, high = np.array(rows).T
    return (np.arange(len(parts)) + 0.5) * 100 / len(parts), low, middle, high


def levels_figure(trajectories: Trajectories, colours: Mapping[str, int], name: str) -> str:
    """Draw lambda(F) along the ramp beside the taught levels, thresholds and windows."""
    with drawing():
        figure = new_figure(6.4, 3.7)
        ramp, bands = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [1.5, 1]})
        values = []
        for index, item in enumerate(trajectories.objects):
            values += [item.ramp_value, np.array([item.low, item.high])]
            if len(item.ramp_value):
                ramp.plot(
                    item.ramp_force_n,
                    item.ramp_value,
                    color=colour(colours[item.label]),
                    marker="o",
                    ms=2.6,
                    lw=1.2,
                )
            if np.isfinite(item.low):
                bands.vlines(index, item.low, item.high, color=colour(colours[item.label]), lw=9)
                bands.plot(index, np.sqrt(abs(item.low * item.high)), ".", color=PAPER, ms=4)
        for window in trajectories.windows:
            for axes in (ramp, bands):
                axes.axhline(window.threshold, color=MUTED, lw=0.8, ls=(0, (4, 3)))
                if not window.closed:
                    axes.axhspan(window.low, window.high, color=INK, alpha=0.06, lw=0)
            bands.annotate(
                window.name + (" (overlap)" if window.closed else ""),
                (1.0, window.threshold),
                xycoords=("axes fraction", "data"),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                color=MUTED,
                annotation_clip=False,
            )
        _finish_levels(ramp, values)
        ramp.set_xlabel("grip force / N")
        ramp.set_ylabel("smallest eigenvalue")
        count = len(trajectories.objects)
        bands.set_xticks(
            range(count), [_short(item.label) for item in trajectories.objects], rotation=40,
            ha="right",
        )  # fmt: skip
        bands.set_xlim(-0.7, count - 0.3)
        bands.grid(visible=False, axis="x")
        return to_svg(figure, name, "eigenvalue along the force ramp, levels and windows")


def _short(label: str) -> str:
    return (label if len(label) <= 12 else label[:11] + "…").replace("$", r"\$")


def _finish_levels(axes: "Axes", values: Sequence[NDArray[np.float64]]) -> None:
    together = np.concatenate(list(values)) if values else np.empty(0)
    known = together[np.isfinite(together)]
    if len(known) and known.min() > 0:
        axes.set_yscale("log")
    axes.margins(x=0.02)
