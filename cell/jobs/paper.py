"""The paper's figures and table beside ours: all trials, one page, and the figures as JSON."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from cell.errors import CellError, ReportError
from cell.files import write_text
from cell.paper_claims import claims
from cell.paper_effort import Effort
from cell.paper_levels import CONDITIONS, Outcome
from cell.paper_study import PaperStudy, study
from cell.paper_view import page_view
from cell.report import page_template

PAGE = "paper.html"
FIGURES = "paper.json"


def reproduce_paper(
    folder: Path, *, effort: float = 1.0, seed: int = 2008, workers: int = 1
) -> tuple[PaperStudy, Path]:
    """Run all trials and write page and figures.

    Parameters
    ----------
    folder
        Where ``paper.html`` and ``paper.json`` go; made where it is missing.
    effort
        Part of the full number of trials; below 1 the figures only show that the page works.
    seed
        Of all that is random.
    workers
        Processes that share the trials.

    Returns
    -------
    study, page
        The figures, and where the page is.

    Raises
    ------
    CellError
        The folder cannot be made or written; ReportError, a kind of it, if jinja2 or matplotlib
        are missing; if scikit-learn is missing too.
    """
    template = page_template("paper.html.j2")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CellError(f"{folder} cannot be made: {error}; name another folder") from error
    start_s = time.monotonic()
    try:
        found = study(Effort(seed=seed).scaled(effort), workers=workers)
    except ValueError as error:
        raise CellError(f"the trials cannot be run: {error}") from error
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
        "claims": [
            {"where": c.where, "claim": c.claim, "found": c.found, "verdict": c.verdict}
            for c in claims(found)
        ],
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
