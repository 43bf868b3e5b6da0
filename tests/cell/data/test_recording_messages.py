"""Messages of a recording: each legal file is read, what does not fit is left out and named."""

import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from cell.control.journal import Journal
from cell.data import (
    recorder as recorder_module,
    recording_messages,
    recording_schema,
    recording_values,
)
from cell.data.formats import RECORDING
from cell.data.recorder import Recorder
from cell.data.recording_messages import RecordedMessages
from cell.data.recording_reader import read_recording, recording_grasps
from cell.data.recording_recovery import recover_recording
from cell.data.recording_schema import RECOVERED
from cell.data.recording_values import grasp_values
from cell.errors import RecordingError
from cell.interfaces.cli.app import app
from tactile.source import TactileFrame
from tests.cell.conftest import plain_grasp
from tests.cell.data.test_recording import PADS, record, record_grasp, same
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


def frame_json(**changed: str) -> bytes:
    """Return a frame for the pads of `GOOD`, with other JSON in some of its fields."""
    fields = {"t_s": "1", "number": "0", "counter": "0", "status": "0", "counts": "[1]"} | changed
    return ("{" + ",".join(f'"{name}":{value}' for name, value in fields.items()) + "}").encode()


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
    monkeypatch.setattr(recording_messages, "breakup_chunk", raising(AssertionError("unpacked")))
    with pytest.raises(RecordingError, match=says):
        read_recording(foreign(tmp_path / "f.mcap", metadata=metadata))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"{", "EOF while parsing"),
        (b"[1]", "it is [1]: Input should be an object"),
        (b"{}", "t_s: Field required"),
        (frame_json(counts="[1,2]"), "2 counts up to 2, expected 1 up to 9"),
        (frame_json(counts="[10]"), "1 counts up to 10, expected 1 up to 9"),
        (frame_json(counts="[70000]"), "counts.0 is 70000: Input should be less than or"),
        (frame_json(counts="[-1]"), "counts.0 is -1: Input should be greater than or"),
        (frame_json(counts="[1.5]"), "counts.0 is 1.5: Input should be a valid integer"),
        (frame_json(extra="[-1]"), "extra.0 is -1: Input should be greater than or"),
        (frame_json(extra="[1]"), "1 further samples, the frames before it have 0"),
        (frame_json(number="-1"), "number is -1: Input should be greater than or equal to 0"),
        (frame_json(number="9223372036854775808"), "number is 9223372036854775808: Input should"),
        (frame_json(counter="true"), "counter is True: Input should be a valid integer"),
        (frame_json(t_s='"soon"'), "t_s is 'soon': Input should be a valid number"),
        (frame_json(t_s="NaN"), "t_s is nan: Input should be a finite number"),
        (frame_json(t_s="1e999"), "t_s is inf: Input should be a finite number"),
        (frame_json(t_s="1" + 400 * "0"), "Input should be a finite number"),
        (frame_json(t_s="-1"), "t_s is -1: Input should be greater than or equal to 0"),
        (
            frame_json(t_s="1e308"),
            "t_s is 1e+308: Input should be less than or equal to",
        ),
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


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ('"shape":{"size_m":"soon"}', "shape.size_m is 'soon': Input should be a valid number"),
        (
            '"grasp_shapes":[{"dimensions_m":{"x":[]}}]',
            "grasp_shapes.0.dimensions_m.x is []: Input should be",
        ),
        ('"labels":[1]', "labels.0 is 1: Input should be a valid string"),
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
        ({"frame_t_s": [math.nan] * 20}, "frame_t_s.0 is nan: Input should be a finite number"),
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


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    record(path, n_grasps=3)
    return path


