"""The transport's format: sizes, refusals, and what the simulated unit sends read back."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from simulator.can.messages import BurstFormat
from tactile.errors import LayoutError
from tactile.frames.assembler import FrameAssembler
from tactile.frames.codec import FrameFormat, crc16_ccitt
from tactile.layout import paper_layout

PAPER = FrameFormat(n_taxels=408, sample_bytes=1)


def test_crc_check_value() -> None:
    assert crc16_ccitt(b"123456789") == 0x29B1


def test_paper_format_fills_59_messages_without_padding() -> None:
    assert (PAPER.n_messages, PAPER.header_bytes, PAPER.data_bytes) == (59, 1, 7)
    assert PAPER.n_messages * PAPER.data_bytes == 408 + 5
    assert FrameFormat.of(paper_layout()) == PAPER


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
    frames = [assembler.push(message, 8, 1.5) for message in messages]
    assert frames[:-1] == [None] * (len(messages) - 1)
    frame = frames[-1]
    assert (frame.counter, frame.status, frame.t_s) == (counter, status, 1.5)
    assert frame.counts.dtype == np.uint16
    assert not frame.counts.flags.writeable
    np.testing.assert_array_equal(frame.counts, counts)
