"""How the command line speaks: progress, tables, errors, JSON files."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from cell.errors import CellError
from recognition.recognizer import UNKNOWN


class _Unheard:
    """A stream that nobody may listen to any more: what it does not take is lost."""

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


class _Aside(Console):
    """A console for what no job depends on: it goes on when the terminal is gone, or full."""

    @property
    def file(self) -> IO[str]:
        """Standard error, whether or not it takes anything."""
        return cast("IO[str]", _Unheard(super().file))

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file


out = Console(highlight=False)
"""Results."""
err = _Aside(stderr=True, highlight=False)
"""Progress and complaints."""


def say(text: str) -> None:
    """Print one line of result; square brackets stand for themselves."""
    out.print(escape(text), soft_wrap=True)


def complain(text: str) -> None:
    """Print one error."""
    err.print(f"[bold red]error:[/] {escape(text)}", soft_wrap=True)


def give_up_output() -> None:
    """Let nothing more be written to standard output or standard error where they take nothing.

    Else the interpreter would try again at its end, and complain in its own words.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        try:
            # A program that was started without them has none.
            if stream is not None:
                stream.flush()
        except OSError:
            os.dup2(nowhere, number)
    os.close(nowhere)


def warn(text: str) -> None:
    """Print one note that the operator should not miss."""
    err.print(f"[bold yellow]NOTE:[/] {escape(text)}", soft_wrap=True)


@contextmanager
def progress_bar() -> Iterator["ProgressBar"]:
    """Draw a bar on standard error for each task that a job names."""
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err) as bars:
        yield ProgressBar(bars)


class ProgressBar:
    """Implements `cell.jobs.progress.Progress` with bars."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._tasks: dict[str, Any] = {}

    def __call__(self, task: str, done: int, total: int) -> None:
        """Draw the bar of one task."""
        if task not in self._tasks:
            self._tasks[task] = self._bars.add_task(escape(task), total=total)
        self._bars.update(self._tasks[task], completed=done, total=total)


def confusion_table(labels: Sequence[str], confusion: Sequence[Sequence[float]]) -> Table:
    """Return a confusion table: rows are what was held, columns the answers."""
    columns = [*labels, UNKNOWN] if len(confusion[0]) > len(labels) else list(labels)
    table = Table(header_style="bold")
    table.add_column("held")
    for column in columns:
        table.add_column(escape(column), justify="right")
    for row, (label, counts) in enumerate(zip(labels, confusion, strict=True)):
        table.add_row(
            escape(label),
            *(
                f"[bold green]{value:g}[/]"
                if place == row
                else f"[red]{value:g}[/]"
                if value
                else "[dim]0[/]"
                for place, value in enumerate(counts)
            ),
        )
    return table


def write_json(path: Path | None, data: dict[str, Any]) -> None:
    """Write what was printed as data. Raises CellError if the file cannot be written."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise CellError(f"{path}: cannot be written: {error}") from error


def percent(share: float, interval: tuple[float, float] | None = None) -> str:
    """Write a share as per cent, with its interval."""
    text = f"{100 * share:.1f} %"
    if interval is not None:
        text += f" ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"
    return text
