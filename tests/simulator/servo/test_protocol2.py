"""Protocol 2.0 on the wire: byte vectors of the e-Manual and properties of the strict parser."""

import pytest
from hypothesis import given, settings, strategies as st

from simulator.servo.protocol2 import (
    HEADER,
    MAX_LENGTH,
    FastBlock,
    Packet,
    PacketParser,
    crc16,
    encode_fast_status,
    encode_instruction,
    encode_status,
    stuff,
    unstuff,
)


def wire(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


# fmt: off
INSTRUCTIONS = [
    ("ping", 1, 0x01, "", "FFFFFD00 01 0300 01 194E"),
    ("ping broadcast", 0xFE, 0x01, "", "FFFFFD00 FE 0300 01 3142"),
    ("read", 1, 0x02, "8400 0400", "FFFFFD00 01 0700 02 8400 0400 1D15"),
    ("write", 1, 0x03, "7400 00020000", "FFFFFD00 01 0900 03 7400 00020000 CA89"),
    ("reg write", 1, 0x04, "6800 C8000000", "FFFFFD00 01 0900 04 6800 C8000000 AE8E"),
    ("action", 1, 0x05, "", "FFFFFD00 01 0300 05 02CE"),
    ("reboot", 1, 0x08, "", "FFFFFD00 01 0300 08 2F4E"),
    ("clear", 1, 0x10, "01 44584C22", "FFFFFD00 01 0800 10 01 44584C22 B1DC"),
    ("factory reset", 1, 0x06, "01", "FFFFFD00 01 0400 06 01 A1E6"),
    ("sync read", 0xFE, 0x82, "8400 0400 01 02", "FFFFFD00 FE 0900 82 8400 0400 01 02 CEFA"),
    ("sync write", 0xFE, 0x83, "7400 0400 01 96000000 02 AA000000",
     "FFFFFD00 FE 1100 83 7400 0400 01 96000000 02 AA000000 8287"),
    ("bulk read", 0xFE, 0x92, "01 9000 0200 02 9200 0100",
     "FFFFFD00 FE 0D00 92 01 9000 0200 02 9200 0100 1A05"),
    ("bulk write", 0xFE, 0x93, "01 2000 0200 A000 02 1F00 0100 50",
     "FFFFFD00 FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768"),
    ("fast sync read", 0xFE, 0x8A, "8400 0400 03 07 04",
     "FFFFFD00 FE 0A00 8A 8400 0400 03 07 04 20F2"),
    ("fast bulk read", 0xFE, 0x9A, "03 8400 0400 07 7C00 0200 04 9200 0100",
     "FFFFFD00 FE 1200 9A 03 8400 0400 07 7C00 0200 04 9200 0100 DA2D"),
    ("backup", 1, 0x20, "01 4354524C", "FFFFFD00 01 0800 20 01 4354524C 16F5"),
    ("restore", 1, 0x20, "02 4354524C", "FFFFFD00 01 0800 20 02 4354524C 9EF5"),
    ("sync read 10", 0xFE, 0x82, "7E00 0A00 01 02", "FFFFFD00 FE 0900 82 7E00 0A00 01 02 3892"),
    ("sync write currents", 0xFE, 0x83, "6600 0200 01 6400 02 9CFF",
     "FFFFFD00 FE 0D00 83 6600 0200 01 6400 02 9CFF E1DB"),
    ("torque on", 1, 0x03, "4000 01", "FFFFFD00 01 0600 03 4000 01 DB66"),
    ("watchdog 100 ms", 1, 0x03, "6200 05", "FFFFFD00 01 0600 03 6200 05 68E4"),
    ("watchdog clear", 1, 0x03, "6200 00", "FFFFFD00 01 0600 03 6200 00 76E4"),
    ("read 70", 1, 0x02, "4600 0100", "FFFFFD00 01 0700 02 4600 0100 3CA3"),
    ("stuffed write", 1, 0x03, "7400 FFFFFDFF", "FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5"),
    ("stuffed sync write", 0xFE, 0x83, "6600 0600 01 FFFF FDFFFFFF",
     "FFFFFD00 FE 0F00 83 6600 0600 01 FFFFFDFDFFFFFF 67DC"),
]
STATUSES = [
    ("ping", 1, 0x00, "060426", "FFFFFD00 01 0700 55 00 060426 655D"),
    ("ping of 2", 2, 0x00, "060426", "FFFFFD00 02 0700 55 00 060426 6F6D"),
    ("read", 1, 0x00, "A6000000", "FFFFFD00 01 0800 55 00 A6000000 8CC0"),
    ("sync read", 2, 0x00, "1F080000", "FFFFFD00 02 0800 55 00 1F080000 BABE"),
    ("bulk read 1", 1, 0x00, "7700", "FFFFFD00 01 0600 55 00 7700 C369"),
    ("bulk read 2", 2, 0x00, "24", "FFFFFD00 02 0500 55 00 24 8BA9"),
    ("alert", 1, 0x80, "20", "FFFFFD00 01 0500 55 80 20 9921"),
    ("stuffed", 1, 0x00, "FFFF FDFFFFFF 00080000",
     "FFFFFD00 01 0F00 55 00 FFFFFDFDFFFFFF00080000 49F0"),
    ("stuffed twice", 1, 0x00, "FFFFFD FFFDFD", "FFFFFD00 01 0B00 55 00 FFFFFDFDFFFDFD 5460"),
]
# fmt: on
BARE_STATUS_CRC = {
    0x00: "A10C",
    0x01: "A48C",
    0x02: "AE8C",
    0x03: "AB0C",
    0x04: "BA8C",
    0x05: "BF0C",
    0x06: "B50C",
    0x07: "B08C",
    0x80: "A28F",
    0x84: "B90F",
    0x87: "B30F",
}  # fmt: skip


def test_crc_has_the_check_value_of_crc16_umts():
    assert crc16(b"123456789") == 0xFEE8


@given(st.binary(max_size=60), st.binary(max_size=60))
def test_crc_can_be_continued(first: bytes, second: bytes):
    assert crc16(second, crc16(first)) == crc16(first + second)


@pytest.mark.parametrize(
    ("packet_id", "instruction", "parameters", "expected"),
    [case[1:] for case in INSTRUCTIONS],
    ids=[case[0] for case in INSTRUCTIONS],
)
def test_instruction_vectors(packet_id: int, instruction: int, parameters: str, expected: str):
    raw = wire(expected)
    assert encode_instruction(packet_id, instruction, wire(parameters)) == raw
    assert PacketParser().push(raw) == [Packet(packet_id, instruction, wire(parameters), True)]


@pytest.mark.parametrize(
    ("packet_id", "error", "parameters", "expected"),
    [case[1:] for case in STATUSES],
    ids=[case[0] for case in STATUSES],
)
def test_status_vectors(packet_id: int, error: int, parameters: str, expected: str):
    raw = wire(expected)
    data = wire(parameters)
    assert encode_status(packet_id, error, data) == raw
    assert PacketParser().push(raw) == [Packet(packet_id, 0x55, bytes((error,)) + data, True)]


@pytest.mark.parametrize(("error", "crc"), BARE_STATUS_CRC.items())
def test_bare_status_checksums(error: int, crc: str):
    assert encode_status(1, error)[-2:] == wire(crc)


@pytest.mark.parametrize(
    ("blocks", "expected"),
    [
        (
            [(3, "A6000000"), (7, "1F080000"), (4, "FF030000")],
            "FFFFFD00 FE 1900 55 00 03 A6000000 8408 00 07 1F080000 16CA 00 04 FF030000 D19E",
        ),
        (
            [(3, "A6000000"), (7, "A501"), (4, "1F")],
            "FFFFFD00 FE 1400 55 00 03 A6000000 67A4 00 07 A501 2474 00 04 1F D9C1",
        ),
        (
            [(1, "FFFFFDFFFFFF00080000"), (2, "FFFFFDFFFFFF00080000")],
            "FFFFFD00 FE 1D00 55 00 01 FFFFFDFFFFFF00080000 40B7 00 02 FFFFFDFFFFFF00080000 4627",
        ),
    ],
)
def test_fast_status_vectors(blocks: list[tuple[int, str]], expected: str):
    made = [FastBlock(servo_id, 0, wire(data)) for servo_id, data in blocks]
    pieces = encode_fast_status([len(block.data) for block in made], made)
    assert b"".join(pieces) == wire(expected)


def test_a_missing_servo_truncates_the_fast_status():
    blocks = [FastBlock(3, 0, wire("A6000000"))]
    (piece,) = encode_fast_status([4, 4, 4], blocks)
    assert piece == wire("FFFFFD00 FE 1900 55 00 03 A6000000 8408")
    assert encode_fast_status([4, 4], []) == ()


def test_the_parser_drops_a_write_that_was_not_stuffed():
    unstuffed = wire("FFFFFD00 01 0900 03 7400 FFFFFDFF CB05")
    ping = wire("FFFFFD00 01 0300 01 194E")
    parser = PacketParser()
    assert parser.push(unstuffed) == []
    assert parser.push(ping) == [Packet(1, 0x01, b"", True)]


def test_a_wrong_checksum_is_reported_once():
    raw = bytearray(wire("FFFFFD00 01 0700 02 8400 0400 1D15"))
    raw[8] ^= 1
    (packet,) = PacketParser().push(bytes(raw))
    assert (packet.packet_id, packet.instruction, packet.intact) == (1, 0x02, False)


@pytest.mark.parametrize("lost", range(1, 14))
def test_a_packet_cut_short_does_not_swallow_the_next(lost: int):
    read = wire("FFFFFD00 01 0700 02 8400 0400 1D15")
    ping = encode_instruction(2, 0x01)
    found = PacketParser().push(read[:-lost] + ping)
    assert [p for p in found if p.intact] == [Packet(2, 0x01, b"", True)]


@pytest.mark.parametrize(
    "garbage",
    [
        b"\xaa" * 40,
        HEADER,
        HEADER + b"\xfd",
        HEADER + b"\x01",
        b"\xff\xff",
        HEADER + b"\x00\x01" + (MAX_LENGTH + 1).to_bytes(2, "little"),
        HEADER + b"\x00\x01\x02\x00",
    ],
)
def test_garbage_before_a_packet_is_passed_over(garbage: bytes):
    ping = encode_instruction(1, 0x01)
    assert PacketParser().push(garbage + ping) == [Packet(1, 0x01, b"", True)]


def test_reset_forgets_half_a_packet():
    parser = PacketParser()
    read = wire("FFFFFD00 01 0700 02 8400 0400 1D15")
    parser.push(read[:9])
    parser.reset()
    assert parser.push(read[9:]) == []


tricky = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]), max_size=30).map(bytes)


