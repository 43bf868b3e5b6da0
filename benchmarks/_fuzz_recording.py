"""Fuzz target of recordings: damaged MCAP files, and whole ones with damaged content."""

import json
import random
import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import zstandard

from benchmarks._fuzz_archives import Folder, make_grasps, small_pads
from benchmarks._fuzz_engine import Broken, Target
from benchmarks._fuzz_mutate import mutated
from cell.errors import RecordingError
from cell.recording import Recorder, read_recording
from cell.recording_reader import Recording
from gripper.force import ForceSample
from gripper.state import Cycle, GripperPhase, GripperState, ServoState
from recognition.grasp import Grasp
from tactile.protocol import TactileFrame

_CHUNK = 0x06
_VALUES = (None, True, -1, 0, 1, 1 << 40, 10**30, 1.5, 1e308, "", "x", [], [1], [[1]], {})


class _Clock:
    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


def _state(t_s: float) -> GripperState:
    servos = tuple(
        ServoState(
            servo_id=i,
            angle_rad=0.1,
            velocity_rad_s=0.0,
            current_a=0.4,
            position_raw=2048,
            temperature_c=31.0,
            voltage_v=12.0,
            tick_ms=7,
            alert=False,
        )
        for i in (1, 2)
    )
    return GripperState(
        t_s=t_s,
        aperture_m=0.02,
        aperture_velocity_m_s=0.0,
        current_a=0.4,
        force_from_current_n=4.0,
        temperature_c=31.0,
        voltage_v=12.0,
        servos=servos,
    )


def _record(folder: Folder) -> bytes:
    """Return a recording of two short grasps."""
    clock = _Clock()
    path = folder.path / "good.mcap"
    recorder = Recorder(path, clock, pads=small_pads())
    for grasp in make_grasps(small_pads(), 2, 6):
        times_s = []
        for i, counts in enumerate(grasp.counts):
            clock.now_s += 0.03
            times_s.append(clock.now_s)
            recorder.frame(TactileFrame(t_s=clock.now_s, counter=i, status=0, counts=counts))
            recorder.cycle(
                Cycle(
                    t_s=clock.now_s,
                    phase=GripperPhase.RAMPING,
                    state=_state(clock.now_s),
                    force=ForceSample(t_s=clock.now_s, force_n=(4.0, 4.0)),
                    setpoint_n=4.0,
                    goal_current_a=0.4,
                    level=1,
                )
            )
        recorder.grasp(replace(grasp, t_s=np.array(times_s) - times_s[0]))
    recorder.event("state", "COMPLETE")
    recorder.close()
    return path.read_bytes()


