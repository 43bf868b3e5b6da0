"""What is wrong with a cell: the step that finds it names it, moves nothing, sets nothing."""

from typing import Any

import pytest

from cell.commissioning.engine import WizardAborted
from cell.commissioning.findings import Verdict
from cell.commissioning.fingers import FINGERS
from cell.commissioning.first_force import FIRST_FORCE
from cell.commissioning.pads import PADS_AT_REST
from cell.commissioning.servos import SERVOS
from cell.commissioning.unit import UNIT
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.drive import DriveMount
from simulator.devices import SimulatedDrive
from simulator.world.taxels import NoiseModel
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tactile.layout import inner_pads
from tests.cell.commissioning.conftest import MakeStand
from tests.cell.commissioning.hands import SimulatedLines

REST, FORCE = PADS_AT_REST, FIRST_FORCE
WARN, FAIL = Verdict.WARN, Verdict.FAIL


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "fault", "status", "named"),
    [
        (SERVOS, "servo2.supply=6", FAIL, "servo 2 has 6.0 V, a XM430-W350 takes 9.5 to 16.0 V"),
        (SERVOS, "servo2.wrong=model_number:1060", FAIL, "servo 2 is XL430-W250"),
        (SERVOS, "servo2.wrong=model_number:1200", FAIL, "need different supplies"),
        (SERVOS, "servo2.error=8", FAIL, "servo 2 reports"),
        (SERVOS, "servos.delayed=0.016", FAIL, "latency timer"),
        (SERVOS, "servos.off", FAIL, "no servo answers at any baud rate: check the supply"),
        (UNIT, "unit.second_node", FAIL, "more came from"),
        (UNIT, "unit.off", FAIL, "No CAN traffic and no reply on can0"),
        (UNIT, "unit.wrong=revision:0x00020001", FAIL, "not that of this software: major revision"),
        (UNIT, "unit.wrong=vendor:99", FAIL, "node 5 is another device: vendor 0x63"),
        (UNIT, "can.unplugged", FAIL, "adapter is unplugged"),
        (UNIT, "unit.heartbeat_off", FAIL, "did not become operational"),
        (UNIT, {"layout": inner_pads("odd", 5, 4, 3e-3)}, FAIL, "layout is unknown (hash "),
        (UNIT, {"unit": ControlUnitSettings(bitrate=125_000)}, FAIL, "too long for a grip"),
        (REST, "taxels.stuck_at=3:0", WARN, "1 taxel is dead: finger0.inner row 0 column 3"),
        (REST, "taxels.stuck_at=80-81:777", WARN, "2 taxels are stuck: finger1.inner row 0"),
        (REST, "taxels.off=0.2", FAIL, "of the taxels of pad finger0.inner are bad"),
        (REST, "taxels.saturated=0", FAIL, "100% of the taxels of pad finger0.inner are bad"),
        (REST, "taxels.offset=900", FAIL, "No zero can be taken"),
        (REST, "unit.stuck", FAIL, "The counts do not change at rest"),
        (REST, "unit.off", FAIL, "did not boot"),
        (FORCE, "can.loss=0.0003", WARN, "The line of the pads loses messages"),
        (FORCE, "servos.loss=0.02", WARN, "The servos' line loses answers"),
        (FORCE, "servo1.watchdog_off", FAIL, "watchdog is not proven to stop the motors: servo 1"),
        (FORCE, "taxels.stuck_at=20-60:3000", FAIL, "taxels of pad finger0.inner are bad"),
        (FORCE, "servo2.turned", FAIL, "on its own side"),
    ],
)
def test_what_is_wrong_is_named(make_stand, step, fault, status, named) -> None:
    """The step moves and sets nothing; a fault may also be other hardware."""
    hardware = fault if isinstance(fault, dict) else {}
    stand = make_stand(**({"noise": NoiseModel(level=0.3)} if step is FORCE else hardware))
    if not hardware:
        stand.cell.inject(fault)
    finding = stand.run(step)
    assert (finding.status, named in "\n".join(finding.lines)) == (status, True), finding.lines
    assert stand.torques == [0, 0]
    assert status is WARN or not finding.settings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "faults"), [(SERVOS, ["servo1.factory"]), (FINGERS, []), (UNIT, []), (FORCE, [])]
)
def test_nothing_is_written_or_moved_that_is_refused(make_stand, step, faults, tmp_path) -> None:
    stand = make_stand(*faults)
    stand.cell.clock.sleep(1.0)  # the servos have booted

    def state() -> Any:
        eeproms = [bytes(s.registers.data[:64]) for s in stand.cell.devices.servo_bus.servos]
        unit = stand.cell.unit.dictionary.number(0x1017)
        return eeproms, unit, stand.torques, stand.cell.devices.mechanics.aperture_m

    before = state()
    with pytest.raises(WizardAborted):
        stand.run(step, leave_at=["approve"])
    *same, aperture_m = state()
    assert (*same,) == before[:-1]
    assert step is FINGERS or aperture_m == before[-1]  # those are moved by hand
    assert not list(tmp_path.glob("backup*"))


