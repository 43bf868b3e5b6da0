"""The control unit: its CAN interface and bit rate, its node-ID, its identity and its taxels."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, get_args

import numpy as np

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Notes, ProposedChange
from cell.commissioning.ports import lasting_name
from cell.config.file import changed_config
from cell.config.section import SIMULATED
from cell.config.sensor import SensorLines
from cell.config.tactile import LONGEST_SYNC_MS, TactileConfig, layout_from_config, link_settings
from cell.hand.local import taxel_sensor
from tactile.can.bus import CanBus, MissingBus
from tactile.can.sdo_client import PolledSdoClient
from tactile.control_unit.object_dictionary import (
    FORCE_MESSAGE,
    FORCES_TIMER,
    FRAMES_COB_ID,
    PRODUCT_CODE,
    VENDOR_ID,
)
from tactile.control_unit.search import BusTraffic, listen, objects_of, scan_nodes
from tactile.control_unit.settings import LinkSettings, least_sync_period_s
from tactile.control_unit.setup import identity_checks, read_identity, refuse_mismatch, written
from tactile.errors import BusNotOpened, TactileError
from tactile.layout import LAYOUTS, TaxelLayout
from tactile.sensor.opening import open_sensor
from tactile.sensor.sensor import TactileSensor
from tactile.source import SourceIdentity

TRIED_BIT_RATES: tuple[int, ...] = tuple(
    sorted(get_args(TactileConfig.model_fields["bitrate"].annotation), reverse=True)
)
"""Bit rates that are tried, in bit/s: those of the config, the fastest first."""
_LISTEN_S = 0.5
"""Time in s of listening at each bit rate: five heartbeats of a configured unit."""
_PATIENCE_S = 0.5
"""Longest silence in s of a unit while a person presses its pads."""
_RATE_FRAMES = 100
_LEAST_RATE = 0.8
"""Frames for the measured rate of boards, and the share of the usual rate below which it is
reported."""
_WRITTEN = {
    "COB-ID SYNC message": "COB-ID of SYNC (1005h)",
    "Synchronous window length": "SYNC window (1007h) in us",
    "Communication cycle period": "SYNC period (1006h) in us",
    "Producer heartbeat time": "heartbeat (1017h) in ms",
    FRAMES_COB_ID: "COB-ID of frames (1800h:1)",
    FORCES_TIMER: "period of force messages (1801h:5) in ms",
}
"""Objects that a start writes, in words, by their names in the EDS."""
_KIND = ("Vendor-ID", "Product code")
"""Parts of the identity object (1018h) that distinguish a control unit from a drive."""
_FRAMES = 10
"""Frames that prove that the link runs."""


@contextmanager
def unit_sensor(bench: Bench, *, mounted: bool = True) -> Iterator[TactileSensor]:
    """Start the sensor of the config so far, and close it at the end.

    A busy machine may be late, and force messages are not used, because nothing is held. Raises
    TactileError as `tactile.open_sensor`.

    Parameters
    ----------
    mounted
        False: pads as in the layout, without ``tactile.mounting``.
    """
    tactile = bench.tactile() if mounted else bench.tactile(mounting=[])
    forces = {"force_period_ms": 0} if tactile.sensor.canopen else {}
    tactile = changed_config(tactile, {"silence_ms": 1e3 * _PATIENCE_S} | forces)
    with ExitStack() as undo:
        place = (tactile.interface, tactile.channel, tactile.bitrate)
        lines = SensorLines(
            clock=bench.clock,
            open_serial=[
                partial(bench.lines.open_serial, port, tactile.sensor.baud_rate)
                for port in tactile.serial_ports
            ],
            can_bus=undo.enter_context(bench.can_bus(*place))
            if tactile.sensor.on_can
            else MissingBus(),
        )
        yield undo.enter_context(taxel_sensor(tactile, lines))


def find_unit(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Find the CAN interface, its bit rate, the control unit, its identity and its taxels.

    Other devices on the same bus may be disturbed for some seconds. Nothing moves. Settings of the
    unit are shown before, and are lost when it is switched off.
    """
    if not bench.tactile().sensor.canopen:
        _find_boards(bench, dialog, notes)
        return
    interface, channel = _interface(bench, dialog)
    bitrate, traffic, how = _bit_rate(bench, dialog, interface, channel)
    notes.fact(f"Bit rate {bitrate:,} bit/s on {channel} ({interface}), found by {how}.")
    notes.settings |= {
        "tactile.interface": interface,
        "tactile.channel": channel,
        "tactile.bitrate": bitrate,
        # The steps of the pads find it again.
        "tactile.board_serial_numbers": None,
        "tactile.mounting": [],
    }
    with bench.can_bus(interface, channel, bitrate) as bus:
        node_id = _node(bus, traffic, dialog, notes)
        with objects_of(bus, node_id) as objects:
            identity = _judge_identity(objects, node_id, notes)
            layout = _judge_layout(objects, bench, notes)
            _fit_period(layout, bitrate, bench, notes)
            tactile = bench.tactile()
            link = link_settings(tactile)
            writes = _writes(objects, node_id, link, notes)
        dialog.approve(writes)
        with open_sensor(bus, layout, node_id=tactile.node_id, link=link) as sensor:
            for _ in range(_FRAMES):
                sensor.read()
            forces = len(sensor.take_forces())
    for key in ("bitrate", "node_id"):
        was, now = getattr(bench.base.tactile, key), getattr(tactile, key)
        if was != now:
            notes.fact(f"tactile.{key} was {was}, is now {now}", corrected=True)
    notes.fact(f"The unit boots, keeps its set-up and sends frames ({forces} force messages).")
    notes.values |= {
        "serial_number": identity.serial,
        "revision": identity.revision,
        "board_serial_numbers": list(identity.boards),
    }


