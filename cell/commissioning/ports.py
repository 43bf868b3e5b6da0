"""Step `ports`: finds the serial port of the servos and checks for obstacles to its use."""

from pathlib import Path

from cell.checks.findings import Notes, Verdict
from cell.checks.ports import check_port, lasting_name
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed

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
        notes.findings += [one for one in checks if one.verdict is not Verdict.PASS]
    else:
        bench.lines.open_servos(port, 57600).close()


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
