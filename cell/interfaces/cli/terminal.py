"""The terminal: results on standard output, progress, notes and errors on standard error."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TextIO, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from cell.errors import CellError, raised_as
from cell.files import json_bytes


class _LossyStream:
    """A stream whose other end may be gone; text that cannot be written is dropped."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _LossyConsole(Console):
    """Console for texts that no job needs: a closed or full terminal raises no error."""

    @property
    def file(self) -> IO[str]:
        """Standard error, which may be gone."""
        return cast("IO[str]", _LossyStream(super().file))

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file


out = Console(highlight=False)
"""Results."""
err = _LossyConsole(stderr=True, highlight=False)
"""Progress, notes and errors."""


def _escaped(text: str) -> str:
    """Return a text with escaped control characters."""
    return "".join(
        sign if sign.isprintable() or sign in "\n\t" else repr(sign)[1:-1] for sign in text
    )


def plain_text(text: str) -> str:
    """Return any text so that terminal and `rich` show it, without control codes and markup."""
    return escape(_escaped(text))


def print_line(text: str) -> None:
    """Print one line of result; square brackets are plain text."""
    out.print(plain_text(text), soft_wrap=True)


def print_table(table: Table) -> None:
    """Print a table; without a terminal, or on a narrow one, each row is one plain line.

    The name of the first column is above these lines. A line names the column before each value
    and omits values that are empty or 0.
    """
    if (
        out.is_terminal
        and out.measure(table, options=out.options.update(width=10_000)).maximum <= out.width
    ):
        out.print(table)
        return
    names = [Text.from_markup(str(column.header)).plain for column in table.columns]
    print_line(f"{names[0]}:")
    for row in zip(*(column.cells for column in table.columns), strict=True):
        first, *values = (Text.from_markup(str(cell)).plain for cell in row)
        named = zip(names[1:], values, strict=True)
        texts = [f"{name} {value}" for name, value in named if value not in ("", "0")]
        print_line(f"  {first}: {', '.join(texts)}")


def print_error(text: str, *, fault: int = 0) -> None:
    """Print one error on standard error, with its number in the fault catalogue; 0: none."""
    head = f"error (fault {fault}):" if fault else "error:"
    err.print(f"[bold red]{head}[/] {plain_text(text)}", soft_wrap=True)


def print_cell(text: str) -> None:
    """Print the cell of a command on standard error: other programs read standard output."""
    err.print(f"cell: {plain_text(text)}", soft_wrap=True)


def print_page(address: str) -> None:
    """Print the address of the page on standard error."""
    err.print(f"[bold]page:[/] {plain_text(address)}", soft_wrap=True)


def print_view(address: str, note: str) -> None:
    """Print the view-only address of the page on standard error.

    A terminal also shows its QR code if other machines reach it; else ``note`` gives the reason.
    """
    err.print(f"[bold]view only:[/] {plain_text(address)}", soft_wrap=True)
    if note:
        err.print(f"  {plain_text(note)}", soft_wrap=True)
    elif err.is_terminal:
        from cell.interfaces.opening import qr_code  # noqa: PLC0415

        qr_code(address).terminal(cast("TextIO", err.file), compact=True)


def print_note(text: str) -> None:
    """Print one note for the operator on standard error."""
    err.print(f"[bold yellow]NOTE:[/] {plain_text(text)}", soft_wrap=True)


def ask(text: str) -> str:
    """Ask at the terminal and return the typed line. Raises EOFError at the end of input.

    A pipe is read without Python's buffer: Python aborts if it ends while a thread waits in the
    buffer.
    """
    text = _escaped(text)
    stdin = sys.__stdin__
    if stdin is None or sys.stdin is not stdin or stdin.isatty():
        return input(text)
    typer.echo(text, nl=False)
    line = bytearray()
    while not line.endswith(b"\n"):
        read = os.read(stdin.fileno(), 1)
        if not read:
            raise EOFError
        line += read
    return line.decode(errors="replace").rstrip("\r\n")


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Draw a bar on standard error for each task of a job; see `cell.learning.parallel`.

    Without a terminal it prints a line at the end of each task.
    """
    if not err.is_terminal:

        def note(task: str, done: int, total: int) -> None:
            if done == total:
                err.print(plain_text(f"{task} {done}/{total}"), soft_wrap=True)

        yield note
        return
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=err) as bars:

        def show(task: str, done: int, total: int) -> None:
            if task not in tasks:
                tasks[task] = bars.add_task(plain_text(task), total=total)
            bars.update(tasks[task], completed=done, total=total)

        yield show


def show(lines: Iterable[str | Table], data: Any = None, path: Path | None = None) -> None:
    """Print a result, lines and tables, and write it as JSON; as `write_json`."""
    for line in lines:
        print_line(line) if isinstance(line, str) else print_table(line)
    write_json(path, data)


def write_json(path: Path | None, data: Any) -> None:
    """Write a result as JSON, null for NaN; without a path nothing.

    Raises CellError if the file cannot be written.
    """
    if path is None:
        return
    with raised_as(CellError, OSError, where=f"{path}: cannot be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(json_bytes(data) + b"\n")


def percent(share: float, interval: tuple[float, float] | None = None) -> str:
    """Return a share in per cent, with its 95 % interval if one is given."""
    text = f"{100 * share:.1f} %"
    if interval is not None:
        text += f" ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"
    return text
