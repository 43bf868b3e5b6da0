"""Recordings and data sets: others can read them, a cut or a full disk costs the rest alone."""

import errno
import json
import math
import os
import shutil
import struct
import threading
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import jsonschema
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from typer.testing import CliRunner

from cell import files
from cell.archive.store import Archive
from cell.commissioning.findings import read_commissioned
from cell.commissioning.servos import read_backup
from cell.config.file import load_config
from cell.config.gripper import measured_drive
from cell.control.journal import Journal
from cell.control.plan import Pose
from cell.control.states import CellState, GraspState
from cell.control.zeroing import SelfZeros
from cell.errors import CellError, DatasetError, RecordingError
from cell.files import RECORDING, Format
from cell.interfaces.cli.app import app
from cell.learning.labelled_grasps import append_to_dataset
from cell.learning.model import load_model
from cell.recording import (
    reader as recording_reader,
    recorder as recorder_module,
    retention,
    schema as recording_schema,
    sink as recorder_sink,
)
from cell.recording.dataset import read_dataset, write_dataset
from cell.recording.reader import (
    RecordedMessages,
    read_recording,
    recording_grasps,
    recover_recording,
)
from cell.recording.recorder import ROOM_BYTES, Recorder
from cell.recording.retention import LEAST_FREE_BYTES, Retention, mark
from cell.recording.schema import RECOVERED
from cell.recording.sink import LEFT_BYTES, RecordingSink
from gripper.dynamixel.models import XM430_W350
from gripper.values.force_sensor import ForceSample
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero
from recognition.recognizer import Posterior
from tactile.source import TactileFrame
from tests.cell.served import until
from tests.fuzz.harness import Clock, same_grasps
from tests.values import (
    HAND_STATISTICS,
    make_cycle,
    make_identification,
    make_pads,
    make_servo,
    make_shape,
    make_state,
    raising,
)

PADS = make_pads(((4, 3), (4, 3)), adc_max=255)


def make_frame(t_s: float, rng: np.random.Generator, n_taxels: int = 24) -> TactileFrame:
    counts = np.clip(np.abs(rng.normal(0, 10, n_taxels)), 1, 20).astype(np.uint16)
    return TactileFrame(t_s=t_s, counter=int(t_s * 50) & 0xFFFF, status=0, counts=counts)


KNOWN: dict[str, Any] = {
    "command": GraspCommand(x_m=1e-3, y_m=0.0, rotation_rad=0.3, roll_rad=0.0, force_n=8.0),
    "zero": SelfZero.from_values([1e-3, 1e-4, 0.1, 0.02, 8.0, 0.2]),
}


