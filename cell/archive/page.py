"""Report page of an archive: its answers with figures, as one self-contained HTML file."""

import math
from collections.abc import Sequence
from datetime import date
from typing import TYPE_CHECKING, Any

from cell.archive.questions import LEAST_DAYS, SIGNALS, Answers, Trend
from cell.report.confusion import ConfusionTable, score
from cell.report.figures import colour, drawing, new_figure, picture
from cell.report.page import Page
from recognition.recognizer import UNKNOWN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUESTIONS = {
    "drift": ("Which cell drifts", "No cell drifts by more than chance."),
    "ageing": ("Which pad ages", "No pad responds less than before by more than chance."),
    "friction": ("Whose friction grows", "No friction grows by more than chance."),
}
_OBJECT = (
    "object", "grasps", "days", "cells", "named rightly", "95 % interval", "grasps until sure",
    "needs more",
)  # fmt: skip
"""Columns of the table of objects."""
_MOST_CONFUSIONS = 20
"""Largest number of listed pairs."""


def archive_report(answers: Answers, target: str) -> Page:
    """Return the page. Raises MissingExtraError without the extra ``report``."""
    table = confusion_table(answers)
    days = sorted({day for some in answers.cells.values() for day in some})
    objects: list[tuple[str, ...]] = [_OBJECT]
    for one in answers.objects:
        named = ("-", "-", "-")
        if one.n_parts:
            interval = "{:.0%} to {:.0%}".format(*one.interval)
            named = (f"{one.n_right} of {one.n_parts}", interval, f"{one.grasps_per_part:.1f}")
        counts = (f"{n}" for n in (one.n_grasps, one.n_days, one.n_cells))
        objects.append((one.label, *counts, *named, "; ".join(one.reasons)))
    sections: dict[str, dict[str, Any]] = {
        "confusions": {
            "title": "Which object is confused with which, and since when",
            "lines": _confusion_lines(answers),
            "tables": [table.in_order(table.labels)] if table else [],
        }
    }
    for question, (title, _) in _QUESTIONS.items():
        sections[question] = {
            "title": title,
            "lead": "Change of each day beside the objects that were grasped on it. A change "
            "counts where its 95 % interval leaves 0 out.",
            "lines": _trend_lines(answers, question),
            "figures": {
                signal.title: picture(trends_figure(some, [*answers.cells]), signal.title)
                for name, signal in SIGNALS.items()
                if signal.question == question
                and (some := [one for one in answers.trends if one.signal == name])
            },
        }
    sections["objects"] = {"title": "Which object needs more grasps", "rows": objects}
    return Page(
        title="Archive of grasps",
        subtitle=f"{target} · {days[0]} to {days[-1]}",
        tiles=[
            (f"{answers.n_grasps:,}", "grasps", ""),
            (f"{len(answers.cells)}", "cells", ""),
            (f"{len(answers.objects)}", "objects", ""),
        ],
        labels=[*answers.cells],
        sections=sections,
    )


def lines(answers: Answers) -> list[str]:
    """Return the answers as lines of text."""
    texts = _confusion_lines(answers)
    for question in _QUESTIONS:
        texts += _trend_lines(answers, question)
    needs = [f"{one.label}: {'; '.join(one.reasons)}" for one in answers.objects if one.reasons]
    return texts + (
        [f"needs more grasps: {one}" for one in needs] or ["No object needs more grasps."]
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
    texts = [trend_text(one) for one in answers.counted(question)]
    if judged and not texts:
        texts = [_QUESTIONS[question][1]]
    days = f"fewer than {LEAST_DAYS} days of the same objects"
    missing = f"No answer about {question}: {days} in {few}."
    return texts + ([missing] if few else [])


def trend_text(trend: Trend) -> str:
    """Return a trend as a sentence."""
    low, high = (_amount(value, trend.unit) for value in trend.interval)
    return (
        f"{trend.cell}: {trend.signal} {_amount(trend.change, trend.unit)} ({low} to {high}) from "
        f"{trend.days[0]} to {trend.days[-1]}"
    )


def _amount(value: float, unit: str) -> str:
    percent = _in_page_unit(value, unit)
    return f"{percent:+.0f} %" if unit == "log" else f"{percent:+.2f} {unit}"


def _in_page_unit(value: float, unit: str) -> float:
    """Return a change as displayed: a change of a logarithm in per cent."""
    return 100.0 * math.expm1(value) if unit == "log" else value


def _confusion_lines(answers: Answers) -> list[str]:
    texts = []
    for one in answers.confusions[:_MOST_CONFUSIONS]:
        cells = ", ".join(f"{cell} {k}" for cell, k in one.cells.items())
        days = f"{one.first} to {one.last}"
        texts.append(f"{one.n} x {one.label} as {one.answer} (of {one.n_parts}), {days}: {cells}")
    return texts or ["No object was confused with another one."]


def trends_figure(trends: Sequence[Trend], cells: Sequence[str]) -> "Figure":
    """Draw the effects of the days of all cells, of one signal."""
    unit = trends[0].unit
    with drawing():
        figure = new_figure(6.4, 3.0)
        axes = figure.subplots()
        for one in trends:
            days: Any = [date.fromisoformat(day) for day in one.days]
            look: Any = {"color": colour(cells.index(one.cell)), "lw": 2.0 if one.counts else 0.9}
            axes.plot(
                days, [_in_page_unit(v, unit) for v in one.effect], marker="o", ms=2.6, **look
            )
        axes.set_ylabel("change / " + ("%" if unit == "log" else unit))
        axes.tick_params(axis="x", labelrotation=30)
    return figure
