"""The control unit of the wizard: what is found on a bus, and what is wrong there, by name."""

import pytest

from cell.checks.findings import Verdict
from cell.commissioning.engine import WizardAborted
from cell.commissioning.unit import UnitStep
from simulator.can.drive import DriveMount
from simulator.devices import SimulatedDrive
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tests.cell.commissioning.conftest import MakeStand
from tests.cell.commissioning.script import SimulatedLines

STEP = UnitStep()


def test_a_unit_is_found_and_set_up_and_named(stand: MakeStand) -> None:
    one = stand(node_id=17, serial_number=4711)
    finding, script = one.passes(STEP), one.person.script
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


def test_a_unit_that_has_a_heartbeat_is_found_by_listening_alone(one) -> None:
    one.cell.clock.sleep(0.1)  # it has booted
    first, second = (one.run(STEP) for _ in range(2))
    assert "found by asking each node-ID" in first.lines[0]
    assert "found by listening" in second.lines[0]


def test_nothing_is_written_that_is_refused(one) -> None:
    with pytest.raises(WizardAborted):
        one.run(STEP, leave_at=["approve"])
    assert one.cell.unit.dictionary.number(0x1017) == 0


@pytest.mark.parametrize("bitrate", [500_000, 250_000])
def test_another_bit_rate_is_found_and_the_period_fits_it(stand: MakeStand, bitrate: int) -> None:
    finding = stand(can_bitrate=bitrate).passes(STEP)
    assert finding.settings["tactile.bitrate"] == bitrate
    assert f"{bitrate:,} bit/s" in finding.lines[0]
    assert ("tactile.sync_period_ms" in finding.settings) == (bitrate == 250_000)


def test_an_adapter_without_some_bit_rate_is_asked_for_the_others(stand: MakeStand) -> None:
    class Adapter(SimulatedLines):
        rates = (500_000,)

        def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
            if bitrate not in self.rates:
                raise BusNotOpened(f"invalid bit rate {bitrate}")
            return super().open_can(interface, channel, bitrate)

    one = stand(can_bitrate=500_000)
    one.bench.lines = lines = Adapter(one.cell)
    assert one.run(STEP).settings["tactile.bitrate"] == 500_000
    lines.rates = ()
    assert one.run(STEP).lines == ["invalid bit rate 1000000"]


def test_a_drive_on_the_same_bus_is_not_taken_for_the_unit(one) -> None:
    mount = DriveMount(node_id=3, increments=1e6, start=0.0, low_switch=-0.1, high_switch=0.1)
    one.cell.devices.can_devices.add(SimulatedDrive(mount))
    finding = one.passes(STEP)
    assert finding.settings["tactile.node_id"] == 5
    assert "Beside it, node 3 is another device" in "\n".join(finding.lines)


def test_the_interface_is_asked_for_only_where_there_are_several(one) -> None:
    one.bench.settings = {"gripper.port": "/dev/ttyUSB0"}
    one.lines.ports += ("/dev/ttyACM0", "/dev/ttyACM1")
    finding = one.run(STEP, unit__interface="slcan /dev/ttyACM1")
    assert finding.settings["tactile.channel"] == "/dev/ttyACM1"
    one.lines.ports = one.lines.ports[:1]
    finding = one.run(STEP)
    assert finding.status is Verdict.FAIL
    assert "No CAN interface was found" in finding.lines[0]
    finding = one.run(STEP, unit__none="alone")
    assert finding.status is Verdict.WARN
    assert finding.values == {"gripper_alone": True}
