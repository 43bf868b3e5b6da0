"""The reference of the command line, made from the commands themselves."""

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from typer.main import get_command

from cell.interfaces.cli.app import app

_SHARED_BY = 4
"""Commands from which on an option with one text stands in the table of shared options."""


class _Command(NamedTuple):
    name: str
    help: str
    rows: list[tuple[str, str]]


def command_page() -> str:
    """Return the options that commands share, and a section for each command."""
    commands = _all_commands()
    often = Counter(row for one in commands for row in one.rows)
    shared = [row for row, n in often.items() if n >= _SHARED_BY]
    lines = ["## Shared options\n", *_table(shared)]
    for one in commands:
        lines += [f"## {one.name}\n", f"{one.help}\n"]
        lines += _table([row for row in one.rows if row not in shared])
        if also := [row[0].split(" ")[0].strip("`,") for row in one.rows if row in shared]:
            lines.append(f"Shared: {', '.join(f'`{name}`' for name in also)}.\n")
    return "\n".join(lines)


def overview_page() -> str:
    """Return one line for each command."""
    rows = [(f"`{one.name}`", one.help.partition("\n\n")[0]) for one in _all_commands()]
    return "\n".join(_table(rows))


def _all_commands() -> list[_Command]:
    return list(_commands(get_command(app), "tactile-cell", None))


def _commands(command: Any, name: str, parent: Any) -> Iterator[_Command]:
    command = getattr(command, "load", lambda: command)()
    context = command.context_class(command, info_name=name.rsplit(" ", 1)[-1], parent=parent)
    subcommands: dict[str, Any] = getattr(command, "commands", {})
    for key, child in subcommands.items():
        yield from _commands(child, f"{name} {key}", context)
    if not subcommands:
        records = [parameter.get_help_record(context) for parameter in command.params]
        yield _Command(name, command.help, [_row(*record) for record in records if record])


def _row(written: str, meaning: str) -> tuple[str, str]:
    meaning = re.sub(r"(?<!\w)--?[a-z][a-z-]*", r"`\g<0>`", meaning)
    return f"`{_cell(written)}`", _cell(meaning)


def _table(rows: list[tuple[str, str]]) -> list[str]:
    lines = [f"| {written} | {meaning} |" for written, meaning in rows]
    return ["| | |\n| --- | --- |", *lines, ""] if lines else []


def _cell(text: str) -> str:
    return text.replace("|", r"\|")
