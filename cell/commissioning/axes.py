"""Step `axes`: finds and names a wrist servo on its own port, and CiA 402 drives."""

from collections.abc import Iterator
from typing import Any

from cell.checks.findings import Finding
from cell.checks.ports import lasting_name
from cell.commissioning.backup import read_control_table
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step
from cell.commissioning.servos import Scan, check_supply, scan_servos
from cell.commissioning.unit import network_interfaces
from gripper.dynamixel.models import MODELS, model_name
from gripper.errors import GripperError
from tactile.can.bus import CanBus
from tactile.control_unit.search import read_device, scan_nodes
from tactile.errors import TactileError

_DRIVES = 402
"""Device profile of drives (CiA 402)."""
_NO = "none"
"""Answer that there is no further axis."""


class AxesStep(Step):
    """Finds the drives and servos that move the object or the gripper."""

    key = "axes"
    title = "Axes"
    purpose = (
        "Looks for a wrist servo on a further serial port and for CiA 402 drives on the CAN buses, "
        "and names them. A cell without axes skips this step. Nothing is written, nothing moves."
    )
    needs = ("ports", "unit")

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        """Look for both kinds of axes."""
        axes: list[dict[str, Any]] = []
        tactile = bench.tactile()
        used = bench.gripper().port, tactile.channel, *tactile.serial_ports
        for port in bench.ports_beside(*used):
            if _leads_to_a_servo(port, dialog):
                try:
                    axes += _servo_axis(bench, dialog, port, notes)
                except GripperError as error:
                    notes.fail(str(error))
        for interface, channel, bitrate in _can_buses(bench, dialog):
            try:
                with bench.can_bus(interface, channel, bitrate) as bus:
                    drives = list(_drives(bus))
            except TactileError as error:
                notes.fail(f"{channel} ({interface}): {error}")
                continue
            for node_id, name in drives:
                notes.fact(f"drive {name or 'without a name'}, node {node_id} on {channel}")
                axes.append({"kind": "cia402", "node_id": node_id, "channel": channel})
        notes.values["axes"] = axes
        if notes.failed:
            return
        if axes:
            notes.fact(
                "name what each of them moves, its increments and limits under positioner.axes in "
                "the config: docs/how-to/move-the-object.md"
            )
        else:
            notes.fact("no axes: a person brings the parts, or a host program does")


def _leads_to_a_servo(port: str, dialog: Dialog) -> bool:
    """Ask the person before sending bytes to a port of an unknown device."""
    answer = dialog.choose(
        "axes.port",
        f"Does the port {lasting_name(port)} lead to the servo of an axis? Then it is scanned.",
        {"no": "no, or another device: leave it alone", "yes": "yes, scan it"},
        "no",
    )
    return answer == "yes"


def _servo_axis(bench: Bench, dialog: Dialog, port: str, notes: Finding) -> list[dict[str, Any]]:
    """Scan a port; return its axis in the form of the config, empty if it cannot be driven."""
    found = scan_servos(bench, port, dialog)
    if complaint := _complaint(port, found):
        notes.fail(complaint)
        return []
    (servo,) = found.servos
    servo_id, name = servo.identity.servo_id, model_name(servo.identity.model_number)
    notes.fact(f"servo {name}, ID {servo_id} at {servo.baud_rate} bit/s on {lasting_name(port)}")
    model = MODELS.get(name)
    if model is None:
        notes.fail(f"the cell cannot drive {name}; use one of {', '.join(MODELS)}")
        return []
    with bench.servo_bus(port, servo.baud_rate) as bus:
        check_supply(servo_id, model, read_control_table(bus, servo_id), notes)
    return [
        {
            "kind": "dynamixel",
            "port": lasting_name(port),
            "baud_rate": servo.baud_rate,
            "id": servo_id,
            "model": name,
        }
    ]


def _complaint(port: str, found: Scan) -> str:
    """Return why the servos of a line cannot be an axis; empty for one servo."""
    if found.crowded or len(found.servos) > 1:
        return (
            f"several servos answer on {port}: the servo of an axis needs its own port. "
            "Disconnect the others, then run the step again"
        )
    if not found.servos:
        return (
            f"no servo answers on {port} at any baud rate: check its supply and wires, then run "
            "the step again"
        )
    return ""


def _can_buses(bench: Bench, dialog: Dialog) -> Iterator[tuple[str, str, int]]:
    """Return the buses of possible drives: that of the control unit, and one more if named."""
    tactile = bench.tactile()
    own: tuple[str, ...] = ()
    if not bench.gripper_alone:
        own = (tactile.channel,)
        # Sensor boards share their bus with no CANopen node.
        if tactile.sensor.canopen:
            yield tactile.interface, tactile.channel, tactile.bitrate
    others = [name for name in network_interfaces() if name not in own]
    if not others:
        return
    answer = dialog.choose(
        "axes.can",
        "Are there drives on another CAN bus? Its nodes are asked for their identity.",
        {_NO: "no"} | {name: name for name in others},
        _NO,
    )
    if answer != _NO:
        # The system sets the bit rate of a network interface.
        yield "socketcan", str(answer), tactile.bitrate


def _drives(bus: CanBus) -> Iterator[tuple[int, str]]:
    """Return node-ID and name of each drive on a bus."""
    for node_id in scan_nodes(bus).nodes:
        profile, name = read_device(bus, node_id)
        if profile == _DRIVES:
            yield node_id, name
