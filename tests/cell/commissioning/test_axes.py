"""Axes of a cell: a wrist servo on a further port, drives on a CAN bus, or none."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.checks.findings import Finding, Verdict
from cell.commissioning import axes
from cell.commissioning.axes import AxesStep
from cell.commissioning.bench import Bench
from cell.commissioning.engine import carry_out
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.simulation import simulation_of
from gripper.dynamixel.serial_port import ByteStream
from simulator.cell import SimulatedCell
from simulator.servo.wrist import SimulatedWrist
from tactile.can.bus import CanBus
from tests.cell.commissioning.script import Script, SimulatedLines
from tests.faults.scenarios.axes import CHANGES

GRIPPER, WRIST = "/dev/ttyUSB0", "/dev/ttyUSB1"


class LinesWithAxes(SimulatedLines):
    """The lines of a simulated cell whose axes have a serial port and a CAN bus of their own."""

    def open_servos(self, port: str, baud_rate: int) -> ByteStream:
        if port != WRIST:
            return super().open_servos(port, baud_rate)
        self.wrist.bus.baudrate = baud_rate
        stream = self.cell._new_axes_streams()["roll"]
        return stream

    @property
    def wrist(self) -> SimulatedWrist:
        wrist = self.cell.devices.axes["roll"]
        assert isinstance(wrist, SimulatedWrist)
        return wrist

    def open_can(self, interface: str, channel: str, bitrate: int) -> CanBus:
        if channel != "can1":
            return super().open_can(interface, channel, bitrate)
        return self.cell._new_axes_bus()


@pytest.fixture
def cell() -> Iterator[SimulatedCell]:
    with simulation_of(changed_config(CellConfig(), CHANGES)) as cell:
        yield cell


def found(
    tmp_path: Path, cell: SimulatedCell, script: Script, ports: tuple[str, ...] = (GRIPPER, WRIST)
) -> Finding:
    bench = Bench(tmp_path, LinesWithAxes(cell, ports))
    bench.settings = {
        "gripper.port": GRIPPER,
        "tactile.interface": "socketcan",
        "tactile.channel": "can0",
    }
    return carry_out(AxesStep(), bench, script)


def test_a_wrist_and_drives_are_found_and_named(tmp_path, cell, monkeypatch) -> None:
    monkeypatch.setattr(axes, "network_interfaces", lambda: ["can0", "can1"])
    script = Script({"axes.port": "yes", "axes.can": "can1"})
    finding = found(tmp_path, cell, script)
    assert finding.status is Verdict.PASS, finding.lines
    assert "servo XM430-W350, ID 1 at 1000000 bit/s on /dev/ttyUSB1" in finding.lines[0]
    kinds = [
        (axis["kind"], axis.get("node_id"), axis.get("port")) for axis in finding.values["axes"]
    ]
    assert kinds == [("dynamixel", None, WRIST), ("cia402", 11, None), ("cia402", 12, None)]
    assert script.writes == []


def test_a_cell_without_axes_is_asked_nothing(tmp_path, cell) -> None:
    finding = found(tmp_path, cell, script := Script(), ports=(GRIPPER,))
    assert (finding.status, finding.values, script.asked) == (Verdict.PASS, {"axes": []}, [])


def test_a_port_that_leads_elsewhere_is_left_alone(tmp_path, cell) -> None:
    finding = found(tmp_path, cell, Script({"axes.port": "no"}))
    assert finding.values == {"axes": []}


def test_a_wrist_without_supply_or_with_too_little_is_named(tmp_path, cell) -> None:
    wrist = LinesWithAxes(cell).wrist
    wrist.servo.core.plant.voltage_v = 6.0
    low = found(tmp_path, cell, Script({"axes.port": "yes"}))
    assert low.status is Verdict.FAIL
    assert "6.0 V" in low.lines[-1]
    wrist.bus.faults.silent.add(1)
    off = found(tmp_path, cell, Script({"axes.port": "yes"}))
    assert off.status is Verdict.FAIL
    assert "no servo answers on /dev/ttyUSB1" in off.lines[-1]
