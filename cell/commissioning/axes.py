"""Step `axes`: finds and names a wrist servo on its own port, and CiA 402 drives."""

from collections.abc import Iterator
from typing import Any

from cell.checks.findings import Notes
from cell.checks.ports import lasting_name
from cell.commissioning.backup import read_control_table
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
from cell.commissioning.servos import check_supply, lone_servo
from cell.commissioning.unit import network_interfaces
from tactile.control_unit.search import read_device, scan_nodes

_DRIVES = 402
"""Device profile of drives (CiA 402)."""


def find_axes(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Look for a wrist servo on a further serial port and for CiA 402 drives on the CAN buses.

    A cell without axes skips this step. Nothing is written, nothing moves.
    """
    axes: list[dict[str, Any]] = []
    tactile = bench.tactile()
    for port in bench.ports_beside(bench.gripper().port, tactile.channel, *tactile.serial_ports):
        # The device at this port is unknown: the person decides whether it gets bytes.
        answer = dialog.choose(
            "axes.port",
            f"Does the port {lasting_name(port)} lead to the servo of an axis? Then it is scanned.",
            {"no": "no, or another device: leave it alone", "yes": "yes, scan it"},
            "no",
        )
        if answer == "yes":
            axes.append(_servo_axis(bench, dialog, port, notes))
    for interface, channel, bitrate in _can_buses(bench, dialog):
        with bench.can_bus(interface, channel, bitrate) as bus:
            nodes = {node_id: read_device(bus, node_id) for node_id in scan_nodes(bus).nodes}
        for node_id, (profile, name) in nodes.items():
            if profile == _DRIVES:
                notes.fact(f"drive {name or 'without a name'}, node {node_id} on {channel}")
                axes.append({"kind": "cia402", "node_id": node_id, "channel": channel})
    notes.values["axes"] = axes
    if notes.failed:
        return
    notes.fact(
        "write what each of them moves under positioner.axes: docs/how-to/move-the-object.md"
        if axes
        else "no axes: a person brings the parts, or a host program does"
    )


AXES = Step(find_axes, "axes", "Axes", needs=("ports", "unit"))


def _servo_axis(bench: Bench, dialog: Dialog, port: str, notes: Notes) -> dict[str, Any]:
    """Scan a port; return its axis in the form of the config. Raises StepFailed without one."""
    rate, servo_id, model = lone_servo(bench, dialog, port)
    notes.fact(f"servo {model.name}, ID {servo_id} at {rate} bit/s on {lasting_name(port)}")
    with bench.servo_bus(port, rate) as bus:
        check_supply(servo_id, model, read_control_table(bus, servo_id), notes)
    place = {"kind": "dynamixel", "port": lasting_name(port), "baud_rate": rate}
    return place | {"id": servo_id, "model": model.name}


def _can_buses(bench: Bench, dialog: Dialog) -> Iterator[tuple[str, str, int]]:
    """Return the buses of possible drives: that of the control unit, and one more if named."""
    tactile = bench.tactile()
    # Sensor boards share their bus with no CANopen node.
    if tactile.sensor.canopen and not bench.gripper_alone:
        yield tactile.interface, tactile.channel, tactile.bitrate
    others = [name for name in network_interfaces() if name != tactile.channel]
    if not others:
        return
    answer = dialog.choose(
        "axes.can",
        "Are there drives on another CAN bus? Its nodes are asked for their identity.",
        {"none": "no"} | {name: name for name in others},
        "none",
    )
    if answer != "none":
        # The system sets the bit rate of a network interface.
        yield "socketcan", answer, tactile.bitrate
