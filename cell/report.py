"""The report: one HTML file that needs nothing else, no script, no font, no network."""

from pathlib import Path
from typing import TYPE_CHECKING

from cell.errors import ReportError
from cell.files import write_atomically
from cell.report_data import ReportData
from cell.report_view import page_view

if TYPE_CHECKING:
    from jinja2 import Template

__all__ = ["ReportData", "page_template", "render_report", "write_report"]


def write_report(path: Path | str, data: ReportData) -> None:
    """Write the page, whole or not at all.

    Parameters
    ----------
    path
        The HTML file; an older one stays until the new one is whole.
    data
        What the page shows.

    Raises
    ------
    ReportError
        If jinja2 or matplotlib are missing (extra ``report``), or the disk refuses.
    """
    page = render_report(data).encode("utf-8", errors="replace")
    write_atomically(Path(path), lambda file: file.write(page), error=ReportError, what="report")


def render_report(data: ReportData) -> str:
    """Return the page as HTML. Raises ReportError if jinja2 or matplotlib are missing."""
    return page_template("report.html.j2").render(page_view(data))


def page_template(name: str) -> "Template":
    """Return a template of this package's pages. Raises ReportError if jinja2 is missing."""
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415
    except ImportError as cause:
        raise ReportError("the report needs jinja2: pip install 'tactile-cell[report]'") from cause
    environment = Environment(
        loader=PackageLoader("cell"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
