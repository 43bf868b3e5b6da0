"""A week of shifts, condensed: each is started anew, and neither disk nor memory grows.

    python -m benchmarks.performance.week [--days D] [--parts N]        (make soak)

In each shift the service on the simulated cell starts in the folder of the ones before. The first
shift of a day measures the self-zero. The service sorts parts. It meets a fault, which a person
clears. It ends, starts again within the shift, and does the same once more. In one shift the clock
is ten years ahead. Recordings are kept for two days. Process and disk are measured each time.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any

from benchmarks._measure import line
from benchmarks.performance.shift import run_job, wait
from benchmarks.performance.soak import ResourceUse, look, show_growth
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.states import Command
from cell.service.opening import open_service
from cell.service.service import RELEASE_KEY, Service

SHIFTS_H = (6.0, 14.0, 22.0)
"""Hours of the day at which a shift begins."""
KEEP_DAYS = 2.0
"""Days for which recordings are kept."""
LIMITS = {"rss_kib": 400.0, "objects": 200.0, "descriptors": 0.01, "threads": 0.01}
"""Growth allowed for each shift."""
_MONDAY_S = datetime(2027, 3, 1).timestamp()
_HOUR_S, _DAY_S = 3600.0, 86_400.0
_LEAP_S = 3650.0 * _DAY_S
_TAUGHT = 6
"""Grasps for teaching each object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftUse:
    """Use of resources in a shift, and its results."""

    process: ResourceUse
    """The process; ``done`` counts shifts."""
    ledger: dict[str, Any]
    """Values as in `Shift.values`, before the end of the shift."""
    kinds: Counter[str]
    """Rows of the history so far, by kind; rows of the clock ahead are on another day."""
    n_recordings: int
    disk_bytes: int
    """Number of recordings, and bytes of all files of the cell."""


def week(folder: Path, config: CellConfig, days: int, n_parts: int) -> Iterator[ShiftUse]:
    """Work for some days, with ``n_parts`` in each half of a shift; yield the use of each shift."""
    changes = {"serve.shift_begins_h": SHIFTS_H, "recording.keep_days": KEEP_DAYS}
    config = changed_config(config, {"serve.lease_timeout_s": 60.0, **changes})
    model, n_shifts, now_s = folder / "parts.npz", len(SHIFTS_H) * days, [_MONDAY_S]

    def started(name: str, self_zero: str = "on_demand", **options: Any) -> Service:
        (folder / name).mkdir()
        now = changed_config(config, {"self_zero": self_zero})
        return open_service(now, folder=folder / name, wall_s=lambda: now_s[0], **options)

    with closing(started("teach-20270301-000000", save=model)) as service:
        lease = service.lease.acquire("week")
        for label in (entry.label for entry in config.simulator.objects):
            run_job(service, lease, {"task": "teach", "label": label, "grasps": _TAUGHT})
    for number in range(n_shifts):
        begin_s = _MONDAY_S + number // 3 * _DAY_S + SHIFTS_H[number % 3] * _HOUR_S
        for half in range(2):
            now_s[0] = begin_s + (4.0 * half + 0.1) * _HOUR_S
            now_s[0] += _LEAP_S * (number == n_shifts // 2)
            name = f"serve-20270301-{number:03}{half:03}"
            # A simulated hand is a new one at each start: `daily` would measure it each time.
            zero = "on_demand" if number % len(SHIFTS_H) or half else "daily"
            with closing(started(name, zero, model=model)) as service:
                _work(service, n_parts, seed=100 * number + 50 * half)
                ledger = service.shift.values()
                service.history.update()
        every = (date.fromtimestamp(_MONDAY_S) + timedelta(day) for day in range(days + 1))
        files = [path for path in folder.rglob("*") if path.is_file()]
        yield ShiftUse(
            process=look(number + 1, now_s[0] - _MONDAY_S),
            ledger=ledger,
            kinds=Counter(row["kind"] for day in every for row in service.history.day(day)),
            n_recordings=sum(path.suffix == ".mcap" for path in files),
            disk_bytes=sum(path.stat().st_size for path in files),
        )


def _work(service: Service, n_parts: int, seed: int) -> None:
    """Sort parts, meet a fault after them, and make the cell ready again."""
    lease = service.lease.acquire("week")
    run_job(service, lease, {"task": "sort", "parts": n_parts, "seed": seed})
    service.simulate_fault("unit.off")
    if not wait(service, lease, service.start(lease, {"task": "identify"})).fault_number:
        raise SystemExit("a control unit without power was no fault")
    service.simulate_fault("unit.off", end=True)
    for command in (Command.CLEAR, Command.RELEASE, Command.RESET):
        wait(service, lease, service.command(lease, command, key=RELEASE_KEY))


def wrong(shifts: Sequence[ShiftUse], n_parts: int) -> list[str]:
    """Return the problems of the shifts."""
    most = int(2 * len(SHIFTS_H) * (KEEP_DAYS + 1.0)) + 1
    found = []
    for number, one in enumerate(shifts):
        ledger, at = one.ledger, f"shift {number + 1}"
        if (ledger["parts"] + ledger["missed"], ledger["faults"]) != (2 * n_parts, 2):
            found.append(
                f"{at}: {ledger['parts']} parts, {ledger['faults']} faults after a restart"
            )
        if one.n_recordings > most:
            found.append(f"{at}: {one.n_recordings} recordings, {most} are kept at most")
    n_whole = len(shifts) - 1
    kinds = shifts[-1].kinds
    if (kinds["part"] + kinds["miss"], kinds["fault"]) != (2 * n_parts * n_whole, 2 * n_whole):
        found.append(f"the history has {kinds['part']} parts and {kinds['fault']} faults")
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.performance.week", description=__doc__
    )
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--parts", type=int, default=10)
    wanted = parser.parse_args(arguments)
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        shifts = list(week(Path(folder), CellConfig(), wanted.days, wanted.parts))
    took_s = time.monotonic() - begin_s
    last = shifts[-1]
    line("week", f"{len(shifts)} shifts, {2 * len(shifts)} starts, in {took_s / 60:.1f} min")
    line("  history", f"{last.kinds['part']} parts, {last.kinds['fault']} faults")
    most_mb, last_mb = max(one.disk_bytes for one in shifts) / 1e6, last.disk_bytes / 1e6
    line("  disk", f"{most_mb:.1f} MB at most, at the end {last_mb:.1f} MB")
    line("  recordings", f"{last.n_recordings} at the end")
    bad = [*wrong(shifts, wanted.parts), *show_growth([one.process for one in shifts], LIMITS)]
    if bad:
        sys.exit("; ".join(bad))


if __name__ == "__main__":
    main()
