"""Messages of tactile frames, and a bus in memory that holds them."""

from collections import deque
from collections.abc import Sequence

import can
import numpy as np

from simulator.settings import SimulatorSettings
from tactile.frames.codec import FrameFormat, encode_frame
from tactile.layout import paper_layout

LAYOUT = paper_layout()
FORMAT = FrameFormat.of(LAYOUT)
NODE_ID = SimulatorSettings().node_id
FRAME_ID = 0x180 + NODE_ID
PERIOD_S = 0.008
"""125 frames a second: what a bus of 1 Mbit/s carries at worst."""
_HEARTBEAT = can.Message(arbitration_id=0x700 + NODE_ID, is_extended_id=False, data=b"\x05")
_FRAMES_A_HEARTBEAT = 10


def made_counts(n_frames: int) -> np.ndarray:
    """Return counts (n_frames, 408): noise on all taxels, as an untouched skin has it."""
    noise = np.abs(10.0 * np.random.default_rng(1).standard_normal((n_frames, LAYOUT.n_taxels)))
    return np.rint(np.clip(noise, 1.0, 20.0)).astype(np.uint16)


def bursts(counts: np.ndarray, first_counter: int = 0) -> list[list[bytes]]:
    """Return the payloads of each frame's messages."""
    return [
        encode_frame(FORMAT, frame, number & 0xFFFF, 0)
        for number, frame in enumerate(counts, start=first_counter)
    ]


def messages_of(payloads: Sequence[Sequence[bytes]]) -> list[list[can.Message]]:
    """Return the messages that a host receives between two SYNCs, heartbeats among them."""
    made = []
    for number, burst in enumerate(payloads):
        beats = [_HEARTBEAT] if number % _FRAMES_A_HEARTBEAT == 0 else []
        frame = [
            can.Message(arbitration_id=FRAME_ID, is_extended_id=False, data=payload)
            for payload in burst
        ]
        made.append(beats + frame)
    return made


class FeedBus(can.BusABC):
    """A bus that passes on another one until it is fed with messages of its own."""

    def __init__(self, inner: can.BusABC | None = None) -> None:
        self.channel_info = "messages in memory"
        self.inner = inner
        self.waiting: deque[can.Message] = deque()
        super().__init__(channel="feed")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Pass a message on; without another bus it was sent, and nobody heard it."""
        if self.inner is not None:
            self.inner.send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.inner is not None:
            return self.inner.recv(timeout), True
        return (self.waiting.popleft() if self.waiting else None), False