# -- The control unit: what is found on a bus ------------------------------------------------------


def test_a_unit_is_found_and_set_up_and_named(make_stand: MakeStand) -> None:
    stand = make_stand(unit=ControlUnitSettings(node_id=17, serial_number=4711))
    finding, script = stand.passes(UNIT), stand.person.script
    assert finding.settings == {
        "tactile.interface": "socketcan",
        "tactile.channel": "can0",
        "tactile.bitrate": 1_000_000,
        "tactile.node_id": 17,
        "tactile.serial_number": 4711,
        "tactile.layout": "pinch",
        "tactile.board_serial_numbers": None,
        "tactile.mounting": [],
    }
    assert not script.asked
    assert [write.where for write in script.writes] == ["control unit, node 17"] * 5
    assert "13 x 6" not in script.text
    assert "force messages" in finding.lines[-1]


def test_a_unit_that_has_a_heartbeat_is_found_by_listening_alone(stand) -> None:
    stand.cell.clock.sleep(0.1)  # it has booted
    first, second = (stand.run(UNIT) for _ in range(2))
    assert "found by asking each node-ID" in first.lines[0]
    assert "found by listening" in second.lines[0]


@pytest.mark.parametrize("bitrate", [500_000, 250_000])
def test_another_bit_rate_is_found_and_the_period_fits_it(
    make_stand: MakeStand, bitrate: int
) -> None:
    finding = make_stand(unit=ControlUnitSettings(bitrate=bitrate)).passes(UNIT)
    assert finding.settings["tactile.bitrate"] == bitrate
    assert f"{bitrate:,} bit/s" in finding.lines[0]
    assert ("tactile.sync_period_ms" in finding.settings) == (bitrate == 250_000)


def test_an_adapter_without_some_bit_rate_is_asked_for_the_others(make_stand: MakeStand) -> None:
    class Adapter(SimulatedLines):
        rates = (500_000,)

        def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
            if bitrate not in self.rates:
                raise BusNotOpened(f"invalid bit rate {bitrate}")
            return super().open_can(interface, channel, bitrate)

    stand = make_stand(unit=ControlUnitSettings(bitrate=500_000))
    stand.bench.lines = lines = Adapter(stand.cell)
    assert stand.run(UNIT).settings["tactile.bitrate"] == 500_000
    lines.rates = ()
    assert stand.run(UNIT).lines == ["invalid bit rate 1000000"]


def test_a_drive_on_the_same_bus_is_not_taken_for_the_unit(stand) -> None:
    mount = DriveMount(node_id=3, increments=1e6, start=0.0, low_switch=-0.1, high_switch=0.1)
    stand.cell.devices.can.add(SimulatedDrive(mount))
    finding = stand.passes(UNIT)
    assert finding.settings["tactile.node_id"] == 5
    assert "Beside it, node 3 is another device" in "\n".join(finding.lines)


def test_the_interface_is_asked_for_only_where_there_are_several(stand) -> None:
    stand.bench.settings = {"gripper.port": "/dev/ttyUSB0"}
    stand.lines.ports += ("/dev/ttyACM0", "/dev/ttyACM1")
    finding = stand.run(UNIT, unit__interface="slcan /dev/ttyACM1")
    assert finding.settings["tactile.channel"] == "/dev/ttyACM1"
    stand.lines.ports = stand.lines.ports[:1]
    finding = stand.run(UNIT)
    assert finding.status is Verdict.FAIL
    assert "No CAN interface was found" in finding.lines[0]
