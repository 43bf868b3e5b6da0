"""Requests of other processes to a simulated cell: objects, recorded grasps, state, faults."""

import math
from collections.abc import Callable
from dataclasses import asdict, fields
from typing import Any

from simulator.devices import CellDevices
from simulator.errors import SimulatorSettingsError
from simulator.faults.injector import FaultInjector
from simulator.world.shapes import ObjectPose

_POSE_FIELDS = tuple(entry.name for entry in fields(ObjectPose))
_FARTHEST = 100.0
"""Largest coordinate or angle of a pose in m or rad: far beyond any cell, and safe to square."""


class CellRequests:
    """Carries out requests, given as JSON objects.

    Requests and their replies:

    - ``{"place": label, "pose": {"x_m": ..}}``: ``{"pose": {..}}``, where it came to rest
    - ``{"remove": true}``: ``{"removed": true}``
    - ``{"press": pad, "x_m": 0.0, "y_m": 0.0, "force_n": 2.0}``: ``{"pressed": pad}``, a person's
      fingertip on a pad; ``{"lift": true}``: ``{"lifted": true}``
    - ``{"play": index}``: ``{"frames": n}`` of that recorded grasp
    - ``{"hand": {"1": 0.02, "2": 0}}``: a person moves the fingers of these servos, without torque,
      to half openings in m: ``{"moving": true}``; "state" shows when they are left
    - ``{"state": true}``: what is placed, forces, opening, frames left, axes, faults
    - ``{"kinds": true}``: ``{"kinds": [..]}``, the faults that fit the cell: name, kind, meaning,
      value (null for none), and whether it is a moment, without an end
    - ``{"inject": "can.loss=0.05@2s"}``: the same back; see `simulator.faults.injector`
    - ``{"clear": "can.loss"}``: ``{"cleared": n}``; by the whole text or by the name
    """

    def __init__(self, devices: CellDevices, injector: FaultInjector) -> None:
        self._devices = devices
        self._injector = injector
        self._requests: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "place": self._place,
            "remove": self._remove,
            "press": self._press,
            "lift": self._lift,
            "play": self._play,
            "hand": self._hand,
            "state": self._state,
            "kinds": self._kinds,
            "inject": self._inject,
            "clear": self._clear,
        }

    def __call__(self, request: dict[str, Any]) -> dict[str, Any]:
        """Carry out one request.

        Raises SimulatorSettingsError or SimulatorStateError if it cannot be carried out; nothing
        has changed then.
        """
        named = [name for name in self._requests if name in request]
        if len(named) != 1:
            raise SimulatorSettingsError(
                f"a request names one of {', '.join(self._requests)}; got {', '.join(request)}"
            )
        return self._requests[named[0]](request)

    def _place(self, request: dict[str, Any]) -> dict[str, Any]:
        label, wanted = request["place"], request.get("pose", {})
        if not isinstance(label, str) or not isinstance(wanted, dict):
            raise SimulatorSettingsError("place takes a label, pose an object of numbers")
        if label.startswith("mesh:") and label not in self._devices.settings.objects:
            raise SimulatorSettingsError("mesh files are named in the settings, not in requests")
        unknown = set(wanted) - set(_POSE_FIELDS)
        if unknown:
            raise SimulatorSettingsError(
                f"a pose has {', '.join(_POSE_FIELDS)}; got {', '.join(sorted(unknown))}"
            )
        numbers = {name: _number(name, value) for name, value in wanted.items()}
        for name, number in numbers.items():
            if abs(number) > _FARTHEST:
                raise SimulatorSettingsError(f"{name} is {number:g}, limit {_FARTHEST:g} m or rad")
        pose = ObjectPose(**numbers)
        reached = self._devices.place(label, pose)
        return {"pose": {name: getattr(reached, name) for name in _POSE_FIELDS}}

    def _remove(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "remove")
        self._devices.physical.remove()
        return {"removed": True}

    def _press(self, request: dict[str, Any]) -> dict[str, Any]:
        pad = request["press"]
        if type(pad) is not int:
            raise SimulatorSettingsError(f"press takes the number of a pad, got {pad!r:.40}")
        x_m, y_m = (_number(name, request.get(name, 0.0)) for name in ("x_m", "y_m"))
        if max(abs(x_m), abs(y_m)) > _FARTHEST:
            raise SimulatorSettingsError(f"x_m, y_m are {x_m:g}, {y_m:g}, limit {_FARTHEST:g} m")
        force_n = _number("force_n", request.get("force_n", 2.0))
        self._devices.physical.press(pad, x_m, y_m, force_n)
        return {"pressed": pad}

    def _lift(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "lift")
        self._devices.physical.lift()
        return {"lifted": True}

    def _play(self, request: dict[str, Any]) -> dict[str, Any]:
        index = request["play"]
        if type(index) is not int:
            raise SimulatorSettingsError(f"play takes the number of a grasp, got {index!r}")
        return {"frames": self._devices.play(index)}

    def _hand(self, request: dict[str, Any]) -> dict[str, Any]:
        wanted = request["hand"]
        if not isinstance(wanted, dict) or not wanted:
            raise SimulatorSettingsError('hand takes an object, as {"1": 0.02}: servo, m')
        _ = self._devices.physical
        servos = {
            str(number): number for number in range(1, 1 + len(self._devices.settings.servos))
        }
        unknown = set(wanted) - set(servos)
        if unknown:
            raise SimulatorSettingsError(f"there is no servo {', '.join(sorted(unknown))}")
        moves = {servos[name] - 1: _number(name, value) for name, value in wanted.items()}
        for axis, half_opening_m in moves.items():
            self._devices.mechanics.move_by_hand(axis, half_opening_m)
        return {"moving": True}

    def _state(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "state")
        devices = self._devices
        plays = bool(devices.settings.grasps)
        placed = None if plays else devices.physical.placed
        return {
            "placed": None if placed is None else placed[0],
            "contact_force_n": list(devices.world.contact_force_n()),
            "aperture_m": devices.mechanics.aperture_m,
            "moved_by_hand": devices.mechanics.moved_by_hand,
            "frames_left": devices.recorded.remaining if plays else 0,
            "control_unit": devices.unit.state,
            "axes": {
                moves: {"position": axis.position, "moving": axis.moving}
                for moves, axis in devices.axes.items()
            },
            "faults": {fault.text: fault.began_s for fault in self._injector.faults},
        }

    def _kinds(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "kinds")
        return {
            "kinds": [
                {
                    "name": name,
                    "kind": entry.kind.value,
                    "meaning": entry.meaning,
                    "value": None if entry.value is None else asdict(entry.value),
                    "moment": entry.moment,
                }
                for name, entry in self._injector.kinds().items()
            ]
        }

    def _inject(self, request: dict[str, Any]) -> dict[str, Any]:
        self._injector.inject(_text(request, "inject"))
        return {"inject": request["inject"]}

    def _clear(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"cleared": self._injector.clear(_text(request, "clear"))}


def _is_true(request: dict[str, Any], name: str) -> None:
    if request[name] is not True:
        raise SimulatorSettingsError(f"{name} takes true, got {request[name]!r}")


def _text(request: dict[str, Any], name: str) -> str:
    if not isinstance(request[name], str):
        raise SimulatorSettingsError(f"{name} takes the text of a fault, got {request[name]!r:.40}")
    return str(request[name])


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
