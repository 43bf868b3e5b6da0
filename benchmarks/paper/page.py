"""From the study to what the template of the page about the paper prints."""

import json
import time
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.claims import claims, paper_share, share
from benchmarks.paper.contenders import LEVEL_CHECK
from benchmarks.paper.effort import Effort
from benchmarks.paper.figures import (
    accuracy_figure,
    condition_index,
    noise_figure,
    resistance_figure,
    trajectories_figure,
)
from benchmarks.paper.grasps import COMMON_N, FULL_N, OFFSET_M
from benchmarks.paper.level_trials import CONDITIONS, LABELS, READINGS, Outcome
from benchmarks.paper.study import PaperStudy, study
from cell.data.files import write_text
from cell.errors import CellError, ReportError
from cell.report.build import paper_table
from cell.report.data import ConfusionTable
from cell.report.page import confusion_view, page_template
from recognition.evaluation.metrics import wilson_interval
from recognition.recognizers import DEFAULT_TRAINER

UNNAMED = "no surface"
_READING = {READINGS[0]: "min |λ|", READINGS[1]: "algebraic minimum"}


def page_view(study: PaperStudy, seconds: float) -> dict[str, Any]:
    """Return all variables of the template; ``seconds`` is how long the trials took."""
    colours = {label: place for place, label in enumerate(LABELS)}
    found = claims(study)
    effort = study.effort
    common = study.tables[condition_index(force_n=COMMON_N, filtered=True)]
    own = study.tables[condition_index(force_n=None, filtered=True)]
    right, n = paper_share()
    best = max(
        (c for c in study.contenders if c.name == DEFAULT_TRAINER and not c.uses_aperture),
        key=lambda c: int(np.trace(c.counts)),
    )
    best_right, best_n = int(np.trace(best.counts)), int(best.counts.sum())
    best_low, best_high = wilson_interval(best_right, best_n)
    return {
        "created": datetime.now().strftime("%Y-%m-%d %H:%M"),
        "seconds": f"{seconds:.0f}",
        "tiles": [
            ("96 %", "paper, Table 1", f"{right} of {n}; 95 % interval "
             + " to ".join(f"{100 * x:.0f} %" for x in wilson_interval(right, n))),
            (f"{100 * common.n_right / common.n:.0f} %", f"its level check at {COMMON_N:g} N",
             f"any pose; {share(common)}, {common.n:,} trials"),
            (f"{100 * own.n_right / own.n:.0f} %", "at each grasp's own force",
             f"any pose; {share(own)}, {own.n:,} trials"),
            (f"{100 * best_right / best_n:.0f} %", f"{best.name}, touch alone",
             f"{100 * best_low:.1f} to {100 * best_high:.1f} %, {best_n:,} trials"),
            (f"{sum(c.verdict == 'holds' for c in found)} of {len(found)}", "claims hold as stated",
             f"{sum(c.verdict == 'in part' for c in found)} in part"),
        ],
        "claims": found,
        "classes": {"holds": "ok", "in part": "warn", "does not hold": "bad"},
        "legend": [(label, f"c{place}") for label, place in colours.items()],
        "figure_2": resistance_figure(study.indentation),
        "figure_3": trajectories_figure(study),
        "figure_4": noise_figure(study),
        "curve": accuracy_figure(study),
        "invariance": [
            {
                "name": part.name,
                "cells": [
                    (f"{part.ratio[reading].min():.3f} to {part.ratio[reading].max():.3f}",
                     part.overlaps[reading])
                    for reading in READINGS
                ],
            }
            for part in study.invariance
        ],
        "confusions": [confusion_view(table, colours) for table in _tables(study)],
        "contenders": _contenders(study),
        "effort": effort,
        "trials": effort.table_lessons * effort.table_tested,
        "curve_trials": effort.curve_lessons * effort.curve_tested,
        "other_trials": effort.other_lessons * effort.other_tested,
        "force": f"{FULL_N[0]:g} to {FULL_N[1]:g} N",
        "common": f"{COMMON_N:g} N",
        "offset": f"{1e3 * OFFSET_M:g} mm",
        "full_tables": effort.table_lessons * effort.table_tested >= 1000,
    }  # fmt: skip


def _tables(study: PaperStudy) -> list[ConfusionTable]:
    tables = [paper_table()]
    for place, outcome in study.tables.items():
        condition = CONDITIONS[place]
        if condition.filtered:
            at = (
                "(a) at each grasp's own full force"
                if condition.force_n is None
                else f"(b) at a common force of {condition.force_n:g} N"
            )
            tables.append(_table(f"{_READING[condition.reading]}, {at}", outcome))
    again = "min |λ|, the same touch again at full force, only the noise new"
    for name, outcome in (
        ("one frame", study.repeated[condition_index(force_n=None, filtered=False)]),
        ("filtered", study.repeated[condition_index(force_n=None, filtered=True)]),
        ("filtered, patch of all taxels above the noise", study.noise_patch[None]),
    ):
        tables.append(_table(f"{again}, {name}", outcome))
    return tables


