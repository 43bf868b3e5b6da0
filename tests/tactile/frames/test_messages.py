"""The bytes of frames and of force messages: damage costs frames, and none comes out torn."""

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from simulator.can.messages import BurstFormat, DamagedObject, force_bytes, read_table, read_zero
from tactile.errors import FrameError, LayoutError
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import PHASE_SHIFT, FrameFormat
from tactile.frames.force_message import (
    BAD_TAXEL,
    TABLE_NODES,
    crc8,
    decode_force_message,
    encode_table,
    encode_zero,
)
from tactile.frames.force_stream import ForceStream
from tactile.source import ForceMessage, ForceStatus, TactileFrame

PAPER = FrameFormat(n_taxels=408, sample_bytes=1)


@pytest.mark.parametrize(
    ("n_taxels", "sample_bytes", "messages", "header"),
    [
        (2, 1, 1, 1),
        (3, 1, 2, 1),
        (443, 1, 64, 1),
        (444, 1, 75, 2),
        (156, 2, 46, 1),
        (408, 1, 59, 1),
        (6 * 16384 - 5, 1, 16384, 2),
    ],
)
def test_sizes(n_taxels, sample_bytes, messages, header) -> None:
    frame_format = FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)
    assert (frame_format.n_messages, frame_format.header_bytes) == (messages, header)
    sent = BurstFormat(n_taxels, sample_bytes)
    assert (sent.n_messages, sent.header_bytes) == (messages, header)


@pytest.mark.parametrize(
    ("n_taxels", "sample_bytes"), [(0, 1), (10, 3), (10, 0), (6 * 16384 - 4, 1)]
)
def test_impossible_formats_are_refused(n_taxels, sample_bytes) -> None:
    with pytest.raises(LayoutError):
        FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)


@settings(max_examples=60)
@given(
    n_taxels=st.one_of(st.integers(1, 500), st.sampled_from([443, 444, 437])),
    sample_bytes=st.sampled_from([1, 2]),
    counter=st.integers(0, 0xFFFF),
    status=st.integers(0, 0xFF),
    seed=st.integers(0, 2**32 - 1),
    shuffle=st.booleans(),
)
def test_round_trip(*, n_taxels, sample_bytes, counter, status, seed, shuffle) -> None:
    rng = np.random.default_rng(seed)
    frame_format = FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)
    counts = rng.integers(0, 1 << 8 * sample_bytes, n_taxels)
    messages = BurstFormat(n_taxels, sample_bytes).burst(counts, counter, status)
    assert all(len(message) == 8 for message in messages)
    if shuffle:
        rng.shuffle(messages)
    assembler = FrameAssembler(frame_format)
    frames = [assembler.push(message, 1.5) for message in messages]
    assert frames[:-1] == [None] * (len(messages) - 1)
    frame = frames[-1]
    assert (frame.counter, frame.status, frame.t_s) == (counter, status, 1.5)
    assert frame.counts.dtype == np.uint16
    assert not frame.counts.flags.writeable
    np.testing.assert_array_equal(frame.counts, counts)


def message(counter: int, force_n: float = 1.0, t_s: float = 0.0) -> ForceMessage:
    return ForceMessage(
        t_s=t_s,
        counter=counter,
        status=ForceStatus.ZEROED,
        force_n=(force_n, force_n),
        centre_taxels=(0.0, 0.0),
    )


def test_the_checksum_is_that_of_the_catalogue() -> None:
    # CRC-8/SAE-J1850 of the catalogue of parametrised CRC algorithms.
    assert crc8(b"123456789") == 0x4B


def test_the_bytes_are_those_of_the_layout() -> None:
    sent = ForceMessage(
        t_s=7.0,
        counter=11,
        status=ForceStatus.ZEROED | ForceStatus.OVERRUN,
        force_n=(12.346, -0.25),
        centre_taxels=(-3.5, 1.0625),
    )
    data = force_bytes(sent)
    assert data[:7] == struct.pack("<Bhhbb", 0x9B, 6173, -125, -56, 17)
    assert decode_force_message(data, 7.0) == sent


def test_without_a_touch_there_is_no_centre_and_what_is_too_much_stays_at_the_end() -> None:
    sent = ForceMessage(
        t_s=0.0, counter=3, status=ForceStatus(0), force_n=(1e3, -1e3), centre_taxels=None
    )
    found = decode_force_message(force_bytes(sent), 0.0)
    assert found.centre_taxels is None
    assert found.force_n == pytest.approx((65.534, -65.534))


@pytest.mark.parametrize("bit", range(64))
def test_one_turned_bit_is_noticed(bit: int) -> None:
    data = bytearray(force_bytes(message(5)))
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(FrameError, match="force CRC"):
        decode_force_message(data, 0.0)


def test_lost_repeated_late_and_damaged_messages_are_told_apart() -> None:
    stream, period_s = ForceStream(0.003), 0.003
    sent = [force_bytes(message(n % 16, 1.0 + 0.1 * n)) for n in range(40)]
    took = []
    order = [0, 1, 2, 5, 5, 4, 6, 7]  # 3 lost, 5 twice, 4 late
    for place, n in enumerate(order):
        took.append(stream.push(sent[n], place * period_s) is not None)
    assert took == [True, True, True, True, False, False, True, True]
    assert stream.push(sent[8][:7], 0.03) is None
    assert stream.push(b"\0" * 8, 0.03) is None
    statistics = stream.counts
    assert (statistics.received, statistics.lost, statistics.repeated) == (6, 1, 1)
    assert (statistics.late, statistics.damaged) == (1, 2)


