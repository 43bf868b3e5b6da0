"""The simulated cell as a process in real time: terminals, and a socket for requests of others."""

import json
import math
import os
import select
import signal
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from simulator.boards.site import SerialBoard
from simulator.can.slcan import SlcanAdapter
from simulator.devices import CellDevices
from simulator.errors import EndpointError, SimulatorError, SimulatorSettingsError
from simulator.faults.injector import FaultInjector
from simulator.realtime.terminals import BoardPty, SerialPty
from simulator.servo.bus import SerialDevice
from simulator.servo.wrist import SimulatedWrist
from simulator.settings import SimulatorSettings
from simulator.world.shapes import ObjectPose
from simulator.world.world import NOTHING, STEP_S
from tactile.layout import Pad

_POSE_FIELDS = tuple(entry.name for entry in fields(ObjectPose))
_FARTHEST = 100.0
"""Largest coordinate or angle of a pose in m or rad: far beyond any cell, and safe to square."""
_NEAR_EDGE = 0.7
"""Position of a fingertip at an edge: share of the way from the middle of the pad to the edge."""
_READ_BYTES = 65536
"""Most bytes of one read."""

Handler = Callable[[dict[str, Any]], dict[str, Any]]
"""Carries out one request and returns the reply; a SimulatorError becomes an error reply."""


_REQUESTS = (
    *("place", "check", "remove", "press", "lift"),
    *("hand", "state", "kinds", "inject", "clear"),
)
"""Names of requests; each has a method of `CellRequests`."""


