"""Step `ports`: finds the serial port of the servos; obstacles to the use of ports, their names."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Finding, Notes, Verdict, check_result
from gripper.dynamixel.serial_port import SerialStream, latency_timer_file, latency_timer_ms
from gripper.errors import PortLost

_WAIT_S = 30.0
"""Longest time in s until an adapter disappears or comes back on request."""
_LOOK_S = 0.5
"""Time in s between two checks of the ports: udev takes some tenths."""


def find_port(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Find the serial port of the servos' adapter, and check it.

    This user must be allowed to open it, no other program may have it, and its latency must be
    short. Nothing is written, nothing moves.
    """
    port = str(bench.given.get("gripper.port") or _port_of_servos(bench, dialog))
    notes.values["port"] = notes.settings["gripper.port"] = port
    notes.fact(f"servo port: {port}")
    if Path(port).exists():
        checks = check_port("gripper.port", port)
        notes.findings += [finding for finding in checks if finding.verdict is not Verdict.PASS]
    else:
        bench.lines.open_serial(port, 57600).close()


PORTS = Step(find_port, "ports", "Ports")


def _port_of_servos(bench: Bench, dialog: Dialog) -> str:
    """Return the only port, or the port that disappears and comes back with its plug."""
    ports = bench.lines.serial_ports()
    if not ports:
        raise StepFailed(
            "No serial adapter was found: plug in that of the servos, or leave and name it "
            "with --servo-port."
        )
    if len(ports) == 1:
        return lasting_name(ports[0])
    dialog.say(f"Serial ports: {', '.join(map(lasting_name, ports))}")
    text = "Which one leads to the servos? Pull the USB plug of their adapter."
    dialog.confirm("ports.unplug", text, "it is pulled")
    left = _changed(bench, ports)
    dialog.confirm("ports.plug_back", "Plug it in again.", "it is plugged in")
    # It may come back under another name.
    back = set(_changed(bench, left)) - set(left)
    if len(left) != len(ports) - 1 or len(back) != 1:
        raise StepFailed(
            f"{len(ports) - len(left)} ports disappeared and {len(back)} came back, one should: "
            "pull the plug of the servos' adapter alone, and wait for each question."
        )
    return lasting_name(back.pop())


def _changed(bench: Bench, before: tuple[str, ...]) -> tuple[str, ...]:
    """Return the ports when they differ from ``before``, at the latest after 30 s."""
    deadline_s = bench.clock.monotonic() + _WAIT_S
    while (now := bench.lines.serial_ports()) == before and bench.clock.monotonic() < deadline_s:
        bench.clock.sleep(_LOOK_S)
    return now


# Obstacles and names


_LATENCY_MS = 1
"""Latency timer in ms that the force loop of 200 Hz needs."""
_BAUD_RATE = 57600
"""Baud rate in bit/s with which a port is opened for its check; any is good."""
_ROOT = Path("/")
"""Folder of the system's folders dev, proc, run and sys."""


def check_port(key: str, port: str) -> Iterator[Finding]:
    """Check that this program can open a port, and that nothing delays or disturbs its bytes.

    Nothing is sent.

    Parameters
    ----------
    key
        Key of the port in the config, which names the check.
    """
    text, advice = port, ""
    if users := users_of(port):
        text = f"{port} is in use by {', '.join(users)}"
        advice = "end it (brltty takes such adapters: sudo apt remove brltty)"
    else:
        try:
            SerialStream(port, _BAUD_RATE).close()
        except PortLost as error:
            text = str(error)
            step = "end a program that uses it" if Path(port).exists() else "plug the adapter in"
            advice = f"{step}; if {key} names another port, correct it"
    yield check_result(key, text, advice, ok=not advice, bad=Verdict.FAIL)
    timer_ms = latency_timer_ms(port)
    if timer_ms is not None:
        command = f"echo {_LATENCY_MS} | sudo tee {latency_timer_file(port)}"
        yield check_result(
            f"USB latency timer of {key}",
            f"each answer waits up to {timer_ms} ms in the adapter, {_LATENCY_MS} ms is needed",
            f"until the next start: {command}; for good: {udev_rule()}",
            ok=timer_ms <= _LATENCY_MS,
        )
    if _sent_to_by_modem_manager(port):
        yield check_result(
            f"ModemManager at {key}",
            f"it runs, and it may send commands to {port} when the adapter is plugged in",
            "write the rules of `tactile-cell service install`, or: sudo systemctl disable --now "
            "ModemManager",
        )