UNIT = Step(find_unit, "unit", "Control unit and its CAN bus", needs=("ports",))


def _find_boards(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Find the lines of the sensor's boards, and check that both send whole frames."""
    tactile = bench.tactile()
    notes.settings["tactile.mounting"] = []
    if tactile.sensor.on_can:
        interface, channel = _interface(bench, dialog)
        notes.settings |= {"tactile.interface": interface, "tactile.channel": channel}
    elif tactile.simulated:
        ports = bench.ports_beside(bench.gripper().port)
        if len(ports) != len(tactile.serial_ports):
            raise StepFailed(
                f"Serial ports beside that of the servos: {', '.join(ports) or 'none'}; the sensor "
                f"needs {len(tactile.serial_ports)}. Plug in the boards alone, or write "
                "gripper.port, tactile.sensor.ports and positioner.kind into the file of --config."
            )
        names = [lasting_name(port) for port in ports]
        notes.settings["tactile.sensor"] = tactile.sensor.model_dump() | {"ports": names}
        if any("/by-path/" in name for name in names):
            notes.fact("Boards without serial numbers are named by their USB sockets: leave them.")
    with unit_sensor(bench) as boards:
        began_s = boards.read().t_s
        for _ in range(_RATE_FRAMES):
            ended_s = boards.read().t_s
        torn = boards.source.statistics.frames.torn
    rate_hz = _RATE_FRAMES / (ended_s - began_s)
    notes.fact(f"Both boards send whole frames, {rate_hz:.0f} a second; {torn} were torn.")
    least_hz = _LEAST_RATE / bench.tactile().frame_period_s
    if rate_hz < least_hz:
        notes.warn(
            f"{rate_hz:.0f} frames a second are few, {least_hz:.0f} are usual: plug each board "
            "into a USB port of its own, not into a hub."
        )
    notes.values["rate_hz"] = rate_hz


def _interface(bench: Bench, dialog: Dialog) -> tuple[str, str]:
    """Return interface and channel: as given, the only one, or as the person answers."""
    config = bench.tactile()
    interface = str(bench.given.get("tactile.interface", config.interface))
    channel = str(bench.given.get("tactile.channel", config.channel))
    if interface != SIMULATED:
        return interface, channel
    servos = str(bench.given.get("gripper.port", bench.gripper().port))
    places = [("socketcan", name) for name in _system_bit_rates()]
    places += [("slcan", lasting_name(port)) for port in bench.ports_beside(servos)]
    if not places:
        raise StepFailed(
            "No CAN interface was found: no network interface of CAN (`ip link`), and no serial "
            "port beside that of the servos. Plug the adapter in; for SocketCAN "
            "`ip link set can0 up type can bitrate 1000000`."
        )
    if len(places) == 1:
        return places[0]
    by_key = {" ".join(place): place for place in places}
    answer = dialog.choose(
        "unit.interface",
        "Which CAN interface leads to the control unit?",
        {key: f"{name} ({kind})" for key, (kind, name) in by_key.items()},
        next(iter(by_key)),
    )
    return by_key[answer]


def _system_bit_rates() -> dict[str, int | None]:
    """Return the bit rate in bit/s of the system's CAN interfaces by name; None where none is set.

    Empty without the program ``ip``.
    """
    command = ["ip", "-details", "-json", "link", "show"]
    try:
        listing = subprocess.run(command, capture_output=True, text=True, check=True, timeout=2.0)
        links = [link for link in json.loads(listing.stdout) if link.get("link_type") == "can"]
        infos = {link["ifname"]: link.get("linkinfo", {}).get("info_data", {}) for link in links}
        return {name: info.get("bittiming", {}).get("bitrate") for name, info in infos.items()}
    except (OSError, subprocess.SubprocessError, ValueError, LookupError):
        return {}


def _bit_rate(
    bench: Bench, dialog: Dialog, interface: str, channel: str
) -> tuple[int, BusTraffic, str]:
    """Return the bit rate with traffic: found by listening first, then by requests."""
    fixed = _system_bit_rates().get(channel) if interface == "socketcan" else None
    rates = TRIED_BIT_RATES if fixed is None else (fixed,)
    refused: dict[int, BusNotOpened] = {}
    errors = 0
    for how in ("listening", "asking each node-ID"):
        for rate in (rate for rate in rates if rate not in refused):
            dialog.live("bit rate", f"{rate:,} bit/s, {how}")
            try:
                with bench.can_bus(interface, channel, rate) as bus:
                    traffic = listen(bus, _LISTEN_S) if how == "listening" else scan_nodes(bus)
            except BusNotOpened as error:
                # Not every adapter has every bit rate.
                refused[rate] = error
                continue
            errors += traffic.errors
            if traffic.messages:
                return rate, traffic, how
    if len(refused) == len(rates):
        raise refused[rates[0]]
    tried = ", ".join(f"{rate:,}" for rate in rates if rate not in refused)
    remedy = "" if fixed is None else f" Or set the rate of the unit with `ip link set {channel}`."
    at_another = f" {errors} error frames came: a device uses another bit rate." if errors else ""
    raise StepFailed(
        f"No CAN traffic and no reply on {channel} ({interface}) at {tried} bit/s. Check the "
        "supply of the control unit, CAN_H and CAN_L, the common ground and both terminating "
        f"resistors (60 Ohm between CAN_H and CAN_L, switched off).{remedy}{at_another}"
    )


def _node(bus: CanBus, traffic: BusTraffic, dialog: Dialog, notes: Notes) -> int:
    """Return the node-ID of the control unit among the nodes on the bus."""
    wanted = (VENDOR_ID, PRODUCT_CODE)
    units, others = [], []
    for node in sorted({*traffic.nodes, *scan_nodes(bus).nodes}):
        try:
            with objects_of(bus, node) as objects:
                vendor, product = (objects[f"Identity object.{name}"].raw for name in _KIND)
        except TactileError as error:
            others.append(f"node {node} does not answer ({error})")
            continue
        if (vendor, product) == wanted:
            units.append(node)
        else:
            others.append(
                f"node {node} is another device: vendor {vendor:#x}, product {product:#x}"
            )
    if not units:
        text = "; ".join(others) or f"{traffic.messages} messages were received and no node answers"
        raise StepFailed(
            f"No control unit is on the bus: {text}. It has vendor {wanted[0]:#x}, product "
            f"{wanted[1]:#x} (object 1018h): check the device, its supply and its firmware."
        )
    for other in others:
        notes.fact(f"Beside it, {other}.")
    if len(units) == 1:
        return units[0]
    text = "Several control units answer. Which one belongs to this gripper?"
    choices = {str(node): f"node {node}" for node in units}
    return int(dialog.choose("unit.node", text, choices, str(units[0])))


def _judge_identity(objects: PolledSdoClient, node_id: int, notes: Notes) -> SourceIdentity:
    """Return the identity of a unit; one of another EDS is refused."""
    identity = read_identity(objects)
    notes.fact(
        f"Node {node_id}: {identity.name}, serial number {identity.serial}, revision "
        f"{identity.revision >> 16}.{identity.revision & 0xFFFF}; boards of the pads "
        f"{identity.boards[0]} and {identity.boards[1]}."
    )
    refuse_mismatch(
        identity_checks(identity),
        "Its EDS is not that of this software",
        "Update the unit's firmware, or this software.",
    )
    notes.settings |= {"tactile.node_id": node_id, "tactile.serial_number": identity.serial}
    return identity


def _judge_layout(objects: PolledSdoClient, bench: Bench, notes: Notes) -> TaxelLayout:
    """Return the layout with the unit's taxels, and set it."""
    layout, value = _layout(objects, bench)
    notes.fact(f"Layout {layout.name}: {layout.n_taxels} taxels on {layout.n_pads} pads.")
    notes.settings["tactile.layout"] = value
    return layout


def _layout(objects: PolledSdoClient, bench: Bench) -> tuple[TaxelLayout, Any]:
    """Return the layout with the unit's taxels, and the value of tactile.layout for it."""
    unit_hash = objects["Taxel layout.Layout hash"].raw
    for name, make in LAYOUTS.items():
        if unit_hash == (layout := make()).layout_hash:
            return layout, name
    given = bench.given.get("tactile.layout") or bench.tactile().model_dump(mode="json")["layout"]
    own = layout_from_config(bench.tactile(layout=given, mounting=[]))
    if unit_hash == own.layout_hash:
        return own, given
    sizes = objects["Rows and columns of each pad"].raw
    shapes = ", ".join(
        f"{rows} x {columns}" for rows, columns in zip(sizes[::2], sizes[1::2], strict=False)
    )
    raise StepFailed(
        f"Its layout is unknown (hash {unit_hash}): "
        f"{objects['Taxel layout.Number of taxels'].raw} taxels on pads of {shapes}, full scale "
        f"{objects['Taxel layout.Full scale of the counts'].raw}. Write its pads into "
        "tactile.layout, or plug in the unit of this gripper. Known layouts: "
        f"{', '.join(LAYOUTS)}."
    )


def _fit_period(layout: TaxelLayout, bitrate: int, bench: Bench, notes: Notes) -> None:
    """Set a period of SYNC that fits a frame, if that of the config is too short."""
    tactile = bench.tactile()
    least_s = least_sync_period_s(layout, link_settings(tactile), bitrate)
    least_ms = float(np.ceil(1e3 * least_s))
    if least_ms <= tactile.sync_period_ms:
        return
    needed = f"At {bitrate:,} bit/s the frames need a period of SYNC of {least_ms:g} ms"
    if least_ms > LONGEST_SYNC_MS:
        raise StepFailed(f"{needed}, too long for a grip: set the unit to 1,000,000 bit/s.")
    notes.settings["tactile.sync_period_ms"] = least_ms
    notes.fact(f"{needed}, which is set now. A faster rate grips softer.")


def _writes(
    objects: PolledSdoClient, node_id: int, link: LinkSettings, notes: Notes
) -> list[ProposedChange]:
    """Return the writes to the unit at each start of the link."""
    forces = objects.find(FORCE_MESSAGE) is not None
    if not forces:
        notes.warn(
            "The unit has no force messages (object 2140h), so the force comes from whole frames "
            "and is slower: update its firmware, or set gripper.approach_speed_mm_s to 12."
        )
    where, undo = f"control unit, node {node_id}", "switch it off and on; it is not stored"
    return [
        ProposedChange(where, _WRITTEN[name], str(objects[name].raw), str(number), undo)
        for name, number in written(link, node_id, forces=forces).items()
    ]
