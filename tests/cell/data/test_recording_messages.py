"""Messages of a recording: what does not fit is left out and named, at a cost that has limits."""

import json
import math
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from cell.data import (
    recorder as recorder_module,
    recording_messages,
    recording_schema,
    recording_values,
)
from cell.data.formats import RECORDING
from cell.data.recorder import Recorder
from cell.data.recording_reader import read_recording, recording_grasps
from cell.data.recording_recovery import recover_recording
from cell.data.recording_values import grasp_values
from cell.errors import RecordingError
from tests.cell.data.test_recording import PADS, record_grasp
from tests.fuzz.harness import Clock
from tests.values import raising

GOOD = {
    "format": str(RECORDING),
    "pads": json.dumps(
        {"pad_shape": [[1, 1]], "taxel_pad": [0], "taxel_xy_m": [[0, 0]], "adc_max": 9}
    ),
    "wall_clock_start_ns": "1",
    "monotonic_start_ns": "1",
}


def foreign(
    path: Path,
    *contents: bytes,
    metadata: dict[str, str] | None = GOOD,
    topic: str = "/tactile/frame",
) -> Path:
    """Write messages of a topic under a description, as another program might."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 30, compression=CompressionType.ZSTD)
        writer.start()
        if metadata is not None:
            metadata = metadata | {"crc32": recording_schema.metadata_crc32(metadata)}
            writer.add_metadata(recording_schema.METADATA, metadata)
        channel = writer.register_channel(topic, "json", 0)
        other = writer.register_channel("/tf", "protobuf", 0)
        for content in contents:
            writer.add_message(channel, 1, content, 1)
        writer.add_message(other, 1, b"\x00\x01", 1)
        writer.finish()
    return path


def bomb(path: Path, content: bytes, topic: str, chunk_bytes: int) -> Path:
    """Write 20 chunks of the same messages, which pack to next to nothing."""

    def record(code: int, data: bytes) -> bytes:
        return struct.pack("<BQ", code, len(data)) + data

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    begun = foreign(path).read_bytes()
    channel = record(0x04, struct.pack("<HH", 1, 0) + text(topic) + text("json") + bytes(4))
    message = record(0x05, struct.pack("<HIQQ", 1, 0, 0, 0) + content)
    plain = channel + max(1, chunk_bytes // len(message)) * message
    packed = zstandard.compress(plain, 19)
    chunks = (
        struct.pack("<QQQI", i, i, len(plain), zlib.crc32(plain))
        + text("zstd")
        + struct.pack("<Q", len(packed))
        + packed
        for i in range(20)
    )
    at = begun.index(b"tactile-cell-recording")
    end = begun.index(b"\x06", at)
    path.write_bytes(begun[:end] + b"".join(record(0x06, chunk) for chunk in chunks))
    return path


def frame_json(**changed: str) -> bytes:
    """Return a frame for the pads of `GOOD`, with other JSON in some of its fields."""
    fields = {"t_s": "1", "number": "0", "counter": "0", "status": "0", "counts": "[1]"} | changed
    return ("{" + ",".join(f'"{name}":{value}' for name, value in fields.items()) + "}").encode()


def counted(monkeypatch: pytest.MonkeyPatch, name: str) -> list[Any]:
    """Return the list to which each result of a function of `recording_messages` is added."""
    results: list[Any] = []
    work = getattr(recording_messages, name)

    def act(*arguments: Any) -> Any:
        results.append(work(*arguments))
        return results[-1]

    monkeypatch.setattr(recording_messages, name, act)
    return results


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        (None, "has no description"),
        ({"format": "other/1"}, "its format is 'other/1'"),
        (GOOD | {"pads": "[" * 100_000}, "does not fit"),
    ],
)
def test_other_mcap_files_are_refused_before_a_message_is_read(
    metadata: dict[str, str] | None, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_messages, "_decompress", raising(AssertionError("unpacked")))
    with pytest.raises(RecordingError, match=says):
        read_recording(foreign(tmp_path / "f.mcap", metadata=metadata))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"{", "EOF while parsing"),
        (b"[1]", "not an object"),
        (b"{}", "t_s is missing"),
        (frame_json(counts="[1,2]"), "2 counts up to 2, expected 1 up to 9"),
        (frame_json(counts="[10]"), "1 counts up to 10, expected 1 up to 9"),
        (frame_json(counts="[70000]"), "from 0 to 65535"),
        (frame_json(counts="[-1]"), "from 0 to 65535"),
        (frame_json(counts="[1.5]"), "from 0 to 65535"),
        (frame_json(extra="[-1]"), "from 0 to 65535"),
        (frame_json(extra="[1]"), "1 further samples, the frames before it have 0"),
        (frame_json(number="-1"), "number is -1, out of its range"),
        (frame_json(number="9223372036854775808"), "out of its range"),
        (frame_json(counter="true"), "counter is True, expected integer"),
        (frame_json(t_s='"soon"'), "t_s is 'soon', expected number"),
        (frame_json(t_s="NaN"), "t_s is nan, out of its range"),
        (frame_json(t_s="1e999"), "t_s is inf, out of its range"),
        (frame_json(t_s="1" + 400 * "0"), "out of its range"),
        (frame_json(t_s="-1"), "its time is -1 s, must be 0 to 1e+09 s"),
        (frame_json(t_s="1e308"), "t_s is 1e+308, out of its range"),
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
    found = recover_recording(path, tmp_path / "new.mcap")
    assert (found.n_frames, found.lost_reason) == (2, recording.lost_reason)
    whole = read_recording(found.recording)
    assert (whole.complete, whole.frames.number.tolist()) == (True, [0, 1])


@pytest.mark.parametrize(("n", "says"), [(8, ""), (9, "9 further samples, allowed are 0 to 8")])
def test_further_samples_of_a_taxel_have_a_limit(n: int, says: str, tmp_path: Path) -> None:
    found = read_recording(foreign(tmp_path / "f.mcap", frame_json(extra=str([7] * n))))
    assert says in found.lost_reason
    assert found.frames.extra.shape == ((0, 1, 0) if says else (1, 1, 8))


WIDE = b'{"t_s":0,"kind":"","text":"","x":[%s]}' % (b"[]," * 500_000 + b"[]")


@pytest.mark.parametrize(
    ("content", "topic", "chunk_bytes", "says"),
    [
        (bytes(20 << 20), "/tactile/frame", 1, "more than 64 times its size"),
        (b"{}", "/tactile/frame", 16 << 20, "more than 64 times its size"),
        (b'{"t_s":0,"kind":"","text":""}', "/sequence/event", 1 << 20, "more messages than"),
        (b'{"t_s":0}', "/sequence/pose", 1 << 20, "more messages than"),
        (b'{"t_s":0,"phase":""}', "/gripper/cycle", 1 << 20, "more messages than"),
        (frame_json(), "/tactile/frame", 1 << 20, "more messages than"),
        (
            b'{"t_s":0,"x_m":0,"y_m":0%s}' % (30_000 * b" "),
            "/sequence/pose",
            1 << 20,
            "more memory",
        ),
        (WIDE, "/sequence/event", 1, "more than 10000 lists and objects"),
    ],
)
def test_a_small_file_that_unpacks_without_end_costs_little(
    *,
    content: bytes,
    topic: str,
    chunk_bytes: int,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = bomb(tmp_path / "bomb.mcap", content, topic, chunk_bytes)
    n_bytes = path.stat().st_size
    assert n_bytes < 100_000
    unpacked, decoded = counted(monkeypatch, "_decompress"), counted(monkeypatch, "from_json")
    tracemalloc.start()
    try:
        recording = read_recording(path)
        recover_recording(path, tmp_path / "new.mcap")
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert says in recording.lost_reason
    may_unpack = recording_messages.FREE_BYTES + recording_messages.MAX_PACKING * n_bytes
    n_readings = 3  # one here, two in the recovery
    assert sum(map(len, unpacked)) <= n_readings * may_unpack
    n_messages = recording_messages.FREE_MESSAGES + n_bytes // recording_messages.MESSAGE_BYTES
    assert len(decoded) <= n_readings * (1 + n_messages)  # and the description
    assert peak_bytes < 3 * may_unpack + recording_messages.MAX_CHUNK_BYTES


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ('"shape":{"size_m":"soon"}', "size_m of shape is 'soon', expected number"),
        (
            '"grasp_shapes":[{"dimensions_m":{"x":[]}}]',
            "x of dimensions_m of an item of grasp_shap",
        ),
        ('"labels":[1]', "an item of labels is 1, expected string"),
    ],
)
def test_values_inside_others_are_checked_too(value: str, says: str, tmp_path: Path) -> None:
    given = {"t_s": 1, "label": "", "probability": 1, "labels": [], "probabilities": []}
    whole = json.dumps(given | {"unknown": 0, "n_grasps": 1})
    content = f"{whole[:-1]},{value}}}".encode()
    path = foreign(tmp_path / "f.mcap", whole.encode(), content, topic="/result")
    recording = read_recording(path)
    assert len(recording.results) == 1
    assert says in recording.lost_reason


def test_grasps_cannot_share_frames(tmp_path: Path) -> None:
    """A grasp of a few bytes would copy all frames, and the next one again."""
    clock = Clock(now_s=1.0)
    with Recorder(tmp_path / "r.mcap", clock, pads=PADS) as recorder:
        grasp = record_grasp(recorder, clock, "ball")
        recorder.grasp(replace(grasp, label="box"))
    recording = read_recording(tmp_path / "r.mcap")
    assert [grasp.label for grasp in recording.grasps] == ["ball"]
    assert "grasp 2 is left out: its frames belong to other grasps" in recording.lost_reason


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frame_t_s": [math.nan] * 20}, "an item of frame_t_s is nan, out of its range"),
        (
            {"frame_t_s": [-0.02 * i for i in range(20)]},
            "its times differ from those of its frames",
        ),
        ({"frame_t_s": [0.0]}, "it has 1 times for 20 frames"),
        ({"aperture_m": [30.0] * 20}, "its opening is 30000"),
        ({"force_n": [1e9] * 20}, "its force is 1e"),
        ({"start_ms": 10**18}, "its start is 1e"),
        ({"counts_crc32": 0}, "the checksum of its counts is wrong"),
    ],
)
def test_a_grasp_with_values_that_none_has_is_left_out_and_named(
    change: dict[str, Any], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_values, "_ENCODER", json.JSONEncoder())  # writes NaN, too
    monkeypatch.setattr(
        recorder_module, "grasp_values", lambda *one, **two: grasp_values(*one, **two) | change
    )
    clock = Clock(now_s=1.0)
    with Recorder(tmp_path / "r.mcap", clock, pads=PADS) as recorder:
        record_grasp(recorder, clock, "ball")
    recording = read_recording(tmp_path / "r.mcap")
    assert (recording.grasps, len(recording.frames)) == ((), 20)
    assert says in recording.lost_reason
    with pytest.raises(RecordingError, match="not complete"):
        recording_grasps(tmp_path / "r.mcap")
    assert recover_recording(tmp_path / "r.mcap", tmp_path / "new.mcap").n_grasps == 0
