"""How this project is installed: which packages of an extra are missing, and the way to add it."""

import json
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

EXTRAS = {
    "report": ("jinja2", "matplotlib"),
    "mesh": ("trimesh",),
    "cluster": ("distributed",),
    "serve": ("fastapi", "uvicorn", "websockets"),
}
"""Extra -> the modules that it brings and that are loaded only where they are needed."""


def missing_packages(extra: str) -> tuple[str, ...]:
    """Return the modules of an extra that cannot be imported here; KeyError for another extra."""
    return tuple(name for name in EXTRAS[extra] if find_spec(name) is None)


def remedy(extra: str) -> str:
    """Return how to add an extra to this installation, as an order to a person.

    An installation from a folder is named by that folder (PEP 610, ``direct_url.json``). No package
    index is named: whether one has this project is not known here.
    """
    text = f"install this project with its extra `{extra}`"
    try:
        origin = json.loads(distribution("tactile-cell").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        origin = {}
    folder = Path(unquote(urlsplit(str(origin.get("url", ""))).path))
    if "dir_info" in origin and folder.is_dir():
        editable = "-e " if origin["dir_info"].get("editable") else ""
        return f"{text}: pip install {editable}'{folder}[{extra}]'"
    return text
