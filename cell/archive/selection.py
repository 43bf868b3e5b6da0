"""Selection: cells, days and objects of an archive or of other grasps."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path

from cell.errors import ConfigError, raised_as
from recognition.grasp import CELL_SOURCE, Grasp

NO_CELL = "unknown"
"""Cell of grasps that name no cell."""
HEAD = "_archive.json"
"""File of an archive that contains its format."""


def is_archive(place: str) -> bool:
    """Return whether a place is an archive: a folder with its head, or any URL."""
    return "://" in place or Path(place, HEAD).is_file()


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Selected grasps of an archive; an empty set means all."""

    cells: frozenset[str] = frozenset()
    """Names of cells."""
    first_day: str = ""
    last_day: str = "9999-12-31"
    """First and last day, for example 2027-01-15 (UTC)."""
    objects: frozenset[str] = frozenset()
    """Labels."""

    def fits(self, grasp: Grasp) -> bool:
        """Return whether a grasp of a file is selected."""
        return (
            (not self.objects or grasp.label in self.objects)
            and (not self.cells or cell_of(grasp) in self.cells)
            and self.first_day <= day_of(grasp.start_ms) <= self.last_day
        )


EVERYTHING = Selection()


def parse_selection(
    cells: Iterable[str] | None, days: str | None, objects: Iterable[str] | None
) -> Selection:
    """Return the selection of some cells, a day or FIRST..LAST, and objects; None means all.

    Raises ConfigError for days in another format or order.
    """
    first, dots, last = (".." if days is None else days).partition("..")
    ends = (first, last if dots else first)
    remedy = f"--days is {days!r}; write 2027-01-15, or 2027-01-01..2027-03-31"
    with raised_as(ConfigError, ValueError, where=remedy):
        first, last = (str(date.fromisoformat(day)) if day or not dots else "" for day in ends)
        if first > (last or EVERYTHING.last_day):
            raise ValueError("it begins after its end")
    return Selection(
        cells=frozenset(cells or ()),
        first_day=first,
        last_day=last or EVERYTHING.last_day,
        objects=frozenset(objects or ()),
    )


def cell_of(grasp: Grasp) -> str:
    """Return the cell that took a grasp; `NO_CELL` where its source names no cell."""
    return grasp.source.removeprefix(CELL_SOURCE) if _names_cell(grasp) else NO_CELL


def of_cell(grasp: Grasp, cell: str) -> Grasp:
    """Return a grasp that names a cell, the given one where it names no cell."""
    return grasp if _names_cell(grasp) or not cell else replace(grasp, source=CELL_SOURCE + cell)


def _names_cell(grasp: Grasp) -> bool:
    return grasp.source.startswith(CELL_SOURCE) and len(grasp.source) > len(CELL_SOURCE)


def day_of(start_ms: int) -> str:
    """Return the day of a time in ms since 1970, UTC; 1970-01-01 for one beyond all calendars."""
    try:
        return datetime.fromtimestamp(1e-3 * start_ms, UTC).date().isoformat()
    except (ValueError, OverflowError):
        return "1970-01-01"
