"""Ports of the servos and of the axes: found by their plugs, named, and left alone."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.checks.findings import Finding, Verdict
from cell.commissioning import axes, ports
from cell.commissioning.axes import AxesStep
from cell.commissioning.bench import Bench
from cell.commissioning.engine import carry_out
from cell.commissioning.ports import PortsStep, by_id, users_of
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.simulation import simulation_of
from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from simulator.cell import SimulatedCell
from simulator.servo.wrist import SimulatedWrist
from tactile.can.bus import CanBus
from tests.cell.commissioning.script import Script, SimulatedLines
from tests.faults.scenarios.axes import CHANGES


@pytest.fixture
def lines() -> SimulatedLines:
    return SimulatedLines(SimulatedCell(), ("/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyACM0"))


def test_the_only_port_is_taken_unasked(tmp_path) -> None:
    bench = Bench(tmp_path, SimulatedLines(SimulatedCell()))
    found = carry_out(PortsStep(), bench, script := Script())
    assert found.settings == {"gripper.port": "/dev/ttyUSB0"}
    assert script.asked == []


def test_a_port_is_found_by_pulling_and_putting_back_its_plug(tmp_path, lines) -> None:
    def without(*gone: str) -> None:
        lines.ports = tuple(port for port in lines.ports if port not in gone)

    def back() -> None:
        # It comes back under another name.
        lines.ports += ("/dev/ttyUSB2",)

    both = [lambda: without("/dev/ttyUSB0", "/dev/ttyACM0"), lambda: without("/dev/ttyUSB1")]
    script = Script({"ports.unplug": [*both], "ports.plug_back": [lambda: None, back]})
    found = carry_out(PortsStep(), Bench(tmp_path, lines), script)
    assert found.settings == {"gripper.port": "/dev/ttyUSB2"}
    assert "2 ports are gone" in script.text
    assert script.asked.count("ports.plug_back") == 2


def test_a_cell_without_any_port_asks_for_the_plug(tmp_path, lines) -> None:
    lines.ports = ()

    def plug_in() -> None:
        lines.ports = ("/dev/ttyUSB0",)

    script = Script({"ports.plug_in": [lambda: None, plug_in]})
    assert carry_out(PortsStep(), Bench(tmp_path, lines), script).status is Verdict.PASS
    assert script.asked == ["ports.plug_in"] * 2


def test_a_slow_latency_timer_is_named_with_the_command_that_mends_it(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(ports, "latency_timer_ms", lambda _port: 16)
    found = carry_out(PortsStep(), Bench(tmp_path, SimulatedLines(SimulatedCell())), Script())
    assert found.status is Verdict.WARN
    advice = found.lines[-1]
    assert "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in advice
    assert 'ATTR{latency_timer}="1"' in advice


def test_a_port_of_another_group_is_named_with_the_command(tmp_path, monkeypatch) -> None:
    device = tmp_path / "tty"
    device.touch(mode=0o600)
    monkeypatch.setattr(ports.os, "access", lambda *_: False)
    bench = Bench(tmp_path, given={"gripper.port": str(device)})
    found = carry_out(PortsStep(), bench, Script())
    assert found.status is Verdict.FAIL
    assert "sudo usermod -a -G" in found.lines[-1]


def test_a_port_that_is_taken_or_gone_is_named(tmp_path, lines) -> None:
    class Taken(SimulatedLines):
        def open_servos(self, port: str, baud_rate: int) -> None:  # type: ignore[override]
            raise PortLost(f"serial port {port} is used by another program")

    bench = Bench(tmp_path, Taken(lines.cell))
    found = carry_out(PortsStep(), bench, Script())
    assert found.status is Verdict.FAIL
    assert "used by another program" in found.lines[-1]


def test_programs_that_have_a_port_open_are_named(tmp_path) -> None:
    device = tmp_path / "tty"
    device.touch()
    assert users_of(str(device)) == ()
    waits = "import sys; file = open(sys.argv[1]); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", waits, str(device)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        (found,) = users_of(str(device))
        assert found.endswith(f"(process {other.pid})")
    assert os.path.exists(device)


def test_ports_are_named_by_the_serial_number_of_their_adapter(tmp_path) -> None:
    device, names = tmp_path / "ttyUSB0", tmp_path / "by-id"
    device.touch()
    names.mkdir()
    (names / "usb-FTDI_U2D2_FT123").symlink_to(device)
    assert by_id(str(device), names) == str(names / "usb-FTDI_U2D2_FT123")
    assert by_id("/dev/ttyUSB9", names) == "/dev/ttyUSB9"
    assert by_id(str(device), tmp_path / "missing") == str(device)


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


@pytest.mark.slow
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