def record_grasp(recorder: Recorder, clock: Clock, label: str, n_frames: int = 20) -> Grasp:
    start_s, rng = clock.now_s, np.random.default_rng(int(clock.now_s * 1000))
    grasp = Grasp(
        pads=PADS,
        counts=np.stack([make_frame(0.0, rng).counts for _ in range(n_frames)]),
        t_s=0.02 * np.arange(n_frames),
        aperture_m=np.linspace(0.03, 0.02, n_frames),
        force_n=np.linspace(0.0, 8.0, n_frames),
        label=label,
        source="test",
        start_ms=1_700_000_000_000,
        **(KNOWN if label.endswith("1") else {}),
    )
    Journal(recorder).pose(Pose(x_m=0.001, rotation_rad=0.3))
    Journal(recorder).note("state", "EXECUTE")
    for i in range(4 * n_frames):
        clock.now_s = start_s + i * 0.005
        recorder.cycle(make_cycle(clock.now_s))
        if i % 4 == 0:
            frame = make_frame(clock.now_s - 0.001, rng)
            recorder.frame(replace(frame, counts=grasp.counts[i // 4]))
    recorder.grasp(grasp)
    return grasp


BAR = make_shape(
    *("flat", 10.0, 15.9),
    half_mm=0.4,
    n_grasps=2,
    probability={"flat": 0.75, "oval": 0.25},
    dimensions_m={"height": 15.9e-3},
)


def record(path: Path, n_grasps: int = 3) -> list[Grasp]:
    clock = Clock(100.0)
    with (
        patch("time.time_ns", lambda: 1_700 * 10**9),
        closing(Recorder(path, clock, pads=PADS, metadata={"config": "abc"})) as recorder,
    ):
        journal = Journal(recorder)
        journal.states(CellState.HELD, GraspState.NO_PART_FOUND)
        journal.loop(HAND_STATISTICS)
        grasps = [record_grasp(recorder, clock, f"object {i}") for i in range(n_grasps)]
        likely = Posterior(
            labels=("object 0", "object 1"), probability=np.array([0.003, 0.997]), unknown=0.01
        )
        journal.result(make_identification(likely, shape=BAR, shapes=(BAR, None)))
    return grasps


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of three grasps."""
    path = tmp_path_factory.mktemp("recording") / "three.mcap"
    record(path)
    return path


def test_recording_holds_all_that_happened(tmp_path) -> None:
    path = tmp_path / "whole.mcap"
    grasps = record(path)
    assert path.stat().st_size < 38_000
    recording = read_recording(path)
    assert same_grasps(grasps, recording.grasps, atol=2e-9)
    back = recording_grasps(path)
    assert len(back) == len(grasps) == sum(grasp.pads is back[0].pads for grasp in back)
    assert recording.complete
    assert (recording.lost_reason, len(recording.frames)) == ("", 60)
    assert recording.frames.number.tolist() == list(range(60))
    assert (recording.frames.counts.shape, len(recording.cycles)) == ((60, 24), 240)
    assert recording.cycles.phase[0] == "RAMPING"
    np.testing.assert_allclose(recording.cycles.force_n[0], [3.9, 4.1])
    np.testing.assert_allclose(recording.cycles.t_s[:3], [100.0, 100.005, 100.01], atol=1e-9)
    assert [pose["rotation_rad"] for pose in recording.poses] == [0.3] * 3
    assert recording.events[0] == {"t_s": 100.0, "kind": "state", "text": "EXECUTE"}
    shape = recording.results[0]["shape"]
    assert (shape["kind"], shape["probability"], shape["n_grasps"]) == ("flat", 0.75, 3)
    assert (shape["size_m"], shape["low_m"], shape["high_m"]) == (0.0159, 0.0155, 0.0163)
    assert [t["size_m"] for t in shape["thicknesses"]] == [0.01, 0.0159]
    assert shape["dimensions_m"] == {"height": 0.0159}
    assert recording.results[0]["grasp_shapes"] == [shape, {}]
    assert recording.states == (
        {
            "t_s": 100.0,
            "state": "HELD",
            "state_number": 11,
            "grasp": "NO PART FOUND",
            "grasp_number": 2,
            "wall_ns": 1_700 * 10**9,
        },
    )
    assert (recording.metadata["config"], recording.wall_clock_start_ns) == ("abc", 1_700 * 10**9)
    assert recording.metadata["monotonic_start_ns"] == str(100 * 10**9)
    assert recording.pads.same_as(PADS)
    assert not recording.cycles.force_n.flags.writeable


def test_foreign_reader_finds_schemas_that_each_message_fits(three) -> None:
    """They have plain types only, so that viewers plot them."""
    validators: dict[str, jsonschema.Draft202012Validator] = {}
    with three.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data)
            if channel.topic not in validators:
                described = json.loads(schema.data)
                jsonschema.Draft202012Validator.check_schema(described)
                assert b"$ref" not in schema.data
                for field in described["properties"].values():
                    assert isinstance(field["type"], str)
                    assert field["description"]
                validators[channel.topic] = jsonschema.Draft202012Validator(described)
            validators[channel.topic].validate(content)
            assert message.log_time == round(content["t_s"] * 1e9)
    assert set(validators) == set(recording_schema.MODELS)


def test_further_samples_of_the_taxels_come_back(three, tmp_path) -> None:
    shear = np.arange(96, dtype=np.uint16).reshape(2, 24, 2)
    with closing(Recorder(tmp_path / "shear.mcap", Clock(100.0), pads=PADS)) as recorder:
        for number in (0, 1):
            frame = make_frame(0.02 * number, np.random.default_rng(number))
            recorder.frame(replace(frame, extra=shear[number]))
    np.testing.assert_array_equal(read_recording(tmp_path / "shear.mcap").frames.extra, shear)
    frames = read_recording(three).frames
    assert frames.extra.shape == (len(frames), 24, 0)


def test_unknown_values_are_left_out(tmp_path) -> None:
    nan = float("nan")
    with closing(Recorder(tmp_path / "r.mcap", Clock(100.0), pads=PADS)) as recorder:
        recorder.cycle(make_cycle(1.0, force=None, setpoint_n=nan))
        recorder.cycle(
            make_cycle(
                1.1,
                force=ForceSample(t_s=1.0, force_n=(nan, 1.0), valid=False),
                state=make_state(1.1, aperture_m=nan, servos=(make_servo(angle_rad=nan),)),
            )
        )
    first, second = (row.content for row in RecordedMessages(tmp_path / "r.mcap"))
    assert not {"force_n", "force_valid", "setpoint_n"} & set(first)
    assert first["servos"][0]["angle_rad"] == 0.123456789
    assert second["force_valid"] is False
    assert not {"force_n", "aperture_m"} & set(second)
    assert "angle_rad" not in second["servos"][0]
    assert second["servos"][0]["voltage_v"] == 12.1
    cycles = read_recording(tmp_path / "r.mcap").cycles
    assert np.isnan(cycles.setpoint_n[0])
    assert np.all(np.isnan(cycles.force_n))


def fill_disk_after(
    monkeypatch: pytest.MonkeyPatch, n_bytes: int, *, reported: bool = True
) -> list[int]:
    """Let the disk take ``n_bytes``, half of the write that goes beyond, then nothing.

    Returns the bytes that are left, for a test to change. Where they are not ``reported``, the disk
    looks empty, as with a quota.
    """
    room, write = [n_bytes], os.write

    def limited(handle: int, data: Any) -> int:
        if room[0] <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken = data[: max(1, room[0])]
        room[0] -= len(taken)
        return write(handle, taken)

    def free(_place: object) -> SimpleNamespace:
        return SimpleNamespace(f_bavail=room[0] if reported else 1 << 40, f_frsize=1)

    monkeypatch.setattr(recorder_sink.os, "write", limited)
    monkeypatch.setattr(recorder_sink.os, "statvfs", free)
    return room


def ended(recorder: Recorder) -> None:
    """Wait until a recording has stopped, and its thread has ended."""
    until(lambda: recorder.check() or recorder.fault)
    thread = recorder._sink._thread
    thread.join(10.0)
    assert not thread.is_alive()


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("room", [0, 100, 9_000, 25_000, 29_000])
def test_a_full_disk_leaves_what_was_whole_before(room, background, tmp_path, monkeypatch) -> None:
    clock, path, notes = Clock(100.0), tmp_path / "r.mcap", list[str]()
    fill_disk_after(monkeypatch, room, reported=False)
    recorder = Recorder(path, clock, pads=PADS, background=background, note=notes.append)
    grasps = [record_grasp(recorder, clock, f"{i}") for i in range(12)]
    with pytest.raises(RecordingError, match=r"No space left.*free space") as caught:
        recorder.close()
    assert recorder.fault is caught.value
    assert notes == [str(caught.value)]
    recorder.close()
    assert path.stat().st_size == recorder._sink._length  # no half record
    if room <= 100:
        with pytest.raises(RecordingError, match=r"metadata are missing|not an MCAP file"):
            read_recording(path)
        return
    recording = read_recording(path)
    assert not recording.complete
    assert same_grasps(grasps[: len(recording.grasps)], recording.grasps, atol=2e-9)
    assert bool(recording.grasps) == (room > 9_000)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("reported", [False, True])
def test_a_recording_begins_again_when_its_disk_has_room(
    *, reported, background, tmp_path, monkeypatch
) -> None:
    clock, path, notes = Clock(100.0), tmp_path / "r.mcap", list[str]()
    room = fill_disk_after(monkeypatch, 25_000 + reported * LEFT_BYTES, reported=reported)
    recorder = Recorder(path, clock, pads=PADS, background=background, note=notes.append)
    (tmp_path / "r-2.mcap").touch()  # somebody else's
    assert not recorder.begin()
    for _ in range(1000):
        record_grasp(recorder, clock, "before")
        recorder.check()
        if recorder.fault is not None:
            break
    ended(recorder)
    why = str(recorder.fault)
    recorder.frame(make_frame(clock.now_s + 0.02, np.random.default_rng(0)))
    room[0] = ROOM_BYTES - 1 if reported else 0
    recorder.begin()
    if not reported:
        ended(recorder)  # the new file cannot be written either
    assert recorder.fault is not None
    room[0] = 2 * ROOM_BYTES
    assert recorder.begin()
    assert (recorder.fault, recorder.path) == (None, tmp_path / "r-3.mcap")
    with pytest.raises(ValueError, match="0 frames are recorded"):  # the others are in r.mcap
        recorder.grasp(Grasp(pads=PADS, counts=np.zeros((1, 24)), t_s=[0.0]))
    first = record_grasp(recorder, clock, "after")
    recorder.close()
    assert notes[0] == why
    if reported:
        old = read_recording(path)
        assert (old.complete, len(old.grasps) > 2) == (True, True)
        assert (old.events[-1]["kind"], old.events[-1]["text"]) == ("note", why)
        assert f"stopped after {len(old.frames)} frames: the disk is nearly full" in why
    new = read_recording(recorder.path)
    assert new.complete
    assert new.frames.number.tolist() == list(range(20))
    assert same_grasps([first], new.grasps, atol=2e-9)
    note = new.events[0]
    assert (note["kind"], note["text"]) == ("note", notes[-1])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r-2.mcap", "r-3.mcap", "r.mcap"]


@pytest.mark.parametrize("background", [False, True])
def test_a_long_recording_continues_in_a_new_file_and_loses_nothing(
    background, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(recorder_module, "LONG_BYTES", 20_000)
    clock = Clock(100.0)
    with closing(Recorder(tmp_path / "r.mcap", clock, pads=PADS, background=background)) as new:
        journal = Journal(new)
        for number in range(30):
            journal.begin()
            journal.states(CellState.EXECUTE, GraspState.IDLE)
            record_grasp(new, clock, f"{number}")
            until(lambda: not new._sink.busy)  # the disk has taken it
    n_files = len(list(tmp_path.iterdir()))
    assert n_files >= 3
    paths = [tmp_path / "r.mcap", *(tmp_path / f"r-{n}.mcap" for n in range(2, n_files + 1))]
    read = [read_recording(path) for path in paths]
    assert all(one.complete and not one.n_broken_grasps for one in read)
    grasps = [grasp.label for one in read for grasp in one.grasps]
    assert grasps == [f"{number}" for number in range(30)]
    assert all(one.states[0]["state"] == "EXECUTE" for one in read)


@pytest.fixture
def go_on(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Let the disk take nothing until the event."""
    event, write = threading.Event(), RecordingSink._write_whole
    waits = lambda file, data: event.wait(20.0) and write(file, data)  # noqa: E731
    monkeypatch.setattr(RecordingSink, "_write_whole", waits)
    return event


def test_a_blocked_disk_holds_up_no_beginning(tmp_path, monkeypatch, go_on) -> None:
    monkeypatch.setattr(recorder_module, "LONG_BYTES", 0)
    recorder = Recorder(tmp_path / "r.mcap", Clock(100.0), pads=PADS, background=True)
    with monkeypatch.context() as patched:
        patched.setattr(recorder_sink.os, "statvfs", raising(AssertionError("it would block")))
        assert not recorder.begin()
    go_on.set()
    recorder.close()


def test_a_removed_recording_is_noticed_and_the_next_job_records_again(tmp_path) -> None:
    clock, folder = Clock(100.0), tmp_path / "run"
    folder.mkdir()
    recorder = Recorder(folder / "r.mcap", clock, pads=PADS)
    shutil.rmtree(folder)
    while recorder.fault is None:
        record_grasp(recorder, clock, "lost")
    ended(recorder)
    assert "removed while it was written" in str(recorder.fault)
    assert recorder.begin()
    recorder.close()
    assert read_recording(folder / "r.mcap").complete


FAILURES: list[tuple[Any, str, Exception]] = [
    (recorder_sink.os, "fsync", OSError(errno.EIO, "Input/output error")),
    (RecordingSink, "_write_whole", RuntimeError("bug")),
]


@pytest.mark.parametrize(
    ("owner", "name", "error", "background"),
    [(*failure, background) for failure in FAILURES for background in (False, True)],
)
def test_a_disk_that_fails_at_the_end_or_in_the_thread_is_a_fault(
    tmp_path, monkeypatch, *, owner, name, error, background
) -> None:
    monkeypatch.setattr(owner, name, raising(error))
    recorder = Recorder(tmp_path / "r.mcap", Clock(100.0), pads=PADS, background=background)
    with pytest.raises(RecordingError, match=str(error.args[-1])):
        recorder.close()


def test_recorder_refuses_what_is_not_in_order(tmp_path) -> None:
    clock = Clock(100.0)
    with pytest.raises(RecordingError, match="check folder"):
        Recorder(tmp_path / "no" / "r.mcap", clock, pads=PADS)
    recorder = Recorder(tmp_path / "r.mcap", clock, pads=PADS)
    with pytest.raises(RecordingError, match="never overwritten"):
        Recorder(tmp_path / "r.mcap", clock, pads=PADS)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="0 frames are recorded, the grasp has 1"):
        recorder.grasp(Grasp(pads=PADS, counts=np.zeros((1, 24)), t_s=[0.0]))
    with pytest.raises(ValueError, match="the pads have 24"):
        recorder.frame(make_frame(1.0, rng, n_taxels=23))
    recorder.frame(make_frame(1.0, rng))
    with pytest.raises(ValueError, match="1 frames are recorded, the grasp has 1 others"):
        recorder.grasp(Grasp(pads=PADS, counts=np.zeros((1, 24)), t_s=[0.0]))
    for t_s in (float("nan"), -1.0):
        with pytest.raises(ValueError, match="not a monotonic time"):
            recorder.cycle(make_cycle(t_s))
    recorder.close()
    with pytest.raises(RecordingError, match="is closed"):
        recorder.now(recording_schema.EVENT, {})


def test_slow_disk_is_an_error_not_a_delay(tmp_path, go_on, monkeypatch) -> None:
    monkeypatch.setattr(recorder_sink, "MAX_WAITING_BYTES", 100)
    monkeypatch.setattr(recorder_sink, "CLOSE_TIMEOUT_S", 0.0)
    for sizes, says in (((60, 60), "too slow: 60 bytes wait"), ((60,), r"within 0.0 s")):
        file = RecordingSink(tmp_path / says, background=True)
        for size in sizes:
            file.write(bytes(size))
        file.close()
        assert says in str(file.error)
        assert file.tell() == 60
    go_on.set()


# -- Messages: each legal file is read, what does not fit is left out and named --------------------


GOOD = {
    "format": str(RECORDING),
    "pads": json.dumps(
        {"pad_shape": [[1, 1]], "taxel_pad": [0], "taxel_xy_m": [[0, 0]], "adc_max": 9}
    ),
    "wall_clock_start_ns": "1",
    "monotonic_start_ns": "1",
}


def foreign(path: Path, *contents: bytes, metadata: dict[str, str] | None = GOOD) -> Path:
    """Write frames under a description, as another program might."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 30, compression=CompressionType.ZSTD)
        writer.start()
        if metadata is not None:
            metadata = metadata | {"crc32": recording_schema.metadata_crc32(metadata)}
            writer.add_metadata(recording_schema.METADATA, metadata)
        channel = writer.register_channel(recording_schema.FRAME, "json", 0)
        other = writer.register_channel("/tf", "protobuf", 0)
        for content in contents:
            writer.add_message(channel, 1, content, 1)
        writer.add_message(other, 1, b"\x00\x01", 1)
        writer.finish()
    return path


def frame_json(**changed: str) -> bytes:
    """Return a frame for the pads of `GOOD`, with other JSON in some of its fields."""
    fields = {"t_s": "1", "number": "0", "counter": "0", "status": "0", "counts": "[1]"} | changed
    return ("{" + ",".join(f'"{name}":{value}' for name, value in fields.items()) + "}").encode()


@pytest.mark.parametrize(
    ("metadata", "says"),
    [(None, "metadata are missing"), (GOOD | {"pads": "[" * 100_000}, "does not fit")],
)
def test_other_files_are_refused_before_a_message_is_read(
    metadata: dict[str, str] | None, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "text").write_text("hello")
    monkeypatch.setattr(recording_reader, "breakup_chunk", raising(AssertionError("unpacked")))
    for name, why in (
        (foreign(tmp_path / "f.mcap", metadata=metadata), says),
        ("none", "check the path"),
        (".", "plain file"),
        ("text", "not a recording of this program: its metadata"),
    ):
        with pytest.raises(RecordingError, match=why):
            read_recording(tmp_path / name)
    monkeypatch.setattr(recording_reader, "MAX_FILE_BYTES", 4)
    with pytest.raises(RecordingError, match="at most 4 bytes"):
        read_recording(tmp_path / "text")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"{", "EOF while parsing"),
        (b"[1]", "it is [1]: Input should be an object"),
        (b"{}", "t_s: Field required"),
        (frame_json(counts="[1,2]"), "2 counts up to 2, expected 1 up to 9"),
        (frame_json(counts="[1.5]"), "counts.0 is 1.5: Input should be a valid integer"),
        (frame_json(extra="[-1]"), "extra.0 is -1: Input should be greater than or"),
        (frame_json(extra="[1]"), "it has 1 further samples of 1 taxels"),
        (frame_json(number="9223372036854775808"), "number is 9223372036854775808: Input should"),
        (frame_json(t_s="NaN"), "t_s is nan: Input should be a finite number"),
        (frame_json(t_s="1e308"), "t_s is 1e+308: Input should be less than or equal to"),
    ],
)
def test_a_message_that_does_not_fit_is_left_out_named_and_not_recovered(
    content: bytes, says: str, tmp_path: Path
) -> None:
    path = foreign(tmp_path / "f.mcap", frame_json(), content, frame_json(number="1"))
    recording = read_recording(path)
    assert recording.lost_reason.startswith("message 2 of /tactile/frame is left out: ")
    assert says in recording.lost_reason
    assert recording.frames.number.tolist() == [0, 1]
    recover_recording(path, tmp_path / "new.mcap")
    whole = read_recording(tmp_path / "new.mcap")
    assert (whole.complete, whole.frames.number.tolist()) == (True, [0, 1])


def chunk_of(compression: bytes, packed: bytes, size: int) -> bytes:
    """Return a chunk without a checksum that states the size of its content."""
    head = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
    return struct.pack("<BQ", 6, len(head) + 8 + len(packed)) + head + prefixed(packed)


def prefixed(data: bytes) -> bytes:
    return struct.pack("<Q", len(data)) + data


@pytest.mark.parametrize(
    ("chunk", "says"),
    [
        (chunk_of(b"zstd", zstandard.compress(bytes(1 << 26)), 9), "states 9 bytes, and unpacks"),
        (chunk_of(b"lz4", lz4.frame.compress(bytes(1 << 26)), 9), "states 9 bytes, and unpacks"),
        (chunk_of(b"", bytes(9), 9), "it has a record of the type 0"),
        (chunk_of(b"", b"\x05" + prefixed(b"")[:7], 8), "unpack_from requires a buffer"),
        (chunk_of(b"", b"", 1 << 40), "it unpacks to more than"),
    ],
)
def test_a_chunk_that_is_larger_than_it_states_is_left_out(three, tmp_path, chunk, says) -> None:
    content = three.read_bytes()
    before_end = content.rindex(struct.pack("<BQ", 15, 4))
    path = tmp_path / "r.mcap"
    path.write_bytes(content[:before_end] + chunk + content[before_end:])
    recording = read_recording(path)
    assert recording.lost_reason.startswith("a chunk is left out: ")
    assert says in recording.lost_reason
    assert len(recording.grasps) == 3


def test_grasps_cannot_share_frames(tmp_path: Path) -> None:
    """A grasp of a few bytes would copy all frames, and the next one again."""
    clock = Clock(now_s=1.0)
    with closing(Recorder(tmp_path / "r.mcap", clock, pads=PADS)) as recorder:
        grasp = record_grasp(recorder, clock, "ball")
        recorder.grasp(replace(grasp, label="box"))
    recording = read_recording(tmp_path / "r.mcap")
    assert [grasp.label for grasp in recording.grasps] == ["ball"]
    assert "grasp 2 is left out: its frames belong to other grasps" in recording.lost_reason


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"force_n": [math.nan] * 20}, "force_n.0 is nan: Input should be a finite number"),
        ({"n_frames": 0}, "frames of it are missing"),
        ({"aperture_m": [30.0] * 20}, "aperture_m.0 is 30.0: Input should be less"),
        ({"force_n": [1e9] * 20}, "force_n.0 is 1000000000.0: Input should"),
        ({"start_ms": 10**18}, "start_ms is 1000000000000000000: Input"),
        ({"label": "UNKNOWN"}, "label is UNKNOWN, the answer for"),
        ({"label": "\x1b[2J"}, "not printable"),
        ({"source": "x" * 201}, "source is 'xxxx"),
    ],
)
def test_a_grasp_with_values_that_none_has_is_left_out_and_named(
    change: dict[str, Any], says: str, three: Path, tmp_path: Path
) -> None:
    path = written_again(three, tmp_path / "r.mcap", change=change)
    recording = read_recording(path)
    assert (recording.grasps, len(recording.frames)) == ((), 60)
    assert says in recording.lost_reason
    with pytest.raises(RecordingError, match="not complete"):
        recording_grasps(path)
    recover_recording(path, tmp_path / "new.mcap")
    assert read_recording(tmp_path / "new.mcap").grasps == ()


def written_again(
    source: Path,
    path: Path,
    *,
    leave_out: Callable[[str, int], bool] = lambda _topic, _number: False,
    described_last: bool = True,
    change: Mapping[str, Any] | None = None,
    **how: Any,
) -> Path:
    """Write a recording again, without some messages of a topic, or with other values of grasps.

    Its description is at the end, as `mcap sort` writes it, or at the start.
    """
    numbers = Counter[str]()
    with source.open("rb") as old, path.open("wb") as new:
        writer = Writer(new, **how)
        writer.start()
        channels: dict[int, int] = {}
        reader = make_reader(old)
        described = list(reader.iter_metadata())
        for metadata in [] if described_last else described:
            writer.add_metadata(metadata.name, metadata.metadata)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "json", number)
            numbers[channel.topic] += 1
            if not leave_out(channel.topic, numbers[channel.topic]):
                data = message.data
                if change is not None and channel.topic == recording_schema.GRASP:
                    data = json.dumps(json.loads(data) | change).encode()  # NaN, too
                times = message.log_time, data, message.publish_time
                writer.add_message(channels[channel.id], *times, sequence=message.sequence)
        for metadata in described if described_last else []:
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "how",
    [
        {"use_chunking": False},
        {"use_chunking": False, "use_statistics": False, "index_types": IndexType.NONE},
        *({"compression": kind} for kind in CompressionType),
        {"chunk_size": 8 << 20, "enable_data_crcs": True},
    ],
    ids=str,
)
def test_each_legal_file_is_read_and_recovered_whole(how, three, tmp_path) -> None:
    before, again = read_recording(three), written_again(three, tmp_path / "a.mcap", **how)
    after = read_recording(again)
    assert (after.complete, after.lost_reason) == (True, "")
    assert len(after.frames) == len(before.frames) == 60
    assert len(after.cycles) == len(before.cycles)
    assert (after.results, after.events) == (before.results, before.events)
    assert same_grasps(before.grasps, after.grasps)
    assert len(after.grasps) == 3
    recover_recording(again, tmp_path / "new.mcap")
    new_recording = read_recording(tmp_path / "new.mcap")
    assert same_grasps(before.grasps, new_recording.grasps)
    assert (new_recording.complete, RECOVERED in new_recording.metadata) == (True, False)


def test_a_damaged_file_without_chunks_is_not_complete(three: Path, tmp_path: Path) -> None:
    how = {"use_chunking": False, "enable_data_crcs": True}
    again = written_again(three, tmp_path / "a.mcap", described_last=False, **how)
    data = again.read_bytes()
    again.write_bytes(data[: len(data) // 2])
    cut = read_recording(again)
    assert not cut.complete
    assert 0 < len(cut.frames) < 60
    at = data.index(b'"RAMPING"')
    again.write_bytes(data[:at] + b'"RAMPENG"' + data[at + 9 :])
    assert "crc validation failed in DataEnd" in read_recording(again).lost_reason


@pytest.mark.parametrize(
    ("frames", "says", "n_grasps"),
    [
        ((45,), "grasp 3 is left out: frames of it are missing", 2),
        (tuple(range(41, 61)), "grasp 3 is left out: frames of it are missing", 2),
        ((1, 2), "grasp 1 is left out: frames of it are missing", 2),
        ((30,), "its 59 frames are not all that were recorded", 0),
    ],
)
def test_a_recording_that_lacks_frames_is_not_complete(
    frames: tuple[int, ...], says: str, n_grasps: int, three: Path, tmp_path: Path
) -> None:
    def leave_out(topic: str, number: int) -> bool:
        return (topic == recording_schema.FRAME and number in frames) or (
            topic == recording_schema.GRASP and not n_grasps
        )

    again = written_again(three, tmp_path / "a.mcap", leave_out=leave_out)
    recording = read_recording(again)
    assert says in recording.lost_reason
    assert not recording.complete
    assert (len(recording.grasps), recording.n_broken_grasps) == (n_grasps, bool(n_grasps))
    saved = rf"not complete: .* saves its {n_grasps} whole" if n_grasps else "not complete.*[^s]$"
    with pytest.raises(RecordingError, match=saved):
        recording_grasps(again)
    recover_recording(again, tmp_path / "new.mcap")
    whole = read_recording(tmp_path / "new.mcap")
    assert (whole.complete, len(whole.grasps)) == (True, n_grasps)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda data: data.replace(b"zstd", b"what"), "a chunk is left out"),
        (lambda data: data[: data.index(b"zstd")], "cut off"),
    ],
)
def test_a_file_of_which_nothing_can_be_read_is_not_recovered(spoil, says, three, tmp_path) -> None:
    path = written_again(three, tmp_path / "a.mcap", chunk_size=1 << 30, described_last=False)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(RecordingError, match=rf"nothing of .* can be recovered: .*{says}"):
        recover_recording(path, tmp_path / "new.mcap")
    assert list(tmp_path.iterdir()) == [path]


def test_the_command_says_what_is_lost_and_never_overwrites(three: Path, tmp_path: Path) -> None:
    data, path, report = three.read_bytes(), tmp_path / "r.mcap", tmp_path / "r.json"
    path.write_bytes(data[: 2 * len(data) // 5])
    done = CliRunner().invoke(app, ["recording", "recover", str(path), "--json", str(report)])
    assert done.exit_code == 0, done.output
    said: dict[str, Any] = json.loads(report.read_text())
    assert said["recording"] == str(tmp_path / "r-recovered.mcap")
    damaged, after = read_recording(path), read_recording(said["recording"])
    assert (damaged.complete, after.complete) == (False, True)
    assert said["lost_reason"] == damaged.lost_reason
    assert said["lost_reason"] in after.metadata[RECOVERED]
    assert 0 < len(after.grasps) == len(damaged.grasps) < 3
    assert same_grasps(damaged.grasps, after.grasps)
    with pytest.raises(RecordingError, match="never overwritten"):
        recover_recording(path, said["recording"])


# -- Retention: what goes by size and space, what stays, and that nothing stops the cell -----------


class Keeper(NamedTuple):
    """A recording in a folder of jobs, and its retention."""

    folder: Path
    notes: list[str]
    recorder: Recorder
    retention: Retention

    def job(self, number: int, n_bytes: int = 1000) -> Path:
        """Add the recording of an earlier job."""
        path = self.folder / f"sort-2027010{number}-080000" / "recording.mcap"
        path.parent.mkdir()
        path.write_bytes(bytes(n_bytes))
        os.utime(path, (number, number))
        return path


@pytest.fixture
def keep(tmp_path: Path) -> Iterator[Callable[..., Keeper]]:
    notes, folder = list[str](), tmp_path / "out"
    path = folder / "serve-20270115-080000" / "recording.mcap"
    path.parent.mkdir(parents=True)
    with closing(Recorder(path, Clock(100.0), pads=PADS, note=notes.append)) as recorder:
        yield lambda **limits: Keeper(
            folder, notes, recorder, Retention(recorder, folder, note=notes.append, **limits)
        )


def test_the_oldest_recordings_go_by_size_and_marked_ones_stay(keep) -> None:
    keeper = keep(keep_bytes=5000)
    first, second, marked, newest = (keeper.job(number) for number in range(1, 5))
    (link := marked.parent.parent / "newest.mcap").symlink_to(marked)
    mark(link)
    (first.parent / "report.html").touch()
    keeper.retention.enforce()
    assert all(path.exists() for path in (first, second, marked, newest))
    late = keeper.job(5, n_bytes=3000)
    keeper.retention.enforce()
    # Together more than 5000 bytes: the oldest go, each with its folder where nothing else is.
    assert [path.exists() for path in (first, second, marked, newest, late)] == [
        False, False, True, False, True,
    ]  # fmt: skip
    assert (first.parent.exists(), second.parent.exists()) == (True, False)
    (note,) = keeper.notes
    assert note.startswith("3 of the oldest recordings are deleted")
    assert "`tactile-cell recording mark FILE` keeps a recording" in note
    marked.with_name(f"{marked.name}.keep").unlink()
    keeper.job(6)
    keeper.retention.enforce()
    assert not marked.exists()
    assert late.exists()


def test_the_oldest_recordings_go_while_the_disk_is_short_of_space(keep, monkeypatch) -> None:
    keeper, disk = keep(), fill_disk_after(monkeypatch, 0)
    first, second, third = (keeper.job(number) for number in range(1, 4))
    disk[0] = LEAST_FREE_BYTES
    keeper.retention.enforce()
    assert first.exists()
    disk[0] = LEAST_FREE_BYTES - 1500
    keeper.retention.enforce()
    assert [path.exists() for path in (first, second, third)] == [False, False, True]
    assert (len(keeper.notes), keeper.retention.problem) == (1, "")
    mark(third)
    for _ in range(2):
        keeper.retention.enforce()
    assert keeper.notes[1:] == [keeper.retention.problem]
    assert "has less than 500 MB free, and no recording can be deleted" in keeper.notes[1]
    disk[0] = LEAST_FREE_BYTES
    keeper.retention.enforce()
    assert keeper.retention.problem == ""
    assert third.exists()


def test_the_recordings_that_programs_write_stay(keep, monkeypatch) -> None:
    keeper = keep(keep_bytes=1)
    path, own = keeper.job(1), keeper.recorder.path
    path.unlink()
    os.utime(own, (0, 0))
    with closing(Recorder(path, Clock(100.0), pads=PADS)):
        keeper.retention.enforce()
        assert path.exists()
    # Without locks only this program's recording is known to be open.
    monkeypatch.setattr(recorder_sink.fcntl, "flock", raising(OSError(errno.ENOLCK, "no locks")))
    keeper.retention.enforce()
    assert (path.exists(), own.exists()) == (False, True)


def test_only_recordings_in_folders_of_jobs_are_managed(keep) -> None:
    keeper = keep(keep_bytes=1)
    own = [keeper.folder / "mine" / "recording.mcap", keeper.job(1).with_name("other.mcap")]
    for path in own:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (keeper.folder / "run-20270101-000000").symlink_to(own[0].parent)
    keeper.retention.enforce()
    assert all(path.exists() for path in own)
    assert "marked take 0.0 GB, more than recording.keep_gb (1e-09)" in keeper.notes[1]
    for path in (keeper.folder, own[1]):
        with pytest.raises(RecordingError, match="is not a recording, or empty"):
            mark(path)
    path = keeper.job(2)
    with closing(Recorder(keeper.folder / "x.mcap", Clock(100.0), pads=PADS)) as outside:
        Retention(outside, keeper.folder, keep_bytes=1).enforce()
    assert path.exists()


def test_a_share_that_disappears_is_noted_once_and_stops_nothing(keep, monkeypatch) -> None:
    keeper = keep()
    with monkeypatch.context() as patched:
        for name in ("statvfs", "scandir"):
            patched.setattr(os, name, raising(OSError(116, "Stale file handle")))
        for _ in range(3):
            keeper.retention.enforce()
    assert len(keeper.notes) == 1
    assert "Stale file handle" in keeper.notes[0]
    keeper.retention.enforce()
    assert keeper.retention.problem == ""


def test_a_disk_that_does_not_answer_holds_up_neither_start_nor_end(keep, monkeypatch) -> None:
    keeper, answers = keep(), threading.Event()
    monkeypatch.setattr(retention, "_CLOSE_TIMEOUT_S", 0.0)
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: answers.wait(10.0) or 0)
    keeper.retention.start()
    keeper.retention.close()
    assert keeper.retention._thread.is_alive()
    answers.set()
    keeper.retention._thread.join(10.0)
    assert not keeper.retention._thread.is_alive()


# -- Data sets: what is written comes back, and what is damaged or hostile is refused --------------


GRASP_PADS = make_pads(((3, 2), (2, 2)), pitch_m=6.5e-3, adc_max=255)
ZERO = SelfZero.from_values([1e-3, 1e-4, 0.1, 0.02, 8.0, 0.2])


def make_grasp(
    seed: int = 0, n_frames: int = 4, pads: PadArray = GRASP_PADS, **changes: Any
) -> Grasp:
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "pads": pads,
        "counts": rng.integers(0, pads.adc_max + 1, (n_frames, pads.n_taxels)),
        "t_s": np.arange(n_frames) / 32,
        "aperture_m": np.linspace(0.03, 0.01, n_frames),
        "force_n": np.linspace(0.0, 8.0, n_frames),
        "label": "ball",
        "shape": "sphere",
        "source": "test",
        "start_ms": 1_700_000_000_000 + seed,
    }
    return Grasp(**(values | changes))


def arrays_of(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "good.npz"
    write_dataset(path, [make_grasp(0), make_grasp(1, 2), make_grasp(2, 7, label="box")])
    return path


def test_what_is_written_comes_back(tmp_path) -> None:
    grasps = [
        make_grasp(0),
        make_grasp(1, 1, label="", shape="", source="", force_n=np.array([np.nan])),
        make_grasp(2, 9, aperture_m=np.full(9, np.nan), label="Müller's <b>Kugel</b>"),
        make_grasp(3, thickness_m=4e-3, series="apple 2"),
        make_grasp(4, command=GraspCommand.from_values([1e-3, -2e-3, 0.5, 6.0, 4.0])),
        *(make_grasp(i, zero=ZERO) for i in (5, 6)),
    ]
    write_dataset(tmp_path / "d.npz", grasps)
    back = read_dataset(tmp_path / "d.npz")
    assert len(back) == 7
    assert back[5].zero is back[6].zero
    assert all(grasp.pads is back[0].pads for grasp in back)
    assert back[0].pads.same_as(GRASP_PADS)
    for was, now in zip(grasps, back, strict=True):
        np.testing.assert_array_equal(now.counts, was.counts)
        for name in ("t_s", "aperture_m", "force_n", "thickness_m"):
            np.testing.assert_allclose(getattr(now, name), getattr(was, name), rtol=1e-6)
        for name in ("label", "shape", "source", "series", "start_ms", "command", "zero"):
            assert getattr(now, name) == getattr(was, name)


def test_file_is_the_documented_format_for_numpy_alone(good) -> None:
    arrays = arrays_of(good)
    assert (str(arrays["format"]), arrays["counts"].dtype) == ("grasp-dataset/1", np.uint16)
    assert (arrays["counts"].shape, arrays["grasp_offsets"].tolist()) == ((13, 10), [0, 4, 6, 13])
    assert {arrays[name].dtype.name for name in ("aperture_mm", "force_n", "t_s")} == {"float32"}
    assert arrays["aperture_mm"][0] == pytest.approx(30.0)
    with zipfile.ZipFile(good) as archive:
        assert {m.compress_type for m in archive.infolist()} == {zipfile.ZIP_DEFLATED}


def test_optional_arrays_are_left_out_where_nothing_is_known(tmp_path) -> None:
    blank = make_grasp(shape="", source="", force_n=np.full(4, np.nan))
    write_dataset(tmp_path / "d.npz", [blank])
    optional = {"force_n", "shape", "source", "series", "thickness_mm", "pose", "self_zero"}
    assert not optional & set(arrays_of(tmp_path / "d.npz"))
    assert np.all(np.isnan(read_dataset(tmp_path / "d.npz")[0].force_n))


DAMAGE: list[tuple[str, Callable[[Any], Any], str]] = [
    ("counts", lambda _: None, "counts missing"),
    ("model", lambda _: "x", "is a model, not a data set"),
    ("force_N", lambda _: np.zeros(13), "unknown arrays 'force_N'"),
    ("counts", lambda a: a.astype(np.int32), "expected kind u"),
    ("counts", np.ravel, "shape"),
    ("adc_max", lambda _: 100, "adc_max = 100"),
    ("taxel_pad", lambda a: a + 1, "names other pads"),
    ("pad_shape", lambda a: a * 0, "rows and columns of a pad"),
    ("taxel_xy_mm", lambda a: a * np.nan, "not finite"),
    ("taxel_xy_mm", lambda a: a * 1e-3, r"the 6 taxels of pad 0 over 0\.013, .* in mm, not in m"),
    ("taxel_xy_mm", lambda a: a * 1e3, "-6500 at 0, must be from -1000 to 1000: places of .* mm"),
    ("aperture_mm", lambda a: a + np.inf, "is inf at 0, must be from"),
    (
        "aperture_mm",
        lambda a: a * 1e-3,
        r"largest aperture_mm is 0\.03, expected 0\.2 .* in mm, not in m",
    ),
    ("aperture_mm", lambda a: -10.0 * a, "aperture_mm is -300 at 0, must be from -100 to 1000"),
    ("t_s", np.negative, "never fall"),
    ("t_s", lambda a: a + 1, "start at 0"),
    ("t_s", lambda a: a * 1e3, r"a frame each 31\.25 s in the mean of grasp 0, .* in s"),
    ("start_ms", lambda _: np.full(3, np.iinfo(np.int64).max), "in ms since 1970"),
    ("start_ms", lambda _: np.full(3, 2**64 - 1, dtype=np.uint64), "in ms since 1970"),
    ("grasp_offsets", lambda a: a + 1, "rise from 0 to the 13"),
    ("grasp_offsets", lambda _: [0, 4, 4, 13], "which rise"),
    ("label", lambda _: ["\x1b[2J"] * 3, "not printable"),
    ("label", lambda _: ["", "b", "UNKNOWN"], "leave it empty"),
    ("label", lambda _: ["x" * 300] * 3, "longer than 200"),
    ("label", lambda _: np.full(3, 0x7FFFFFFF, dtype="<u4").view("<U1"), "not a character"),
    ("pose", lambda _: np.where(np.eye(3, 5), np.nan, 0.1), "must be finite"),
    ("pose", lambda _: np.full((3, 5), 2.0), "pose is 2 at 0, .* offsets in m"),
]
"""Array, what becomes of it (None: it is missing), and the complaint."""


@pytest.mark.parametrize(("name", "change", "says"), DAMAGE, ids=[f"{n}:{t}" for n, _, t in DAMAGE])
def test_damage_is_refused_naming_file_and_array(name, change, says, good, tmp_path) -> None:
    arrays = arrays_of(good)
    arrays[name] = change(arrays.get(name))
    if name == "model":  # which has no counts
        del arrays["counts"]
    np.savez(tmp_path / "bad.npz", **{n: a for n, a in arrays.items() if a is not None})
    with pytest.raises(DatasetError, match=says) as caught:
        read_dataset(tmp_path / "bad.npz")
    assert "bad.npz" in str(caught.value)


def npy(header: bytes) -> bytes:
    return b"\x93NUMPY\2\0" + len(header).to_bytes(4, "little") + header


LIE = npy(b"{'descr': '<u2', 'fortran_order': False, 'shape': (99999999999, 99), }") + bytes(64)
VALUE = npy(b"{'descr': '<u2', 'fortran_order': False, 'shape': (1,), }") + bytes(2)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"a.txt": b"x"}, r"array a\.txt: .* expected 8 bytes got 1"),
        ({"a.npy": b""}, "array a: EOF"),
        ({"a.npy": b"PK\5\6" + bytes(18)}, "array a: the magic string is not correct"),
        ({"a.npy": npy(b" " * 20_000)}, "array a: Header"),
        ({"counts.npy": LIE}, "array counts: (Unable to allocate|EOF)"),
        ({"a": VALUE, "a.npy": VALUE}, "its directory counts 2 arrays, 1 are there"),
        ({"a": VALUE + b"x"}, r"array a: shape \(1,\) does not fit"),
        (
            {f"a{i}.npy": bytes(5_000_000) for i in range(4)},
            "unpacks to 20000000 bytes, the limit is 10000000",
        ),
        (
            b"label: ball\n",
            "is not a grasp data set: it is not an npz archive; name a grasp data set",
        ),
        (b"", "is not a grasp data set: it is empty; name"),
        (b"PK\x03\x04", "is a damaged grasp data set .*; take another copy"),
        (b"\x89MCAP0\r\n" + bytes(100), r"is a recording, not a grasp data set; .* in \.mcap"),
    ],
)
def test_files_of_something_else_or_beyond_a_limit_are_refused(content, says, tmp_path) -> None:
    """An archive of these members, or a file of these bytes."""
    if isinstance(content, bytes):
        (tmp_path / "x.npz").write_bytes(content)
    else:
        with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in content.items():
                archive.writestr(name, data)
    with pytest.raises(DatasetError, match=says):
        read_dataset(tmp_path / "x.npz", limit_bytes=10_000_000)


def test_what_could_not_be_read_again_is_not_written(tmp_path, monkeypatch) -> None:
    other = replace(GRASP_PADS, adc_max=256)
    monkeypatch.setattr("cell.recording.dataset.DATASET_LIMIT_BYTES", 9_000)
    for grasps, says in (
        ([], "no grasp"),
        ([make_grasp(), make_grasp(pads=other)], "grasp 1 was taken on other pads"),
        ([make_grasp(label="a\0")], "label is .*not printable"),
        ([make_grasp()] * 99, "it would unpack to .* bytes, the limit is 9000; .* another file"),
        (
            [make_grasp(), make_grasp(start_ms=2 * 10**15)],
            r"cannot write .* start_ms is 2e\+15 at 1, must be",
        ),
    ):
        with pytest.raises(DatasetError, match=says):
            write_dataset(tmp_path / "d.npz", grasps)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "says"),
    [(errno.ENOSPC, "no space left"), (errno.EROFS, "not writable"), (errno.EIO, "Input/output")],
)
def test_full_disk_leaves_the_old_file(number, says, good, tmp_path, monkeypatch) -> None:
    path = tmp_path / "d.npz"
    path.write_bytes(good.read_bytes())
    path.chmod(0o640)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", raising(OSError(number, os.strerror(number))))
        with pytest.raises(DatasetError, match=f"{says}.*unchanged"):
            write_dataset(path, [make_grasp()])
    assert path.read_bytes() == good.read_bytes()
    assert list(tmp_path.iterdir()) == [path]
    write_dataset(path, [make_grasp()])
    assert (append_to_dataset(path, [make_grasp()]), len(read_dataset(path))) == (1, 2)
    assert path.stat().st_mode & 0o777 == 0o640


def test_programs_that_extend_one_data_set_wait_for_each_other(tmp_path) -> None:
    path = tmp_path / "d.npz"
    with ThreadPoolExecutor(4) as pool:
        before = pool.map(lambda _n: append_to_dataset(path, [make_grasp()]), range(12))
        assert sorted(before) == list(range(12))


def test_a_missing_folder_and_what_is_no_plain_file_are_refused(tmp_path) -> None:
    with pytest.raises(DatasetError, match="does not exist; make it first"):
        write_dataset(tmp_path / "nowhere" / "d.npz", [make_grasp()])
    with pytest.raises(DatasetError, match="not a plain file"):
        write_dataset(tmp_path, [make_grasp()])
    for path in (tmp_path, tmp_path / "x.npz"):
        with pytest.raises(DatasetError, match="check the path"):
            read_dataset(path)
    assert issubclass(DatasetError, CellError)


# -- Files of another version: each reader refuses them, with both versions and a next step --------


PROGRAM = f"tactile-cell {version('tactile-cell')}"


def text(path: Path, form: str) -> None:
    """Write a text, JSON or YAML, with a key that this version does not have."""
    path.write_text(json.dumps({"format": form, "colour": "blue"}) + "\n")


def arrays(path: Path, form: str) -> None:
    """Write an archive that begins as a data set, and as a model."""
    with path.open("wb") as file:
        np.savez(file, format=np.array(form), model=np.array(json.dumps({"format": form})))


def recording(path: Path, form: str) -> None:
    foreign(path, b"{}", metadata=GOOD | {"format": form})


def archive(path: Path, form: str) -> None:
    path.mkdir()
    text(path / "_archive.json", form)


def self_zero(path: Path) -> None:
    """Read a self-zero; a cell starts without the one that it cannot read."""
    raise CellError(SelfZeros(path=path).refused)


KINDS: list[tuple[Format, Callable[[Path, str], None], Callable[[Path], Any]]] = [
    (files.CONFIG, text, load_config),
    (files.DATASET, arrays, read_dataset),
    (files.MODEL, arrays, load_model),
    (files.RECORDING, recording, read_recording),
    (files.COMMISSIONING, text, read_commissioned),
    (files.SERVO_BACKUP, text, read_backup),
    (files.SERVO_BENCH, text, lambda path: measured_drive(path, XM430_W350)),
    (files.SELF_ZERO, text, self_zero),
    (files.ARCHIVE, archive, lambda path: Archive(str(path))),
]
"""A format, what writes a file of another one, and what reads the file."""


@pytest.mark.parametrize(("kind", "write", "read"), KINDS, ids=[str(k.what) for k, *_ in KINDS])
def test_a_file_of_another_version_is_refused(kind, write, read, tmp_path) -> None:
    name, number = kind.text.split("/")
    other, path = f"{name}/{int(number) + 1}", tmp_path / "backup-servo1.json"
    write(path, other)
    with pytest.raises(CellError) as refused:
        read(path)
    said = str(refused.value)
    assert f"{path}: its format is '{other}', but {PROGRAM} reads {kind}; {kind.remedy}" in said
    assert len([kind for kind in vars(files).values() if isinstance(kind, Format)]) == len(KINDS)