def test_after_a_silence_any_counter_is_newer() -> None:
    stream = ForceStream(0.003)
    assert stream.push(force_bytes(message(4)), 0.0) is not None
    assert stream.push(force_bytes(message(4)), 0.048) is not None
    assert stream.counts.lost == 15
    assert stream.push(force_bytes(message(5, 2.0)), 0.148) is not None
    assert stream.counts.lost == 15


def test_a_message_that_comes_again_and_again_stays_old() -> None:
    stream = ForceStream(0.003)
    took = [stream.push(force_bytes(message(4)), 0.003 * n) for n in range(100)]
    assert [n for n, one in enumerate(took) if one is not None] == [0]
    assert stream.counts.repeated == 99


@pytest.mark.parametrize("start", range(16))
def test_a_unit_that_counts_from_zero_again_is_followed_within_ten_messages(start: int) -> None:
    stream = ForceStream(0.003)
    assert stream.push(force_bytes(message(start)), 0.0) is not None
    took = [
        stream.push(force_bytes(message(n % 16, 2.0)), 0.003 * (n + 1)) is not None
        for n in range(12)
    ]
    assert all(took[9:])


def test_the_table_comes_back_within_half_a_step() -> None:
    table_n = np.linspace(0.0, [14.0, 20.0], TABLE_NODES).T
    np.testing.assert_allclose(read_table(encode_table(table_n)), table_n, atol=0.00026)
    with pytest.raises(FrameError, match="shape"):
        encode_table(table_n[:, :-1])


def test_the_zero_comes_back_and_names_the_taxels_that_fail() -> None:
    zero_counts = np.array([0.0, 8.03, 250.0, 17.5])
    bad = np.array([False, False, True, False])
    data = encode_zero(3.5, zero_counts, bad, 255)
    touch_counts, found_counts, found_bad = read_zero(data, 4, 255)
    assert touch_counts == pytest.approx(3.5, abs=0.003)
    np.testing.assert_allclose(found_counts[~bad], zero_counts[~bad], atol=0.003)
    np.testing.assert_array_equal(found_bad, bad)
    assert int.from_bytes(data[6:8], "little") == BAD_TAXEL


def test_a_damaged_object_is_refused() -> None:
    data = bytearray(encode_table(np.zeros((2, TABLE_NODES))))
    data[17] ^= 4
    with pytest.raises(DamagedObject, match="CRC"):
        read_table(bytes(data))
    with pytest.raises(DamagedObject, match="where 12 were"):
        read_zero(bytes(data), 4, 255)


# -- The assembler: every kind of damage costs frames, none yields a torn one ----------------------


N_FRAMES = 6
N_MESSAGES = 59
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
    frames = (assembler.push(m, i * 1e-4) for i, m in enumerate(stream))
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
    assert (assembler.counts.reordered, assembler.counts.torn) == (1, 0)


def test_a_message_later_than_the_next_frame_does_not_bring_back_an_older_frame(assembler) -> None:
    first, second, third = (SENT.burst(np.full(408, c), c, 0) for c in (0, 1, 2))
    late = first.pop(40)
    counters = [frame.counter for frame in received(assembler, first + second + [late] + third)]
    assert counters == [1, 2]


def test_duplicates_and_swaps_are_counted_and_harmless(assembler) -> None:
    messages = SENT.burst(np.arange(408) & 255, 9, 0)
    swapped = [messages[1], messages[0], messages[0], *messages[2:], messages[58], messages[3]]
    assert len(received(assembler, swapped)) == 1
    assert (assembler.counts.reordered, assembler.counts.duplicate) == (1, 3)


def test_repeated_and_older_frames_are_stale(assembler) -> None:
    newer, older = (SENT.burst(np.full(408, c), c, 0) for c in (9, 8))
    other = SENT.burst(np.full(408, 77), 9, 0)
    assert len(received(assembler, newer + older + other)) == 1
    assert assembler.counts.stale == 2


@pytest.mark.parametrize("length", [0, 1, 3, 7])
def test_short_messages_are_dropped(assembler, length: int) -> None:
    messages = SENT.burst(np.zeros(408, int), 0, 0)
    assert assembler.push(messages[0][:length], 0.0) is None
    assert assembler.counts.short == 1
    assert len(received(assembler, messages)) == 1


def test_index_beyond_the_burst_is_refused(assembler) -> None:
    assert assembler.push(bytes([59]) + bytes(7), 0.0) is None
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
        frame = assembler.push(buffer, 0.0)
    np.testing.assert_array_equal(frame.counts, np.arange(408) & 255)


@pytest.mark.parametrize("missing", [1, 2, 5, 6])
def test_idle_frames_after_lost_ones_are_not_taken_for_duplicates(missing: int) -> None:
    kept = [c for c in range(20) if not 8 <= c < 8 + missing]
    frames = received(FrameAssembler(PAPER), stream_of(dict.fromkeys(kept, np.zeros(408, int))))
    assert [frame.counter for frame in frames] == kept
