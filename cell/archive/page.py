"""Report page of an archive: its answers with figures, as one self-contained HTML file."""

import math
from collections.abc import Sequence
from datetime import date
from typing import TYPE_CHECKING, Any

from cell.archive.questions import LEAST_DAYS, SIGNALS, Answers, Trend
from cell.report.confusion import ConfusionTable, score
from cell.report.page import Page, colour, drawing, new_figure, picture
from recognition.recognizer import UNKNOWN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUESTIONS = {
    "drift": ("Which cell drifts", "No cell drifts by more than chance."),
    "ageing": ("Which pad ages", "No pad responds less than before by more than chance."),
    "friction": ("Whose friction grows", "No friction grows by more than chance."),
}
_OBJECT = (
    "object", "grasps", "days", "cells", "named rightly", "95 % interval", "grasps for each part",
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
    for need in answers.objects:
        named = ("-", "-", "-")
        if need.n_parts:
            interval = "{:.0%} to {:.0%}".format(*need.interval)
            named = (f"{need.n_right} of {need.n_parts}", interval, f"{need.grasps_per_part:.1f}")
        counts = (f"{n}" for n in (need.n_grasps, need.n_days, need.n_cells))
        objects.append((need.label, *counts, *named, "; ".join(need.reasons)))
    sections: dict[str, dict[str, Any]] = {
        "confusions": {
            "title": "Which object is confused with which, and since when",
            "lines": _confusion_lines(answers),
            "tables": [table.without_empty()] if table else [],
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
                and (some := [trend for trend in answers.trends if trend.signal == name])
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
    needs = [f"{need.label}: {'; '.join(need.reasons)}" for need in answers.objects if need.reasons]
    return texts + (
        [f"needs more grasps: {need}" for need in needs] or ["No object needs more grasps."]
    )


def confusion_table(answers: Answers) -> ConfusionTable | None:
    """Return the table of all identifications of named parts; None without identifications."""
    asked = [(label, answer, n) for (label, answer), n in answers.parts.items() if label and answer]
    if not asked:
        return None
    labels = sorted({name for row in asked for name in row[:2]} - {UNKNOWN})
    labels += [UNKNOWN] if any(truth == UNKNOWN for truth, *_ in asked) else []
    truths, given = zip(*(row[:2] for row in asked for _ in range(row[2])), strict=True)
    return score("All identifications of named parts", truths, given, labels)


def _trend_lines(answers: Answers, question: str) -> list[str]:
    """Return the trends that answer a question, and the cells with too few days for one."""
    judged = {trend.cell for trend in answers.trends if trend.question == question}
    few = ", ".join(cell for cell in answers.cells if cell not in judged)
    texts = []
    for trend in answers.counted(question):
        change, low, high = (_amount(v, trend.unit) for v in (trend.change, *trend.interval))
        span = f"from {trend.days[0]} to {trend.days[-1]}"
        texts.append(f"{trend.cell}: {trend.signal} {change} ({low} to {high}) {span}")
    if judged and not texts:
        texts = [_QUESTIONS[question][1]]
    days = f"fewer than {LEAST_DAYS} days of the same objects"
    missing = f"No answer about {question}: {days} in {few}."
    return texts + ([missing] if few else [])


def _amount(value: float, unit: str) -> str:
    percent = _in_page_unit(value, unit)
    return f"{percent:+.0f} %" if unit == "log" else f"{percent:+.2f} {unit}"


def _in_page_unit(value: float, unit: str) -> float:
    """Return a change in the unit of the page: log ratios in per cent."""
    return 100.0 * math.expm1(value) if unit == "log" else value


def _confusion_lines(answers: Answers) -> list[str]:
    if confusion_table(answers) is None:
        return ["No answer about confusions: no identification of a named part."]
    texts = []
    for pair in answers.confusions[:_MOST_CONFUSIONS]:
        cells = ", ".join(f"{k} in {cell}" for cell, k in pair.cells.items())
        days = f"{pair.first} to {pair.last}"
        texts.append(
            f"{pair.n} x {pair.label} as {pair.answer} (of {pair.n_parts}), {days}: {cells}"
        )
    return texts or ["No object was confused with another one."]


def trends_figure(trends: Sequence[Trend], cells: Sequence[str]) -> "Figure":
    """Draw the effects of the days of all cells, of one signal."""
    unit = trends[0].unit
    with drawing():
        figure = new_figure(6.4, 3.0)
        axes = figure.subplots()
        for trend in trends:
            days: Any = [date.fromisoformat(day) for day in trend.days]
            look: Any = {
                "color": colour(cells.index(trend.cell)),
                "lw": 2.0 if trend.counts else 0.9,
            }
            axes.plot(
                days, [_in_page_unit(v, unit) for v in trend.effect], marker="o", ms=2.6, **look
            )
        axes.set_ylabel("change / " + ("%" if unit == "log" else unit))
        axes.tick_params(axis="x", labelrotation=30)
    return figure
