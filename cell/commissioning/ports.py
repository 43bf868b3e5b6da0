"""Step `ports`: finds the serial port of the servos and checks for obstacles to its use."""

import os
from collections.abc import Iterator
from pathlib import Path

from cell.checks.findings import Finding
from cell.checks.ports import (
    LATENCY_MS,
    lasting_name,
    latency_command,
    rights_command,
    udev_rule,
)
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
from gripper.dynamixel.serial_port import latency_timer_ms
from gripper.errors import PortLost

_WAIT_S = 30.0
"""Longest time in s until an adapter disappears or comes back on request."""
_LOOK_S = 0.5
"""Time in s between two checks of the ports: udev takes some tenths."""


class PortsStep(Step):
    """Finds the servos' port: given, the only one, or the one whose plug is pulled."""

    key = "ports"
    title = "Ports"
    purpose = (
        "Finds the serial port of the servos' adapter and checks that this user may open it, that "
        "no other program has it, and its latency. Writes and moves nothing."
    )

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        """Find the port and check it."""
        named = bench.given.get("gripper.port")
        port = str(named) if named else _found(bench, dialog)
        timer_ms = latency_timer_ms(port)
        notes.values |= {"port": port, "latency_timer_ms": timer_ms}
        notes.settings["gripper.port"] = port
        notes.fact(f"servo port: {port}")
        if timer_ms is not None:
            notes.fact(f"latency timer of its adapter: {timer_ms} ms")
        if timer_ms is not None and timer_ms > LATENCY_MS:
            notes.warn(
                f"each answer waits {timer_ms} ms in the adapter, {LATENCY_MS} ms is needed. "
                f"Until the next start: {latency_command(port)}. For good: {udev_rule()}"
            )
        for obstacle in _obstacles(bench, port):
            notes.fail(obstacle)


def users_of(port: str, processes: Path = Path("/proc")) -> tuple[str, ...]:
    """Return the programs that have a port open, e.g. ``name (process 12)``, without this one.

    Only an administrator sees the programs of other users. Pseudo-terminals are skipped: their
    maker has them open.
    """
    device = os.path.realpath(port)
    if device.startswith("/dev/pts/"):
        return ()
    found = []
    for process in sorted(processes.glob("[0-9]*")):
        if process.name == str(os.getpid()):
            continue
        try:
            open_files = [os.readlink(handle) for handle in (process / "fd").iterdir()]
            if device in open_files:
                name = (process / "comm").read_text("utf-8").strip()
                found.append(f"{name} (process {process.name})")
        except OSError:
            # It has ended, or belongs to another user.
            continue
    return tuple(found)


def _found(bench: Bench, dialog: Dialog) -> str:
    """Return the only port, or the port that disappears and comes back with its plug."""
    ports = bench.lines.serial_ports()
    while not ports:
        dialog.confirm(
            "ports.plug_in",
            "No serial adapter was found. Plug in that of the servos. (Name a port of the main "
            "board with --servo-port.)",
            "it is plugged in",
        )
        ports = _changed(bench, ports)
    if len(ports) == 1:
        return lasting_name(ports[0])
    gone: set[str] = set()
    while len(gone) != 1:
        dialog.say(f"Serial ports: {', '.join(map(lasting_name, ports))}")
        dialog.confirm(
            "ports.unplug",
            "Which one leads to the servos? Pull the USB plug of their adapter.",
            "it is pulled",
        )
        gone = set(ports) - set(_changed(bench, ports))
        if len(gone) != 1:
            dialog.say(
                f"{len(gone)} ports are gone, one should be. Pull the plug of the servos' adapter "
                "alone; plug in the others first."
            )
            ports = bench.lines.serial_ports()
    left = tuple(port for port in ports if port not in gone)
    back: set[str] = set()
    while len(back) != 1:
        dialog.confirm("ports.plug_back", "Plug it in again.", "it is plugged in")
        # It may come back under another name.
        back = set(_changed(bench, left)) - set(left)
    return lasting_name(back.pop())


def _changed(bench: Bench, before: tuple[str, ...]) -> tuple[str, ...]:
    """Return the ports when they differ from ``before``, at the latest after 30 s."""
    deadline_s = bench.clock.monotonic() + _WAIT_S
    while (now := bench.lines.serial_ports()) == before and bench.clock.monotonic() < deadline_s:
        bench.clock.sleep(_LOOK_S)
    return now


def _obstacles(bench: Bench, port: str) -> Iterator[str]:
    """Return why a port cannot be opened, with the remedy."""
    if command := rights_command(port):
        yield f"this user may not open it: {command}, then log out and in"
        return
    try:
        bench.lines.open_servos(port, 57600).close()
    except PortLost as error:
        yield str(error)
    users = users_of(port) if Path(port).exists() else ()
    if users:
        yield (
            f"in use by {', '.join(users)}: end it (brltty takes such adapters: sudo apt remove "
            "brltty)"
        )