def _records(data: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 8
    while at + 9 <= len(data) - 8:
        code, size = struct.unpack_from("<BQ", data, at)
        found.append((code, data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def _file(records: list[tuple[int, bytes]]) -> bytes:
    magic = b"\x89MCAP0\r\n"
    return magic + b"".join(struct.pack("<BQ", c, len(d)) + d for c, d in records) + magic


class RecordingTrial:
    """Half damaged bytes, a quarter records moved or left out, a quarter forged messages."""

    def __init__(self) -> None:
        self.folder = Folder()
        self.data = _record(self.folder)
        self.records = _records(self.data)
        if _file(self.records) != self.data:
            raise Broken("the records of the good file were not understood")
        self.right = read_recording(self.folder.path / "good.mcap")
        if not self.right.complete or len(self.right.grasps) != 2:
            raise Broken("the good file is not good")

    def generate(self, rng: random.Random) -> tuple[bool, bytes]:
        chance = rng.random()
        if chance < 0.5:
            return True, mutated(rng, self.data, (self.data,))
        if chance < 0.75:
            records = list(self.records)
            for _ in range(rng.randint(1, 2)):
                at = rng.randrange(len(records))
                kind = rng.randrange(4)
                code, content = records[at]
                if kind == 0 and len(records) > 1:
                    del records[at]
                elif kind == 1:
                    records.insert(rng.randrange(len(records)), records[at])
                elif kind == 2:
                    records[at] = (rng.randrange(256), content)
                else:
                    records[at] = (code, mutated(rng, content))
            return True, _file(records)
        return False, _file([self._forged(rng, *record) for record in self.records])

    def _forged(self, rng: random.Random, code: int, content: bytes) -> tuple[int, bytes]:
        """Return a chunk with other messages and right checksums."""
        if code != _CHUNK:
            return code, content
        head = content[:16]
        name_size = int.from_bytes(content[28:32], "little")
        packed = content[32 + name_size + 8 :]
        name = content[32 : 32 + name_size]
        plain = zstandard.ZstdDecompressor().decompress(packed) if name == b"zstd" else packed
        inner, at = [], 0
        while at + 9 <= len(plain):
            kind, size = struct.unpack_from("<BQ", plain, at)
            inner.append((kind, plain[at + 9 : at + 9 + size]))
            at += 9 + size
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(inner))
            kind, body = inner[at]
            if kind == 0x05:
                inner[at] = (kind, body[:22] + _other_json(rng, body[22:]))
        plain = b"".join(struct.pack("<BQ", k, len(b)) + b for k, b in inner)
        head += len(plain).to_bytes(8, "little") + zlib.crc32(plain).to_bytes(4, "little")
        return code, head + bytes(4) + len(plain).to_bytes(8, "little") + plain

    def check(self, item: tuple[bool, bytes]) -> str:
        damaged, data = item
        try:
            recording = read_recording(self.folder.file(data, "x.mcap"))
        except RecordingError:
            return "refused: RecordingError"
        if not damaged:
            return "read: other messages" if recording.complete else "salvaged: said to be damaged"
        if recording.complete:
            self._compare(recording)
            return "read: the damage is in no value"
        for grasp in recording.grasps:
            if not any(_equal(grasp, right) for right in self.right.grasps):
                raise Broken("a damaged grasp was salvaged")
        return "salvaged: said to be damaged"

    def _compare(self, recording: Recording) -> None:
        right = self.right
        same = (
            np.array_equal(recording.frames.counts, right.frames.counts)
            and np.array_equal(recording.frames.t_s, right.frames.t_s)
            and np.array_equal(recording.cycles.setpoint_n, right.cycles.setpoint_n)
            and recording.cycles.phase == right.cycles.phase
            and recording.events == right.events
            and recording.metadata == right.metadata
            and len(recording.grasps) == len(right.grasps)
            and all(map(_equal, recording.grasps, right.grasps))
        )
        if not same:
            raise Broken("a damaged recording was read as whole with other content")


def _equal(a: Grasp, b: Grasp) -> bool:
    return (
        a.label == b.label
        and np.array_equal(a.counts, b.counts)
        and np.array_equal(a.t_s, b.t_s)
        and np.array_equal(a.aperture_m, b.aperture_m, equal_nan=True)
    )


def _other_json(rng: random.Random, data: bytes) -> bytes:
    chance = rng.random()
    if chance < 0.3:
        return mutated(rng, data)
    if chance < 0.33:
        return b"[" * 100_000
    try:
        content: dict[str, Any] = json.loads(data)
        key = rng.choice(list(content))
    except (ValueError, TypeError, IndexError, RecursionError):
        return data  # damaged before
    if chance < 0.5:
        del content[key]
    elif chance < 0.6 and isinstance(content[key], list) and content[key]:
        content[key][rng.randrange(len(content[key]))] = rng.choice(_VALUES)
    else:
        content[key] = rng.choice(_VALUES)
    return json.dumps(content).encode()


TARGETS = (
    Target(
        name="recording",
        parser="cell.recording_reader, cell.recording_salvage",
        inputs="bytes changed, cut, spliced; records dropped, doubled, renamed; forged messages "
        "under right checksums",
        make=RecordingTrial,
    ),
)
