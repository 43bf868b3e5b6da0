"""Serial ports: the rights of this user, and the latency timer of the adapter."""

import grp
import os
import pwd
from pathlib import Path

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
    group = grp.getgrgid(device.stat().st_gid).gr_name
    return f"sudo usermod -a -G {group} {pwd.getpwuid(os.getuid()).pw_name}"
