"""Fuzz targets of the CAN side: frames, features, emergencies, a whole link, SDO at both ends."""

import random
from collections.abc import Callable

import can
import canopen
import numpy as np

from benchmarks._fuzz_engine import BY_CHANCE, Broken, Target
from benchmarks._fuzz_mutate import mutated
from benchmarks._fuzz_servo import Clock
from simulator.assembly import CellDevices
from simulator.settings import SimulatorSettings
from tactile import eds
from tactile.assembler import FrameAssembler
from tactile.emergency import decode_emergency, encode_emergency
from tactile.errors import TactileError
from tactile.features import FeatureCollector, PadFeatures, encode_features
from tactile.layouts import paper_layout
from tactile.link_settings import LinkSettings
from tactile.protocol import FrameFormat, encode_frame
from tactile.sdo import MAX_OBJECT_BYTES, ObjectAccess, PolledSdoClient
from tactile.session import LinkSession

_NODE = 5
_MOST_REQUESTS = 20_000
Messages = list[tuple[bytes, int]]


class FrameTrial:
    """Bursts of frames of the paper's and of a small size, damaged as wires and drivers do."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.cases = []
        for frame_format, n_frames in (
            (FrameFormat(n_taxels=10, sample_bytes=2), 200),
            (FrameFormat(n_taxels=408, sample_bytes=1), 24),
        ):
            frames = []
            for counter in range(n_frames):
                top = 1 << (8 * frame_format.sample_bytes)
                counts = rng.integers(0, top, frame_format.n_taxels).astype(np.uint16)
                status = int(rng.integers(0, 16))
                burst = encode_frame(frame_format, counts, counter, status)
                frames.append((counts, status, burst))
            self.cases.append((FrameAssembler(frame_format), frames))

    def generate(self, rng: random.Random) -> tuple[int, Messages]:
        case = int(rng.random() < 0.08)
        _, frames = self.cases[case]
        first = rng.randrange(len(frames) - 10)
        step = rng.choice((1, 1, 1, 4))  # four scans later the phase is the same
        messages = [
            (message, len(message))
            for k in range(rng.randint(1, 3))
            for message in frames[first + k * step][2]
        ]
        for _ in range(rng.randint(1, 4)):
            _disturb(rng, messages)
        return case, messages

    def check(self, item: tuple[int, Messages]) -> str:
        assembler, frames = self.cases[item[0]]
        assembler.reset()
        found = 0
        for data, dlc in item[1]:
            frame = assembler.push(data, dlc, 0.0)
            if frame is None:
                continue
            found += 1
            if frame.counter >= len(frames):
                return BY_CHANCE
            counts, status, _ = frames[frame.counter]
            if frame.status != status or not np.array_equal(frame.counts, counts):
                return BY_CHANCE
        if assembler.statistics.complete != found:
            raise Broken(f"{found} frames, counted {assembler.statistics}")
        return "whole frames only" if found else "dropped"


def _disturb(rng: random.Random, messages: Messages) -> None:
    if not messages:
        return
    kind, at = rng.randrange(8), rng.randrange(len(messages))
    data, dlc = messages[at]
    if kind == 0:
        del messages[at]
    elif kind == 1:
        messages.insert(rng.randrange(len(messages) + 1), (data, dlc))
    elif kind == 2:
        messages.insert(rng.randrange(len(messages)), messages.pop(at))
    elif kind == 3:
        messages[at] = (mutated(rng, data), dlc)
    elif kind == 4:
        messages[at] = (data, rng.randrange(16))
    elif kind == 5:
        other = messages[rng.randrange(len(messages))][0]
        messages[at] = (data[:1] + other[1:], dlc)
    elif kind == 6:
        size = rng.choice((0, 1, 7, 8, 8, 8, 64))
        messages.insert(at, (rng.randbytes(size), min(size, 15)))
    else:
        flipped = bytearray(data or b"\0")
        flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
        messages[at] = (bytes(flipped), dlc)


class FeatureTrial:
    """Pairs of feature messages, and emergencies: the small messages."""

    def __init__(self) -> None:
        self.collector = FeatureCollector()

    def generate(self, rng: random.Random) -> tuple[list[bytes], list[bytes], bytes]:
        self.sent = set()
        firsts, seconds = [], []
        for pad in rng.sample(range(64), 3):
            features = PadFeatures(
                pad=pad,
                counter=rng.randrange(256),
                active=rng.randrange(256),
                peak_counts=rng.randrange(1 << 16),
                total_counts=rng.randrange(1 << 32),
                centroid_row=rng.randrange(1 << 16) / 256,
                centroid_column=rng.randrange(1 << 16) / 256,
            )
            self.sent.add(features)
            first, second = encode_features(features)
            firsts.append(mutated(rng, first) if rng.random() < 0.3 else first)
            seconds.append(mutated(rng, second) if rng.random() < 0.3 else second)
        if rng.random() < 0.3:
            firsts[0], firsts[1] = firsts[1], firsts[0]
        return firsts, seconds, rng.randbytes(rng.choice((0, 2, 7, 8, 8, 9, 64)))

    def check(self, item: tuple[list[bytes], list[bytes], bytes]) -> str:
        firsts, seconds, other = item
        emergency = decode_emergency(other)
        if (emergency is not None) != (len(other) == 8):
            raise Broken("an emergency that is not of 8 bytes")
        if emergency is not None and (encode_emergency(emergency) != other or not emergency.text):
            raise Broken("an emergency changed")
        for first in firsts:
            self.collector.push_first(first)
        outcome = "dropped"
        for second in seconds:
            features = self.collector.push_second(second)
            if features is not None:
                if features not in self.sent:
                    return BY_CHANCE
                outcome = "whole features only"
        return outcome


class _Nowhere(can.BusABC):
    """A bus that takes everything and says nothing."""

    def __init__(self) -> None:
        super().__init__("nowhere")
        self.on_send: Callable[[can.Message], None] = lambda message: None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.on_send(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return None


class _Script:
    """A source that hands out the messages of one input."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.messages: list[can.Message] = []

    def start(self) -> None: ...

    def drain(self) -> list[tuple[float, can.Message]]:
        messages, self.messages = self.messages, []
        return [(self.clock.monotonic(), message) for message in messages]

    def wait(self, timeout_s: float) -> None:
        self.clock.sleep(timeout_s)

    def close(self) -> None: ...


