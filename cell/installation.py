"""Installation of this project: missing packages of an extra, and how to add them.

Modules of an extra are imported within `extra`, so that all errors are the same.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

from cell.errors import MissingExtraError

EXTRAS = {
    "report": ("jinja2", "matplotlib"),
    "mesh": ("trimesh",),
    "serve": ("fastapi", "segno", "uvicorn", "websockets"),
}
"""Modules of each extra, which `doctor` or a note names before they are needed."""


@contextmanager
def extra(name: str, *, needed_by: str) -> Iterator[None]:
    """Raise MissingExtraError, with the user of the extra, if an import in the block fails."""
    try:
        yield
    except ImportError as error:
        package = (error.name or str(error)).partition(".")[0]
        raise MissingExtraError(f"{needed_by} needs {package}; {remedy(name)}") from error


def missing_note(extra: str, what: str) -> str:
    """Return the note that ``what`` is omitted without its extra; empty if nothing is missing."""
    missing = [name for name in EXTRAS[extra] if find_spec(name) is None]
    return f"no {what}: {' and '.join(missing)} missing; {remedy(extra)}" if missing else ""


def remedy(extra: str) -> str:
    """Return instructions to add an extra to this installation.

    pip gets the project from its origin (PEP 610, ``direct_url.json``): a folder, a file, a
    repository, or else the index.
    """
    text = f"install this project with its extra `{extra}`"
    try:
        origin = json.loads(distribution("tactile-cell").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        origin = {}
    url, option, what = str(origin.get("url", "")), "", f"tactile-cell[{extra}]"
    if "dir_info" in origin:
        folder = Path(unquote(urlsplit(url).path))
        if not folder.is_dir():
            return text
        option, what = "-e " if origin["dir_info"].get("editable") else "", f"{folder}[{extra}]"
    elif url:
        kind = origin.get("vcs_info", {}).get("vcs")
        what += f" @ {kind}+{url}" if kind else f" @ {url}"
    return f"{text}: pip install {option}'{what}'"
