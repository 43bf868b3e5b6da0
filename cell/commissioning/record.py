"""Record of a commissioning: a text with every step, finding, value and write, to sign and file."""

import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any

from cell.checks.findings import Notes, ProposedChange

RECORD_NAME = "commissioning.md"
"""File in the cell's folder."""
_LONGEST_LIST = 8
"""Longest list of the record; longer ones are in commissioning.json only."""


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
            lines += [f"- `{name}`: {_text(value)}" for name, value in one.settings.items()]
            lines += [f"- {name}: {value}" for name, value in _flat(one.values)]
        else:
            lines.append("not done\n")
        for write in (write for write in approved if write.step == key):
            change = f"{write.where}: {write.what}: {write.before} -> {write.after}"
            lines.append(f"- approved {write.at}: {change}; undo: {write.undo}")
    return "\n".join([*lines, "\nDate, name, signature:\n"])


def _flat(values: Mapping[str, Any], way: str = "") -> Iterator[tuple[str, str]]:
    """Yield the name and text of each value, those of nested mappings by a dotted name."""
    for name, value in values.items():
        place = f"{way}{name}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}.")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            yield from _flat({str(i): one for i, one in enumerate(value)}, f"{place}.")
        elif not (isinstance(value, list | tuple) and len(value) > _LONGEST_LIST):
            yield place, _text(value)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"[{', '.join(map(_text, value))}]" if isinstance(value, list | tuple) else str(value)
