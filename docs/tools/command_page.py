"""The reference of the command line, made from the commands themselves."""

import re
from typing import Any

from typer.main import get_command

from cell.interfaces.cli.app import app


def command_page() -> str:
    """Return a section for each command: usage, help, arguments and options."""
    command: Any = get_command(app)
    return "\n".join(_sections(command, "tactile-cell", None))


def _sections(command: Any, name: str, parent: Any) -> list[str]:
    command = getattr(command, "load", lambda: command)()
    context = command.context_class(command, info_name=name.rsplit(" ", 1)[-1], parent=parent)
    subcommands: dict[str, Any] = getattr(command, "commands", {})
    if subcommands:
        lines = [command.help, ""] if parent else []
        return lines + [
            line
            for key, child in subcommands.items()
            for line in _sections(child, f"{name} {key}", context)
        ]
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    lines = [
        f"## {name}",
        "",
        command.help,
        "",
        "```sh",
        usage,
        "```",
        "",
        "| | |",
        "| --- | --- |",
    ]
    for parameter in command.params:
        written, meaning = parameter.get_help_record(context)
        meaning = re.sub(r"(?<!\w)--?[a-z][a-z-]*", r"`\g<0>`", meaning)
        lines.append(f"| `{_cell(written)}` | {_cell(meaning)} |")
    return [*lines, ""]


def _cell(text: str) -> str:
    return text.replace("|", r"\|")