def written_again(
    source: Path,
    path: Path,
    *,
    leave_out: Callable[[str, int], bool] = lambda _topic, _number: False,
    described_last: bool = True,
    **how: Any,
) -> Path:
    """Write a recording again, without some messages of a topic.

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
                times = message.log_time, message.data, message.publish_time
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
def test_each_legal_file_is_read_and_recovered_whole(
    how: dict[str, Any], whole: Path, tmp_path: Path
) -> None:
    before, again = read_recording(whole), written_again(whole, tmp_path / "a.mcap", **how)
    after = read_recording(again)
    assert (after.complete, after.lost_reason) == (True, "")
    assert len(after.frames) == len(before.frames) == 60
    assert len(after.cycles) == len(before.cycles)
    assert (after.results, after.events) == (before.results, before.events)
    assert all(map(same, before.grasps, after.grasps))
    assert len(after.grasps) == len(before.grasps) == 3
    found = recover_recording(again, tmp_path / "new.mcap")
    assert (found.lost_reason, found.n_grasps) == ("", 3)
    assert read_recording(found.recording).complete


def test_a_damaged_file_without_chunks_is_not_complete(whole: Path, tmp_path: Path) -> None:
    how = {"use_chunking": False, "enable_data_crcs": True}
    again = written_again(whole, tmp_path / "a.mcap", described_last=False, **how)
    data = again.read_bytes()
    again.write_bytes(data[: len(data) // 2])
    cut = read_recording(again)
    assert not cut.complete
    assert 0 < len(cut.frames) < 60
    at = data.index(b'"RAMPING"')
    again.write_bytes(data[:at] + b'"RAMPENG"' + data[at + 9 :])
    assert "crc validation failed in DataEnd" in read_recording(again).lost_reason


@pytest.mark.parametrize(
    ("topic", "left_out", "says", "n_grasps"),
    [
        ("/tactile/frame", (45,), "grasp 3 is left out: frames of it are missing", 2),
        ("/tactile/frame", tuple(range(41, 61)), "grasp 3 is left out: frames of it are miss", 2),
        ("/tactile/frame", (1, 2), "grasp 1 is left out: frames of it are missing", 2),
    ],
)
def test_a_recording_that_lacks_frames_is_not_complete(
    *, topic: str, left_out: tuple[int, ...], says: str, n_grasps: int, whole: Path, tmp_path: Path
) -> None:
    again = written_again(
        whole, tmp_path / "a.mcap", leave_out=lambda of, n: of == topic and n in left_out
    )
    found = read_recording(again)
    assert says in found.lost_reason
    assert not found.complete
    assert (len(found.grasps), found.n_broken_grasps) == (n_grasps, 1)
    with pytest.raises(RecordingError, match="not complete"):
        recording_grasps(again)
    assert recover_recording(again, tmp_path / "new.mcap").n_grasps == n_grasps
    assert len(recording_grasps(tmp_path / "new.mcap")) == n_grasps


def test_frames_of_no_grasp_that_are_missing_make_it_incomplete_too(
    whole: Path, tmp_path: Path
) -> None:
    def leave_out(topic: str, number: int) -> bool:
        return topic == "/sequence/grasp" or (topic == "/tactile/frame" and number == 30)

    found = read_recording(written_again(whole, tmp_path / "a.mcap", leave_out=leave_out))
    assert (found.complete, found.n_broken_grasps) == (False, 0)
    assert found.lost_reason == "its 59 frames are not all that were recorded"


def test_messages_that_the_statistics_count_and_nobody_finds_are_a_loss(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = written_again(whole, tmp_path / "a.mcap")
    n_messages = sum(1 for _ in RecordedMessages(again))
    monkeypatch.setattr(recording_messages, "breakup_chunk", lambda *_a, **_k: [])
    found = read_recording(again)
    assert found.lost_reason == f"0 of its {n_messages} messages are there"


@pytest.mark.parametrize("kind", ["compression", "size", "cut"])
def test_a_file_of_which_nothing_can_be_read_is_not_recovered(
    kind: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written_again(whole, tmp_path / "a.mcap", chunk_size=1 << 30)
    if kind == "compression":
        path.write_bytes(path.read_bytes().replace(b"zstd", b"what"))
        says = "its compression 'what' is not read"
    elif kind == "size":
        monkeypatch.setattr(recording_messages, "MAX_CHUNK_BYTES", 100_000)
        says = "it unpacks to more than 100000 bytes"
    else:
        data = whole.read_bytes()
        path.write_bytes(data[: data.index(b"zstd")])
        says = "cut off"
    with pytest.raises(RecordingError, match=rf"nothing of .* can be recovered: .*{says}"):
        recover_recording(path, tmp_path / "new.mcap")
    assert CliRunner().invoke(app, ["recover", str(path)]).exit_code != 0
    assert list(tmp_path.iterdir()) == [path]


# -- Recordings that were cut off or damaged become whole ones again -------------------------------


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Forty grasps of twelve frames, in several chunks."""
    rng = np.random.default_rng(0)
    grasps = [
        plain_grasp(f"object {i}", counts=rng.integers(500, 4096, (12, 24))) for i in range(40)
    ]
    path = tmp_path / "r.mcap"
    with Recorder(path, time, pads=grasps[0].pads) as recorder:
        for number, grasp in enumerate(grasps):
            for i in range(grasp.n_frames):
                recorder.frame(
                    TactileFrame(
                        t_s=10.0 * number + float(grasp.t_s[i]),
                        counter=i,
                        status=0,
                        counts=grasp.counts[i],
                    )
                )
            Journal(recorder).note("note", f"grasp {number}")
            recorder.grasp(grasp)
    return path


def damage(path: Path, kind: str) -> None:
    data = bytearray(path.read_bytes())
    if kind == "cut":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["cut", "bit"])
def test_what_is_whole_is_kept_and_what_is_lost_is_said(recording, kind) -> None:
    before = read_recording(recording)
    whole = recover_recording(recording, recording.with_name("copy.mcap"))
    assert (whole.lost_reason, whole.n_grasps) == ("", 40)
    assert RECOVERED not in read_recording(whole.recording).metadata
    damage(recording, kind)
    damaged = read_recording(recording)
    assert not damaged.complete
    assert len(damaged.grasps) < 40
    assert damaged.n_broken_grasps == (1 if kind == "bit" else 0)
    found = recover_recording(recording, recording.with_name("new.mcap"))
    after = read_recording(found.recording)
    assert after.complete
    assert after.n_broken_grasps == 0
    assert found.lost_reason == damaged.lost_reason
    assert found.lost_reason in after.metadata[RECOVERED]
    assert found.n_grasps == len(after.grasps) == len(damaged.grasps) > 0
    assert found.n_frames == len(after.frames) == len(damaged.frames)
    places = {int(number): i for i, number in enumerate(before.frames.number)}
    same = [places[int(number)] for number in after.frames.number]
    np.testing.assert_array_equal(after.frames.counts, before.frames.counts[same])
    labels = {grasp.label: grasp for grasp in before.grasps}
    for grasp in after.grasps:
        np.testing.assert_array_equal(grasp.counts, labels[grasp.label].counts)


def test_the_command_says_what_is_lost_and_never_overwrites(recording, tmp_path) -> None:
    damage(recording, "cut")
    report = tmp_path / "r.json"
    done = CliRunner().invoke(app, ["recover", str(recording), "--json", str(report)])
    assert done.exit_code == 0, done.output
    said: dict[str, Any] = json.loads(report.read_text())
    assert said["recording"] == str(tmp_path / "r-recovered.mcap")
    assert said["lost_reason"]
    assert read_recording(said["recording"]).complete
    with pytest.raises(RecordingError, match="never overwritten"):
        recover_recording(recording, said["recording"])
