"""The control unit of the wizard: what is found on a bus, and what is wrong there, by name."""

from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Finding, Left, Step, Verdict, carry_out
from cell.commissioning.law import LawStep
from cell.commissioning.pads import PadsAtRestStep, PadsPressedStep
from cell.commissioning.unit import UnitStep
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.pytest_plugin.process import CellProcess
from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.devices import SimulatedDrive
from simulator.settings import SimulatorSettings
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tactile.layout import pinch_layout
from tests.cell.commissioning.script import Script, SimulatedLines

GIVEN = {"tactile.interface": "socketcan", "tactile.channel": "can0"}


def found(
    tmp_path: Path,
    *faults: str,
    script: Script | None = None,
    given: dict[str, Any] | None = None,
    **settings: Any,
) -> Finding:
    """Run the step on a simulated cell with these faults."""
    made = SimulatorSettings(**{"layout": pinch_layout()} | settings, faults=faults)
    with SimulatedCell(made) as cell:
        bench = Bench(tmp_path, SimulatedLines(cell), given=GIVEN if given is None else given)
        return carry_out(UnitStep(), bench, script or Script())


def test_a_unit_is_found_and_set_up_and_named(tmp_path: Path) -> None:
    script = Script()
    finding = found(tmp_path, script=script, node_id=17, serial_number=4711)
    assert finding.status is Verdict.PASS, finding.lines
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


def test_a_unit_that_has_a_heartbeat_is_found_by_listening_alone(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        cell.clock.sleep(0.1)  # it has booted
        bench = Bench(tmp_path, SimulatedLines(cell), given=GIVEN)
        first, second = (carry_out(UnitStep(), bench, Script()) for _ in range(2))
    assert "found by asking each node-ID" in first.lines[0]
    assert "found by listening" in second.lines[0]


def test_nothing_is_written_that_is_refused(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        bench = Bench(tmp_path, SimulatedLines(cell), given=GIVEN)
        with pytest.raises(Left):
            carry_out(UnitStep(), bench, Script(leave_at=["approve"]))
        assert cell.unit.dictionary.number(0x1017) == 0


@pytest.mark.parametrize("bitrate", [500_000, 250_000])
def test_another_bit_rate_is_found_and_the_period_fits_it(tmp_path: Path, bitrate: int) -> None:
    finding = found(tmp_path, f"can.bit_rate={bitrate}")
    assert finding.status is Verdict.PASS, finding.lines
    assert finding.settings["tactile.bitrate"] == bitrate
    assert f"{bitrate:,} bit/s" in finding.lines[0]
    assert ("tactile.sync_period_ms" in finding.settings) == (bitrate == 250_000)


def test_an_adapter_without_some_bit_rate_is_asked_for_the_others(tmp_path: Path) -> None:
    class Adapter(SimulatedLines):
        rates = (500_000,)

        def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
            if bitrate not in self.rates:
                raise BusNotOpened(f"invalid bit rate {bitrate}")
            return super().open_can(interface, channel, bitrate)

    settings = SimulatorSettings(layout=pinch_layout(), faults=("can.bit_rate=500000",))
    with SimulatedCell(settings) as cell:
        lines = Adapter(cell)
        finding = carry_out(UnitStep(), Bench(tmp_path, lines, given=GIVEN), Script())
        assert finding.settings["tactile.bitrate"] == 500_000
        lines.rates = ()
        finding = carry_out(UnitStep(), Bench(tmp_path, lines, given=GIVEN), Script())
        assert finding.lines == ("BusNotOpened: invalid bit rate 1000000",)


def test_a_bit_rate_that_is_too_slow_for_a_frame_is_refused(tmp_path: Path) -> None:
    finding = found(tmp_path, "can.bit_rate=125000")
    assert finding.status is Verdict.FAIL
    assert "too long for a grip" in finding.lines[-1]


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("unit.second_node", "more came from"),
        ("unit.off", "Nobody is heard and nobody answers on can0"),
        ("unit.wrong=revision:0x00020001", "EDS is not that of this software: major revision"),
        ("unit.wrong=vendor:99", "node 5 is another device: vendor 0x63"),
        ("unit.other_layout", "taxels are of no known layout (hash 0000000000000000): 156 taxels"),
        ("can.unplugged", "adapter is out"),
        ("unit.heartbeat_off", "did not become operational"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, fault: str, named: str) -> None:
    finding = found(tmp_path, fault)
    assert finding.status is Verdict.FAIL
    assert named in finding.lines[-1]


def test_a_drive_on_the_same_bus_is_not_taken_for_the_unit(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        mount = DriveMount(node_id=3, increments=1e6, start=0.0, low_switch=-0.1, high_switch=0.1)
        cell.devices.can_devices.add(SimulatedDrive(mount))
        bench = Bench(tmp_path, SimulatedLines(cell), given=GIVEN)
        finding = carry_out(UnitStep(), bench, Script())
    assert finding.status is Verdict.PASS, finding.lines
    assert finding.settings["tactile.node_id"] == 5
    assert "Beside it, node 3 is another device" in "\n".join(finding.lines)


def test_the_interface_is_asked_for_only_where_there_are_several(tmp_path: Path) -> None:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        ports = ("/dev/ttyUSB0", "/dev/ttyACM0", "/dev/ttyACM1")
        bench = Bench(tmp_path, SimulatedLines(cell, ports), given={"gripper.port": ports[0]})
        script = Script({"unit.interface": "slcan /dev/ttyACM1"})
        finding = carry_out(UnitStep(), bench, script)
        assert finding.settings["tactile.channel"] == "/dev/ttyACM1"
        one = Bench(tmp_path, SimulatedLines(cell, ports[:1]), given={"gripper.port": ports[0]})
        finding = carry_out(UnitStep(), one, Script())
        assert finding.status is Verdict.FAIL
        assert "No CAN interface was found" in finding.lines[0]
        finding = carry_out(UnitStep(), one, Script({"unit.none": "alone"}))
    assert finding.status is Verdict.WARN
    assert finding.values == {"gripper_alone": True}


@pytest.mark.parametrize("step", [PadsAtRestStep(), PadsPressedStep(), LawStep()])
def test_steps_of_the_pads_pass_by_where_there_are_none(tmp_path: Path, step: Step) -> None:
    bench = Bench(tmp_path)
    bench.found = {"unit": {"gripper_alone": True}}
    finding = carry_out(step, bench, Script())
    assert finding.status is Verdict.WARN
    assert "no pads yet" in finding.lines[0]


@pytest.mark.long
def test_a_unit_of_another_bit_rate_is_found_over_a_real_serial_adapter(tmp_path: Path) -> None:
    config = changed_config(
        CellConfig(), {"tactile.layout": "pinch", "simulator.faults": ["can.bit_rate=500000"]}
    )
    cell = CellProcess(config)
    try:
        given = {"tactile.interface": "slcan", "tactile.channel": cell.can_channel}
        bench = Bench(tmp_path, given=given)
        finding = carry_out(UnitStep(), bench, Script())
        assert finding.status is Verdict.PASS, finding.lines
        assert finding.settings["tactile.bitrate"] == 500_000
        bench.settings = finding.settings
        cell.ask(press=1, x_m=0.015, y_m=0.006, force_n=2.0)
        finding = carry_out(PadsAtRestStep(), bench, Script())
        assert finding.status is Verdict.FAIL
        assert "for an untouched taxel: clear the pads" in finding.lines[-1]
        cell.ask(lift=True)
        assert carry_out(PadsAtRestStep(), bench, Script()).status is Verdict.PASS
    finally:
        cell.end()
