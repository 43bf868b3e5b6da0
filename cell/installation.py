"""Installation of this project: hidden packages, missing packages of an extra.

Modules of an extra are imported within `extra`, so that all errors are the same.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from cell.errors import MissingExtraError

EXTRAS = {
    "report": ("jinja2", "matplotlib"),
    "mesh": ("trimesh",),
    "serve": ("fastapi", "segno", "uvicorn", "websockets"),
}
"""Modules of each extra, which `doctor` or a note names before they are needed."""
_NEIGHBOURS = ("gripper", "tactile", "motion", "recognition", "simulator")
"""Packages that are installed beside `cell`, at the top level."""


def refuse_shadows() -> None:
    """Raise ImportError if another module hides a package of this project.

    They have plain names: a host's own ``gripper.py`` earlier on ``sys.path`` would be imported
    instead, and fail with "'gripper' is not a package".
    """
    home = Path(__file__).resolve().parents[1]
    for name in _NEIGHBOURS:
        spec = find_spec(name)
        origin = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if origin is not None and origin != home / name / "__init__.py":
            raise ImportError(
                f"{origin} hides the package {name!r} of tactile-cell in {home}: it comes first on "
                "sys.path; rename it, or start the program in another folder"
            )


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
    """Return instructions to add an extra to this installation."""
    return (
        f"install this project with its extra `{extra}`: pip install '.[{extra}]' in its checkout"
    )
