"""Pad features: numbers, round trip, damage."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile.errors import FrameError
from tactile.frames.pad_features import (
    FeatureCollector,
    PadFeatures,
    decode_features,
    encode_features,
    pad_features,
)
from tactile.layout import paper_layout

SOME = PadFeatures(
    pad=5,
    counter=0x42,
    active=3,
    peak_counts=200,
    total_counts=0x01020304,
    centroid_row=2.5,
    centroid_column=1.25,
)


def test_byte_vector() -> None:
    first, second = encode_features(SOME)
    assert first == bytes.fromhex("85 03 C8 00 04 03 02 01")
    assert second[:6] == bytes.fromhex("85 42 80 02 40 01")
    assert decode_features(first, second) == SOME


@settings(derandomize=True, max_examples=50, deadline=None)
@given(
    pad=st.integers(0, 63),
    counter=st.integers(0, 255),
    active=st.integers(0, 255),
    peak=st.integers(0, 0xFFFF),
    total=st.integers(0, 0xFFFFFFFF),
    row=st.integers(0, 0xFFFF),
    column=st.integers(0, 0xFFFF),
)
def test_round_trip(
    *, pad: int, counter: int, active: int, peak: int, total: int, row: int, column: int
) -> None:
    features = PadFeatures(
        pad=pad,
        counter=counter,
        active=active,
        peak_counts=peak,
        total_counts=total,
        centroid_row=row / 256,
        centroid_column=column / 256,
    )
    assert decode_features(*encode_features(features)) == features


def test_features_of_a_frame() -> None:
    layout = paper_layout()
    counts = np.full(408, 10, dtype=np.uint16)
    inner = layout.taxels_of(5)
    counts[inner.start + 4 * 4 + 1] = 50
    counts[inner.start + 4 * 4 + 2] = 150
    features = pad_features(layout, counts, 0x1FF, 30)
    assert len(features) == 10
    pad = features[5]
    assert (pad.counter, pad.active, pad.peak_counts, pad.total_counts) == (0xFF, 2, 150, 200)
    assert (pad.centroid_row, pad.centroid_column) == (4.0, 1.75)
    assert (features[0].active, features[0].total_counts, features[0].peak_counts) == (0, 0, 10)
    assert (features[0].centroid_row, features[0].centroid_column) == (0.0, 0.0)
    with pytest.raises(FrameError, match="407"):
        pad_features(layout, counts[:407], 0, 30)


@pytest.mark.parametrize("bit", range(128))
def test_every_flipped_bit_is_found(bit: int) -> None:
    both = bytearray(b"".join(encode_features(SOME)))
    both[bit // 8] ^= 1 << bit % 8
    with pytest.raises(FrameError):
        decode_features(bytes(both[:8]), bytes(both[8:]))


def test_messages_of_two_scans_do_not_mix() -> None:
    first, _ = encode_features(SOME)
    _, second = encode_features(replace(SOME, counter=0x43))
    with pytest.raises(FrameError, match="CRC"):
        decode_features(first, second)


def test_inconsistent_headers_are_refused_even_with_a_good_crc() -> None:
    first, second = encode_features(SOME)
    from tactile.frames.codec import crc16

    forged = second[:1] + b"\x43" + second[2:6]
    with pytest.raises(FrameError, match="different scans"):
        decode_features(first, forged + crc16(first + forged).to_bytes(2, "little"))


@pytest.mark.parametrize("change", [{"pad": 64}, {"active": 256}, {"centroid_row": 256.0}])
def test_values_that_do_not_fit_are_refused(change: dict) -> None:
    with pytest.raises(FrameError):
        encode_features(replace(SOME, **change))


def test_collector_pairs_and_counts_what_is_left_over() -> None:
    collector = FeatureCollector()
    first, second = encode_features(SOME)
    assert collector.push_second(second) is None
    collector.push_first(first)
    collector.push_first(b"\0")
    assert collector.push_second(second) == SOME
    assert collector.push_second(second) is None
    assert collector.push_second(b"") is None
    assert collector.malformed == 4
    assert collector.take() == (SOME,)
    assert collector.take() == ()
