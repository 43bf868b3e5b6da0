"""The transport: exact vectors, round trips, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tactile.errors import FrameError, LayoutError
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import FrameFormat, crc16, encode_frame
from tactile.layout import paper_layout, pinch_layout

PAPER = FrameFormat(n_taxels=408, sample_bytes=1)
RAMP = np.arange(408) & 0xFF


def test_crc_check_value() -> None:
    assert crc16(b"123456789") == 0x29B1


def test_paper_format_fills_59_messages_without_padding() -> None:
    assert (PAPER.n_messages, PAPER.header_bytes, PAPER.data_bytes) == (59, 1, 7)
    assert PAPER.payload_bytes == 408 + 5
    assert FrameFormat.of(paper_layout()) == PAPER


@pytest.mark.parametrize(
    ("counts", "counter", "status", "last"),
    [
        (np.zeros(408, int), 0, 0, "3A 00 00 00 00 00 74 87"),
        (np.full(408, 255), 0xFFFF, 1, "FA FF FF FF FF 01 A4 36"),
        (RAMP, 0x1234, 0, "3A 96 97 34 12 00 31 1D"),
        (RAMP, 0x1235, 0, "7A 96 97 35 12 00 01 2A"),
    ],
)
def test_last_message_vectors(counts: np.ndarray, counter: int, status: int, last: str) -> None:
    assert encode_frame(PAPER, counts, counter, status)[58] == bytes.fromhex(last)


def test_message_vectors() -> None:
    messages = encode_frame(PAPER, RAMP, 0x1235, 0)
    assert len(messages) == 59
    assert messages[0] == bytes.fromhex("40 00 01 02 03 04 05 06")
    assert messages[1] == bytes.fromhex("41 07 08 09 0A 0B 0C 0D")
    assert messages[57] == bytes.fromhex("79 8F 90 91 92 93 94 95")


@pytest.mark.parametrize(
    ("n_taxels", "sample_bytes", "messages", "header"),
    [
        (1, 1, 1, 1),
        (2, 1, 1, 1),
        (3, 1, 2, 1),
        (443, 1, 64, 1),
        (444, 1, 75, 2),
        (156, 2, 46, 1),
        (408, 2, 137, 2),
        (6 * 16384 - 5, 1, 16384, 2),
    ],
)
def test_sizes(n_taxels: int, sample_bytes: int, messages: int, header: int) -> None:
    frame_format = FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)
    assert (frame_format.n_messages, frame_format.header_bytes) == (messages, header)


def test_pinch_layout_sends_16_bit_little_endian_and_zero_padding() -> None:
    frame_format = FrameFormat.of(pinch_layout())
    counts = np.full(156, 0x0ABC)
    messages = encode_frame(frame_format, counts, 2, 0)
    assert messages[0] == bytes.fromhex("80 BC 0A BC 0A BC 0A BC")
    # 312 sample bytes + 5 of padding + 5 of trailer = 46 x 7
    payload = b"".join(message[1:] for message in messages)
    assert payload[312:317] == bytes(5)
    assert payload[317:320] == bytes.fromhex("02 00 00")
    assert int.from_bytes(payload[320:], "little") == crc16(payload[:320])


def test_long_header_is_phase_and_index_high_then_low() -> None:
    frame_format = FrameFormat(n_taxels=2000, sample_bytes=1)
    messages = encode_frame(frame_format, np.arange(2000) % 251, 3, 0)
    assert messages[0][:2] == bytes([0xC0, 0x00])
    assert messages[300][:2] == bytes([0xC1, 0x2C])


@pytest.mark.parametrize(
    ("n_taxels", "sample_bytes"), [(0, 1), (10, 3), (10, 0), (6 * 16384 - 4, 1)]
)
def test_impossible_formats_are_refused(n_taxels: int, sample_bytes: int) -> None:
    with pytest.raises(LayoutError):
        FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)


@pytest.mark.parametrize(
    ("counts", "counter", "status", "says"),
    [
        (np.zeros(407, int), 0, 0, "407"),
        (np.full(408, 256), 0, 0, "256"),
        (np.full(408, -1), 0, 0, "-1"),
        (np.zeros(408), 0, 0, "float64"),
        (np.zeros(408, int), 65536, 0, "65536"),
        (np.zeros(408, int), 0, 256, "256"),
    ],
)
def test_values_that_do_not_fit_are_refused(
    counts: np.ndarray, counter: int, status: int, says: str
) -> None:
    with pytest.raises(FrameError, match=says):
        encode_frame(PAPER, counts, counter, status)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(
    n_taxels=st.one_of(st.integers(1, 500), st.sampled_from([443, 444, 437])),
    sample_bytes=st.sampled_from([1, 2]),
    counter=st.integers(0, 0xFFFF),
    status=st.integers(0, 0xFF),
    seed=st.integers(0, 2**32 - 1),
    shuffle=st.booleans(),
)
def test_round_trip(
    *, n_taxels: int, sample_bytes: int, counter: int, status: int, seed: int, shuffle: bool
) -> None:
    rng = np.random.default_rng(seed)
    frame_format = FrameFormat(n_taxels=n_taxels, sample_bytes=sample_bytes)
    counts = rng.integers(0, 1 << 8 * sample_bytes, n_taxels)
    messages = encode_frame(frame_format, counts, counter, status)
    assert all(len(message) == 8 for message in messages)
    if shuffle:
        rng.shuffle(messages)
    assembler = FrameAssembler(frame_format)
    frames = [assembler.push(message, 8, 1.5) for message in messages]
    assert frames[:-1] == [None] * (len(messages) - 1)
    frame = frames[-1]
    assert frame is not None
    assert (frame.counter, frame.status, frame.t_s) == (counter, status, 1.5)
    assert frame.counts.dtype == np.uint16
    assert not frame.counts.flags.writeable
    np.testing.assert_array_equal(frame.counts, counts)
