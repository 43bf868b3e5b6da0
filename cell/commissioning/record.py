"""Record of a commissioning: a text with every step, finding, value and write, to sign and file."""

import json
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from cell.checks.findings import Notes, ProposedChange

RECORD_NAME = "commissioning.md"
"""File in the cell's folder."""
_LONGEST = 100
"""Characters of a value above which it is in commissioning.json only."""


def record_text(
    cell: str,
    titles: Mapping[str, str],
    notes: Mapping[str, Notes],
    approved: Sequence[ProposedChange],
) -> str:
    """Return the record as Markdown.

    Parameters
    ----------
    cell
        Name of the cell.
    titles, notes
        Title of each step, and the notes of the steps so far, by their keys.
    approved
        Approved writes and motions.
    """
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    corrected = [line for one in notes.values() for line in one.corrected] or ["none"]
    lines = [
        f"# Commissioning of {cell}\n",
        f"tactile-cell {version('tactile-cell')} on {platform.node()}, {system}\n",
        "## Errors found and corrected\n",
        *(f"- {line}" for line in corrected),
    ]
    for key, title in titles.items():
        lines.append(f"\n## {title}\n")
        if one := notes.get(key):
            lines.append(f"{one.status}, {one.began} to {one.ended}\n")
            lines += [f"- {line}" for line in one.lines]
            lines += [f"- `{name}`: {_json(value)}" for name, value in one.settings.items()]
            texts = {name: _json(value) for name, value in one.values.items()}
            lines += [f"- {name}: {text}" for name, text in texts.items() if len(text) < _LONGEST]
        else:
            lines.append("not done\n")
        for write in (write for write in approved if write.step == key):
            change = f"{write.where}: {write.what}: {write.before} -> {write.after}"
            lines.append(f"- approved {write.at}: {change}; undo: {write.undo}")
    return "\n".join([*lines, "\nDate, name, signature:\n"])


def _json(value: Any) -> str:
    return json.dumps(value, default=list)
