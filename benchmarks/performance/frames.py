"""Frames of 408 taxels put together per second, against what a bus of 1 Mbit/s can carry.

Twice: from payloads to frames alone, and from a bus in memory with the whole receive path (each
message through python-can's ``recv``, SYNC, heartbeat and all deadlines). The plain alternative is
canopen: its PdoMap takes each message and hands out the two mapped variables by ``.raw``; it checks
neither CRC nor order. The naive assembler copies slices into a numpy array and checks nothing.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import canopen
import numpy as np

from benchmarks._measure import Timed, in_turns, line, ratio, repeats, same, timed
from benchmarks.performance._frame_feed import (
    FORMAT,
    FRAME_ID,
    LAYOUT,
    NODE_ID,
    PERIOD_S,
    FedLink,
    FeedBus,
    bursts,
    made_counts,
    messages_of,
)
from tactile.frames.assembler import FrameAssembler
from tactile.unit import object_dictionary

_BITS_BEST, _BITS_WORST = 111, 135
"""A message of 8 bytes with its interframe space: without stuffing, and with the most of it."""
_BITRATE = 1_000_000
_LAST = FORMAT.n_messages - 1


class PdoDecoder:
    """The plain way with canopen: mapped variables of each received PDO, put side by side."""

    def __init__(self) -> None:
        self.network = canopen.Network()
        pdo = self.network.add_node(NODE_ID, str(object_dictionary.EDS_PATH)).tpdo[1]
        pdo.read(from_od=True)
        pdo.add_callback(self._on_message)
        self.frames: list[np.ndarray] = []
        self._samples = bytearray(FORMAT.payload_bytes)

    def _on_message(self, pdo: canopen.pdo.base.PdoMap) -> None:
        index = pdo[0].raw & 63
        self._samples[7 * index : 7 * index + 7] = pdo[1].raw.to_bytes(7, "little")
        if index == _LAST:
            counts = np.frombuffer(bytes(self._samples), dtype=np.uint8, count=LAYOUT.n_taxels)
            self.frames.append(counts.astype(np.uint16))

    def decode(self, payloads: list[list[bytes]]) -> list[np.ndarray]:
        """Return the counts of all frames."""
        for burst in payloads:
            for data in burst:
                self.network.notify(FRAME_ID, data, 0.0)
        return self.frames


class Assembled:
    """Our way."""

    def __init__(self) -> None:
        self._push = FrameAssembler(FORMAT).push

    def decode(self, payloads: list[list[bytes]]) -> list[np.ndarray]:
        """Return the counts of all frames."""
        push = self._push
        whole = [push(data, 8, 0.0) for burst in payloads for data in burst]
        return [frame.counts for frame in whole if frame is not None]


class Sliced:
    """The naive way with numpy."""

    def __init__(self) -> None:
        self._samples = np.zeros(FORMAT.payload_bytes, dtype=np.uint8)

    def decode(self, payloads: list[list[bytes]]) -> list[np.ndarray]:
        """Return the counts of all frames."""
        frames, samples = [], self._samples
        for burst in payloads:
            for data in burst:
                index = data[0] & 63
                samples[7 * index : 7 * index + 7] = np.frombuffer(data, dtype=np.uint8, offset=1)
                if index == _LAST:
                    frames.append(samples[: LAYOUT.n_taxels].astype(np.uint16))
        return frames


def codec_run(make: Callable[[], Any], payloads: list[list[bytes]]) -> Timed:
    """Let a fresh decoder take in all payloads; making it does not count."""
    decoder = make()
    return timed(lambda: decoder.decode(payloads))


def link_run(received: list, frames: list[np.ndarray]) -> Timed:
    """Let the link take in all messages, one poll a SYNC period; only the polls count."""
    fed = FedLink()
    wall_s = cpu_s = 0.0
    try:
        for messages in received:
            fed.bus.waiting.extend(messages)
            fed.clock.advance_to(fed.clock.monotonic() + PERIOD_S)
            cpu, wall = time.process_time(), time.perf_counter()
            found = fed.link.poll()
            wall_s += time.perf_counter() - wall
            cpu_s += time.process_time() - cpu
            frames.extend(frame.counts for frame in found)
    finally:
        fed.close()
    return Timed(wall_s=wall_s, cpu_s=cpu_s)


def network_run(received: list, frames: list[np.ndarray]) -> Timed:
    """Let canopen's network take in the same messages from the same kind of bus."""
    decoder, bus = PdoDecoder(), FeedBus()
    wall_s = cpu_s = 0.0
    for messages in received:
        bus.waiting.extend(messages)
        cpu, wall = time.process_time(), time.perf_counter()
        while (message := bus.recv(0)) is not None:
            decoder.network.notify(message.arbitration_id, message.data, message.timestamp)
        wall_s += time.perf_counter() - wall
        cpu_s += time.process_time() - cpu
    bus.shutdown()
    frames.extend(decoder.frames)
    return Timed(wall_s=wall_s, cpu_s=cpu_s)


def main(effort: float = 1.0) -> None:
    n_frames, rounds = repeats(300, effort, least=12), repeats(9, effort)
    counts = made_counts(n_frames)
    payloads = bursts(counts)
    received = messages_of(payloads)

    decoders = {"FrameAssembler": Assembled, "canopen PdoMap": PdoDecoder, "numpy slices": Sliced}
    for name, make in decoders.items():
        same(np.array_equal(make().decode(payloads), counts), f"{name} gives other counts")
    paths = {"TactileLink": link_run, "canopen Network": network_run}
    for name, run in paths.items():
        frames: list[np.ndarray] = []
        run(received, frames)
        same(np.array_equal(frames, counts), f"{name} gives other counts")

    codec = in_turns(
        {name: partial(codec_run, make, payloads) for name, make in decoders.items()}, rounds
    )
    path = in_turns({name: partial(run, received, []) for name, run in paths.items()}, rounds)

    best, worst = (_BITRATE / (FORMAT.n_messages * bits) for bits in (_BITS_BEST, _BITS_WORST))
    line("compared", f"{n_frames} frames of {FORMAT.n_messages} messages, {rounds} rounds in turns")
    line("a bus of 1 Mbit/s carries", f"{worst:.1f} to {best:.1f} frames/s")
    for title, group, reference in (
        ("payloads to frames", codec, "FrameAssembler"),
        ("bus in memory to frames", path, "TactileLink"),
    ):
        line(title, "")
        for name, runs in group.items():
            rate = n_frames / statistics.median(run.wall_s for run in runs)
            share = worst * statistics.median(run.cpu_s for run in runs) / n_frames
            line(
                f"  {name}",
                f"{rate:7.0f} frames/s, {rate / best:.0f} to {rate / worst:.0f} times the bus, "
                f"{100 * share:.2f} % of a core at {worst:.0f} frames/s",
            )
        ours = [run.wall_s for run in group[reference]]
        for name, runs in group.items():
            if name != reference:
                text = f"{reference} is {ratio([r.wall_s for r in runs], ours):.1f} times as fast"
                line("  ratio", f"{text} as {name}")


if __name__ == "__main__":
    main()