def _table(name: str, outcome: Outcome) -> ConfusionTable:
    by_windows = outcome.windows_right / max(1, outcome.windows_named)
    return ConfusionTable(
        name=name,
        labels=LABELS,
        columns=(*LABELS, UNNAMED),
        counts=outcome.counts,
        caption=f"{outcome.counts.sum(axis=1).min():,} trials a row. With the windows kept, "
        f"{100 * outcome.windows_named / outcome.n:.0f} % are named, {100 * by_windows:.0f} % of "
        "those right.",
    )


def _contenders(study: PaperStudy) -> list[dict[str, Any]]:
    rows = []
    for one in study.contenders:
        n, right = int(one.counts.sum()), int(np.trace(one.counts))
        low, high = wilson_interval(right, n)
        kind = (
            "default" if one.name == DEFAULT_TRAINER
            else "the paper's" if one.name == LEVEL_CHECK
            else "reference"
        )  # fmt: skip
        rows.append(
            {
                "name": one.name,
                "kind": kind,
                "sees": "touch and opening" if one.uses_aperture else "touch alone",
                "right": f"{100 * right / n:.1f}",
                "low": f"{100 * low:.1f}",
                "high": f"{100 * high:.1f}",
                "span": f"{100 * (high - low):.1f}",
                "each": [f"{100 * one.counts[i, i] / one.counts[i].sum():.0f}"
                         for i in range(len(LABELS))],
                "rejected": f"{100 * one.rejected / n:.1f}",
                "order": (one.uses_aperture, -right),
            }
        )  # fmt: skip
    return sorted(rows, key=lambda row: row["order"])


# The paper's figures and table beside ours: all trials, one page, and the figures as JSON.

PAGE = "paper.html"
FIGURES = "paper.json"


def reproduce_paper(
    folder: Path, *, effort: float = 1.0, workers: int = 1
) -> tuple[PaperStudy, Path]:
    """Run all trials and write page and figures.

    Raises CellError where the folder cannot be made or written; ReportError, a kind of it, if
    jinja2 or matplotlib are missing.

    Parameters
    ----------
    folder
        Where ``paper.html`` and ``paper.json`` go; made where it is missing.
    effort
        Part of the full number of trials; below 1 the figures only show that the page works.
    workers
        Processes that share the trials.

    Returns
    -------
    study, page
        The figures, and where the page is.
    """
    template = page_template("paper.html.j2")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CellError(f"{folder} cannot be made: {error}; name another folder") from error
    start_s = time.monotonic()
    found = study(Effort().scaled(effort), workers=workers)
    seconds = time.monotonic() - start_s
    page = folder / PAGE
    write_text(page, template.render(page_view(found, seconds)), error=ReportError, what="page")
    write_text(
        folder / FIGURES,
        json.dumps(as_json(found, seconds), indent=1),
        error=ReportError,
        what="figures",
    )
    return found, page


def as_json(found: PaperStudy, seconds: float) -> dict[str, Any]:
    """Return the figures that the page and the docs quote."""
    return {
        "seconds": round(seconds, 1),
        "claims": [asdict(claim) for claim in claims(found)],
        "invariance": [
            {
                "varied": part.name,
                **{str(r): [float(v.min()), float(v.max())] for r, v in part.ratio.items()},
                "overlaps": {str(r): n for r, n in part.overlaps.items()},
            }
            for part in found.invariance
        ],
        "tables": {_name(place): _outcome(one) for place, one in found.tables.items()},
        "repeated": {_name(place): _outcome(one) for place, one in found.repeated.items()},
        "noise_patch": {
            "own force" if force_n is None else f"{force_n:g} N": _outcome(one)
            for force_n, one in found.noise_patch.items()
        },
        "curve": [
            {
                "noise_share": point.noise_share,
                **{
                    _name(place): {
                        "n": one.n,
                        "adjusted": one.n_right / one.n,
                        "fixed": point.fixed[place].n_right / point.fixed[place].n,
                    }
                    for place, one in point.adjusted.items()
                },
            }
            for point in found.curve
        ],
        "recognizers": [
            {
                "name": one.name,
                "uses_aperture": one.uses_aperture,
                "n": int(one.counts.sum()),
                "right": int(np.trace(one.counts)),
                "rejected": one.rejected,
                "confusion": one.counts.tolist(),
            }
            for one in found.contenders
        ],
    }


def _name(place: int) -> str:
    condition = CONDITIONS[place]
    at = "own force" if condition.force_n is None else f"{condition.force_n:g} N"
    return f"{condition.reading}, {at}, {'filtered' if condition.filtered else 'one frame'}"


def _outcome(one: Outcome) -> dict[str, Any]:
    return {
        "n": one.n,
        "right": one.n_right,
        "confusion": one.counts.tolist(),
        "windows_named": one.windows_named,
        "windows_right": one.windows_right,
    }
