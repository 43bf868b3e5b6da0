"""The assembler: every kind of damage costs frames, none yields a torn one."""

from collections.abc import Callable

import numpy as np
import pytest

from simulator.can.messages import BurstFormat
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import PHASE_SHIFT, FrameFormat
from tactile.source import TactileFrame

N_FRAMES = 6
N_MESSAGES = 59
PAPER = FrameFormat(n_taxels=408, sample_bytes=1)
SENT = BurstFormat(n_taxels=408, sample_bytes=1)
RUNS = 40

Stream = list[bytes]
Damage = Callable[[Stream, np.random.Generator], Stream]


def sent_frames(rng: np.random.Generator, n: int = N_FRAMES) -> dict[int, np.ndarray]:
    start = int(rng.integers(0, 0x10000))
    return {(start + i) & 0xFFFF: rng.integers(0, 256, 408) for i in range(n)}


def stream_of(frames: dict[int, np.ndarray]) -> Stream:
    return [m for counter, counts in frames.items() for m in SENT.burst(counts, counter, 0)]


def received(assembler: FrameAssembler, stream: Stream) -> list[TactileFrame]:
    frames = (assembler.push(m, len(m), i * 1e-4) for i, m in enumerate(stream))
    return [frame for frame in frames if frame is not None]


@pytest.fixture
def assembler() -> FrameAssembler:
    return FrameAssembler(PAPER)


def burst_loss(stream: Stream, rng: np.random.Generator) -> Stream:
    length = int(rng.integers(1, 131))
    start = int(rng.integers(0, len(stream) - length))
    return stream[:start] + stream[start + length :]


def loss_of_frames(n_frames: int) -> Damage:
    """Lose exactly so many messages as those frames have, from anywhere."""

    def lose(stream: Stream, rng: np.random.Generator) -> Stream:
        start = int(rng.integers(0, len(stream) - n_frames * N_MESSAGES))
        return stream[:start] + stream[start + n_frames * N_MESSAGES :]

    return lose


def random_loss(stream: Stream, rng: np.random.Generator) -> Stream:
    return [message for message in stream if rng.random() > 0.01]


@pytest.mark.parametrize("damage", [burst_loss, loss_of_frames(1), loss_of_frames(4), random_loss])
def test_every_frame_that_lost_nothing_is_handed_out(damage: Damage) -> None:
    rng = np.random.default_rng(21)
    for _ in range(RUNS):
        sent = sent_frames(rng)
        stream = damage(stream_of(sent), rng)
        left = set(stream)
        whole = [
            counter
            for counter, counts in sent.items()
            if left.issuperset(SENT.burst(counts, counter, 0))
        ]
        assert [f.counter for f in received(FrameAssembler(PAPER), stream)] == whole


def test_undamaged_stream_is_all_there_across_the_counters_turn(assembler) -> None:
    frames = received(
        assembler, stream_of({c & 0xFFFF: np.full(408, c & 0xFF) for c in range(65530, 65546)})
    )
    assert len(frames) == 16
    statistics = assembler.counts
    assert (statistics.complete, statistics.lost, statistics.torn) == (16, 0, 0)


def test_lost_and_torn_are_counted() -> None:
    messages = [SENT.burst(np.full(408, c), c, 0) for c in range(8)]
    del messages[2][17]
    stream = [m for c in (0, 1, 2, 3, 6, 7) for m in messages[c]]
    assembler = FrameAssembler(PAPER)
    assert [frame.counter for frame in received(assembler, stream)] == [0, 1, 3, 6, 7]
    statistics = assembler.counts
    assert (statistics.lost, statistics.torn) == (3, 1)


def test_a_late_message_completes_its_own_frame_while_the_next_one_arrives() -> None:
    first, second = (SENT.burst(np.full(408, c), c, 0) for c in (0, 1))
    late = first.pop(40)
    stream = first + second[:20] + [late] + second[20:]
    assembler = FrameAssembler(PAPER)
    assert [frame.counter for frame in received(assembler, stream)] == [0, 1]
    assert assembler.counts.reordered == 1
    assert assembler.counts.torn == 0


def test_a_message_later_than_the_next_frame_does_not_bring_back_an_older_frame(assembler) -> None:
    first, second, third = (SENT.burst(np.full(408, c), c, 0) for c in (0, 1, 2))
    late = first.pop(40)
    counters = [frame.counter for frame in received(assembler, first + second + [late] + third)]
    assert counters == [1, 2]


def test_duplicates_and_swaps_are_counted_and_harmless(assembler) -> None:
    messages = SENT.burst(np.arange(408) & 255, 9, 0)
    swapped = [messages[1], messages[0], messages[0], *messages[2:], messages[58], messages[3]]
    assert len(received(assembler, swapped)) == 1
    assert assembler.counts.reordered == 1
    assert assembler.counts.duplicate == 3


def test_repeated_and_older_frames_are_stale(assembler) -> None:
    newer, older = (SENT.burst(np.full(408, c), c, 0) for c in (9, 8))
    other = SENT.burst(np.full(408, 77), 9, 0)
    assert len(received(assembler, newer + older + other)) == 1
    assert assembler.counts.stale == 2


@pytest.mark.parametrize("length", [0, 1, 3, 7])
def test_short_messages_are_dropped_even_if_the_dlc_says_eight(assembler, length: int) -> None:
    messages = SENT.burst(np.zeros(408, int), 0, 0)
    assert assembler.push(messages[0][:length], 8, 0.0) is None
    assert assembler.push(messages[0], length, 0.0) is None
    assert assembler.counts.short == 2
    assert len(received(assembler, messages)) == 1


def test_index_beyond_the_burst_is_refused(assembler) -> None:
    assert assembler.push(bytes([59]) + bytes(7), 8, 0.0) is None
    assert assembler.counts.corrupt == 1


def test_wrong_crc_is_refused_and_the_next_frame_is_taken(assembler) -> None:
    first, second = (SENT.burst(np.full(408, c), c, 0) for c in (4, 5))
    first[58] = first[58][:-1] + bytes([first[58][-1] ^ 1])
    assert [frame.counter for frame in received(assembler, first + second)] == [5]
    assert assembler.counts.corrupt == 1


def test_a_counter_of_another_phase_than_its_messages_is_refused(assembler) -> None:
    sent = [bytes([m[0] ^ 1 << PHASE_SHIFT]) + m[1:] for m in stream_of({4: np.full(408, 7)})]
    assert received(assembler, sent) == []
    assert assembler.counts.corrupt == 1


def test_a_buffer_that_the_caller_reuses_does_no_harm(assembler) -> None:
    buffer = bytearray(8)
    frame = None
    for message in SENT.burst(np.arange(408) & 255, 1, 0):
        buffer[:] = message
        frame = assembler.push(buffer, 8, 0.0)
    np.testing.assert_array_equal(frame.counts, np.arange(408) & 255)


@pytest.mark.parametrize("missing", [1, 2, 5, 6])
def test_idle_frames_after_lost_ones_are_not_taken_for_duplicates(missing: int) -> None:
    kept = [c for c in range(20) if not 8 <= c < 8 + missing]
    frames = received(FrameAssembler(PAPER), stream_of(dict.fromkeys(kept, np.zeros(408, int))))
    assert [frame.counter for frame in frames] == kept