def users_of(port: str) -> tuple[str, ...]:
    """Return the programs that have a port open, e.g. ``name (process 12)``, without this one.

    Only an administrator sees the programs of other users. The maker of a pseudo-terminal is no
    user of it.
    """
    device = os.path.realpath(port)
    users = []
    for process, name in () if device.startswith("/dev/pts/") else _processes():
        # It may have ended, or belong to another user.
        with suppress(OSError):
            if device in [os.readlink(handle) for handle in (process / "fd").iterdir()]:
                users.append(f"{name} (process {process.name})")
    return tuple(users)


def _processes() -> Iterator[tuple[Path, str]]:
    """Yield the folder and the name of each other process."""
    for process in sorted(_ROOT.glob("proc/[0-9]*")):
        with suppress(OSError):
            if process.name != str(os.getpid()):
                yield process, (process / "comm").read_text("utf-8").strip()


def _sent_to_by_modem_manager(port: str) -> bool:
    """Return whether ModemManager runs and no udev rule keeps it away from a USB adapter."""
    usb, _ = _usb_device(_tty(port))
    if usb is None or all(name != "ModemManager" for _, name in _processes()):
        return False
    properties = _ROOT / f"run/udev/data/c{(usb / 'dev').read_text('ascii').strip()}"
    # A container may have no list of devices.
    text = properties.read_text("utf-8") if properties.is_file() else ""
    return "ID_MM_DEVICE_IGNORE=1" not in text


def udev_rule() -> str:
    """Return the udev rule that sets the latency timer of all FTDI adapters."""
    return (
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
        f'ATTR{{latency_timer}}="{_LATENCY_MS}" in /etc/udev/rules.d/99-tactile-cell.rules'
    )


def lasting_name(port: str) -> str:
    """Return the name of a port by the serial number of its adapter, or else by its USB socket.

    A port without such a name keeps its own.
    """
    by_socket = "DEVPATH" in (usb_identity(port) or ())
    device = os.path.realpath(port)
    names = sorted(_ROOT.glob("dev/serial/by-path/*" if by_socket else "dev/serial/by-id/*"))
    return next((str(name) for name in names if os.path.realpath(name) == device), port)


def usb_identity(port: str) -> dict[str, str] | None:
    """Return the udev properties that identify a USB adapter; None for any other port.

    An adapter without a serial number of its own is identified by its USB socket.
    """
    usb, identity = _usb_device(_tty(port))
    if usb is None:
        return None
    ttys = _ROOT.glob("sys/class/tty/*")
    twins = (other for other, same in map(_usb_device, ttys) if same == identity)
    if "ID_SERIAL_SHORT" in identity and {*twins} == {usb}:
        return identity
    identity.pop("ID_SERIAL_SHORT", None)
    # The number of a USB bus may change at a restart, its controller stays.
    bus = next(folder for folder in usb.parents if folder.name.startswith("usb"))
    return identity | {"DEVPATH": f"*/{bus.parent.name}/usb*/*-{usb.name.partition('-')[2]}/*"}


def _tty(port: str) -> Path:
    return _ROOT / "sys/class/tty" / Path(port).resolve().name


def _usb_device(tty: Path) -> tuple[Path | None, dict[str, str]]:
    """Return the folder of a port's USB adapter and its udev properties; None for other ports."""
    device = (tty / "device").resolve()
    folders = (device, *device.parents)

    def read(folder: Path, name: str) -> str:
        return (folder / name).read_text("utf-8").strip()

    usb = next((path for path in folders if (path / "idVendor").is_file()), None)
    if usb is None:
        return None, {}
    identity = {"ID_VENDOR_ID": read(usb, "idVendor"), "ID_MODEL_ID": read(usb, "idProduct")}
    interface = next((path for path in folders if (path / "bInterfaceNumber").is_file()), None)
    if interface is not None:
        identity["ID_USB_INTERFACE_NUM"] = read(interface, "bInterfaceNumber")
    if (usb / "serial").is_file():
        # As udev writes it: other characters become underscores.
        identity["ID_SERIAL_SHORT"] = "".join(
            sign if sign.isalnum() or sign in "#+-.:=@_" else "_" for sign in read(usb, "serial")
        )
    return usb, identity