@settings(max_examples=150, derandomize=True)
@given(tricky)
def test_stuffing_is_undone_and_leaves_no_header(body: bytes):
    stuffed = stuff(body)
    assert unstuff(stuffed) == body
    assert HEADER not in stuffed.replace(HEADER + b"\xfd", b"")


@settings(max_examples=150, derandomize=True)
@given(
    st.lists(st.tuples(st.integers(0, 252), tricky | st.binary(max_size=30)), max_size=5),
    st.data(),
)
def test_packets_survive_any_cut_of_the_stream(
    packets: list[tuple[int, bytes]], data: st.DataObject
):
    raw = b"".join(encode_instruction(i, 0x03, body) for i, body in packets)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(raw)), max_size=6)))
    parser = PacketParser()
    found: list[Packet] = []
    for start, end in zip([0, *cuts], [*cuts, len(raw)], strict=True):
        found += parser.push(raw[start:end])
    assert found == [Packet(i, 0x03, body, True) for i, body in packets]


@settings(max_examples=150, derandomize=True)
@given(tricky | st.binary(max_size=60))
def test_after_any_noise_a_packet_is_found_again(noise: bytes):
    parser = PacketParser()
    parser.push(noise)
    ping = encode_instruction(7, 0x01)
    found = [p for _ in range(3) for p in parser.push(ping) if p.intact and p.packet_id == 7]
    assert found
