"""Ports of the servos: found by their plugs, named by their adapters, and their obstacles."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from cell.commissioning import ports
from cell.commissioning.bench import Bench
from cell.commissioning.engine import carry_out
from cell.commissioning.findings import Verdict
from cell.commissioning.ports import PORTS, check_port, lasting_name, usb_identity
from gripper.errors import PortLost
from simulator.cell import SimulatedCell
from tests.cell.commissioning.hands import Script, SimulatedLines

USB0, USB1, ACM0 = "/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyACM0"


@pytest.mark.parametrize(
    ("ports", "pulled", "answer", "named"),
    [
        ((USB0,), (), USB0, "servo port: "),
        # The adapter comes back under another name.
        ((USB0, USB1, ACM0), (USB1,), "/dev/ttyUSB2", "servo port: "),
        ((USB0, USB1, ACM0), (USB0, ACM0), "", "2 ports disappeared and 1 came back"),
        ((), (), "", "plug in that of the servos"),
    ],
)
def test_the_port_is_the_only_one_or_found_by_pulling_its_plug(
    tmp_path, ports, pulled, answer, named
) -> None:
    lines = SimulatedLines(SimulatedCell(), ports)

    def pull() -> None:
        lines.ports = tuple(port for port in ports if port not in pulled)

    def put_back() -> None:
        lines.ports += ("/dev/ttyUSB2",)

    script = Script({"ports.unplug": pull, "ports.plug_back": put_back})
    notes = carry_out(PORTS, Bench(tmp_path, lines), script)
    assert notes.settings == ({"gripper.port": answer} if answer else {})
    assert named + answer in notes.lines[0]
    assert script.asked == ["ports.unplug", "ports.plug_back"] * (len(ports) > 1)


def test_a_port_that_is_taken_or_gone_is_named(tmp_path) -> None:
    lines = SimulatedLines(SimulatedCell())
    lines.open_serial = Mock(side_effect=PortLost("the port is used by another program"))
    notes = carry_out(PORTS, Bench(tmp_path, lines), Script())
    assert notes.status is Verdict.FAIL
    assert "used by another program" in notes.lines[-1]


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folders sys and dev: adapters with a serial number, without one, and with the same one."""
    for usb, serial, tty, number in (
        ("1-1", "FT 1/9", "ttyUSB0", "00"),
        ("1-1", "FT 1/9", "ttyUSB1", "01"),
        ("1-2", "", "ttyUSB2", "00"),
        ("1-3", "0001", "ttyUSB3", "00"),
        ("1-4.1", "0001", "ttyUSB4", "00"),
    ):
        folder = tmp_path / "sys/devices/0000:00:14.0/usb1" / usb
        port = folder / f"{usb}:1.{int(number)}" / tty
        port.mkdir(parents=True)
        (folder / "idVendor").write_text("0403\n")
        (folder / "idProduct").write_text("6010\n")
        (folder / "dev").write_text(f"189:{usb}\n")
        if serial:
            (folder / "serial").write_text(serial + "\n")
        (port.parent / "bInterfaceNumber").write_text(number + "\n")
        (tmp_path / "sys/class/tty" / tty).mkdir(parents=True)
        (tmp_path / "sys/class/tty" / tty / "device").symlink_to(port)
        for name in (f"by-id/{serial[:4]}-if{number}", f"by-path/{usb}:1.{number}"):
            link = tmp_path / "dev/serial" / name
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)  # the last one of the same name has it
            link.symlink_to(tmp_path / "dev" / tty)
    (tmp_path / "sys/class/tty/ttyS0").mkdir()
    monkeypatch.setattr(ports, "_ROOT", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("port", "number", "identity", "name"),
    [
        ("ttyUSB0", "00", {"ID_SERIAL_SHORT": "FT_1_9"}, "serial/by-id/FT 1-if00"),
        ("ttyUSB1", "01", {"ID_SERIAL_SHORT": "FT_1_9"}, "serial/by-id/FT 1-if01"),
        ("ttyUSB2", "00", {"DEVPATH": "*/0000:00:14.0/usb*/*-2/*"}, "serial/by-path/1-2:1.00"),
        ("ttyUSB3", "00", {"DEVPATH": "*/0000:00:14.0/usb*/*-3/*"}, "serial/by-path/1-3:1.00"),
        ("ttyUSB4", "00", {"DEVPATH": "*/0000:00:14.0/usb*/*-4.1/*"}, "serial/by-path/1-4.1:1.00"),
        ("ttyS0", "", None, "ttyS0"),
        ("nothing", "", None, "nothing"),
    ],
)
def test_an_adapter_is_named_by_its_own_serial_number_or_else_by_its_socket(
    machine, port, number, identity, name
) -> None:
    dev = machine / "dev"
    common = {"ID_VENDOR_ID": "0403", "ID_MODEL_ID": "6010", "ID_USB_INTERFACE_NUM": number}
    assert usb_identity(str(dev / port)) == (None if identity is None else common | identity)
    assert lasting_name(str(dev / port)) == str(dev / name)


@pytest.mark.parametrize(
    ("obstacle", "what", "verdict", "text"),
    [
        ("", "key", Verdict.PASS, ""),
        ("missing", "key", Verdict.FAIL, "cannot open serial port"),
        ("another program", "key", Verdict.FAIL, "is in use by brltty (process 12)"),
        ("slow", "USB latency timer of key", Verdict.WARN, "waits up to 16 ms"),
        ("modems", "ModemManager at key", Verdict.WARN, "send commands"),
        ("modems in a container", "ModemManager at key", Verdict.WARN, "send commands"),
        ("modems kept away", "key", Verdict.PASS, ""),
    ],
)
def test_each_obstacle_at_a_port_is_named(
    machine, monkeypatch, *, obstacle, what, verdict, text
) -> None:
    port = machine / "dev/ttyUSB0"
    if obstacle != "missing":
        monkeypatch.setattr(ports, "SerialStream", Mock())
    monkeypatch.setattr(ports, "latency_timer_ms", lambda _port: 16 if obstacle == "slow" else 1)
    process = machine / "proc/12"
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("brltty\n")
    if obstacle == "another program":
        (process / "fd/3").symlink_to(port)
    if "modems" in obstacle:
        (process / "comm").write_text("ModemManager\n")
        if "container" not in obstacle:
            (udev := machine / "run/udev/data").mkdir(parents=True)
            ignored = "E:ID_MM_DEVICE_IGNORE=1" if "kept" in obstacle else ""
            (udev / "c189:1-1").write_text(f"E:ID_BUS=usb\n{ignored}\n")
    bad = [one for one in check_port("key", str(port)) if one.verdict is not Verdict.PASS]
    assert [(one.what, one.verdict) for one in bad] == [(what, verdict)] * bool(text)
    assert all(text in one.text and one.advice for one in bad)
    if obstacle == "slow":
        assert "echo 1 | sudo tee" in bad[0].advice
        assert 'ATTR{latency_timer}="1"' in bad[0].advice
