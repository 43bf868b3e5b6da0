"""The bytes of frames and of force messages: damage costs frames, and none comes out torn."""

import struct

import numpy as np
import pytest

from simulator.can.scanner import BurstFormat, force_bytes
from tactile.control_unit.settings import LinkSettings
from tactile.control_unit.watch import ForceFlow
from tactile.errors import LayoutError
from tactile.frames import PHASE_SHIFT, FrameAssembler, FrameFormat, crc8, decode_force_message
from tactile.source import ForceMessage, ForceStatistics, ScanStatus, TactileFrame

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


def test_a_frame_of_too_many_taxels_is_refused() -> None:
    with pytest.raises(LayoutError, match="allowed are 16384"):
        FrameFormat(n_taxels=6 * 16384 - 4, sample_bytes=1)


@pytest.mark.parametrize(("n_taxels", "sample_bytes"), [(1, 1), (443, 1), (444, 1), (156, 2)])
def test_a_frame_comes_back_from_its_messages_in_any_order(n_taxels, sample_bytes) -> None:
    rng = np.random.default_rng(n_taxels)
    counts = rng.integers(0, 1 << 8 * sample_bytes, n_taxels)
    messages = BurstFormat(n_taxels, sample_bytes).burst(counts, 0xFFFE, 0x81)
    rng.shuffle(messages)
    assembler = FrameAssembler(FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes))
    *early, frame = (assembler.push(message, 1.5) for message in messages)
    assert early == [None] * (len(messages) - 1)
    assert (frame.counter, frame.status, frame.t_s) == (0xFFFE, 0x81, 1.5)
    np.testing.assert_array_equal(frame.counts, counts)


def message(counter: int, force_n: float = 1.0) -> ForceMessage:
    return ForceMessage(
        t_s=0.0,
        counter=counter,
        status=ScanStatus.ZEROED,
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
        status=ScanStatus.ZEROED | ScanStatus.OVERRUN,
        force_n=(12.346, -0.25),
        centre_taxels=(-3.5, 1.0625),
    )
    data = force_bytes(sent)
    assert data[:7] == struct.pack("<Bhhbb", 0x9B, 6173, -125, -56, 17)
    assert decode_force_message(data, 7.0) == sent


def test_without_a_touch_there_is_no_centre_and_what_is_too_much_stays_at_the_end() -> None:
    sent = ForceMessage(
        t_s=0.0, counter=3, status=ScanStatus(0), force_n=(1e3, -1e3), centre_taxels=None
    )
    decoded = decode_force_message(force_bytes(sent), 0.0)
    assert decoded.centre_taxels is None
    assert decoded.force_n == pytest.approx((65.534, -65.534))


