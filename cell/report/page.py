"""The page of a recording or of an archive: one HTML file without script, fonts or network.

A page has tiles, a legend and sections. A section is a title with the values of some blocks; the
template draws each block. It escapes all texts: markup in a label has no effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.errors import ReportError
from cell.files import write_atomically
from cell.installation import extra
from cell.report.figures import COLOURS, N_SHADES
from recognition.evaluation.evaluation import wilson_interval

DENSE_LABELS = 12
"""Most labels of a confusion table in normal size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """All values of a page."""

    title: str
    subtitle: str = ""
    tiles: Sequence[tuple[str, str, str]] = ()
    """The main results: value with unit, meaning, and basis in small print."""
    labels: Sequence[str] = ()
    """Objects or cells, in the order of their colours."""
    sections: Mapping[str, Mapping[str, Any]]
    """Sections by their keys: a `title`, a `lead` and blocks; one with empty blocks is left out."""


def write_report(path: Path | str, page: Page) -> None:
    """Write the page atomically: an older file stays until the new file is complete.

    Raises ReportError if it cannot be written or its name does not end with .html, and
    MissingExtraError without the extra ``report``.
    """
    if Path(path).suffix != ".html":
        raise ReportError(f"{path}: the name of a report must end with .html")
    data = render_report(page).encode("utf-8", errors="replace")
    write_atomically(Path(path), lambda file: file.write(data), error=ReportError, what="report")


def render_report(page: Page) -> str:
    """Return the page as HTML. Raises MissingExtraError without jinja2 or matplotlib."""
    sections = {
        key: section
        for key, section in page.sections.items()
        if any(block for name, block in section.items() if name not in ("title", "lead"))
    }
    place = {label: place for place, label in enumerate(page.labels)}
    with extra("report", needed_by="the report"):
        from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415
    environment = Environment(
        loader=PackageLoader("cell.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {
        "colours": COLOURS,
        "dense_labels": DENSE_LABELS,
        "n_shades": N_SHADES,
        "wilson": wilson_interval,
        "zip": zip,
    }
    environment.filters["percent"] = percent
    template = environment.get_template("report.html.j2")
    return template.render(page=page, sections=sections, place=place)


def percent(share: float) -> str:
    """Return a share in per cent; one of nearly 1 has digits, and is not rounded to 1."""
    if 0.99 < share < 1.0:
        return f"{100 * min(share, 0.9999):.2f} %"
    return f"{100 * share:.0f} %"
