"""Faults of disk, recordings, configs and models, and ports that another program has opened."""

import os
import pickle
import pty
import re
import sys
import tempfile
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

from cell.build import build_cell
from cell.control.records import pad_array
from cell.errors import CellError, ConfigError, ModelError, RecordingError
from cell.learning.model import save_model
from cell.recording.reader import read_recording, recording_grasps, recover_recording
from cell.recording.recorder import Recorder
from cell.recording.sink import BackgroundFile, DirectFile
from cell.runtime.plugin import TactileCellPlugin
from gripper.dynamixel.serial_port import SerialStream
from gripper.errors import PortLost
from recognition.recognizers import make_trainer
from tactile.can.bus import close_bus, open_bus
from tactile.errors import BusNotOpened
from tactile.layout import paper_layout
from tests.cell.conftest import COARSE_PADS
from tests.faults.campaign import (
    CampaignCell,
    FaultRow,
    Observed,
    campaign_cell,
    campaign_config,
    observe,
)
from tests.recognition.conftest import make_grasps

# -- 36: the disk ----------------------------------------------------------------------------

_ENOSPC = OSError(28, "No space left on device")
_BACKGROUND = {"max_waiting_bytes": 1 << 16, "close_timeout_s": 10.0}
"""Limits of a recording in a thread: 64 KiB may wait for the disk, soon reached."""
_STUCK_S = 20.0
"""Longest time in s that a write waits for the disk of the campaign."""


class _Disk:
    """A disk that refuses, or stands still, once the part is touched."""

    def __init__(self, cell: CampaignCell, *, stuck: threading.Event | None = None) -> None:
        self._cell = cell
        self._stuck = stuck
        self._write = DirectFile.write
        self.refused_s: float | None = None

    def write(self, file: DirectFile, data: bytes) -> int:
        if self.refused_s is None and self._cell.grip_n > 0.5:
            self.refused_s = self._cell.now_s
        if self.refused_s is None:
            return self._write(file, data)
        if self._stuck is None:
            raise _ENOSPC
        self._stuck.wait(_STUCK_S)
        return self._write(file, data)


@contextmanager
def _background_recorder() -> Iterator[None]:
    def in_a_thread(*arguments: Any, **options: Any) -> Recorder:
        return Recorder(*arguments, **options | {"background": True})

    with (
        mock.patch.object(sys.modules[build_cell.__module__], "Recorder", in_a_thread),
        mock.patch.object(BackgroundFile.__init__, "__kwdefaults__", _BACKGROUND),
    ):
        yield


def _recorded_job(cell: CampaignCell) -> None:
    cell.start()
    for _ in range(3):
        cell.grasp()


def disk_refuses(row: FaultRow, *, slow: bool = False) -> Observed:
    """Record a job on a disk that is full, or stands still, from the first touch on.

    The job runs to its end or is held; closing the recording raises what the disk has done.
    """
    go_on = threading.Event()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if slow:
            stack.enter_context(_background_recorder())
        try:
            with campaign_cell(row.changes, folder=folder) as cell:
                disk = _Disk(cell, stuck=go_on if slow else None)

                def write(file: DirectFile, data: bytes) -> int:
                    return disk.write(file, data)

                def flagged() -> bool:
                    recorder = cell.cell._recorder
                    return recorder is not None and recorder.fault is not None

                with (
                    mock.patch.object(DirectFile, "write", write),
                    cell.first_time(flagged) as flagged_s,
                ):
                    job = observe(cell, job=_recorded_job)
                go_on.set()
                cell.monitor.check()
        except RecordingError as error:
            left = read_recording(folder / "recording.mcap")
            why = "" if row.reaction == "HOLD" else f": {error}"
            outcome = f"{job.outcome}; {len(left.frames)} frames can be read{why}"
            noted = bool(flagged_s) and job.reaction == "NOTHING"
            assert disk.refused_s is not None
            return Observed(
                "NOTE" if noted else job.reaction,
                flagged_s[0] - disk.refused_s if flagged_s else None,
                outcome.replace(f"{folder}/", ""),
            )
    return Observed("NOTHING", None, "the recording was closed without an error")


def folder_is_read_only(row: FaultRow) -> Observed:
    """Start a cell that shall record where nothing can be written."""
    try:
        with campaign_cell(row.changes, folder=Path("/proc/tactile-cell")) as cell:
            cell.start()
    except RecordingError as error:
        return Observed("REJECT", None, str(error))
    return Observed("NOTHING", None, "it was recorded")


# -- 37: recordings --------------------------------------------------------------------------


