"""The report page: one HTML file without script, fonts or network.

`write_report` makes it from `ReportData`; the views are the variables of the templates.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cell.data.files import write_atomically
from cell.errors import ReportError
from cell.installation import extra
from cell.learning.shape_reading import in_words
from cell.report.data import Answered, ConfusionTable, ReportData, ShownGrasp
from cell.report.pad_pictures import level_pictures, pressure_levels
from cell.report.plots import N_COLOURS, levels_figure, sweep_figure, timeline_figure
from cell.report.shapes import shapes_view
from recognition.evaluation.metrics import wilson_interval
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import fuse
from tactile.layout import TaxelLayout

if TYPE_CHECKING:
    from jinja2 import Template


MAX_SEQUENCES = 80
"""Most identifications on a page; the page counts the others."""
_SEQUENCES_PER_OBJECT = 2
"""Most identifications of each object on a page."""
_LEAST_SHARE = 0.002
"""Smallest probability in a bar."""

DENSE_LABELS = 12
"""Most labels of a confusion table in normal size."""


def write_report(path: Path | str, data: ReportData) -> None:
    """Write the page atomically: an older file stays until the new file is complete.

    Raises ReportError if it cannot be written, and MissingExtraError without the extra ``report``.
    """
    page = render_report(data).encode("utf-8", errors="replace")
    write_atomically(Path(path), lambda file: file.write(page), error=ReportError, what="report")


def render_report(data: ReportData) -> str:
    """Return the page as HTML. Raises MissingExtraError without jinja2 or matplotlib."""
    return page_template("report.html.j2").render(page_view(data))


def page_template(name: str) -> "Template":
    """Return a template of this package's pages. Raises MissingExtraError without jinja2."""
    with extra("report", needed_by="the report"):
        from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415
    environment = Environment(
        loader=PackageLoader("cell.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def label_order(data: ReportData) -> tuple[str, ...]:
    """Return all taught labels, each once; their order gives the colours on the page."""
    tables = [table.labels for table in data.confusions]
    answers = [found.fused.labels for found in data.sequences]
    drawn = [one.label for one in data.trajectories.objects] if data.trajectories else []
    return tuple(dict.fromkeys(label for labels in (*tables, *answers, drawn) for label in labels))


def example_view(layout: TaxelLayout, shown: ShownGrasp, name: str) -> dict[str, Any]:
    """Return the heat maps of a grasp, all on one scale, and its time-line."""
    levels = pressure_levels(shown.grasp)
    full = max([1.0, *(float(counts.max()) for counts in levels.values())])
    pictures = [level_pictures(layout, *level, full) for level in levels.items()]
    return {
        "label": shown.label,
        "note": shown.note,
        "levels": pictures,
        "last": pictures[-1],
        "full": f"{full:.0f}",
        "adc_max": layout.adc_max,
        "timeline": timeline_figure(shown.cycles, name),
    }


def trajectories_view(data: ReportData, colours: Mapping[str, int]) -> dict[str, Any] | None:
    """Return the plots of the paper's eigenvalues and a table of its windows."""
    shown = data.trajectories
    if shown is None:
        return None
    return {
        "sweep": (
            sweep_figure(shown, colours, "sweep")
            if any(len(o.sweep) for o in shown.objects)
            else ""
        ),
        "levels": levels_figure(shown, colours, "levels"),
        "windows": shown.windows,
    }


def drawn_sequences(data: ReportData) -> list[Answered]:
    """Return some identifications of each object: first the wrong ones, then the longest.

    They are the most useful ones for a reader; the tables count all.
    """
    drawn = []
    for name in dict.fromkeys(one.name for one in data.sequences):
        found = [one for one in data.sequences if one.name == name]
        found.sort(key=lambda one: (one.label == one.presented, -one.n_grasps))
        drawn += found[:_SEQUENCES_PER_OBJECT]
    return drawn[:MAX_SEQUENCES]


def sequence_view(found: Answered, colours: Mapping[str, int]) -> dict[str, Any]:
    """Return the bars of one identification.

    Its probability is the share of the answer in the last thick bar; all shares sum to one.
    """
    steps = [
        {
            "number": number,
            "note": note,
            "fused": _bars(fuse(found.posteriors[:number]), colours),
            "single": _bars(posterior, colours),
        }
        for number, (posterior, note) in enumerate(
            zip(found.posteriors, (*found.notes, *[""] * found.n_grasps), strict=False), start=1
        )
    ] or [{"number": found.n_grasps, "note": "", "fused": _bars(found.fused, colours)}]
    unknown = found.label == UNKNOWN
    shares = dict(zip(found.fused.labels, found.fused.probability.tolist(), strict=True))
    share = found.fused.unknown if unknown else (1.0 - found.fused.unknown) * shares[found.label]
    shape = "" if found.shape is None else in_words(found.shape) if unknown else str(found.shape)
    return {
        "truth": found.presented,
        "answer": found.label,
        "probability": _percent(share),
        "verdict": "right"
        if found.label == found.presented
        else "unknown"
        if unknown
        else "wrong"
        if found.presented
        else "named",
        "place": found.place,
        "shape": shape,
        "steps": steps,
    }


def _bars(posterior: Posterior, colours: Mapping[str, int]) -> list[dict[str, str]]:
    known = 1.0 - posterior.unknown
    shares = [
        (label, f"c{colours[label] % N_COLOURS}", known * p)
        for label, p in zip(posterior.labels, posterior.probability.tolist(), strict=True)
    ]
    return [
        {"label": label, "colour": colour, "share": f"{100 * share:.2f}", "text": _percent(share)}
        for label, colour, share in (*shares, (UNKNOWN, "unknown", posterior.unknown))
        if share >= _LEAST_SHARE
    ]


def _percent(share: float) -> str:
    if 0.99 < share < 1.0:
        return f"{100 * min(share, 0.9999):.2f} %"
    return f"{100 * share:.0f} %"


def confusion_view(table: ConfusionTable, colours: Mapping[str, int]) -> dict[str, Any]:
    """Return one table: per cent and counts of each cell, Wilson intervals of each row.

    All tables of a page have rows and columns in the same order.
    """
    rows = []
    last = len(colours)
    columns = sorted(
        (
            (place, column)
            for place, column in enumerate(table.columns)
            if column in table.labels or table.counts[:, place].any()
        ),
        key=lambda item: colours.get(item[1], last),
    )
    ordered = sorted(zip(table.labels, table.counts, strict=True), key=lambda row: colours[row[0]])
    for label, counts in ordered:
        total = int(counts.sum())
        right = int(counts[table.columns.index(label)]) if label in table.columns else 0
        rows.append(
            {
                "label": label,
                "total": total,
                "cells": [
                    {
                        "count": int(counts[place]),
                        "percent": f"{100 * counts[place] / max(1, total):.0f}",
                        "share": f"{counts[place] / max(1, total):.3f}",
                        "kind": "hit"
                        if column == label
                        else "open"
                        if column == UNKNOWN
                        else "miss",
                    }
                    for place, column in columns
                ],
                **_interval(right, total),
            }
        )
    return {
        "name": table.name,
        "caption": table.caption,
        "columns": [column for _, column in columns],
        "rows": rows,
        "n": table.n,
        "n_right": table.n_right,
        "dense": len(table.labels) > DENSE_LABELS,
        **_interval(table.n_right, table.n),
    }


def _interval(right: int, n: int) -> dict[str, str]:
    low, high = wilson_interval(right, n)
    return {
        "right": f"{100 * right / n:.1f}" if n else "-",
        "low": f"{100 * low:.1f}",
        "high": f"{100 * high:.1f}",
        "span": f"{100 * (high - low):.1f}",
    }


def page_view(data: ReportData) -> dict[str, Any]:
    """Return all variables of the template."""
    order = label_order(data)
    colours = {label: place for place, label in enumerate(order)}
    shown = drawn_sequences(data)
    rows = [(one.presented, one.label, one.shape) for one in data.sequences]
    shapes = shapes_view(rows, data.true_sizes)
    sections = {
        "result": "Confusion" if data.confusions else "",
        "shapes": "Shape and size" if shapes is not None else "",
        "sequences": "Identifications" if shown else "",
        "examples": "Grasps" if data.examples else "",
        "trajectories": "The paper's method" if data.trajectories is not None else "",
        "health": "Links",
        "cell": "Cell and files",
    }
    return {
        "data": data,
        "sections": [(key, name) for key, name in sections.items() if name],
        "legend": [(label, f"c{place % N_COLOURS}") for label, place in colours.items()],
        "examples": [
            example_view(data.layout, one, f"t{number}") for number, one in enumerate(data.examples)
        ],
        "trajectories": trajectories_view(data, colours),
        "sequences": [sequence_view(one, colours) for one in shown],
        "shapes": shapes,
        "n_hidden": len(data.sequences) - len(shown),
        "confusions": [confusion_view(table, colours) for table in data.confusions],
    }