class LinkTrial:
    """Whatever a CAN adapter may hand out, for a link in operation: any identifier, any length."""

    def __init__(self) -> None:
        self.layout = paper_layout()
        frame_format = FrameFormat.of(self.layout)
        counts = np.arange(self.layout.n_taxels).astype(np.uint16) % 256
        self.counts = counts
        self.burst = encode_frame(frame_format, counts, 9, 0)
        self.bus = _Nowhere()
        self._begin()

    def close(self) -> None:
        self.bus.shutdown()

    def _begin(self) -> None:
        self.clock = Clock()
        self.source = _Script(self.clock)
        self.session = LinkSession(
            self.bus,
            self.source,
            node_id=_NODE,
            layout=self.layout,
            clock=self.clock,
            settings=LinkSettings(),
        )
        self.session.enter_operation()

    def generate(self, rng: random.Random) -> list[can.Message]:
        messages = []
        for _ in range(rng.randint(1, 6)):
            base = rng.choice((0x180, 0x180, 0x280, 0x380, 0x580, 0x600, 0, -1))
            if rng.random() < 0.005:
                base = rng.choice((0x80, 0x700))
            can_id = rng.randrange(0x100, 0x700) if base < 0 else base + (_NODE if base else 0)
            size = rng.choice((8, 8, 8, 8, 8, 7, 0, 1, 3))
            data = rng.randbytes(size)
            if base == 0x180 and rng.random() < 0.7:
                data = mutated(rng, rng.choice(self.burst))[:8]
            message = can.Message(arbitration_id=can_id, is_extended_id=False, data=data)
            if rng.random() < 0.1:
                message.dlc = rng.randrange(16)
            if rng.random() < 0.02:
                message.is_remote_frame = True
            if rng.random() < 0.02:
                message.is_extended_id = True
            if rng.random() < 0.005:
                message.is_error_frame = True
            messages.append(message)
        if rng.random() < 0.3:
            messages += [
                can.Message(arbitration_id=0x185, is_extended_id=False, data=data)
                for data in self.burst
            ]
        return messages

    def check(self, item: list[can.Message]) -> str:
        self.source.messages = list(item)
        self.clock.now_s += 0.001
        try:
            self.session.service()
        except TactileError as error:
            self._begin()
            return f"refused: {type(error).__name__}"
        for frame in self.session.take_frames():
            if frame.counter != 9 or not np.array_equal(frame.counts, self.counts):
                return BY_CHANCE
        return "dropped and counted"


