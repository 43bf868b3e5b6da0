"""Rows 36 to 39 and 41: disk, recordings, configs, models, and ports that another program has."""

import os
import pickle
import pty
import re
import tempfile
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    COARSE_PADS,
    CampaignCell,
    campaign_cell,
    campaign_config,
    observe,
)
from cell import recording_file
from cell.collect import pad_array
from cell.config import CellConfig
from cell.errors import CellError, ConfigError, ModelError, RecordingError
from cell.layouts import layout_from_config
from cell.model import save_model
from cell.plugin import TactileCellPlugin
from cell.recording import Recorder, read_recording, recording_grasps
from cell.recording_file import DirectFile
from cell.recording_recover import recover_recording
from gripper.errors import PortLost
from gripper.port import SerialStream
from recognition.grasp import Grasp
from recognition.recognizers import make_trainer
from tactile.can_bus import close_bus, open_bus
from tactile.errors import BusNotOpened

PERIOD_S = 1.0 / campaign_config().gripper.loop_rate_hz
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


# -- 38: configs -----------------------------------------------------------------------------


def _before_hardware(make: Callable[[], object], error: type[CellError]) -> tuple[str, bool]:
    """Return what was said, and whether a device was touched."""
    touched: list[object] = []

    def touch(*arguments: Any, **_options: Any) -> Any:
        touched.append(arguments)
        raise ConfigError("the cell was built")

    with mock.patch("cell.plugin.build_cell", touch):
        try:
            make()
        except error as refusal:
            return str(refusal), bool(touched)
    return "", True


def _bad_config(text: str, key: str) -> Observed:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_bytes(text.encode())
        said, touched = _before_hardware(lambda: TactileCellPlugin(path), ConfigError)
    said = said.replace(f"{folder}/", "")
    placed = re.match(r"cell\.yaml:\d+:\d+: ", said) is not None and key in said
    return Observed(
        reaction="REJECT" if placed and not touched else "TAKEN",
        detected_after_s=None,
        outcome=said,
    )


# -- 39: models ------------------------------------------------------------------------------


@cache
def _model(layout: str = "paper") -> bytes:
    pads = pad_array(layout_from_config(CellConfig().tactile.model_copy(update={"layout": layout})))
    rng = np.random.default_rng(1)
    grasps = [
        Grasp(
            pads=pads,
            counts=rng.integers(0, 40 + 40 * number, (30, pads.n_taxels)).astype(np.uint16),
            t_s=np.arange(30) * 0.02,
            aperture_m=np.linspace(0.02, 0.01, 30),
            force_n=np.linspace(0.0, 6.0, 30),
            label=label,
        )
        for number, label in enumerate(("ball", "box"))
        for _ in range(4)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.npz"
        save_model(
            path,
            make_trainer("shrinkage_lda").fit(grasps),
            trainer_name="shrinkage_lda",
            pads=pads,
        )
        return path.read_bytes()


class _Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._marker),)


def _bad_model(content: Callable[[Path], bytes]) -> Observed:
    """Load a model file whose content is made knowing where code that runs leaves its mark."""
    with tempfile.TemporaryDirectory() as folder:
        path, marker = Path(folder) / "m.npz", Path(folder) / "code-was-run"
        path.write_bytes(content(marker))
        said, touched = _before_hardware(
            lambda: TactileCellPlugin(campaign_config(), model=path), ModelError
        )
        run = marker.exists()
    refused = said != "" and not touched and not run
    return Observed(
        reaction="REJECT" if refused else "CODE RUN" if run else "TAKEN",
        detected_after_s=None,
        outcome=said.replace(f"{folder}/", ""),
    )


def _flipped_model(_marker: Path) -> bytes:
    data = bytearray(_model())
    data[len(data) // 2] ^= 0x01
    return bytes(data)


def _other_version(_marker: Path) -> bytes:
    with np.load(BytesIO(_model()), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    text = str(arrays["model"]).replace("tactile-cell-model/1", "tactile-cell-model/9")
    file = BytesIO()
    np.savez(file, **arrays | {"model": np.array(text)})
    return file.getvalue()


def _pickle(marker: Path) -> bytes:
    data = pickle.dumps(_Evil(marker))
    pickle.loads(data)  # what the product must not do: it leaves the mark
    marker.rmdir()
    return data


def _pickle_in_npz(marker: Path) -> bytes:
    file = BytesIO()
    np.savez(file, model=np.array([_Evil(marker)], dtype=object))
    return file.getvalue()


def _bomb(_marker: Path) -> bytes:
    """State in the directory of the archive that an array unpacks to 2 GiB."""
    data = bytearray(_model())
    entry = data.index(b"PK\x01\x02")
    data[entry + 24 : entry + 28] = (2 << 30).to_bytes(4, "little")
    return bytes(data)


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


def _config_rows() -> list[FaultRow]:
    texts = (
        ("corrupt", "gripper: {force_max_n: [\n", "not YAML"),
        ("partial", "gripper:\n  force_max_n: 1", "cut off"),
        ("duplicate key", "gripper:\n  force_max_n: 5\n  force_max_n: 50\n", "force_max_n"),
        ("NaN", "gripper:\n  force_max_n: .nan\n", "gripper.force_max_n"),
        ("out of range", "gripper:\n  force_max_n: 51.0\n", "gripper.force_max_n"),
        ("misspelt", "gripper:\n  forc_max_n: 5.0\n", "is force_max_n meant"),
        ("wrong type", "gripper:\n  force_max_n: '5'\n", "gripper.force_max_n"),
        ("alias bomb", "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "aliases"),
    )
    return [
        FaultRow(
            row=38,
            variant=variant,
            fault=f"config: {variant}",
            injected=f"`{text.strip().splitlines()[-1].strip()}`",
            reaction="REJECT",
            limit_s=None,
            run=lambda text=text, key=key: _bad_config(text, key),
        )
        for variant, text, key in texts
    ]


def _model_rows() -> list[FaultRow]:
    contents: tuple[tuple[str, Callable[[Path], bytes]], ...] = (
        ("corrupt", _flipped_model),
        ("cut off", lambda _marker: _model()[:-400]),
        ("other taxel map", lambda _marker: _model("pinch")),
        ("other version", _other_version),
        ("pickle", _pickle),
        ("pickle in an archive", _pickle_in_npz),
        ("archive that unpacks to 2 GiB", _bomb),
    )
    return [
        FaultRow(
            row=39,
            variant=variant,
            fault=f"model: {variant}",
            injected="bytes of the file",
            reaction="REJECT",
            limit_s=None,
            run=lambda content=content: _bad_model(content),
        )
        for variant, content in contents
    ]


ROWS: tuple[FaultRow, ...] = (
    *_file_rows(),
    *_config_rows(),
    *_model_rows(),
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
