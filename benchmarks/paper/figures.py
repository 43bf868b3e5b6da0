"""The plots that stand beside the paper's figures 2, 3 and 4, and the accuracy over the noise."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.grasps import COMMON_N, PAPER_NOISE, Indentation
from benchmarks.paper.level_trials import CONDITIONS, LABELS, READINGS, Condition, Outcome
from benchmarks.paper.study import PaperStudy
from cell.report.paper_table import FIGURE_2
from cell.report.plots import INK, MUTED, colour, drawing, new_figure, to_svg
from recognition.evaluation.metrics import wilson_interval
from recognition.quadric.thresholds import find_thresholds
from simulator.world.taxels import resistance_mohm

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS = 240
_DASHES = (0, (4, 2.5))


def condition_index(*, force_n: float | None, filtered: bool) -> int:
    """Return the place of a condition of the first reading in `CONDITIONS`."""
    return CONDITIONS.index(Condition(reading=READINGS[0], force_n=force_n, filtered=filtered))


def resistance_figure(indentation: Indentation) -> str:
    """Draw figure 2: resistance over force, law, quoted points and simulated taxel."""
    with drawing():
        figure = new_figure(6.4, 3.8)
        axes = figure.subplots()
        force_n = np.linspace(0.0, 9.0, 181)
        axes.plot(force_n, 1e3 * resistance_mohm(force_n), color=INK, lw=1.4, label="equation (11)")
        kilo_ohm = 1e3 * indentation.resistance_mohm
        axes.plot(
            indentation.taxel_n,
            kilo_ohm,
            "o",
            ms=3.4,
            color=colour(0),
            label="simulated taxel, force on the taxel",
        )
        axes.plot(
            indentation.force_n,
            kilo_ohm,
            color=colour(1),
            ls=_DASHES,
            label="the same, force on the indenter",
        )
        axes.plot(
            *zip(*FIGURE_2, strict=True),
            "D",
            ms=7,
            mfc="none",
            mew=1.6,
            color=colour(5),
            label="paper, Fig. 2",
        )
        axes.set_yscale("log")
        axes.set_yticks([50, 100, 250, 650, 1579], ["50", "100", "250", "650", "1579"])
        axes.minorticks_off()
        axes.set_xlim(-0.1, 9.1)
        axes.set_xlabel("force / N")
        axes.set_ylabel("resistance / kOhm")
        axes.legend(loc="upper right")
        return to_svg(figure, "fig2", "resistance of a taxel over force")


def trajectories_figure(study: PaperStudy) -> str:
    """Draw figure 3: the trajectories over the printed grid, and over its first scale alone."""
    with drawing():
        figure = new_figure(10.2, 3.8)
        whole, part = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.25, 1]})
        trajectory = study.trajectories[READINGS[0]]
        grid = trajectory.settings
        n_part = len(grid.translation) * len(grid.angle_rad)
        for index, values in enumerate(trajectory.value):
            parts = np.array_split(values, _BINS)
            at = (np.arange(_BINS) + 0.5) * len(values) / _BINS
            low, high = (np.array([fold(one) for one in parts]) for fold in (np.min, np.max))
            whole.fill_between(at, 1e3 * low, 1e3 * high, color=colour(index), alpha=0.25, lw=0)
            middle = np.array([np.median(one) for one in parts])
            whole.plot(at, 1e3 * middle, color=colour(index), lw=1.2)
            part.plot(1e3 * values[:n_part], color=colour(index), lw=0.7)
        whole.set_yscale("log")
        whole.set_yticks([0.2, 0.5, 1.0, 2.0, 5.0], ["0.2", "0.5", "1", "2", "5"])
        whole.minorticks_off()
        whole.set_xlabel("evaluation: scale 1 to 4, then translation, then rotation")
        whole.set_ylabel("min |λ| / 10⁻³")
        whole.set_title("the whole printed grid", loc="left", fontsize=9.5)
        part.set_xlabel("evaluation: translation, then rotation")
        part.set_title("scale 1 only", loc="left", fontsize=9.5)
        for axes in (whole, part):
            axes.margins(x=0.01)
        return to_svg(figure, "fig3", "eigenvalue trajectories of the five objects")


def noise_figure(study: PaperStudy) -> str:
    """Draw figure 4: levels under rising noise, thresholds, and the windows at the paper's."""
    with drawing():
        figure = new_figure(10.2, 4.2)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, filtered in zip(panels, (False, True), strict=True):
            place = condition_index(force_n=COMMON_N, filtered=filtered)
            trails = 1e3 * study.noise_trails[..., place]
            _trails(axes, 100 * np.array(study.trail_shares), trails)
            axes.set_xlabel("largest noise / % of full scale")
            name = "noise filter (frames near the force averaged)" if filtered else "one frame"
            axes.set_title(name, loc="left", fontsize=9.5)
        # A single touch that hardly carries a surface any more must not squeeze all the others.
        places = [condition_index(force_n=COMMON_N, filtered=f) for f in (False, True)]
        middle = 1e3 * np.nanmedian(study.noise_trails[..., places], axis=2)
        panels[0].set_ylim(0.75 * np.nanmin(middle), 1.2 * np.nanmax(middle))
        panels[0].set_ylabel(f"min |λ| at {COMMON_N:g} N / 10⁻³")
        return to_svg(figure, "fig4", "levels of five touches under rising noise")


