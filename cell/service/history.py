"""History of a cell: parts and faults of a shift, and their table that outlives the program.

The table is in SQLite. A separate thread writes new rows each second, so a slow or full disk delays
neither the force loop nor a client. Days are those of the local wall clock, and at most `MOST_DAYS`
are kept.
"""

import sqlite3
import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any

from cell.control.identification import Identification
from cell.control.part import Part
from cell.errors import CellError, RequestRefused
from cell.files import PROGRAM, name_in_file
from cell.runtime.plugin import HostStatus
from recognition.recognizer import UNKNOWN

MOST_ANSWERS = 20
"""Number of newest answers that are kept, each with its last grasp."""
_MOST_CYCLES = 1000
"""Number of newest parts whose cycle times are kept."""
_HOUR_S = 3600.0
"""Time in s before now in which recent parts are counted."""


class Shift:
    """Counts the parts that a cell has identified and sorted; every method from any thread.

    Parameters
    ----------
    begins_h
        Hours of the local day at which a shift begins.
    n_faults
        Returns the faults since the program began.
    wall_clock
        Returns the unix time in s.
    """

    def __init__(
        self,
        begins_h: Sequence[float] = (0.0,),
        n_faults: Callable[[], int] = lambda: 0,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._begins_h, self._n_faults, self._now_s = begins_h, n_faults, wall_clock
        self._lock = threading.Lock()
        self._started_s = wall_clock()
        self._times_s = deque[float]()
        self.parts: tuple[Part, ...] = ()
        """The newest parts, at most `MOST_ANSWERS`, oldest first; replaced with each part."""
        self._curves: dict[int, Mapping[str, Any] | None] = {}
        self._begin(wall_clock(), 0)

    def _begin(self, since_s: float, n_faults: int) -> None:
        self.began_s = began_s(self._now_s(), self._begins_h)
        """Unix time in s at which the shift began, by the clock on the wall."""
        self._since_s, self._faults_before = since_s, n_faults
        self._counts = Counter[str]()
        self._n_rejected = self._n_missed = 0
        self._cycles_s = deque[float](maxlen=_MOST_CYCLES)

    def _look(self, n_faults: int) -> None:
        """Begin a new shift when its hour has come; a clock set back by minutes ends none."""
        now_s = self._now_s()
        again = 0.0 < self.began_s - now_s < _HOUR_S
        if not again and (since_s := began_s(now_s, self._begins_h)) != self.began_s:
            self._begin(since_s, n_faults)

    def add(self, part: Part, curves: Mapping[str, Any] | None = None) -> None:
        """Count a part and keep the curves of its last grasp, or count a turn without a part."""
        n_faults = self._n_faults()
        with self._lock:
            self._look(n_faults)
            if not part.label:
                self._n_missed += 1
                return
            self._count(part.label, part.rejected, part.seconds, part.time_s)
            self.parts = (*self.parts, part)[-MOST_ANSWERS:]
            self._curves[part.number] = curves
            if len(self._curves) > MOST_ANSWERS:
                del self._curves[next(iter(self._curves))]

    def _count(self, label: str, rejected: bool, seconds: float, time_s: float) -> None:
        self._n_rejected += rejected
        self._cycles_s.append(seconds)
        self._counts[label] += 1
        self._times_s.append(time_s)
        self._forget_times()

    def _forget_times(self) -> None:
        """Forget the times before the last hour, and those after now: the clock was set back."""
        now_s = self._now_s()
        while self._times_s and not now_s - _HOUR_S < self._times_s[0] <= now_s:
            self._times_s.popleft()

    def add_earlier(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Count the rows of the history that earlier programs have written in the same shift."""
        with self._lock:
            rows = [row for row in rows if row["time_s"] >= self.began_s]
            self._since_s = min((self._since_s, *(row["time_s"] for row in rows)))
            self._n_missed += sum(row["kind"] == "miss" for row in rows)
            self._faults_before -= sum(row["kind"] == "fault" for row in rows)
            own_s, self._times_s = self._times_s, deque()
            for row in (row for row in rows if row["kind"] == "part"):
                self._count(row["label"], bool(row["rejected"]), row["seconds"], row["time_s"])
            self._times_s += own_s

    def values(self) -> dict[str, Any]:
        """Return the ledger, with its newest parts as ``answers``; times in s."""
        n_faults = self._n_faults()
        with self._lock:
            self._look(n_faults)
            self._forget_times()
            return {
                "since_s": self._since_s,
                "started_s": self._started_s,
                "parts": self._counts.total(),
                "rejected": self._n_rejected,
                "missed": self._n_missed,
                "faults": n_faults - self._faults_before,
                "cycle_s": statistics.median(self._cycles_s) if self._cycles_s else None,
                "parts_last_hour": len(self._times_s),
                "counts": dict(self._counts),
                "answers": list(self.parts),
            }

    def part(self, number: int) -> Part:
        """Return a part by its number. Raises RequestRefused if it is not kept."""
        for part in self.parts:
            if part.number == number:
                return part
        newest = self.parts[-1].number if self.parts else 0
        raise RequestRefused(
            f"part {number} is not kept; the newest is {newest}, and {MOST_ANSWERS} are kept"
        )

    def curves(self, number: int) -> Mapping[str, Any] | None:
        """Return the last grasp of a part by its number; None if it is not kept."""
        return self._curves.get(number)


def began_s(now_s: float, begins_h: Sequence[float]) -> float:
    """Return the unix time in s at which the shift of a moment began.

    ``begins_h`` are hours of the local day; the night shift begins on the day before.
    """
    now = datetime.fromtimestamp(now_s)
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    begins = (midnight + timedelta(hours=hour - 24.0 * day) for hour in begins_h for day in (0, 1))
    # On the day of a time change the wall clock repeats an hour or leaves one out.
    return max(begin for at in begins if (begin := at.timestamp()) <= now_s)


def _add_value(summary: dict[str, float], value: float) -> None:
    """Add a value to a number of values and their sum."""
    summary["_count"] += 1
    summary["_sum"] += value


class Totals:
    """Totals since the start of the program; one thread adds, any thread reads."""

    def __init__(self) -> None:
        self.parts: Counter[tuple[str, str]] = Counter()
        """Parts by label and result: ``named``, ``unknown``, ``rejected`` (named, but released at
        the place of the rejects) or ``missed`` (no part found; without label)."""
        self.cycles_s = {"_count": 0.0, "_sum": 0.0}
        """Time of each part in s, as `Part.seconds`: ``_count`` and ``_sum``."""
        self.force_errors_n = {"_count": 0.0, "_sum": 0.0}
        """Distance in N between force and set-point at the end of each grasp, likewise."""

    def add(self, part: Part, identification: Identification | None) -> None:
        """Count a part with its grasps, or a turn without a part."""
        if not part.label:
            self.parts["", "missed"] += 1
            return
        named = "rejected" if part.rejected else "named"
        self.parts[part.label, "unknown" if part.label == UNKNOWN else named] += 1
        _add_value(self.cycles_s, part.seconds)
        for record in () if identification is None else identification.records:
            wanted_n = record.cycles[-1].setpoint_n
            _add_value(self.force_errors_n, abs(record.outcome.final_force_n - wanted_n))


VERSION = 2
"""Version of the table, ``user_version`` of the file."""
MOST_DAYS = 400
"""Most days; the rows of the oldest are deleted."""
COLUMNS = {
    "day": "TEXT NOT NULL",
    "time_s": "REAL NOT NULL",
    "kind": "TEXT NOT NULL",
    "label": "TEXT",
    "presented": "TEXT",
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
"""Columns of the table and their types. ``kind`` is ``start``, ``part``, ``miss`` or ``fault``. The
values of a part have the names of `Part`; ``second`` is the label of its runner-up."""
_TABLE = f"""
    CREATE TABLE IF NOT EXISTS events ({", ".join(map(" ".join, COLUMNS.items()))});
    CREATE INDEX IF NOT EXISTS by_day ON events (day);
    PRAGMA user_version = {VERSION}"""
_OLDEST_DAY = """
    DELETE FROM events WHERE day < (
        SELECT MIN(day) FROM (SELECT DISTINCT day FROM events ORDER BY day DESC LIMIT ?)
    )"""
_NEAR = 0.1
"""Least probability of the second label at which an unconfirmed answer counts as near."""
_MOST_CONFUSED = 5
"""Most pairs of objects in the sums."""
_WAITING_MAX = 10_000
"""Most rows that wait for the disk; the oldest are dropped."""
_LOOK_S = 1.0
"""Time in s from one write to the next."""


_Sums = Counter[Any]
"""Sums of a day: rows by ``kind``, ``rejected`` parts, ``seconds`` of all parts, and pairs of
objects: presented or second label, name, whether the first was given."""


def _add(sums: _Sums, row: Mapping[str, Any]) -> None:
    """Add a row to the sums of its day."""
    sums[row["kind"]] += 1
    if row["kind"] == "part":
        sums["rejected"] += bool(row["rejected"])
        sums["seconds"] += row["seconds"]
        presented, named = row["presented"], row["label"]
        near = not presented and row["second_probability"] >= _NEAR
        if named != UNKNOWN and (presented not in ("", named) or near):
            sums[presented or row["second"], named, bool(presented)] += 1


def _listed(sums: _Sums) -> dict[str, Any]:
    """Return sums in the form of `History.values`."""
    pairs = [(-n, pair) for pair, n in sums.items() if isinstance(pair, tuple)]
    kinds = {"parts": "part", "missed": "miss", "faults": "fault", "starts": "start"}
    return {name: sums[kind] for name, kind in kinds.items()} | {
        "rejected": sums["rejected"],
        "cycle_s": sums["seconds"] / sums["part"] if sums["part"] else None,
        "confused": [
            {"held": held, "named": named, "n": -n, "confirmed": given}
            for n, (held, named, given) in sorted(pairs)[:_MOST_CONFUSED]
        ],
    }


class History:
    """Parts and faults of a cell, for the page and other clients; every method from any thread.

    Parameters
    ----------
    path
        SQLite file. None keeps the history in memory.
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
        self._days: dict[str, _Sums] = {}
        self._written = set[str]()
        self._over = threading.Event()
        self._updating, self._counting = threading.Lock(), threading.Lock()
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
        second = part.runner_up or {"label": "", "probability": 0.0}
        self._add(
            kind="part" if part.label else "miss",
            second=second["label"],
            second_probability=second["probability"],
            **part.model_dump(include=set(COLUMNS)),
        )

    def values(self) -> dict[str, Any]:
        """Return the sums of ``today``, ``yesterday`` and this ``week``, which begins on Monday.

        Each has ``parts``, ``rejected``, ``missed``, ``faults``, ``starts``, the mean ``cycle_s``,
        and ``confused``: pairs ``held`` and ``named`` with their number ``n``, the most frequent
        first. In a pair that is not ``confirmed`` the held object was not given: ``held`` is then
        the second label. The sums are empty until the first `update`; rows that wait for the disk
        count from then on.
        """
        self._count_faults()
        with self._counting:
            return self._summed() if self._days else {}

    def day(self, day: date) -> list[Mapping[str, Any]]:
        """Return the rows of a day as `read_day`; empty if the history is in memory."""
        self.update()
        return [] if self._path is None else read_day(self._path, day)

    def update(self) -> None:
        """Write new rows to SQLite and update the totals. An error becomes a note."""
        with self._updating:
            self._update()

    def _update(self) -> None:
        if self._shift is not None:
            self._shift.values()  # a new shift begins in time, even without a client
        self._count_faults()
        try:
            self._resume_shift()
            self._read_days()
            self._write()
            self._refused = ""
        except (sqlite3.Error, OSError, CellError) as error:
            if str(error) != self._refused:
                text = f"the history is not kept in {self._path}: {error}"
                self._note(f"{text}; free space on a full disk, move a damaged file away")
            self._refused = str(error)
            self._close_link()

    def _run(self) -> None:
        self.update()
        while not self._over.wait(_LOOK_S):
            self.update()
        self.update()
        if self._refused:  # a file that was removed is made anew
            self.update()
        self._close_link()

    def _count_faults(self) -> None:
        """Add the faults since the last call."""
        now = self._status()
        with self._counting:
            # Another thread may have counted a newer status.
            before, self._n_faults = self._n_faults, max(self._n_faults, now.n_faults)
        for n in range(now.n_faults - before, 0, -1):
            newest = n == 1 and now.fault is not None
            number = now.fault_number if newest else 0
            self._add(kind="fault", fault_number=number, text=now.fault if newest else "")

    def _add(self, **row: Any) -> None:
        row = {"time_s": self._wall_s()} | row
        row = {"day": str(date.fromtimestamp(row["time_s"]))} | row
        with self._counting:
            self._waiting.append(row)
            if row["day"] in self._days:
                _add(self._days[row["day"]], row)

    def _resume_shift(self) -> None:
        """Give the shift its earlier rows once, before this program writes its first ones.

        A row counts by its own time, even if the clock was set since.
        """
        if self._shift is None or self._resumed:
            return
        begin, now = (date.fromtimestamp(s) for s in (self._shift.began_s, self._wall_s()))
        with self._opened() as link:
            rows = [row for day in sorted({begin, now}) for row in _rows(link, str(day))]
        self._shift.add_earlier(rows)
        self._resumed = True

    def _read_days(self) -> None:
        """Sum the rows of the days of the sums, written and waiting; each day is read once."""
        today = date.fromtimestamp(self._wall_s())
        days = [str(today - timedelta(days=n)) for n in range(max(1, today.weekday()) + 1)]
        read = {day: _Sums() for day in days if day not in self._days}
        for day, sums in read.items():
            for row in _rows(self._opened(), day):
                _add(sums, row)
        with self._counting:
            for row in self._waiting:
                if row["day"] in read:
                    _add(read[row["day"]], row)
            self._days = {day: (self._days | read)[day] for day in days}

    def _write(self) -> None:
        """Write all waiting rows in one transaction."""
        with self._counting:
            rows = [*self._waiting]
        if not rows:
            return
        with self._opened() as link:
            for row in rows:
                names, places = ", ".join(row), ", ".join("?" * len(row))
                link.execute(f"INSERT INTO events ({names}) VALUES ({places})", [*row.values()])
            if not self._written.issuperset(row["day"] for row in rows):
                link.execute(_OLDEST_DAY, (MOST_DAYS,))
        self._written.update(row["day"] for row in rows)
        with self._counting:
            for row in rows:
                if self._waiting[0] is row:  # a full queue drops its oldest rows by itself
                    self._waiting.popleft()

    def _summed(self) -> dict[str, Any]:
        """Return the sums of `values`."""
        days = [*self._days]  # today, yesterday and so on
        n_week = date.fromisoformat(days[0]).weekday() + 1
        spans = {"today": days[:1], "yesterday": days[1:2], "week": days[:n_week]}
        return {
            name: _listed(sum((self._days[day] for day in some), _Sums()))
            for name, some in spans.items()
        }

    def _opened(self) -> sqlite3.Connection:
        """Return the connection. Raises CellError if the tables are of another version."""
        if self._link is None:
            if self._path is not None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
            self._link = _connected(":memory:" if self._path is None else str(self._path))
            if self._link.execute("PRAGMA user_version").fetchone() == (0,):
                self._link.executescript(_TABLE)
        return self._link

    def _close_link(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with suppress(sqlite3.Error):
                link.close()


def history_file(directory: Path, cell_name: str) -> Path:
    """Return the file of the history of a cell, beside the folders of its jobs."""
    return directory / f"history-{name_in_file(cell_name)}.sqlite3"


def read_day(path: Path, day: date) -> list[Mapping[str, Any]]:
    """Return the rows of a day, oldest first, with `COLUMNS`.

    Raises CellError if the file cannot be read.
    """
    try:
        with closing(_connected(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as link:
            return list(_rows(link, str(day)))
    except sqlite3.Error as error:
        raise CellError(f"cannot read the history {path}: {error}; check the path") from error


def _connected(name: str, *, uri: bool = False) -> sqlite3.Connection:
    link = sqlite3.connect(name, timeout=1.0, check_same_thread=False, uri=uri)
    try:
        (version,) = link.execute("PRAGMA user_version").fetchone()
        if version not in (0, VERSION):  # 0: a new file
            raise CellError(
                f"{name} has a table of version {version}, but {PROGRAM} reads version {VERSION}; "
                "move it away, or use the tactile-cell that wrote it"
            )
    except BaseException:
        link.close()
        raise
    return link


def _rows(link: sqlite3.Connection, day: str) -> Iterator[dict[str, Any]]:
    for row in link.execute("SELECT * FROM events WHERE day = ? ORDER BY rowid", (day,)):
        yield dict(zip(COLUMNS, row, strict=True))
