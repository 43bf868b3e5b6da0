"""Step `ports`: finds the serial port of the servos and checks for obstacles to its use."""

from pathlib import Path

from cell.checks.findings import Finding, Verdict
from cell.checks.ports import check_port, lasting_name
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
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
        notes.values["port"] = port
        notes.settings["gripper.port"] = port
        notes.fact(f"servo port: {port}")
        for check in check_port("gripper.port", port) if Path(port).exists() else ():
            if check.verdict is not Verdict.PASS:
                add = notes.warn if check.verdict is Verdict.WARN else notes.fail
                add(f"{check.found}: {check.advice}")
        if not notes.failed:
            try:
                bench.lines.open_servos(port, 57600).close()
            except PortLost as error:
                notes.fail(str(error))


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
