"""The examples of the Protocol 2.0 manual as whole conversations: bytes to a servo, bytes back.

Two of the checksums that the manual prints are wrong (the instruction of its Fast Bulk Read and
Control Table Restore); here the right ones stand. `dxl2`, a client written by others, computes the
instruction packets a second time.
"""

import pytest
from dxl2 import v2 as dxl2

from gripper.dynamixel.models import XM430_W210
from simulator.servo.firmware import ServoCore
from tests.simulator.conftest import ServoBench

PREFIX = "FFFFFD00"
ACK = "FFFFFD00 01 0400 55 00 A10C"
OLD, NEW = 38, 48
"""Firmware: the manual's examples show 38; fast reads and the backup came later."""

# fmt: off
DIALOGUES = [
    # name, firmware, registers by servo, request, expected answer
    ("ping", OLD, {}, "01 0300 01 194E", "FFFFFD00 01 0700 55 00 060426 655D"),
    ("ping of all", OLD, {}, "FE 0300 01 3142",
     "FFFFFD00 01 0700 55 00 060426 655D FFFFFD00 02 0700 55 00 060426 6F6D"),
    ("read", OLD, {1: {"present_position": 166}}, "01 0700 02 8400 0400 1D15",
     "FFFFFD00 01 0800 55 00 A6000000 8CC0"),
    ("write", OLD, {}, "01 0900 03 7400 00020000 CA89", ACK),
    ("reg write", OLD, {}, "01 0900 04 6800 C8000000 AE8E", ACK),
    ("torque on", OLD, {}, "01 0600 03 4000 01 DB66", ACK),
    ("watchdog 100 ms", OLD, {}, "01 0600 03 6200 05 68E4", ACK),
    ("watchdog clear", OLD, {}, "01 0600 03 6200 00 76E4", ACK),
    ("reboot", OLD, {}, "01 0300 08 2F4E", ACK),
    ("factory reset but for the ID", OLD, {}, "01 0400 06 01 A1E6", ACK),
    ("clear", NEW, {}, "01 0800 10 01 44584C22 B1DC", ACK),
    ("clear before it was known", OLD, {}, "01 0800 10 01 44584C22 B1DC", "AE8C of 02"),
    ("backup", NEW, {}, "01 0800 20 01 4354524C 16F5", ACK),
    ("restore of nothing", NEW, {}, "01 0800 20 02 4354524C 9EF5", "A48C of 01"),
    ("action of nothing", OLD, {}, "01 0300 05 02CE", "AE8C of 02"),
    ("sync read", OLD, {1: {"present_position": 166}, 2: {"present_position": 2079}},
     "FE 0900 82 8400 0400 01 02 CEFA",
     "FFFFFD00 01 0800 55 00 A6000000 8CC0 FFFFFD00 02 0800 55 00 1F080000 BABE"),
    ("bulk read", OLD, {1: {"present_input_voltage": 119}, 2: {"present_temperature": 36}},
     "FE 0D00 92 01 9000 0200 02 9200 0100 1A05",
     "FFFFFD00 01 0600 55 00 7700 C369 FFFFFD00 02 0500 55 00 24 8BA9"),
    ("fast sync read", NEW,
     {3: {"present_position": 166}, 7: {"present_position": 2079}, 4: {"present_position": 1023}},
     "FE 0A00 8A 8400 0400 03 07 04 20F2",
     "FFFFFD00 FE 1900 55 00 03 A6000000 8408 00 07 1F080000 16CA 00 04 FF030000 D19E"),
    ("fast bulk read", NEW,
     {3: {"present_position": 166}, 7: {"present_pwm": 421}, 4: {"present_temperature": 31}},
     "FE 1200 9A 03 8400 0400 07 7C00 0200 04 9200 0100 DA2D",
     "FFFFFD00 FE 1400 55 00 03 A6000000 67A4 00 07 A501 2474 00 04 1F D9C1"),
    ("sync write", OLD, {}, "FE 1100 83 7400 0400 01 96000000 02 AA000000 8287", ""),
    ("bulk write", OLD, {}, "FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768", ""),
]
# fmt: on


def wire(text: str) -> bytes:
    """Return the bytes; ``CRC of ERROR`` stands for a bare status of servo 1."""
    crc, of, error = text.partition(" of ")
    return bytes.fromhex(f"FFFFFD0001040055{error}{crc}" if of else text)


@pytest.fixture(autouse=True)
def registers_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the present values be those of the examples instead of the motor's."""
    monkeypatch.setattr(ServoCore, "refresh", lambda _self, _now_s: None)