@cache
def _recording() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        with campaign_cell({"tactile.layout": COARSE_PADS}, folder=Path(folder)) as cell:
            _recorded_job(cell)
        return (Path(folder) / "recording.mcap").read_bytes()


def damaged_recording(_row: FaultRow, *, damage: Callable[[bytes], bytes]) -> Observed:
    """Read a damaged recording, then recover it: each grasp that is left must be a true one."""
    with tempfile.TemporaryDirectory() as folder:
        path, whole = Path(folder) / "r.mcap", Path(folder) / "whole.mcap"
        whole.write_bytes(_recording())
        path.write_bytes(damage(_recording()))
        try:
            recording_grasps(path)
        except RecordingError as error:
            refusal = str(error).removeprefix(str(path))
        else:
            return Observed("NOTHING", None, "taken for whole")
        found = recover_recording(path, Path(folder) / "new.mcap")
        new = read_recording(found.recording)
        good = {grasp.counts.tobytes() for grasp in read_recording(whole).grasps}
        honest = new.complete and {grasp.counts.tobytes() for grasp in new.grasps} <= good
        kept = f"`recording recover` keeps {found.n_grasps} of {len(good)} grasps, unchanged"
        return Observed("REJECT" if honest else "SHORT DATA", None, f"{refusal}; {kept}")


def cut(data: bytes) -> bytes:
    return data[: len(data) * 3 // 5]


def flipped(data: bytes, mask: int = 0x04) -> bytes:
    """Return the same with one bit of the middle byte turned."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ mask]) + data[middle + 1 :]


# -- 38: configs -----------------------------------------------------------------------------


def _before_hardware(make: Callable[[], object], error: type[CellError]) -> tuple[str, bool]:
    """Return the refusal, empty for none, and whether a device was touched."""
    touched: list[object] = []

    def touch(*arguments: Any, **_options: Any) -> Any:
        touched.append(arguments)
        raise ConfigError("the cell was built")

    with mock.patch.object(sys.modules[build_cell.__module__], "build_cell", touch):
        try:
            make()
        except error as refusal:
            return str(refusal), bool(touched)
    return "", True


def bad_config(_row: FaultRow, *, text: str, word: str) -> Observed:
    """Load a config; the refusal names line, column and a word of the cause."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_bytes(text.encode())
        refusal, touched = _before_hardware(lambda: TactileCellPlugin(path), ConfigError)
    refusal = refusal.replace(f"{folder}/", "")
    placed = re.match(r"cell\.yaml:\d+:\d+: ", refusal) is not None and word in refusal
    return Observed("REJECT" if placed and not touched else "TAKEN", None, refusal)


# -- 39: models ------------------------------------------------------------------------------


@cache
def model_file() -> bytes:
    """Return a model of some objects."""
    pads = pad_array(paper_layout())
    grasps = make_grasps(4, seed=1, pads=pads, gripping=paper_layout().gripping_pads)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.npz"
        model = make_trainer("level_check").fit(grasps)
        save_model(path, model, trainer_name="level_check", pads=pads)
        return path.read_bytes()


class _Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._marker),)


def bad_model(_row: FaultRow, *, content: Callable[[Path], bytes]) -> Observed:
    """Load a model file whose content is made for a path where code that runs leaves its mark."""
    with tempfile.TemporaryDirectory() as folder:
        path, marker = Path(folder) / "m.npz", Path(folder) / "code-was-run"
        path.write_bytes(content(marker))
        refusal, touched = _before_hardware(
            lambda: TactileCellPlugin(campaign_config({"tactile.layout": "paper"}), model=path),
            ModelError,
        )
        run = marker.exists()
    refused = refusal != "" and not touched and not run
    reaction = "REJECT" if refused else "CODE RUN" if run else "TAKEN"
    return Observed(reaction, None, refusal.replace(f"{folder}/", ""))


def evil_pickle(marker: Path) -> bytes:
    data = pickle.dumps(_Evil(marker))
    pickle.loads(data)  # what the product must not do: it leaves the mark
    marker.rmdir()
    return data


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


def servo_port_opened_twice(_row: FaultRow) -> Observed:
    return _opened_twice(SerialStream, SerialStream.close, PortLost)


def can_port_opened_twice(_row: FaultRow) -> Observed:
    return _opened_twice(lambda port: open_bus("slcan", port), close_bus, BusNotOpened)


def _opened_twice(
    opened: Callable[[str], Any], close: Callable[[Any], None], error: type[Exception]
) -> Observed:
    with _port() as port:
        first = opened(port)
        try:
            close(opened(port))
        except error as refusal:
            return Observed("REJECT", None, str(refusal).replace(port, "PORT"))
        finally:
            close(first)
    return Observed("NOTHING", None, "both have it open")
