"""Serial ports: their lasting names, the rights of this user, the latency timer of the adapter."""

import grp
import os
import pwd
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gripper.dynamixel.serial_port import latency_timer_file

LATENCY_MS = 1
"""Latency timer in ms that the force loop of 200 Hz needs."""


def latency_command(port: str) -> str:
    """Return the command that sets the latency timer of a port until the next reboot."""
    return f"echo {LATENCY_MS} | sudo tee {latency_timer_file(port)}"


def udev_rule() -> str:
    """Return the udev rule that sets the latency timer of all FTDI adapters."""
    return (
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
        f'ATTR{{latency_timer}}="{LATENCY_MS}" in /etc/udev/rules.d/99-tactile-cell.rules'
    )


def rights_command(port: str) -> str:
    """Return the command that permits this user to open a port; empty if not needed."""
    device = Path(port)
    if not device.exists() or os.access(device, os.R_OK | os.W_OK):
        return ""
    group = _name(grp.getgrgid, device.stat().st_gid)
    return f"sudo usermod -a -G {group} {_name(pwd.getpwuid, os.getuid())}"


def _name(find: Callable[[int], Any], number: int) -> str:
    """Return the name of a group or user; its number where it has none, as in a container."""
    try:
        return str(find(number)[0])
    except KeyError:
        return str(number)


def lasting_name(port: str, dev: Path = Path("/dev"), sys_folder: Path = Path("/sys")) -> str:
    """Return the name of a port by the serial number of its adapter, or else by its USB socket.

    A port without such a name keeps its own.
    """
    by_socket = "DEVPATH" in (usb_identity(port, sys_folder) or ())
    device = os.path.realpath(port)
    names = sorted((dev / "serial" / ("by-path" if by_socket else "by-id")).glob("*"))
    return next((str(name) for name in names if os.path.realpath(name) == device), port)


def usb_identity(port: str, sys_folder: Path = Path("/sys")) -> dict[str, str] | None:
    """Return the udev properties that identify a USB adapter; None for any other port.

    An adapter without a serial number of its own is identified by its USB socket.
    """
    ttys = sys_folder / "class/tty"
    usb, found = _usb_device(ttys / Path(port).resolve().name)
    if usb is None:
        return None
    twins = (other for other, same in map(_usb_device, ttys.iterdir()) if same == found)
    if "ID_SERIAL_SHORT" in found and {*twins} == {usb}:
        return found
    found.pop("ID_SERIAL_SHORT", None)
    # The number of a USB bus may change at a restart, its controller stays.
    bus = next(folder for folder in usb.parents if folder.name.startswith("usb"))
    return found | {"DEVPATH": f"*/{bus.parent.name}/usb*/*-{usb.name.partition('-')[2]}/*"}


def _usb_device(tty: Path) -> tuple[Path | None, dict[str, str]]:
    """Return the folder of a port's USB adapter and its udev properties; None for other ports."""
    device = (tty / "device").resolve()
    folders = (device, *device.parents)

    def read(folder: Path, name: str) -> str:
        return (folder / name).read_text("utf-8").strip()

    usb = next((one for one in folders if (one / "idVendor").is_file()), None)
    if usb is None:
        return None, {}
    found = {"ID_VENDOR_ID": read(usb, "idVendor"), "ID_MODEL_ID": read(usb, "idProduct")}
    interface = next((one for one in folders if (one / "bInterfaceNumber").is_file()), None)
    if interface is not None:
        found["ID_USB_INTERFACE_NUM"] = read(interface, "bInterfaceNumber")
    if (usb / "serial").is_file():
        # As udev writes it: other characters become underscores.
        found["ID_SERIAL_SHORT"] = "".join(
            sign if sign.isalnum() or sign in "#+-.:=@_" else "_" for sign in read(usb, "serial")
        )
    return usb, found