class SdoClientTrial:
    """Objects read from a unit whose responses are damaged, doubled, cut, foreign or endless."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.client = PolledSdoClient(
            node_id=_NODE,
            dictionary=canopen.import_od(str(eds.EDS_PATH), _NODE),
            clock=self.clock,
            service=lambda: None,
            wait=self.clock.sleep,
            timeout_s=0.1,
        )
        self.bus = _Nowhere()
        self.client.network = canopen.Network(self.bus)
        self.objects = ObjectAccess(self.client, name="the unit")

    def close(self) -> None:
        self.bus.shutdown()

    def generate(self, rng: random.Random) -> tuple[int, int, bytes, list[int], bool]:
        index, sub, size = rng.choice(
            (
                (eds.IDENTITY, 1, 4),
                (eds.DEVICE_NAME, 0, 20),
                (eds.LAYOUT, 3, 16),
                (eds.LAYOUT, 2, 2),
                (eds.LAST_FRAME_COUNTER, 0, 2),
                (eds.FORMAT, 2, 1),
            )
        )
        seeds = [rng.randrange(1 << 30) if rng.random() < 0.4 else 0 for _ in range(12)]
        return index, sub, rng.randbytes(size), seeds, rng.random() < 0.001

    def check(self, item: tuple[int, int, bytes, list[int], bool]) -> str:
        index, sub, value, seeds, endless = item
        damages = iter(seeds)
        requests = 0
        at = 0

        def serve(message: can.Message) -> None:
            nonlocal requests, at
            requests += 1
            if requests > _MOST_REQUESTS:
                raise Broken(f"more than {_MOST_REQUESTS} requests for one object")
            command = message.data[0]
            head = index.to_bytes(2, "little") + bytes((sub,))
            if command == 0x40:
                at = 0
                if len(value) <= 4 and not endless:
                    free = 4 - len(value)
                    response = bytes((0x43 | free << 2,)) + head + value + bytes(free)
                else:
                    response = b"\x41" + head + len(value).to_bytes(4, "little")
            elif command & 0xE0 == 0x60:
                piece = bytes(7) if endless else value[at : at + 7]
                at += 7
                last = not endless and at >= len(value)
                first = command & 0x10 | (7 - len(piece)) << 1 | last
                response = bytes((first,)) + piece.ljust(7, b"\0")
            else:
                return
            seed = next(damages, 0)
            for data in _responses(seed, response):
                self.client.on_response(0x585, data, 0.0)

        self.bus.on_send = serve
        try:
            found = self.objects.read(index, sub)
        except TactileError as error:
            return f"refused: {type(error).__name__}"
        if found == value:
            return "the right value"
        if len(found) > MAX_OBJECT_BYTES:
            raise Broken(f"{len(found)} bytes for one object")
        if any(seeds):
            return "another value: SDO has no checksum, identity and layout are compared after it"
        raise Broken(f"read {found!r}, sent {value!r}")


def _responses(seed: int, response: bytes) -> list[bytes]:
    if not seed:
        return [response]
    rng = random.Random(seed)
    return rng.choice(
        (
            [],
            [response, response],
            [rng.randbytes(8)],
            [b"\x80" + rng.randbytes(7)],
            [mutated(rng, response), response],
            [mutated(rng, response)],
        )
    )


class SdoServerTrial:
    """Any CAN message for the simulated control unit: SDO requests first of all."""

    def __init__(self) -> None:
        self.unit = CellDevices(SimulatorSettings()).unit
        self.sent: list[tuple[int, bytes]] = []
        self.now_s = 0.1
        self.unit.connect(self._take)
        self.unit.advance(self.now_s)

    def _take(self, ready_s: float, can_id: int, burst: list[bytes]) -> float:
        self.sent += [(can_id, data) for data in burst]
        return ready_s

    def generate(self, rng: random.Random) -> list[tuple[int, bytes]]:
        messages = []
        for _ in range(rng.randint(1, 4)):
            index = rng.choice((0x1000, 0x1005, 0x1008, 0x1014, 0x1017, 0x1018, 0x1800, 0x1A00))
            index = rng.choice((index, rng.randrange(0x2100, 0x2210), rng.randrange(1 << 16)))
            command = rng.choice((0x40, 0x23, 0x2F, 0x2B, 0x21, 0x20, 0x60, 0x70, 0x00, 0x10, 0x01))
            data = bytes((command,)) + index.to_bytes(2, "little") + bytes((rng.randrange(6),))
            data += rng.choice((bytes(4), rng.randbytes(4), b"\x01\0\0\0"))
            if rng.random() < 0.4:
                data = mutated(rng, data)
            can_id = 0x600 + _NODE
            if rng.random() < 0.02:
                can_id, data = rng.choice((0, 0x80, 0x185, rng.randrange(0x800))), data[:2]
            messages.append((can_id, data[:8]))
        return messages

    def check(self, item: list[tuple[int, bytes]]) -> str:
        self.sent.clear()
        for can_id, data in item:
            self.now_s += 1e-3
            self.unit.receive(can_id, data, self.now_s)
        answers = [data for can_id, data in self.sent if can_id == 0x580 + _NODE]
        if any(len(data) > 8 for _, data in self.sent) or any(len(data) != 8 for data in answers):
            raise Broken("a message of more than 8 bytes, or an SDO response of less")
        if len(answers) > len(item):
            raise Broken(f"{len(answers)} responses to {len(item)} requests")
        aborts = sum(data[0] == 0x80 for data in answers)
        return "answered" if aborts < len(answers) else "refused: SDO abort or silence"


TARGETS = (
    Target(
        name="can-frame",
        parser="tactile.assembler, tactile.protocol",
        inputs="bursts of 1 to 3 frames: lost, doubled, moved, mixed, changed, other lengths",
        make=FrameTrial,
        crc_tests=3,
    ),
    Target(
        name="can-features",
        parser="tactile.features, tactile.emergency",
        inputs="three pairs of feature messages and one emergency, damaged or swapped",
        make=FeatureTrial,
        crc_tests=3,
    ),
    Target(
        name="can-link",
        parser="tactile.session, tactile.supervision",
        inputs="1 to 65 messages of any identifier, length and kind for a link in operation",
        make=LinkTrial,
        crc_tests=1,
    ),
    Target(
        name="sdo-client",
        parser="tactile.sdo",
        inputs="SDO responses damaged, doubled, foreign, cut, aborted, without an end",
        make=SdoClientTrial,
        limit_s=2.0,
    ),
    Target(
        name="sdo-server",
        parser="simulator.sdo_gate, simulator.control_unit",
        inputs="1 to 4 SDO requests and other messages, damaged",
        make=SdoServerTrial,
    ),
)
