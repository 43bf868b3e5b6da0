"""Rows 36, 37 and 41: the disk, recordings, and ports that another program has."""

import os
import pty
import tempfile
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.fault_campaign.host_jobs import PERIOD_S
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    COARSE_PADS,
    CampaignCell,
    campaign_cell,
    observe,
)
from cell import recording_file
from cell.errors import RecordingError
from cell.recording import Recorder, read_recording, recording_grasps
from cell.recording_file import DirectFile
from cell.recording_recover import recover_recording
from gripper.errors import PortLost
from gripper.port import SerialStream
from tactile.can_bus import close_bus, open_bus
from tactile.errors import BusNotOpened

_ENOSPC = OSError(28, "No space left on device")
_WAITING_BYTES = 1 << 16


# -- 36: the disk ----------------------------------------------------------------------------


class _Disk:
    """A disk that refuses, or stands still, once the part is touched."""

    def __init__(self, cell: CampaignCell, *, stuck: threading.Event | None = None) -> None:
        self._cell = cell
        self._stuck = stuck
        self._write = DirectFile.write
        self.refused_s: float | None = None

    def write(self, file: DirectFile, data: bytes) -> int:
        """Write as always until the part is touched."""
        if self.refused_s is None and self._cell.grip_n > 0.5:
            self.refused_s = self._cell.now_s
        if self.refused_s is None:
            return self._write(file, data)
        if self._stuck is None:
            raise _ENOSPC
        self._stuck.wait(20.0)
        return self._write(file, data)


@contextmanager
def _background_recorder() -> Iterator[None]:
    def in_a_thread(*arguments: Any, **options: Any) -> Recorder:
        return Recorder(*arguments, **options | {"background": True})

    with (
        mock.patch("cell.build.Recorder", in_a_thread),
        mock.patch.object(recording_file.BackgroundFile.__init__, "__kwdefaults__", _LIMITS),
    ):
        yield


_LIMITS = {"max_waiting_bytes": _WAITING_BYTES, "close_timeout_s": 10.0}


def _recorded_job(cell: CampaignCell) -> None:
    cell.start()
    for _ in range(3):
        cell.grasp()


def _disk_refuses(when_lost: str, *, slow: bool = False) -> Observed:
    go_on = threading.Event()
    seen: list[Observed] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if slow:
            stack.enter_context(_background_recorder())
        try:
            with campaign_cell(folder=folder, recording__when_lost=when_lost) as cell:
                disk = _Disk(cell, stuck=go_on if slow else None)

                def write(file: DirectFile, data: bytes) -> int:
                    return disk.write(file, data)

                known_s: list[float] = []

                def look(now_s: float) -> None:
                    if not known_s and cell.cell.health()["recording"] is not None:
                        known_s.append(now_s)

                cell.simulated.clock.on_advance.append(look)
                with mock.patch.object(DirectFile, "write", write):
                    job = observe(cell, lambda: None, _recorded_job)
                go_on.set()
                cell.monitor.check()
                assert disk.refused_s is not None
                flagged = bool(known_s)
                seen.append(
                    Observed(
                        reaction="NOTE" if flagged and job.reaction == "NOTHING" else job.reaction,
                        detected_after_s=known_s[0] - disk.refused_s if flagged else None,
                        outcome=job.outcome,
                    )
                )
        except RecordingError as told:
            left = read_recording(folder / "recording.mcap")
            why = "" if when_lost == "hold" else f": {told}"
            outcome = f"{seen[0].outcome}; {len(left.frames)} frames can be read{why}"
            return Observed(
                reaction=seen[0].reaction,
                detected_after_s=seen[0].detected_after_s,
                outcome=outcome.replace(f"{folder}/", ""),
            )
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="nobody was told")


def _read_only() -> Observed:
    try:
        with campaign_cell(folder=Path("/proc/tactile-cell")) as cell:
            cell.start()
    except RecordingError as error:
        return Observed(reaction="REJECT", detected_after_s=None, outcome=str(error))
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="it was recorded")


# -- 37: recordings --------------------------------------------------------------------------


