"""Pictures of a grasp and of a confusion table as files of their own: PNG or SVG."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cell.data.files import write_atomically
from cell.errors import ReportError
from cell.installation import extra
from cell.report.data import ConfusionTable
from cell.report.plots import new_figure
from recognition.grasp import Grasp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = (".png", ".svg")
"""Endings of pictures."""
_SIDE_IN, _LEAST_IN = 0.35, 4.0
"""Size of a cell of a table, and of the smallest picture, in inches."""


def grasp_figure(grasp: Grasp, title: str) -> "Figure":
    """Return loads of the gripping pads, opening and force over time, and the pads at most load.

    Raises MissingExtraError without matplotlib.
    """
    with extra("report", needed_by="a picture"):
        figure = new_figure(8.0, 5.0)
    figure.suptitle(title.replace("$", r"\$"))
    (load, opening), maps = figure.subplots(2, 2)
    loads = np.array(
        [grasp.counts[:, grasp.pads.taxels_of(pad)].sum(axis=1) for pad in range(grasp.pads.n_pads)]
    )
    gripping = sorted(np.argsort(-np.ptp(loads, axis=1), kind="stable")[:2].tolist())
    largest = grasp.counts[int(loads[gripping].sum(axis=0).argmax())]
    for axes in maps:
        axes.set_axis_off()
    for pad, axes in zip(gripping, maps, strict=False):
        load.plot(grasp.t_s, loads[pad], label=f"pad {pad}")
        taxels = grasp.pads.taxels_of(pad)
        xy_mm = 1e3 * grasp.pads.taxel_xy_m[taxels]
        shown = axes.scatter(*xy_mm.T, c=largest[taxels], marker="s", vmin=0, vmax=largest.max())
        axes.set(aspect="equal", title=f"pad {pad}")
        figure.colorbar(shown, ax=axes, label="counts")
    load.set(xlabel="time / s", ylabel="sum of the counts")
    load.legend()
    opening.plot(grasp.t_s, 1e3 * grasp.aperture_m, color="C2")
    opening.set(xlabel="time / s", ylabel="opening / mm")
    if grasp.commanded:
        force = opening.twinx()
        force.plot(grasp.t_s, grasp.force_n, color="C3")
        force.set_ylabel("commanded force / N")
    return figure


def confusion_figure(table: ConfusionTable) -> "Figure":
    """Return a table of what was held (rows) against what was named, in per cent of the row."""
    rows, columns = len(table.labels), len(table.columns)
    with extra("report", needed_by="a picture"):
        figure = new_figure(
            max(_LEAST_IN, 2.0 + _SIDE_IN * columns), max(_LEAST_IN, 1.5 + _SIDE_IN * rows)
        )
    axes = figure.subplots()
    share = 100.0 * table.counts / np.maximum(table.counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=100)
    for row, column in zip(*np.nonzero(table.counts), strict=True):
        dark = "white" if share[row, column] > 50 else "black"
        axes.text(column, row, str(table.counts[row, column]), ha="center", va="center", color=dark)
    names = [[one.replace("$", r"\$") for one in some] for some in (table.columns, table.labels)]
    axes.set_xticks(range(columns), names[0], rotation=60, ha="right")
    axes.set_yticks(range(rows), names[1])
    axes.set(xlabel="named", ylabel="held", title=table.text)
    return figure


def write_picture(path: Path, figure: "Figure") -> None:
    """Write a picture. Raises ReportError for another ending, or where the disk refuses."""
    if path.suffix not in KINDS:
        raise ReportError(f"{path}: the name of a picture ends in {' or '.join(KINDS)}")
    write_atomically(
        path,
        lambda file: figure.savefig(file, format=path.suffix[1:], dpi=150),
        error=ReportError,
        what="picture",
    )
