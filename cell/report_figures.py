"""Line plots of the report."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cell.plots import INK, MUTED, N_COLOURS, PAPER, colour, drawing, new_figure, to_svg
from cell.report_grasps import GraspTimeline, Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["N_COLOURS", "colour", "levels_figure", "sweep_figure", "timeline_figure"]

_MAX_BINS = 260


def timeline_figure(timeline: GraspTimeline, name: str) -> str:
    """Draw force against set-point, goal current and opening over time."""
    with drawing():
        figure = new_figure(6.4, 6.3)
        force, current, opening = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1, 1]}
        )
        t_s = timeline.t_s
        for finger in (0, 1):
            force.plot(
                t_s,
                timeline.force_n[:, finger],
                color=colour(finger),
                lw=1.1,
                alpha=0.75,
                label=f"finger {finger}",
            )
        grip_n = timeline.force_n.mean(axis=1)
        force.plot(t_s, grip_n, color=colour(2), lw=2.0, label="grip")
        force.plot(t_s, timeline.setpoint_n, color=INK, lw=1.3, ls=(0, (4, 2)), label="set-point")
        force.set_ylabel("force / N")
        force.set_ylim(bottom=min(0.0, _least(timeline.force_n)))
        force.legend(loc="upper left", ncols=4, handlelength=1.6, columnspacing=1.2)
        force.margins(y=0.22)
        current.plot(t_s, timeline.goal_current_a * 1e3, color=colour(3))
        current.set_ylabel("goal current / mA")
        opening.plot(t_s, timeline.aperture_m * 1e3, color=colour(6))
        opening.set_ylabel("opening / mm")
        opening.set_xlabel("time / s")
        for axes in (force, current, opening):
            axes.margins(x=0.01)
            if timeline.contact_t_s is not None:
                axes.axvline(timeline.contact_t_s, color=MUTED, lw=0.9, ls=":")
        if timeline.contact_t_s is not None:
            opening.annotate(
                "contact",
                (timeline.contact_t_s, 0.92),
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


def sweep_figure(trajectories: Trajectories, name: str) -> str:
    """Draw the smallest eigenvalue over the poses of Algorithm 1: median and range."""
    with drawing():
        figure = new_figure(6.4, 3.7)
        axes = figure.subplots()
        for index, item in enumerate(trajectories.objects):
            share, low, middle, high = _envelope(item.sweep)
            if not len(share):
                continue
            axes.fill_between(share, low, high, color=colour(index), alpha=0.18, lw=0)
            axes.plot(share, middle, color=colour(index))
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


def levels_figure(trajectories: Trajectories, name: str) -> str:
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
                    color=colour(index),
                    marker="o",
                    ms=2.6,
                    lw=1.2,
                )
            if np.isfinite(item.low):
                bands.vlines(index, item.low, item.high, color=colour(index), lw=9)
                bands.plot(index, np.sqrt(abs(item.low * item.high)), ".", color=PAPER, ms=4)
        for window in trajectories.windows:
            for axes in (ramp, bands):
                axes.axhline(window.threshold, color=MUTED, lw=0.8, ls=(0, (4, 3)))
                if not window.closed:
                    axes.axhspan(window.low, window.high, color=INK, alpha=0.06, lw=0)
            bands.annotate(
                window.name + (" (closed)" if window.closed else ""),
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