@pytest.mark.parametrize("bit", range(64))
def test_one_turned_bit_is_noticed(bit: int) -> None:
    data = bytearray(force_bytes(message(5)))
    data[bit // 8] ^= 1 << bit % 8
    assert decode_force_message(data, 0.0) is None


@pytest.fixture
def stream() -> ForceFlow:
    return ForceFlow("the unit", LinkSettings(force_period_s=0.003), ForceStatistics())


def test_lost_repeated_late_and_damaged_messages_are_told_apart(stream) -> None:
    period_s = 0.003
    sent = [force_bytes(message(n % 16, 1.0 + 0.1 * n)) for n in range(40)]
    took, order = [], [0, 1, 2, 5, 5, 4, 6, 7]  # 3 lost, 5 twice, 4 late
    for place, n in enumerate(order):
        took.append(stream.push(sent[n], place * period_s) is not None)
    assert took == [True, True, True, True, False, False, True, True]
    assert stream.push(sent[8][:7], 0.03) is None
    assert stream.push(b"\0" * 8, 0.03) is None
    statistics = stream.counts
    assert (statistics.received, statistics.lost, statistics.repeated) == (6, 1, 1)
    assert (statistics.late, statistics.damaged) == (1, 2)


def test_after_a_silence_any_counter_is_newer(stream) -> None:
    assert stream.push(force_bytes(message(4)), 0.0) is not None
    assert stream.push(force_bytes(message(4)), 0.048) is not None
    assert stream.counts.lost == 15
    assert stream.push(force_bytes(message(5, 2.0)), 0.148) is not None
    assert stream.counts.lost == 15


def test_a_message_that_comes_again_and_again_stays_old(stream) -> None:
    took = [stream.push(force_bytes(message(4)), 0.003 * n) for n in range(100)]
    assert [n for n, one in enumerate(took) if one is not None] == [0]
    assert stream.counts.repeated == 99


@pytest.mark.parametrize("start", range(16))
def test_a_unit_that_counts_from_zero_again_is_followed_within_ten(stream, start: int) -> None:
    assert stream.push(force_bytes(message(start)), 0.0) is not None
    took = [
        stream.push(force_bytes(message(n % 16, 2.0)), 0.003 * (n + 1)) is not None
        for n in range(12)
    ]
    assert all(took[9:])


# -- The assembler: every kind of damage costs frames, none yields a torn one ----------------------


N_MESSAGES = 59
SENT = BurstFormat(n_taxels=408, sample_bytes=1)

Stream = list[bytes]


def received(assembler: FrameAssembler, stream: Stream) -> list[TactileFrame]:
    frames = (assembler.push(m, i * 1e-4) for i, m in enumerate(stream))
    return [frame for frame in frames if frame is not None]


@pytest.mark.parametrize(
    ("shortest", "longest"), [(1, 130), (N_MESSAGES, N_MESSAGES), 2 * (4 * N_MESSAGES,), (0, 0)]
)
def test_every_frame_that_lost_nothing_is_handed_out(shortest: int, longest: int) -> None:
    """A burst of messages is lost, as many as frames have too, or one in a hundred."""
    rng = np.random.default_rng(21)
    for _ in range(40):
        counters = (rng.integers(0x10000) + np.arange(6)) & 0xFFFF
        sent = {int(c): SENT.burst(rng.integers(0, 256, 408), int(c), 0) for c in counters}
        stream = [message for messages in sent.values() for message in messages]
        length = int(rng.integers(shortest, longest, endpoint=True))
        start = int(rng.integers(0, len(stream) - length))
        left = stream[:start] + stream[start + length :]
        if not length:
            left = [message for message in stream if rng.random() > 0.01]
        whole = [counter for counter, messages in sent.items() if set(left).issuperset(messages)]
        assert [f.counter for f in received(FrameAssembler(PAPER), left)] == whole


def burst(counter: int, value: int | None = None) -> Stream:
    return SENT.burst(np.full(408, counter & 0xFF if value is None else value), counter, 0)


def without(messages: Stream, index: int) -> Stream:
    return messages[:index] + messages[index + 1 :]


def swapped(m: Stream) -> Stream:
    return [m[1], m[0], m[0], *m[2:], m[58], m[3]]


@pytest.mark.parametrize(
    ("stream", "handed_out", "counted"),
    [
        # The counter turns.
        (
            [m for c in range(65530, 65546) for m in burst(c & 0xFFFF)],
            [c & 0xFFFF for c in range(65530, 65546)],
            {"complete": 16, "lost": 0, "torn": 0},
        ),
        (
            [*burst(0), *burst(1), *without(burst(2), 17), *burst(3), *burst(6), *burst(7)],
            [0, 1, 3, 6, 7],
            {"lost": 3, "torn": 1},
        ),
        # Completed while the next one arrives, and later.
        (
            [*without(burst(0), 40), *burst(1)[:20], burst(0)[40], *burst(1)[20:]],
            [0, 1],
            {"reordered": 1, "torn": 0},
        ),
        ([*without(burst(0), 40), *burst(1), burst(0)[40], *burst(2)], [1, 2], {}),
        (swapped(burst(9)), [9], {"reordered": 1, "duplicate": 3}),
        ([*burst(9), *burst(8), *burst(9, 77)], [9], {"stale": 2}),
        ([*(burst(0)[0][:n] for n in (0, 1, 3, 7)), *burst(0)], [0], {"short": 4}),
        # Beyond the burst, with a wrong CRC, of another phase.
        ([bytes([59]) + bytes(7)], [], {"corrupt": 1}),
        ([*burst(4)[:58], burst(4)[58][:7] + b"\0", *burst(5)], [5], {"corrupt": 1}),
        ([bytes([m[0] ^ 1 << PHASE_SHIFT]) + m[1:] for m in burst(4)], [], {"corrupt": 1}),
    ],
)
def test_what_is_handed_out_and_counted(stream: Stream, handed_out, counted) -> None:
    assembler = FrameAssembler(PAPER)
    assert [frame.counter for frame in received(assembler, stream)] == handed_out
    assert {name: getattr(assembler.counts, name) for name in counted} == counted


def test_a_buffer_that_the_caller_reuses_does_no_harm() -> None:
    assembler = FrameAssembler(PAPER)
    buffer, frame = bytearray(8), None
    for message in SENT.burst(np.arange(408) & 255, 1, 0):
        buffer[:] = message
        frame = assembler.push(buffer, 0.0)
    np.testing.assert_array_equal(frame.counts, np.arange(408) & 255)


@pytest.mark.parametrize("missing", [1, 2, 5, 6])
def test_idle_frames_after_lost_ones_are_not_taken_for_duplicates(missing: int) -> None:
    present = [c for c in range(20) if not 8 <= c < 8 + missing]
    frames = received(FrameAssembler(PAPER), [m for c in present for m in burst(c, 0)])
    assert [frame.counter for frame in frames] == present