class CellRequests:
    """Carries out requests, given as JSON objects.

    Requests and their replies:

    - ``{"place": label, "pose": {"x_m": ..}}``: ``{"pose": {..}}``, its resting pose; the label
      ``nothing`` removes the object. ``"offset": {"x_m": ..}`` is added to the poses of this object
      and of all later ones
    - ``{"check": label}``: ``{"known": true}`` if it is an object, a shape as text or ``nothing``
    - ``{"remove": true}``: ``{"removed": true}``
    - ``{"press": "finger0.inner", "at": ["tip", "left"], "force_n": 2.0}``: ``{"pressed": pad}``, a
      person's fingertip on a pad, in its middle or at some of tip, base, left, right, inside,
      outside as `simulator.realtime.hands` has them; ``{"lift": true}``: ``{"lifted": true}``
    - ``{"hand": {"1": 0.02, "2": 0}}``: a person moves the fingers of these servos, without torque,
      to half openings in m: ``{"moving": true}``; "state" shows the end of the motion
    - ``{"state": true}``: placed object, pressed pad, the names of objects, the offset of their
      poses, forces, opening, half openings, number of servos, kind of the linkage, names of the
      pads, axes, faults
    - ``{"kinds": true}``: ``{"kinds": [..]}``, the faults that fit the cell: name, meaning,
      value (null for none), and whether it is a moment, without an end
    - ``{"inject": "can.loss=0.05@2s"}``: the same object; see `simulator.faults.injector`
    - ``{"clear": "can.loss"}``: ``{"cleared": n}``; by the whole text or by the name
    """

    def __init__(self, devices: CellDevices, injector: FaultInjector) -> None:
        self._devices = devices
        self._injector = injector

    def __call__(self, request: dict[str, Any]) -> dict[str, Any]:
        """Carry out one request.

        Raises SimulatorSettingsError or SimulatorStateError, without any change, if it cannot be
        carried out.
        """
        named = [name for name in _REQUESTS if name in request]
        if len(named) != 1:
            raise SimulatorSettingsError(
                f"a request needs one of {', '.join(_REQUESTS)}; got {', '.join(request)}"
            )
        (name,) = named
        value = request[name]
        if name in ("remove", "lift", "state", "kinds") and value is not True:
            raise SimulatorSettingsError(f"{name} takes true, got {value!r}")
        if name in ("inject", "clear") and not isinstance(value, str):
            raise SimulatorSettingsError(f"{name} takes the text of a fault, got {value!r:.40}")
        reply: dict[str, Any] = getattr(self, f"_{name}")(value, request)
        return reply

    def _place(self, label: Any, request: dict[str, Any]) -> dict[str, Any]:
        devices, label = self._devices, self._label(label)
        pose, before = _pose(request.get("pose", {})), devices.offset
        devices.offset = _pose(request["offset"]) if "offset" in request else before
        try:
            return {"pose": asdict(devices.place(label, pose))}
        except SimulatorError:
            devices.offset = before
            raise

    def _check(self, label: Any, _request: dict[str, Any]) -> dict[str, Any]:
        if self._label(label) != NOTHING:
            self._devices.world.shape(label)
        return {"known": True}

    def _label(self, label: Any) -> str:
        """Return the name or text of a shape; names of files are refused."""
        if not isinstance(label, str):
            raise SimulatorSettingsError(f"a shape is a name or text, got {label!r:.40}")
        if label.startswith("mesh:") and label not in self._devices.world.objects:
            raise SimulatorSettingsError("mesh files are named in the settings, not in requests")
        return label

    def _remove(self, _true: Any, _request: dict[str, Any]) -> dict[str, Any]:
        self._devices.world.remove()
        return {"removed": True}

    def _press(self, name: Any, request: dict[str, Any]) -> dict[str, Any]:
        pads = {pad.name: number for number, pad in enumerate(self._devices.settings.layout.pads)}
        if not isinstance(name, str) or name not in pads:
            raise SimulatorSettingsError(
                f"there is no pad {name!r:.40}; there are {', '.join(pads)}"
            )
        pad = self._devices.settings.layout.pads[pads[name]]
        x_m, y_m = _place_on(pad, request.get("at", []))
        force_n = _number("force_n", request.get("force_n", 2.0))
        self._devices.world.press(pads[name], x_m, y_m, force_n)
        return {"pressed": name}

    def _lift(self, _true: Any, _request: dict[str, Any]) -> dict[str, Any]:
        self._devices.world.lift()
        return {"lifted": True}

    def _hand(self, openings: Any, _request: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(openings, dict) or not openings:
            raise SimulatorSettingsError('hand takes an object such as {"1": 0.02}: servo, m')
        axes = {str(1 + axis): axis for axis in range(len(self._devices.settings.servos))}
        if unknown := set(openings) - set(axes):
            raise SimulatorSettingsError(f"there is no servo {', '.join(sorted(unknown))}")
        moves = {axes[name]: _number(name, value) for name, value in openings.items()}
        for axis, half_opening_m in moves.items():
            self._devices.mechanics.move_by_hand(axis, half_opening_m)
        return {"moving": True}

    def _state(self, _true: Any, _request: dict[str, Any]) -> dict[str, Any]:
        devices = self._devices
        world, mechanics, settings = devices.world, devices.mechanics, devices.settings
        return {
            "placed": None if world.placed is None else world.placed[0],
            "objects": list(world.objects),
            "offset": asdict(devices.offset),
            "pressed": world.pressed,
            "pads": [pad.name for pad in settings.layout.pads],
            "servos": len(settings.servos),
            "linkage": settings.linkage.kind,
            "contact_force_n": list(world.contact_force_n()),
            "aperture_m": mechanics.aperture_m,
            "fingers_m": list(mechanics.finger_position_m),
            "moved_by_hand": mechanics.moved_by_hand,
            "control_unit": devices.unit.nmt_state,
            "axes": {
                moves: {"position": axis.position, "moving": axis.moving}
                for moves, axis in devices.axes.items()
            },
            "faults": {fault.text: fault.began_s for fault in self._injector.faults},
        }

    def _kinds(self, _true: Any, _request: dict[str, Any]) -> dict[str, Any]:
        return {
            "kinds": [
                {
                    "name": name,
                    "meaning": entry.meaning,
                    "value": None if entry.value is None else asdict(entry.value),
                    "moment": entry.moment,
                }
                for name, entry in self._injector.kinds().items()
            ]
        }

    def _inject(self, text: str, _request: dict[str, Any]) -> dict[str, Any]:
        self._injector.inject(text)
        return {"inject": text}

    def _clear(self, text: str, _request: dict[str, Any]) -> dict[str, Any]:
        return {"cleared": self._injector.clear(text)}


def _pose(pose: Any) -> ObjectPose:
    if not isinstance(pose, dict) or not set(pose) <= set(_POSE_FIELDS):
        raise SimulatorSettingsError(
            f"a pose is an object of {', '.join(_POSE_FIELDS)}; got {pose!r:.80}"
        )
    numbers = {name: _number(name, value) for name, value in pose.items()}
    for name, number in numbers.items():
        if abs(number) > _FARTHEST:
            raise SimulatorSettingsError(f"{name} is {number:g}, limit {_FARTHEST:g} m or rad")
    return ObjectPose(**numbers)


def _place_on(pad: Pad, places: Any) -> tuple[float, float]:
    """Return the position on a pad in m for words such as ``["tip", "left"]``."""
    to_tip, inside = np.eye(3)[0], np.eye(3)[2]
    face = inside if pad.face == "tip" else pad.normal
    # Finger 1's frame is left-handed.
    left = (1 - 2 * pad.finger) * np.cross(face, to_tip)
    ways = {"tip": to_tip, "left": left, "inside": inside, "middle": np.zeros(3)}
    ways |= {"base": -to_tip, "right": -left, "outside": -inside}
    if not isinstance(places, list) or any(str(place) not in ways for place in places):
        raise SimulatorSettingsError(f"a pad has the places {', '.join(ways)}; got {places!r:.60}")
    way = np.array([pad.x_axis, pad.y_axis]) @ sum((ways[name] for name in places), np.zeros(3))
    along_m, across_m = 0.5 * pad.rows * pad.pitch_x_m, 0.5 * pad.columns * pad.pitch_y_m
    return _NEAR_EDGE * along_m * float(way[0]), _NEAR_EDGE * across_m * float(way[1])


def _number(name: str, value: Any) -> float:
    number = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # JSON has integers beyond any float
            number = math.inf
    if not math.isfinite(number):
        raise SimulatorSettingsError(f"{name} is {value!r:.40}, must be a finite number")
    return number


class PositionerServer:
    """Serves requests of other processes on this machine.

    Request and reply are JSON objects, each on one line; a refusal is ``{"error": text}``. Only the
    owner can use the socket. Raises EndpointError if the socket cannot be created.

    Parameters
    ----------
    path
        Path of the socket; an existing socket is replaced.
    """

    def __init__(self, path: Path, handle: Handler) -> None:
        self.path = path
        self._handle = handle
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        """Connection and incomplete line of each client by its descriptor."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            if path.is_socket():
                path.unlink()
            self._listener.bind(str(path))
            os.chmod(path, 0o600)
            self._listener.listen()
        except OSError as error:
            self._listener.close()
            raise EndpointError(f"no socket for the positioner at {path}: {error}") from error

    def filenos(self) -> list[int]:
        """Return the descriptors to wait on."""
        return [self._listener.fileno(), *self._clients]

    def poll(self, readable: list[int]) -> None:
        """Serve the ready descriptors; never waits."""
        for descriptor in readable:
            if descriptor == self._listener.fileno():
                self._accept()
            elif descriptor in self._clients:
                self._serve(*self._clients[descriptor])

    def close(self) -> None:
        """Disconnect all clients and remove the socket; a second call has no effect."""
        for connection, _ in list(self._clients.values()):
            self._drop(connection)
        if self._listener.fileno() >= 0:
            self._listener.close()
            self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        connection.setblocking(False)
        self._clients[connection.fileno()] = (connection, bytearray())

    def _serve(self, connection: socket.socket, received: bytearray) -> None:
        try:
            data = connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
            return
        received += data
        *lines, received[:] = received.split(b"\n")
        replies = b"".join(self._answer(bytes(line)) for line in lines if line.strip())
        try:
            connection.sendall(replies)
        except OSError:
            self._drop(connection)  # a client that does not take its replies is gone

    def _answer(self, line: bytes) -> bytes:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError) as error:
            return _line({"error": f"the request is not valid JSON: {error}"})
        if not isinstance(request, dict):
            return _line({"error": "a request is a JSON object"})
        try:
            return _line(self._handle(request))
        except SimulatorError as error:
            return _line({"error": str(error)})

    def _drop(self, connection: socket.socket) -> None:
        self._clients.pop(connection.fileno(), None)
        connection.close()


def _line(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, allow_nan=False).encode() + b"\n"


PIECE_S = 0.02
"""Longest time in s that the world advances before clients are served again."""
FORGIVEN_S = 0.25
"""Longest stall in s that is made up; a longer stall is skipped."""
POWERED_BEFORE_S = 0.1
"""Power-on time in s before clients can connect: the devices have booted by then."""

Announce = Callable[[dict[str, Any]], None]


class RealTimeCell:
    """World, devices and endpoints of a cell in real time; its owner has the loop and the clock.

    Parameters
    ----------
    folder
        Folder for the links to the terminals, and for the socket.
    """

    def __init__(self, settings: SimulatorSettings, folder: Path, now_s: float) -> None:
        self.devices = CellDevices(settings, start_s=now_s - POWERED_BEFORE_S)
        self.devices.world.skip_to(now_s)
        self._world_s = now_s
        # A step serves them in this order: the time of its start is then that of the CAN bytes.
        lines: dict[str, SerialDevice] = {
            "can": SlcanAdapter(self.devices.can),
            "servos": self.devices.servo_bus,
        }
        if self.devices.axes_can is not None:
            lines["axes-can"] = SlcanAdapter(self.devices.axes_can)
        for moves, axis in self.devices.axes.items():
            if isinstance(axis, SimulatedWrist):
                lines[f"axis-{moves}"] = axis.bus
        lines |= {f"board{finger}": board for finger, board in enumerate(self.devices.boards)}
        self._ptys: dict[str, SerialPty] = {}
        with ExitStack() as opened:
            for name, device in lines.items():
                kind = BoardPty if isinstance(device, SerialBoard) else SerialPty
                self._ptys[name] = kind(device, folder / name)
                opened.callback(self._ptys[name].close)
            self.injector = FaultInjector(self.devices, now_s - POWERED_BEFORE_S)
            requests = CellRequests(self.devices, self.injector)
            self._server = PositionerServer(folder / "positioner.sock", requests)
            opened.callback(self._server.close)
            self.step(now_s, [])
            for text in settings.faults:
                self.injector.inject(text)
            self._close = opened.pop_all().close

    def announcement(self) -> dict[str, Any]:
        """Return addresses and settings for clients; plain values for JSON."""
        settings = self.devices.settings
        paths = {name: pty.path for name, pty in self._ptys.items()}
        return {
            "servo_port": paths["servos"],
            "servo_baud_rate": settings.servo_baud_rate,
            "servo_ids": [servo.servo_id for servo in settings.servos],
            "can_interface": "slcan",
            "can_channel": paths["can"],
            "can_bitrate": settings.unit.bitrate,
            "node_id": settings.unit.node_id,
            "axes_can_channel": paths.get("axes-can"),
            "axes_ports": {
                moves: paths[f"axis-{moves}"] for moves in settings.axes if f"axis-{moves}" in paths
            },
            "board_ports": [paths[f"board{n}"] for n in range(len(self.devices.boards))],
            "positioner_socket": str(self._server.path),
            "pid": os.getpid(),
            "config": None,
        }

    def descriptors(self) -> list[int]:
        """Return the descriptors whose input wakes the cell."""
        ptys = [pty.fileno() for pty in self._ptys.values() if pty.plugged_in]
        return [*ptys, *self._server.filenos()]

    def step(self, now_s: float, readable: list[int]) -> float:
        """Advance the time and serve the clients; return the latest time of the next call in s.

        Parameters
        ----------
        readable
            Items of `descriptors` with input.
        """
        if now_s - self._world_s > FORGIVEN_S:
            self._world_s = now_s - PIECE_S
            self.devices.world.skip_to(self._world_s)
        self._world_s = min(now_s, self._world_s + PIECE_S)
        # First the bytes that clients sent while this process did not run: they came before now.
        due_s = [pty.poll(now_s) for pty in self._ptys.values()]
        self.devices.advance_to(self._world_s)
        self.injector.advance(self._world_s)
        self._server.poll(readable)
        return min(self._world_s + STEP_S, *due_s)

    def close(self) -> None:
        """Remove terminals, links and socket; a second call has no effect."""
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def serve(
    settings: SimulatorSettings,
    announce: Announce,
    *,
    folder: Path,
    until_parent_ends: bool = False,
) -> None:
    """Run a simulated cell until SIGTERM or SIGINT, in the main thread of a separate process.

    Raises EndpointError if terminals or socket cannot be made.

    Parameters
    ----------
    announce
        Called once, when clients can connect, with plain values for JSON: ``servo_port``,
        ``servo_baud_rate``, ``servo_ids``, ``can_interface``, ``can_channel``, ``can_bitrate``,
        ``node_id``, ``axes_can_channel`` (None without drives), ``axes_ports`` (of wrists, by what
        they move), ``board_ports`` (of sensor boards, by finger), ``positioner_socket``, ``pid``,
        and ``config``, which is None here.
    folder
        Folder for the links to the terminals, and for the socket.
    until_parent_ends
        Also end when the parent process ends.
    """
    parent = os.getppid()
    stop: list[int] = []
    with ExitStack() as stack:
        for number in (signal.SIGTERM, signal.SIGINT):
            before = signal.signal(number, lambda received, _frame: stop.append(received))
            stack.callback(signal.signal, number, before)
        cell = stack.enter_context(RealTimeCell(settings, folder, time.monotonic()))
        announce(cell.announcement())
        due_s = time.monotonic()
        while not stop:
            timeout_s = max(0.0, due_s - time.monotonic())
            readable, _, _ = select.select(cell.descriptors(), [], [], timeout_s)
            if until_parent_ends and os.getppid() != parent:
                return
            due_s = cell.step(time.monotonic(), readable)