def _trails(axes: "Axes", percent: NDArray[np.float64], trails: NDArray[np.float64]) -> None:
    known: NDArray[np.bool_] = np.asarray(np.isfinite(trails).any(axis=2), dtype=np.bool_)
    for index in range(len(LABELS)):
        at, here = percent[known[:, index]], trails[known[:, index], index]
        axes.fill_between(
            at, np.nanmin(here, 1), np.nanmax(here, 1), color=colour(index), alpha=0.2, lw=0
        )
        axes.plot(at, np.nanmedian(here, 1), color=colour(index), marker=".", ms=4)
    axes.axvline(100 * PAPER_NOISE, color=INK, lw=0.9, ls=":")
    at_paper = int(np.argmin(np.abs(percent - 100 * PAPER_NOISE)))
    thresholds = np.array(
        [find_thresholds(list(one)).threshold if np.isfinite(one).any(1).all() else [np.nan] * 4
         for one in trails]
    )  # fmt: skip
    for line in thresholds.T:
        axes.plot(percent, line, color=MUTED, lw=0.8, ls=_DASHES)
    levels = find_thresholds(list(trails[at_paper]))
    names = iter("ABCDEFGH")
    for below, above, gap in zip(levels.order[:-1], levels.order[1:], levels.window, strict=True):
        low, high = float(levels.high[below]), float(levels.low[above])
        name = next(names)
        if gap > 0:
            axes.plot([percent[at_paper]] * 2, [low, high], color=INK, lw=3.5)
        axes.annotate(
            name if gap > 0 else f"{name} closed",
            (percent[at_paper], 0.5 * (low + high)),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            color=INK,
        )
    axes.margins(x=0.02)


def accuracy_figure(study: PaperStudy) -> str:
    """Draw the share of right names over the noise, with 95 % intervals."""
    common, own = COMMON_N, None
    lines = (
        (f"at {COMMON_N:g} N, filtered", common, True, True, colour(0)),
        (f"at {COMMON_N:g} N, one frame", common, False, True, colour(1)),
        ("at full force, filtered", own, True, True, colour(2)),
        (f"at {COMMON_N:g} N, filtered, thresholds not adjusted", common, True, False, colour(0)),
        (f"at {COMMON_N:g} N, one frame, not adjusted", common, False, False, colour(1)),
    )
    with drawing():
        figure = new_figure(10.2, 3.9)
        axes = figure.subplots()
        for name, force_n, filtered, adjusted, shade in lines:
            place = condition_index(force_n=force_n, filtered=filtered)
            outcomes: list[Mapping[int, Outcome]] = [
                point.adjusted if adjusted else point.fixed for point in study.curve
            ]
            found = [one[place] for one in outcomes]
            percent = [100 * point.noise_share for point in study.curve]
            band = 100 * np.array([wilson_interval(one.n_right, one.n) for one in found])
            axes.fill_between(percent, band[:, 0], band[:, 1], color=shade, alpha=0.15, lw=0)
            axes.plot(
                percent,
                [100 * one.n_right / one.n for one in found],
                color=shade,
                marker="o" if adjusted else None,
                ms=3.5,
                ls="-" if adjusted else _DASHES,
                label=name,
            )
        axes.axhline(20, color=MUTED, lw=0.8)
        axes.annotate("chance", (20, 20), xytext=(0, 3), textcoords="offset points",
                      ha="right", color=MUTED)  # fmt: skip
        axes.axvline(100 * PAPER_NOISE, color=INK, lw=0.9, ls=":")
        axes.plot([100 * PAPER_NOISE], [96], "D", ms=7, mfc="none", mew=1.6, color=colour(5),
                  label="paper, Table 1")  # fmt: skip
        axes.set_ylim(0, 102)
        axes.set_xlabel("largest noise / % of full scale")
        axes.set_ylabel("right / %")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return to_svg(figure, "curve", "accuracy of the level check over the noise")