class Conversation(ServoBench):
    """Servos of the examples; the registers of some hold what an example wants."""

    def __init__(self, firmware: int, values: dict[int, dict[str, int]]) -> None:
        super().__init__(sorted(values.keys() | {1, 2}), model=XM430_W210, firmware=firmware)
        self._registers = {servo.servo_id: servo.core.registers for servo in self.servos}
        for servo_id, named in values.items():
            for name, value in named.items():
                self.put(servo_id, name, value)

    def put(self, servo_id: int, name: str, value: int) -> None:
        self._registers[servo_id].put(name, value)

    def get(self, servo_id: int, name: str) -> int:
        return self._registers[servo_id].get(name)


@pytest.mark.parametrize(
    ("firmware", "values", "request_", "answer"),
    [case[1:] for case in DIALOGUES],
    ids=[case[0] for case in DIALOGUES],
)
def test_the_manuals_example(
    firmware: int, values: dict[int, dict[str, int]], request_: str, answer: str
) -> None:
    assert Conversation(firmware, values).exchange(wire(PREFIX + request_)) == wire(answer)


@pytest.mark.parametrize(
    "request_", [case[3] for case in DIALOGUES], ids=[case[0] for case in DIALOGUES]
)
def test_another_encoder_makes_the_same_bytes(request_: str) -> None:
    raw = wire(PREFIX + request_)
    made = dxl2.InstructionPacket(raw[4], raw[7], dxl2.Params(list(raw[8:-2])))
    assert made.raw == raw


@pytest.mark.parametrize(
    ("request_", "changed"),
    [
        ("01 0900 03 7400 00020000 CA89", {(1, "goal_position"): 512}),
        (
            "FE 1100 83 7400 0400 01 96000000 02 AA000000 8287",
            {(1, "goal_position"): 150, (2, "goal_position"): 170},
        ),
        (
            "FE 0D00 83 6600 0200 01 6400 02 9CFF E1DB",
            {(1, "goal_current"): 100, (2, "goal_current"): -100},
        ),
        (
            "FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768",
            {(1, "max_voltage_limit"): 160, (2, "temperature_limit"): 80},
        ),
    ],
)
def test_what_the_examples_write_is_there(
    request_: str, changed: dict[tuple[int, str], int]
) -> None:
    # Mode 5 takes currents and positions.
    talk = Conversation(NEW, {i: {"operating_mode": 5} for i in (1, 2)})
    assert talk.exchange(wire(PREFIX + request_))[:4] in (b"", wire(PREFIX))
    assert {key: talk.get(*key) for key in changed} == changed


def test_a_registered_write_and_its_action() -> None:
    talk = Conversation(OLD, {1: {"operating_mode": 1}})
    assert talk.exchange(wire("FFFFFD00 01 0900 04 6800 C8000000 AE8E")) == wire(ACK)
    assert (talk.get(1, "goal_velocity"), talk.get(1, "registered_instruction")) == (0, 1)
    assert talk.exchange(wire("FFFFFD00 01 0300 05 02CE")) == wire(ACK)
    assert (talk.get(1, "goal_velocity"), talk.get(1, "registered_instruction")) == (200, 0)


def test_bytes_that_are_stuffed_both_ways() -> None:
    talk = Conversation(NEW, {1: {"operating_mode": 5}})
    stuffed = "FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5"
    assert talk.exchange(wire(stuffed)) == wire(ACK)
    assert talk.get(1, "goal_position") == -131073
    # As the vendor's package 4.1.0 sends it: the stuffing does not reach the wire.
    assert talk.exchange(wire("FFFFFD00 01 0900 03 7400 FFFFFDFF CB05")) == b""
    for name, value in (("current", -1), ("velocity", -3), ("position", 2048)):
        talk.put(1, f"present_{name}", value)
    answer = talk.exchange(dxl2_read(1, 126, 10))
    assert answer == wire("FFFFFD00 01 0F00 55 00 FFFFFDFDFFFFFF00080000 49F0")


def test_a_factory_reset_of_all_servos_changes_nothing() -> None:
    talk = Conversation(NEW, {2: {"temperature_limit": 61}})
    everything = dxl2.InstructionPacket(0xFE, 0x06, dxl2.Params([0xFF])).raw
    assert talk.exchange(everything) == b""
    assert talk.get(2, "temperature_limit") == 61


def dxl2_read(servo_id: int, address: int, size: int) -> bytes:
    parameters = [address, 0, size, 0]
    raw: bytes = dxl2.InstructionPacket(servo_id, 0x02, dxl2.Params(parameters)).raw
    return raw
