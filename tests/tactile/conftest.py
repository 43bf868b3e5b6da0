"""A clock that jumps, and a small control unit that answers with scripted bytes."""

import struct
from collections import deque
from collections.abc import Callable, Iterator

import can
import numpy as np
import pytest

from simulator.clock import VirtualClock
from tactile.frames.codec import FrameFormat, encode_frame
from tactile.layout import TaxelLayout, paper_layout
from tactile.unit import object_dictionary as od
from tactile.unit.link import LinkSettings, TactileLink

NODE = 5


class JumpClock(VirtualClock):
    """A virtual clock that begins at 100 s."""

    def __init__(self) -> None:
        super().__init__(100.0)

    @property
    def now_s(self) -> float:
        return self.monotonic()


class ScriptedBus(can.BusABC):
    """The host's end of a bus in memory."""

    def __init__(self) -> None:
        self.incoming: deque[can.Message | Exception] = deque()
        self.sent: list[can.Message] = []
        self.on_send: Callable[[can.Message], None] = lambda message: None
        self.send_error: Exception | None = None
        super().__init__("memory")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.send_error is not None:
            raise self.send_error
        self.sent.append(msg)
        self.on_send(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self.incoming:
            return None
        message = self.incoming.popleft()
        if isinstance(message, Exception):
            raise message
        return message

    def put(self, cob_id: int, data: bytes, **options: object) -> None:
        self.incoming.append(
            can.Message(
                arbitration_id=cob_id,
                data=data,
                is_extended_id=False,
                **options,  # type: ignore[arg-type]
            )
        )


class ScriptedUnit:
    """A control unit: NMT, heartbeat, SDO server, a burst of frame messages after each SYNC.

    Every public attribute is a knob that a test turns.
    """

    def __init__(self, bus: ScriptedBus, clock: JumpClock, layout: TaxelLayout) -> None:
        self.bus = bus
        self.clock = clock
        self.layout = layout
        self.format = FrameFormat.of(layout)
        self.rng = np.random.default_rng(1)
        self.counts = np.zeros(layout.n_taxels, dtype=np.uint16)
        self.noisy = False
        self.state = 0
        self.counter = 0
        self.alive = True
        self.heartbeats = True
        self.mute_syncs = 0
        self.boots = 1
        self.alter: Callable[[list[bytes]], list[bytes]] = lambda messages: messages
        self.mute_sdo = 0
        self.tare_result = int(od.TareResult.DONE)
        self.tare_polls = 2
        self.nmt: list[int] = []
        self.written: dict[tuple[int, int], int] = {}
        self._heartbeat_s = 0.0
        self._next_heartbeat_s = 0.0
        self._segments: list[bytes] = []
        self.objects: dict[tuple[int, int], bytes] = {
            (od.DEVICE_NAME, 0): b"Tactile control unit",
            (od.IDENTITY, 1): struct.pack("<L", od.VENDOR_ID),
            (od.IDENTITY, 2): struct.pack("<L", od.PRODUCT_CODE),
            (od.IDENTITY, 3): struct.pack("<L", od.REVISION + 7),
            (od.IDENTITY, 4): struct.pack("<L", 4711),
            (od.BOARDS, 1): struct.pack("<L", 31),
            (od.BOARDS, 2): struct.pack("<L", 32),
            (od.LAYOUT, 2): struct.pack("<H", layout.n_taxels),
            (od.LAYOUT, 3): layout.layout_hash.encode(),
            (od.LAYOUT, 4): struct.pack("<H", layout.adc_max),
            (od.FORMAT, 2): bytes([layout.sample_bytes]),
            (od.FORMAT, 3): struct.pack("<H", self.format.n_messages),
            (od.FORMAT, 4): bytes([self.format.header_bytes]),
            (od.TPDO1_MAPPING, 0): b"\x02",
            (od.TPDO1_MAPPING, 1): struct.pack("<L", od.TPDO1_ENTRIES[0]),
            (od.TPDO1_MAPPING, 2): struct.pack("<L", od.TPDO1_ENTRIES[1]),
            (od.TPDO1_PARAMETER, 1): struct.pack("<L", 0x4000_0180 + NODE),
            (od.TARE, 2): b"\x00",
            (od.TARE, 4): struct.pack("<H", 93),
            (od.LAST_FRAME_COUNTER, 0): b"\0\0",
        }
        bus.on_send = self.receive
        clock.on_advance.append(self.advance)

    def receive(self, message: can.Message) -> None:
        if not self.alive:
            return
        cob_id, data = message.arbitration_id, bytes(message.data)
        if cob_id == 0 and data[1] in {0, NODE}:
            self.nmt.append(data[0])
            if data[0] in {129, 130}:
                self.boot()
            else:
                self.state = {1: 5, 2: 4, 128: 127}[data[0]]
        elif cob_id == 0x80 and self.state == 5:
            self.sync()
        elif cob_id == 0x600 + NODE and self.state in {5, 127}:
            self.sdo(data)

    def boot(self) -> None:
        self.state = 127
        self._heartbeat_s = 0.0
        for _ in range(self.boots):
            self.bus.put(0x700 + NODE, b"\0")

    def advance(self, now_s: float) -> None:
        due = self._heartbeat_s and now_s >= self._next_heartbeat_s - 1e-9
        if due and self.alive and self.heartbeats:
            self._next_heartbeat_s = now_s + self._heartbeat_s
            self.bus.put(0x700 + NODE, bytes([self.state]))

    def frame(self) -> list[bytes]:
        counts = self.counts
        if self.noisy:
            noise = np.rint(np.clip(np.abs(self.rng.normal(0, 10, len(counts))), 1, 20))
            counts = np.minimum(counts + noise.astype(np.uint16), self.layout.adc_max)
        messages = encode_frame(self.format, counts, self.counter & 0xFFFF, 0)
        self.objects[od.LAST_FRAME, 0] = counts.astype(
            np.uint8 if self.layout.sample_bytes == 1 else "<u2"
        ).tobytes()
        self.objects[od.LAST_FRAME_COUNTER, 0] = struct.pack("<H", self.counter & 0xFFFF)
        self.counter += 1
        return messages

    def sync(self) -> None:
        messages = self.alter(self.frame())
        if self.mute_syncs:
            self.mute_syncs -= 1
            return
        for message in messages:
            self.bus.put(0x180 + NODE, message)

    def sdo(self, data: bytes) -> None:
        if self.mute_sdo:
            self.mute_sdo -= 1
            return
        command, index, sub = struct.unpack_from("<BHB", data)
        answer = bytes(8)
        if command & 0xE0 == 0x20 and command & 2:
            size = 4 - (command >> 2 & 3)
            answer = self.write(index, sub, int.from_bytes(data[4 : 4 + size], "little"), size)
        elif command & 0xE0 == 0x40:
            answer = self.read(index, sub)
        elif command & 0xE0 == 0x60:
            part = self._segments.pop(0)
            header = command & 0x10 | (7 - len(part)) << 1 | (not self._segments)
            answer = bytes([header]) + part.ljust(7, b"\0")
        self.bus.put(0x580 + NODE, answer)

    def read(self, index: int, sub: int) -> bytes:
        if (index, sub) == (
            od.TARE,
            od.TARE_RESULT,
        ) and self.written.get((od.TARE, 1)):
            self.tare_polls -= 1
            done = self.tare_polls < 0
            value = bytes([self.tare_result if done else od.TareResult.RUNNING])
        elif (index, sub) in self.objects:
            value = self.objects[index, sub]
        else:
            return struct.pack("<BHBL", 0x80, index, sub, 0x0602_0000)
        if len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            return struct.pack("<BHB", command, index, sub) + value.ljust(4, b"\0")
        self._segments = [value[i : i + 7] for i in range(0, len(value), 7)]
        return struct.pack("<BHBL", 0x41, index, sub, len(value))

    def write(self, index: int, sub: int, value: int, size: int) -> bytes:
        self.written[index, sub] = value
        self.objects[index, sub] = value.to_bytes(size, "little")
        if index == od.HEARTBEAT_MS:
            self._heartbeat_s = value / 1000
            self._next_heartbeat_s = self.clock.now_s
        return struct.pack("<BHBL", 0x60, index, sub, 0)


class Bench:
    """Link, unit, bus and clock together."""

    def __init__(self, layout: TaxelLayout, **settings: object) -> None:
        self.clock = JumpClock()
        self.bus = ScriptedBus()
        self.unit = ScriptedUnit(self.bus, self.clock, layout)
        self.link = TactileLink(
            self.bus,
            node_id=NODE,
            layout=layout,
            clock=self.clock,
            settings=LinkSettings(**({"threaded": False} | settings)),  # type: ignore[arg-type]
        )

    def run(self, seconds: float, step_s: float = 0.005) -> list:
        frames = []
        for _ in range(round(seconds / step_s)):
            self.clock.sleep(step_s)
            frames += self.link.poll()
        return frames


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    benches = []

    def make(layout: TaxelLayout | None = None, **settings: object) -> Bench:
        benches.append(Bench(layout or paper_layout(), **settings))
        return benches[-1]

    yield make
    for bench in benches:
        bench.link.close()
        bench.bus.shutdown()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()
