"""The examples of the Protocol 2.0 manual as whole conversations: bytes to a servo, bytes back.

`dxl2`, a client written by others, computes the instruction packets a second time, and the checksum
of a stuffed answer.
"""

import pytest
from dxl2 import v2 as dxl2

from gripper.dynamixel.models import XM430_W210
from simulator.servo.device import SimulatedServo
from tests.simulator.conftest import ServoBench

PREFIX = "FFFFFD00"
ACK = "FFFFFD00 01 0400 55 00 A10C"
FIRMWARE = 38
"""Version that the manual's examples show."""

# fmt: off
DIALOGUES = [
    # name, registers by servo, request, expected answer, registers that have changed
    ("ping", {}, "01 0300 01 194E", "FFFFFD00 01 0700 55 00 060426 655D", {}),
    ("ping of all", {}, "FE 0300 01 3142",
     "FFFFFD00 01 0700 55 00 060426 655D FFFFFD00 02 0700 55 00 060426 6F6D", {}),
    ("read", {1: {"present_position": 166}}, "01 0700 02 8400 0400 1D15",
     "FFFFFD00 01 0800 55 00 A6000000 8CC0", {}),
    ("write", {}, "01 0900 03 7400 00020000 CA89", ACK, {(1, "goal_position"): 512}),
    ("torque on", {}, "01 0600 03 4000 01 DB66", ACK, {(1, "torque_enable"): 1}),
    ("watchdog 100 ms", {}, "01 0600 03 6200 05 68E4", ACK, {(1, "bus_watchdog"): 5}),
    ("watchdog clear", {}, "01 0600 03 6200 00 76E4", ACK, {(1, "bus_watchdog"): 0}),
    ("reboot", {}, "01 0300 08 2F4E", ACK, {}),
    ("sync read", {1: {"present_position": 166}, 2: {"present_position": 2079}},
     "FE 0900 82 8400 0400 01 02 CEFA",
     "FFFFFD00 01 0800 55 00 A6000000 8CC0 FFFFFD00 02 0800 55 00 1F080000 BABE", {}),
    ("bulk read", {1: {"present_input_voltage": 119}, 2: {"present_temperature": 36}},
     "FE 0D00 92 01 9000 0200 02 9200 0100 1A05",
     "FFFFFD00 01 0600 55 00 7700 C369 FFFFFD00 02 0500 55 00 24 8BA9", {}),
    ("sync write", {}, "FE 1100 83 7400 0400 01 96000000 02 AA000000 8287", "",
     {(1, "goal_position"): 150, (2, "goal_position"): 170}),
    ("sync write of currents", {}, "FE 0D00 83 6600 0200 01 6400 02 9CFF E1DB", "",
     {(1, "goal_current"): 100, (2, "goal_current"): -100}),
    ("bulk write", {1: {"max_voltage_limit": 150}, 2: {"temperature_limit": 61}},
     "FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768", "",
     {(1, "max_voltage_limit"): 160, (2, "temperature_limit"): 80}),
]
# fmt: on


def wire(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.fixture(autouse=True)
def registers_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the present values be those of the examples instead of the motor's."""
    monkeypatch.setattr(SimulatedServo, "refresh", lambda _self, _now_s: None)


class Conversation(ServoBench):
    """Servos of the examples; the registers of some hold what an example wants."""

    def __init__(self, values: dict[int, dict[str, int]]) -> None:
        super().__init__(model=XM430_W210)
        self.registers = {servo.servo_id: servo.registers for servo in self.servos}
        for servo_id, registers in self.registers.items():
            for name, value in ({"firmware_version": FIRMWARE} | values.get(servo_id, {})).items():
                registers.put(name, value)


@pytest.mark.parametrize(
    ("values", "request_", "answer", "changed"),
    [case[1:] for case in DIALOGUES],
    ids=[case[0] for case in DIALOGUES],
)
def test_the_manuals_example(values, request_, answer, changed) -> None:
    # Mode 5 takes currents and positions.
    talk = Conversation({i: {"operating_mode": 5} | values.get(i, {}) for i in (1, 2)})
    raw = wire(PREFIX + request_)
    assert dxl2.InstructionPacket(raw[4], raw[7], dxl2.Params(list(raw[8:-2]))).raw == raw
    assert talk.exchange(raw) == wire(answer)
    assert {(i, name): talk.registers[i].get(name) for i, name in changed} == changed


def test_bytes_that_are_stuffed_both_ways() -> None:
    talk = Conversation({1: {"operating_mode": 5}})
    assert talk.exchange(wire("FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5")) == wire(ACK)
    assert talk.registers[1].get("goal_position") == -131073
    # As the vendor's package 4.1.0 sends it: the stuffing does not reach the wire.
    assert talk.exchange(wire("FFFFFD00 01 0900 03 7400 FFFFFDFF CB05")) == b""
    for name, value in (("current", -1), ("velocity", -3), ("position", 2048)):
        talk.registers[1].put(f"present_{name}", value)
    answer = talk.exchange(dxl2.InstructionPacket(1, 0x02, dxl2.Params([126, 0, 10, 0])).raw)
    assert answer == wire("FFFFFD00 01 0F00 55 00 FFFFFDFDFFFFFF00080000 49F0")
    assert dxl2.StatusPacket(list(answer)).valid
