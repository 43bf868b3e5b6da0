"""Bad recordings: damaged MCAP files, and forged messages under right checksums."""

import functools
import json
import struct
import tempfile
import zlib
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zstandard
from hypothesis import strategies as st

from cell.control.journal import Journal
from cell.errors import RecordingError
from cell.recording.reader import Recording, read_recording, recover_recording
from cell.recording.recorder import Recorder
from tactile.source import TactileFrame
from tests.fuzz.harness import (
    Clock,
    Damage,
    bad_input,
    damages,
    good_grasps,
    json_values,
    same_grasps,
    spoilt,
)
from tests.values import make_cycle

MESSAGE, CHUNK, DATA_END = 0x05, 0x06, 0x0F
MAGIC = b"\x89MCAP0\r\n"

Records = list[tuple[int, bytes]]
"""Code and content of each record of an MCAP file, or of a chunk in one."""


def records_of(data: bytes) -> Records:
    found, at = [], 0
    while at + 9 <= len(data):
        code, size = struct.unpack_from("<BQ", data, at)
        found.append((code, data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def bytes_of(records: Records) -> bytes:
    return b"".join(struct.pack("<BQ", code, len(data)) + data for code, data in records)


def file_of(records: Records) -> bytes:
    return MAGIC + bytes_of(records) + MAGIC


class Good(NamedTuple):
    """The bytes of a recording, its records, and what is read of it."""

    data: bytes
    records: Records
    recording: Recording


@functools.cache
def good() -> Good:
    """Return a recording of two short grasps."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.mcap"
        with closing(Recorder(path, clock, pads=good_grasps()[0].pads)) as recorder:
            for grasp in good_grasps()[:2]:
                times_s = clock.now_s + 0.03 * np.arange(1, 1 + len(grasp.counts))
                for i, clock.now_s in enumerate(times_s.tolist()):
                    recorder.frame(
                        TactileFrame(t_s=clock.now_s, counter=i, status=0, counts=grasp.counts[i])
                    )
                    recorder.cycle(make_cycle(clock.now_s))
                recorder.grasp(replace(grasp, t_s=times_s - times_s[0]))
            Journal(recorder).note("state", "COMPLETE")
        data, recording = path.read_bytes(), read_recording(path)
    made = Good(data, records_of(data[len(MAGIC) : -len(MAGIC)]), recording)
    assert file_of(made.records) == data
    assert recording.complete
    assert len(recording.grasps) == 2
    return made


def same(ours: Recording, other: Recording) -> bool:
    return (
        np.array_equal(ours.frames.counts, other.frames.counts)
        and np.array_equal(ours.frames.t_s, other.frames.t_s)
        and np.array_equal(ours.cycles.setpoint_n, other.cycles.setpoint_n)
        and ours.cycles.phase == other.cycles.phase
        and ours.events == other.events
        and ours.metadata == other.metadata
        and same_grasps(ours.grasps, other.grasps)
    )


def read(folder: Path, data: bytes) -> Recording | None:
    """Return what is read of a recording, None where it is refused."""
    (folder / "x.mcap").write_bytes(data)
    try:
        return read_recording(folder / "x.mcap")
    except RecordingError:
        return None


def check(folder: Path, data: bytes) -> str:
    """Assert that a damaged recording is refused, unchanged, or salvaged without a change."""
    found = read(folder, data)
    if found is None:
        return "refused"
    if found.complete:
        assert same(found, good().recording)
        return "unchanged"
    assert len(found.grasps) <= len(good().recording.grasps)
    for grasp in found.grasps:
        assert any(same_grasps([grasp], [right]) for right in good().recording.grasps)
    (folder / "recovered.mcap").unlink(missing_ok=True)
    try:
        recover_recording(folder / "x.mcap", folder / "recovered.mcap")
    except RecordingError:
        return "nothing to salvage"
    whole = read_recording(folder / "recovered.mcap")
    assert whole.complete
    assert same_grasps(whole.grasps, found.grasps)
    return "salvaged"


@bad_input(harm=damages(), sound={"harm": []}, examples=100)
def test_a_damaged_recording_is_refused_unchanged_or_salvaged(tmp_path, harm):
    return check(tmp_path, spoilt(good().data, harm))


Change = tuple[str, int, Any, list[Damage]]
"""Kind, place, value and damage of one change to the JSON of a message."""


def changed(text: bytes, change: Change) -> bytes:
    kind, place, value, harm = change
    if kind == "spoil":
        return spoilt(text, harm)
    if kind == "brackets":
        return b"[" * 100_000
    content = json.loads(text)
    key = list(content)[place % len(content)]
    if kind == "lose":
        del content[key]
    elif kind == "element" and isinstance(content[key], list) and content[key]:
        content[key][place % len(content[key])] = value
    else:
        content[key] = value
    return json.dumps(content).encode()


def forged(chunk: bytes, changes: dict[int, Change]) -> bytes:
    """Return a chunk with other messages under right checksums."""
    name_size = int.from_bytes(chunk[28:32], "little")
    packed = chunk[32 + name_size + 8 :]
    is_packed = chunk[32 : 32 + name_size] == b"zstd"
    inner = records_of(zstandard.ZstdDecompressor().decompress(packed) if is_packed else packed)
    messages = [at for at, (code, _) in enumerate(inner) if code == MESSAGE]
    for at, change in {messages[n % len(messages)]: changes[n] for n in changes}.items():
        head, text = inner[at][1][:22], inner[at][1][22:]
        inner[at] = (MESSAGE, head + changed(text, change))
    plain = bytes_of(inner)
    start = chunk[:16] + len(plain).to_bytes(8, "little") + zlib.crc32(plain).to_bytes(4, "little")
    return start + bytes(4) + len(plain).to_bytes(8, "little") + plain


@pytest.mark.slow
@bad_input(
    changes=st.dictionaries(
        st.integers(0, 99),
        st.tuples(
            st.sampled_from(["value", "value", "element", "lose", "spoil", "brackets"]),
            st.integers(0, 99),
            json_values,
            damages(at_least=1),
        ),
        max_size=3,
    ),
    examples=60,
)
def test_a_recording_of_other_messages_is_read_and_recovered(tmp_path, changes):
    records = [
        (code, forged(d, changes) if code == CHUNK else bytes(4) if code == DATA_END else d)
        for code, d in good().records
    ]
    found = read(tmp_path, file_of(records))
    (tmp_path / "recovered.mcap").unlink(missing_ok=True)
    recover_recording(tmp_path / "x.mcap", tmp_path / "recovered.mcap")
    whole = read_recording(tmp_path / "recovered.mcap")
    assert whole.complete
    assert same_grasps(whole.grasps, found.grasps)
    return "read as whole" if found.complete else "read as damaged"