@cache
def _recording() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        with campaign_cell(folder=Path(folder), tactile__layout=COARSE_PADS) as cell:
            _recorded_job(cell)
        return (Path(folder) / "recording.mcap").read_bytes()


def _damaged_recording(damage: Callable[[bytearray], None]) -> Observed:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.mcap"
        whole = Path(folder) / "whole.mcap"
        whole.write_bytes(_recording())
        data = bytearray(_recording())
        damage(data)
        path.write_bytes(data)
        try:
            recording_grasps(path)
        except RecordingError as error:
            told = str(error).removeprefix(str(path))
        else:
            return Observed(reaction="NOTHING", detected_after_s=None, outcome="taken for whole")
        found = recover_recording(path, Path(folder) / "new.mcap")
        new = read_recording(found.path)
        good = {grasp.counts.tobytes() for grasp in read_recording(whole).grasps}
        honest = new.complete and {grasp.counts.tobytes() for grasp in new.grasps} <= good
        return Observed(
            reaction="REJECT" if honest else "SHORT DATA",
            detected_after_s=None,
            outcome=f"{told}; `recover` keeps {found.n_grasps} of {len(good)} grasps, unchanged",
        )


def _cut(data: bytearray) -> None:
    del data[len(data) * 3 // 5 :]


def _flip(data: bytearray) -> None:
    data[len(data) // 2] ^= 0x04


# -- 41: two programs ------------------------------------------------------------------------


@contextmanager
def _port() -> Iterator[str]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


def _servo_port() -> Observed:
    with _port() as port:
        first = SerialStream(port)
        try:
            SerialStream(port).close()
        except PortLost as error:
            return Observed(
                reaction="REJECT", detected_after_s=None, outcome=str(error).replace(port, "PORT")
            )
        finally:
            first.close()
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="both have it open")


def _can_port() -> Observed:
    with _port() as port:
        first = open_bus("slcan", port)
        try:
            close_bus(open_bus("slcan", port))
        except BusNotOpened as error:
            return Observed(
                reaction="REJECT", detected_after_s=None, outcome=str(error).replace(port, "PORT")
            )
        finally:
            close_bus(first)
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="both have it open")


def _file_rows() -> list[FaultRow]:
    full, slow_disk = "the disk is full from the contact on", "the disk stands still from then on"
    disk = [
        ("full disk", f"{full}, when_lost: finish", "ENOSPC", "finish", False, "NOTE"),
        ("full disk and hold", f"{full}, when_lost: hold", "ENOSPC", "hold", False, "HOLD"),
        ("slow disk", slow_disk, "a write that waits", "finish", True, "NOTE"),
    ]
    rows = [
        FaultRow(
            row=36,
            variant=variant,
            fault=fault,
            injected=injected,
            reaction=reaction,
            # From the first write that is refused; of a slow disk, until 64 KiB wait for it.
            limit_s=10.0 if slow else 2 * PERIOD_S,
            run=lambda when=when, slow=slow: _disk_refuses(when, slow=slow),
        )
        for variant, fault, injected, when, slow, reaction in disk
    ]
    rows.append(
        FaultRow(
            row=36,
            variant="read-only",
            fault="the folder of the recording cannot be written",
            injected="a folder below /proc",
            reaction="REJECT",
            limit_s=None,
            run=_read_only,
        )
    )
    rows += [
        FaultRow(
            row=37,
            variant=variant,
            fault=f"the recording is {variant}",
            injected="bytes of the file",
            reaction="REJECT",
            limit_s=None,
            run=lambda damage=damage: _damaged_recording(damage),
        )
        for variant, damage in (("truncated", _cut), ("bit-flipped", _flip))
    ]
    return rows


ROWS: tuple[FaultRow, ...] = (
    *_file_rows(),
    *(
        FaultRow(
            row=41,
            variant=variant,
            fault=f"a second program opens {variant}",
            injected="the same pseudo-terminal again",
            reaction="REJECT",
            limit_s=None,
            run=run,
        )
        for variant, run in (
            ("the servo port", _servo_port),
            ("the CAN adapter's port", _can_port),
        )
    ),
)
