"""History of a cell: parts and faults in one SQLite table per day, kept after the program's end.

A separate thread writes new rows each second, so a slow or full disk delays neither the force loop
nor a client. Days are those of the local wall clock, and at most `KEPT_DAYS` have a table.
"""

import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from cell.control.part import Part
from cell.data.files import free_name, name_in_file
from cell.data.formats import PROGRAM
from cell.errors import CellError
from cell.runtime.plugin import HostStatus
from cell.service.shift import Shift
from recognition.recognizer import UNKNOWN

VERSION = 1
"""Version of the tables, ``user_version`` of the file."""
KEPT_DAYS = 400
"""Most days with a table; the oldest are dropped."""
COLUMNS = {
    "time_s": "REAL NOT NULL",
    "kind": "TEXT NOT NULL",
    "label": "TEXT",
    "held": "TEXT",
    "probability": "REAL",
    "second": "TEXT",
    "second_probability": "REAL",
    "place": "TEXT",
    "rejected": "INTEGER",
    "n_grasps": "INTEGER",
    "seconds": "REAL",
    "fault_number": "INTEGER",
    "text": "TEXT",
}
"""Columns of each table and their types. ``kind`` is ``start``, ``part``, ``miss`` or ``fault``;
``held`` is the label of the brought object according to host, person or simulator, or empty."""
_NEAR = 0.1
"""Least probability of the second label at which an unconfirmed answer counts as near."""
_MOST_CONFUSED = 5
"""Most pairs of objects in the sums."""
_WAITING_MAX = 10_000
"""Most rows that wait for the disk; the oldest are dropped."""
_LOOK_S = 1.0
"""Time in s from one write to the next."""
_FRESH_S = 60.0
"""Time in s after which the sums are computed again: a new day may have begun."""
_SUM_SHARE = 0.02
"""Largest share of the time for the sums: those of a full week take tenths of a second."""
_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class History:
    """Parts and faults of a cell, for the page and other clients; every method from any thread.

    Parameters
    ----------
    path
        SQLite file; a damaged file is moved away. None keeps the history in memory.
    status
        Returns the state of the cell, with its faults.
    note
        Gets messages for the operator, for example that the file cannot be written.
    shift
        Gets the rows of earlier programs in the same shift.
    wall_s
        Unix time in s.
    """

    def __init__(
        self,
        path: Path | None,
        status: Callable[[], HostStatus],
        *,
        note: Callable[[str], None] = lambda _text: None,
        shift: Shift | None = None,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self._path, self._status, self._note, self._wall_s = path, status, note, wall_s
        self._shift, self._resumed = shift, False
        self._n_faults = 0
        self._waiting = deque[dict[str, Any]](maxlen=_WAITING_MAX)
        self._link: sqlite3.Connection | None = None
        self._refused = ""
        self._summed_s, self._sum_took_s, self._old = float("-inf"), 0.0, False
        self._values: dict[str, Any] = {}
        self._over, self._updating = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)
        self._add(kind="start")

    def start(self) -> None:
        """Write each second, in a separate thread, until `close`."""
        self._thread.start()

    def close(self, timeout_s: float = 2.0) -> None:
        """Write the waiting rows, and end; do not wait longer for a blocked disk."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def add(self, part: Part) -> None:
        """Add a part, or a turn without one; nothing is written yet."""
        if not part.label:
            self._add(kind="miss", held=part.presented)
            return
        second = part.runner_up or {"label": "", "probability": 0.0}
        names = ("label", "probability", "place", "rejected", "n_grasps", "seconds")
        self._add(
            kind="part",
            held=part.presented,
            second=second["label"],
            second_probability=second["probability"],
            **{name: getattr(part, name) for name in names},
        )

    def values(self) -> dict[str, Any]:
        """Return the sums of ``today``, ``yesterday`` and this ``week``, which begins on Monday.

        Each has ``parts``, ``rejected``, ``missed``, ``faults``, ``starts``, the mean ``cycle_s``,
        and ``confused``: pairs ``held`` and ``named`` with their number ``n``, the most frequent
        first. In a pair that is not ``confirmed`` the held object was not given: ``held`` is then
        the second label. The sums are empty until the first `update`.
        """
        return self._values

    def day(self, day: date) -> list[Mapping[str, Any]]:
        """Return the rows of a day as `read_day`; empty if the history is in memory."""
        return [] if self._path is None else read_day(self._path, day)

    def update(self) -> None:
        """Write the rows since the last call, and compute the sums; raises nothing."""
        with self._updating:
            self._update()

    def _update(self) -> None:
        if self._shift is not None:
            self._shift.values()  # a new shift begins in time, even without a client
        now = self._status()
        for n in range(now.n_faults - self._n_faults, 0, -1):
            newest = n == 1 and now.fault is not None
            number = now.fault_number if newest else 0
            self._add(kind="fault", fault_number=number, text=now.fault if newest else "")
        self._n_faults = now.n_faults
        try:
            self._resume_shift()
            self._old |= self._write()
            age_s = self._wall_s() - self._summed_s
            due = self._old and _SUM_SHARE * max(_LOOK_S, age_s) >= self._sum_took_s
            if due or not 0.0 <= age_s < _FRESH_S:
                self._sum()
            self._refused = ""
        except (sqlite3.Error, OSError, CellError) as error:
            if str(error) != self._refused:
                self._note(f"the history is not kept in {self._path}: {error}")
            self._refused = str(error)
            self._close_link()
            if getattr(error, "sqlite_errorcode", 0) in _DAMAGED:
                self._move_away()

    def _run(self) -> None:
        self.update()
        while not self._over.wait(_LOOK_S):
            self.update()
        self.update()
        self._close_link()

    def _add(self, **row: Any) -> None:
        self._waiting.append({"time_s": self._wall_s()} | row)

    def _resume_shift(self) -> None:
        """Give the shift its earlier rows once, before this program writes its first ones.

        A row counts by its own time, even if the clock was set since.
        """
        if self._shift is None or self._resumed:
            return
        begin, now = (date.fromtimestamp(s) for s in (self._shift.began_s, self._wall_s()))
        with self._opened() as link:
            rows = [row for day in sorted({begin, now}) for row in _rows(link, day)]
        self._shift.add_earlier(rows)
        self._resumed = True

    def _write(self) -> bool:
        """Write all waiting rows in one transaction; return whether there were any."""
        rows = list(self._waiting)
        if not rows:
            return False
        with self._opened() as link:
            for row in rows:
                table = _table(date.fromtimestamp(row["time_s"]))
                columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
                link.execute(f"CREATE TABLE IF NOT EXISTS {table} ({columns})")
                names, places = ", ".join(row), ", ".join("?" * len(row))
                link.execute(f"INSERT INTO {table} ({names}) VALUES ({places})", [*row.values()])
            for old in sorted(_tables(link))[:-KEPT_DAYS]:
                link.execute(f"DROP TABLE {old}")
        for _ in rows:
            self._waiting.popleft()
        return True

    def _sum(self) -> None:
        began_s = time.perf_counter()
        today = date.fromtimestamp(self._wall_s())
        week = [today - timedelta(days=n) for n in range(today.weekday() + 1)]
        with self._opened() as link:
            self._values = {
                "today": _sums(link, [today]),
                "yesterday": _sums(link, [today - timedelta(days=1)]),
                "week": _sums(link, week),
            }
        self._sum_took_s, self._old = time.perf_counter() - began_s, False
        self._summed_s = self._wall_s()

    def _opened(self) -> sqlite3.Connection:
        """Return the connection. Raises CellError if the tables are of another version."""
        if self._link is None:
            if self._path is not None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
            self._link = _connected(":memory:" if self._path is None else str(self._path))
            self._link.execute(f"PRAGMA user_version = {VERSION}")
        return self._link

    def _close_link(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with suppress(sqlite3.Error):
                link.close()

    def _move_away(self) -> None:
        assert self._path is not None
        with suppress(OSError):
            moved = self._path.rename(free_name(self._path))
            self._note(f"a new history begins; the damaged file is now {moved}")


def history_file(directory: Path, cell_name: str) -> Path:
    """Return the file of the history of a cell, beside the folders of its jobs."""
    return directory / f"history-{name_in_file(cell_name)}.sqlite3"


def read_day(path: Path, day: date) -> list[Mapping[str, Any]]:
    """Return the rows of a day, oldest first, with `COLUMNS`; empty if the day has no table.

    Raises CellError if the file cannot be read.
    """
    try:
        with closing(_connected(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as link:
            return _rows(link, day)
    except sqlite3.Error as error:
        raise CellError(f"cannot read the history {path}: {error}; check the path") from error


def _connected(name: str, *, uri: bool = False) -> sqlite3.Connection:
    link = sqlite3.connect(name, timeout=1.0, check_same_thread=False, uri=uri)
    try:
        (version,) = link.execute("PRAGMA user_version").fetchone()
        if version not in (0, VERSION):  # 0: a new file
            raise CellError(
                f"{name} has tables of version {version}, but {PROGRAM} reads version {VERSION}; "
                "move it away, or use the tactile-cell that wrote it"
            )
    except BaseException:
        link.close()
        raise
    return link


def _table(day: date) -> str:
    return f"day_{day:%Y%m%d}"


def _tables(link: sqlite3.Connection) -> set[str]:
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND name GLOB 'day_*'"
    return {name for (name,) in link.execute(query)}


def _rows(link: sqlite3.Connection, day: date) -> list[Mapping[str, Any]]:
    if _table(day) not in _tables(link):
        return []
    rows = link.execute(f"SELECT * FROM {_table(day)} ORDER BY rowid").fetchall()
    return [dict(zip(COLUMNS, row, strict=True)) for row in rows]


def _sums(link: sqlite3.Connection, days: list[date]) -> dict[str, Any]:
    """Return the sums of some days, in the form of `History.values`."""
    tables = [_table(day) for day in days if _table(day) in _tables(link)]
    all_rows = " UNION ALL ".join(f"SELECT * FROM {table}" for table in tables)
    counts: dict[str, Any] = dict.fromkeys(("parts", "rejected", "missed", "faults", "starts"), 0)
    if not tables:
        return counts | {"cycle_s": None, "confused": []}
    query = f"SELECT kind, COUNT(*), SUM(rejected), AVG(seconds) FROM ({all_rows}) GROUP BY kind"
    by_kind = {kind: found for kind, *found in link.execute(query)}
    for name, kind in zip(counts, ("part", "", "miss", "fault", "start"), strict=True):
        counts[name] = by_kind.get(kind, [0])[0]
    _, rejected, cycle_s = by_kind.get("part", (0, 0, None))
    pairs = f"""
        SELECT held, label, COUNT(*) AS n, 1 FROM ({all_rows}) WHERE kind = 'part'
        AND held <> '' AND held <> label AND label <> '{UNKNOWN}' GROUP BY held, label
        UNION ALL SELECT second, label, COUNT(*) AS n, 0 FROM ({all_rows}) WHERE kind = 'part'
        AND held = '' AND second_probability >= {_NEAR} AND label <> '{UNKNOWN}'
        GROUP BY second, label ORDER BY n DESC, held, label LIMIT {_MOST_CONFUSED}"""
    confused = [
        {"held": held, "named": label, "n": n, "confirmed": bool(known)}
        for held, label, n, known in link.execute(pairs)
    ]
    return counts | {"rejected": rejected or 0, "cycle_s": cycle_s, "confused": confused}
