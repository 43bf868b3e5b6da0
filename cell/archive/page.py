"""Report page of an archive: its answers with plots, as one self-contained HTML file."""

import math
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

from cell.archive.questions import LEAST_DAYS, SIGNALS, Answers, Signal, Trend
from cell.data.files import write_atomically
from cell.errors import ReportError
from cell.report.build import score
from cell.report.data import ConfusionTable
from cell.report.page import confusion_view, page_template
from cell.report.plots import N_COLOURS, colour, drawing, new_figure, to_svg
from recognition.recognizer import UNKNOWN

_QUESTIONS = {
    "drift": ("Which cell drifts", "No cell drifts by more than chance."),
    "ageing": ("Which pad ages", "No pad responds less than before by more than chance."),
    "friction": ("Whose friction grows", "No friction grows by more than chance."),
}
_MOST_CONFUSIONS = 20
"""Largest number of listed pairs."""


def write_page(path: Path, answers: Answers, target: str) -> None:
    """Write the page, whole or not at all.

    Raises ReportError if the disk refuses, and MissingExtraError without the extra ``report``.
    """
    page = page_template("archive.html.j2").render(_view(answers, target))
    data = page.encode("utf-8", errors="replace")
    write_atomically(path, lambda file: file.write(data), error=ReportError, what="report")


def lines(answers: Answers) -> list[str]:
    """Return the answers as lines of text."""
    found = [_confusion_line(one) for one in answers.confusions[:_MOST_CONFUSIONS]]
    found = found or ["no object was confused with another one"]
    for question in _QUESTIONS:
        found += _trend_lines(answers, question)
    needs = [f"{one.label}: {'; '.join(one.reasons)}" for one in answers.objects if one.reasons]
    return found + (
        [f"needs more grasps: {one}" for one in needs] or ["no object needs more grasps"]
    )


def confusion_table(answers: Answers) -> ConfusionTable | None:
    """Return the table of all identifications of named parts; None without identifications."""
    asked = [(label, answer, n) for (label, answer), n in answers.parts.items() if label and answer]
    if not asked:
        return None
    labels = sorted({name for one in asked for name in one[:2]} - {UNKNOWN})
    truths, given = zip(*(one[:2] for one in asked for _ in range(one[2])), strict=True)
    return score("All identifications of named parts", truths, given, labels)


def _trend_lines(answers: Answers, question: str) -> list[str]:
    """Return the trends that answer a question, and the cells with too few days for one."""
    judged = {one.cell for one in answers.trends if one.question == question}
    few = ", ".join(cell for cell in answers.cells if cell not in judged)
    found = [trend_text(one) for one in answers.found(question)]
    if judged and not found:
        found = [_QUESTIONS[question][1]]
    days = f"fewer than {LEAST_DAYS} days of the same objects"
    missing = f"No answer about {question}: {days} in {few}."
    return found + ([missing] if few else [])


def trend_text(trend: Trend) -> str:
    """Return a trend as a sentence."""
    low, high = (_amount(value, trend.unit) for value in trend.interval)
    since = f", since {trend.since}" if trend.since else ""
    return (
        f"{trend.cell}: {trend.signal} {_amount(trend.change, trend.unit)} ({low} to {high}) from "
        f"{trend.days[0]} to {trend.days[-1]}{since}"
    )


def _amount(value: float, unit: str) -> str:
    shown = _shown(value, unit)
    return f"{shown:+.0f} %" if unit == "log" else f"{shown:+.2f} {unit}"


def _shown(value: float, unit: str) -> float:
    """Return a change as displayed: a change of a logarithm in per cent."""
    return 100.0 * math.expm1(value) if unit == "log" else value


def _confusion_line(one: Any) -> str:
    cells = ", ".join(f"{cell} {k}" for cell, k in one.cells.items())
    since = f"more often since {one.since}" if one.since else f"{one.first} to {one.last}"
    return f"{one.n} x {one.label} as {one.answer} (of {one.n_parts}), {since}: {cells}"


def _view(answers: Answers, target: str) -> dict[str, Any]:
    table = confusion_table(answers)
    places = {label: i for i, label in enumerate(table.labels)} if table else {}
    days = sorted({day for those in answers.cells.values() for day in those})
    colours = {cell: i for i, cell in enumerate(answers.cells)}
    plots = [
        (signal.title, signal.question, _trends_figure(signal, trends, colours, name))
        for name, signal in SIGNALS.items()
        if (trends := [one for one in answers.trends if one.signal == name])
    ]
    return {
        "target": target,
        "n_grasps": f"{answers.n_grasps:,}",
        "n_cells": len(answers.cells),
        "n_objects": len(answers.objects),
        "days": f"{days[0]} to {days[-1]}" if days else "no day",
        "cells": [
            (cell, f"c{colours[cell] % N_COLOURS}", len(those))
            for cell, those in answers.cells.items()
        ],
        "confusion": confusion_view(table, places) if table else None,
        "confusions": [_confusion_line(one) for one in answers.confusions[:_MOST_CONFUSIONS]],
        "questions": [
            {
                "key": key,
                "title": title,
                "answers": _trend_lines(answers, key),
                "plots": [(name, plot) for name, question, plot in plots if question == key],
            }
            for key, (title, _) in _QUESTIONS.items()
        ],
        "objects": [
            {
                "label": one.label,
                "n_grasps": one.n_grasps,
                "n_days": one.n_days,
                "n_cells": one.n_cells,
                "right": f"{one.n_right} of {one.n_parts}" if one.n_parts else "-",
                "interval": "{:.0%} to {:.0%}".format(*one.interval) if one.n_parts else "-",
                "per_part": f"{one.grasps_per_part:.1f}" if one.n_parts else "-",
                "reasons": "; ".join(one.reasons),
            }
            for one in answers.objects
        ],
    }


def _trends_figure(
    signal: Signal, trends: Sequence[Trend], colours: dict[str, int], name: str
) -> str:
    """Draw the effects of the days of all cells."""
    with drawing():
        figure = new_figure(6.4, 3.0)
        axes = figure.subplots()
        for one in trends:
            days: Any = [date.fromisoformat(day) for day in one.days]
            look: Any = {"color": colour(colours[one.cell]), "lw": 2.0 if one.found else 0.9}
            axes.plot(days, [_shown(v, one.unit) for v in one.effect], marker="o", ms=2.6, **look)
        axes.set_ylabel("change / " + ("%" if signal.unit == "log" else signal.unit))
        axes.tick_params(axis="x", labelrotation=30)
        return to_svg(figure, name, f"{signal.title} by day and cell")
