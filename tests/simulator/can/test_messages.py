"""The bytes of the simulated control unit: exact vectors of its bursts."""

from binascii import crc_hqx

import numpy as np
import pytest

from simulator.can.messages import BurstFormat

PAPER = BurstFormat(n_taxels=408, sample_bytes=1)
RAMP = np.arange(408) & 0xFF


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
    assert PAPER.burst(counts, counter, status)[58] == bytes.fromhex(last)


def test_message_vectors() -> None:
    messages = PAPER.burst(RAMP, 0x1235, 0)
    assert len(messages) == 59
    assert messages[0] == bytes.fromhex("40 00 01 02 03 04 05 06")
    assert messages[1] == bytes.fromhex("41 07 08 09 0A 0B 0C 0D")
    assert messages[57] == bytes.fromhex("79 8F 90 91 92 93 94 95")


def test_pinch_layout_sends_16_bit_little_endian_and_zero_padding() -> None:
    pinch = BurstFormat(n_taxels=156, sample_bytes=2)
    counts = np.full(156, 0x0ABC)
    messages = pinch.burst(counts, 2, 0)
    assert messages[0] == bytes.fromhex("80 BC 0A BC 0A BC 0A BC")
    # 312 sample bytes + 5 of padding + 5 of trailer = 46 x 7
    payload = b"".join(message[1:] for message in messages)
    assert payload[312:317] == bytes(5)
    assert payload[317:320] == bytes.fromhex("02 00 00")
    assert int.from_bytes(payload[320:], "little") == crc_hqx(payload[:320], 0xFFFF)


def test_long_header_is_phase_and_index_high_then_low() -> None:
    long = BurstFormat(n_taxels=2000, sample_bytes=1)
    messages = long.burst(np.arange(2000) % 251, 3, 0)
    assert messages[0][:2] == bytes([0xC0, 0x00])
    assert messages[300][:2] == bytes([0xC1, 0x2C])
