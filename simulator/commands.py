"""What other processes may ask of a simulated cell: objects, recorded grasps, fault knobs."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from simulator.assembly import CellDevices
from simulator.errors import SimulatorSettingsError, SimulatorStateError
from simulator.servo_faults import ServoFaultKnobs
from simulator.shapes import ObjectPose

_POSE_FIELDS = tuple(entry.name for entry in fields(ObjectPose))
_LARGEST = 1e5
_LONGEST_S = 60.0
_FARTHEST = 100.0
Plugs = Mapping[str, tuple[Callable[[], None], Callable[[], None]]]
"""Name of a cable -> how to pull it, how to plug it in again."""


class CellCommands:
    """Carries out requests, given as JSON objects.

    Requests and their replies:

    - ``{"place": label, "pose": {"x_m": ..}}``: ``{"pose": {..}}``, where it came to rest
    - ``{"remove": true}``: ``{"removed": true}``
    - ``{"play": index}``: ``{"frames": n}`` of that recorded grasp
    - ``{"state": true}``: what is placed, forces, opening, frames left, faults
    - ``{"inject": "can.loss=0.05@2s"}``: the same back; see `simulator.faults`
    - ``{"clear": "can.loss"}``: ``{"cleared": n}``; by the whole text or by the name
    - ``{"fault": "can.drop_rate", "value": 0.01}``: the same back
    - ``{"servo": id, "do": "overload" | .., "value": ..}``: ``{"servo": id}``
    - ``{"emergency": code}``: the same back
    - ``{"power_cycle": true}``: the same back; the control unit boots anew
    - ``{"unplug": "servos" | "can"}``, ``{"plug_in": ..}``: the same back

    Parameters
    ----------
    devices
        The cell.
    plugs
        Its cables.
    now
        Returns the time of the cell in s.
    """

    def __init__(self, devices: CellDevices, plugs: Plugs, now: Callable[[], float]) -> None:
        self._devices = devices
        self._plugs = plugs
        self._now = now
        self._commands: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "place": self._place,
            "remove": self._remove,
            "play": self._play,
            "state": self._state,
            "inject": self._inject,
            "clear": self._clear,
            "fault": self._fault,
            "servo": self._servo,
            "emergency": self._emergency,
            "power_cycle": self._power_cycle,
            "unplug": lambda request: self._plug(request, "unplug", 0),
            "plug_in": lambda request: self._plug(request, "plug_in", 1),
        }

    def __call__(self, request: dict[str, Any]) -> dict[str, Any]:
        """Carry out one request.

        Raises
        ------
        SimulatorSettingsError, SimulatorStateError
            If it cannot be carried out; nothing has changed then.
        """
        named = [name for name in self._commands if name in request]
        if len(named) != 1:
            raise SimulatorSettingsError(
                f"a request names one of {', '.join(self._commands)}; got {', '.join(request)}"
            )
        return self._commands[named[0]](request)

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
        reached = self._devices.physical.place(label, pose)
        return {"pose": {name: getattr(reached, name) for name in _POSE_FIELDS}}

    def _remove(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "remove")
        self._devices.physical.remove()
        return {"removed": True}

    def _play(self, request: dict[str, Any]) -> dict[str, Any]:
        index = request["play"]
        if type(index) is not int:
            raise SimulatorSettingsError(f"play takes the number of a grasp, got {index!r}")
        return {"frames": self._devices.play(index)}

    def _state(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "state")
        devices = self._devices
        plays = bool(devices.settings.grasps)
        placed = None if plays else devices.physical.placed
        return {
            "placed": None if placed is None else placed[0],
            "contact_force_n": list(devices.world.contact_force_n()),
            "aperture_m": devices.mechanics.aperture_m,
            "frames_left": devices.recorded.remaining if plays else 0,
            "control_unit": devices.unit.state,
            "faults": {fault.text: fault.began_s for fault in devices.injector.faults},
        }

    def _inject(self, request: dict[str, Any]) -> dict[str, Any]:
        self._devices.inject(_text(request, "inject"))
        return {"inject": request["inject"]}

    def _clear(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"cleared": self._devices.injector.clear(_text(request, "clear"))}

    def _fault(self, request: dict[str, Any]) -> dict[str, Any]:
        path = request["fault"]
        if not isinstance(path, str) or "value" not in request:
            raise SimulatorSettingsError("fault takes the name of a knob, and a value beside it")
        owner: Any = self._devices.faults
        *way, last = path.split(".")
        for name in way:
            owner = getattr(owner, name) if name in _knobs(owner) else None
        if last not in _knobs(owner):
            raise SimulatorSettingsError(f"there is no fault {path!r}")
        value = _like(path, getattr(owner, last), request["value"])
        if isinstance(value, dict | set):
            self._check_taxels(path, value)
        setattr(owner, last, value)
        return {"fault": path, "value": request["value"]}

    def _check_taxels(self, path: str, taxels: dict[int, int] | set[int]) -> None:
        layout = self._devices.settings.layout
        counts = taxels.values() if isinstance(taxels, dict) else ()
        if not all(0 <= taxel < layout.n_taxels for taxel in taxels) or not all(
            0 <= value <= layout.adc_max for value in counts
        ):
            raise SimulatorSettingsError(
                f"fault {path}: taxels are 0 to {layout.n_taxels - 1}, counts 0 to {layout.adc_max}"
            )

    def _servo(self, request: dict[str, Any]) -> dict[str, Any]:
        servo_id, servos = request["servo"], self._devices.faults.servos
        if type(servo_id) is not int or servo_id not in servos:
            raise SimulatorSettingsError(f"servo {servo_id!r} is none of {list(servos)}")
        self._turn(servos[servo_id], str(request.get("do")), request.get("value"))
        return {"servo": servo_id}

    def _turn(self, knobs: ServoFaultKnobs, action: str, value: Any) -> None:
        simple: dict[str, Callable[[], None]] = {
            "overload": knobs.overload,
            "stick_encoder": knobs.stick_encoder,
            "clear": knobs.clear,
            "reboot": lambda: knobs.reboot(self._now()),
        }
        if action in simple:
            simple[action]()
        elif action == "overheat":
            knobs.overheat(_number("overheat", value))
        elif action == "supply":
            knobs.supply(_number("supply", value))
        elif action == "hardware_error" and type(value) is int:
            knobs.hardware_error(value)
        else:
            raise SimulatorSettingsError(
                f"do is one of {', '.join(simple)}, overheat, supply, hardware_error with a "
                f"value; got {action!r} with {value!r}"
            )

    def _emergency(self, request: dict[str, Any]) -> dict[str, Any]:
        code = request["emergency"]
        if type(code) is not int or not 0 <= code <= 0xFFFF:
            raise SimulatorSettingsError(f"emergency takes a code of 16 bits, got {code!r}")
        self._devices.unit.emergency(code)
        return {"emergency": code}

    def _power_cycle(self, request: dict[str, Any]) -> dict[str, Any]:
        _is_true(request, "power_cycle")
        self._devices.unit.power_cycle()
        return {"power_cycle": True}

    def _plug(self, request: dict[str, Any], name: str, which: int) -> dict[str, Any]:
        cable = str(request[name])
        if cable not in self._plugs:
            raise SimulatorStateError(
                f"{name} takes one of {', '.join(self._plugs) or 'no cable'}, got {cable!r}"
            )
        self._plugs[cable][which]()
        return {name: cable}


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


def _knobs(owner: Any) -> set[str]:
    """Return the names of a holder of knobs; single servos and cables have own requests."""
    if not is_dataclass(owner):
        return set()
    return {entry.name for entry in fields(owner)} - {"servos", "unplugged"}


def _like(path: str, present: Any, value: Any) -> Any:
    """Return a JSON value as the type that the knob has and in its range, or refuse it."""
    if isinstance(present, bool) and isinstance(value, bool):
        return value
    if type(present) is int and type(value) is int:
        return _in_range(path, value)
    if isinstance(present, float):
        return _in_range(path, _number(path, value))
    if isinstance(present, set) and isinstance(value, list):
        return {int(_number(path, item)) for item in value}
    if isinstance(present, dict) and isinstance(value, dict) and all(map(str.isdecimal, value)):
        return {int(key): int(_number(path, item)) for key, item in value.items()}
    raise SimulatorSettingsError(
        f"fault {path} is {value!r}, must be a {type(present).__name__} as {present!r}"
    )


def _in_range(path: str, value: float) -> float:
    low, high = 0.0, _LARGEST
    if path.endswith(("_rate", ".probability")):
        high = 1.0
    elif path.endswith("_s"):
        high = _LONGEST_S
    elif path == "unit.offset_counts":
        low = -_LARGEST
    if not low <= value <= high:
        raise SimulatorSettingsError(f"fault {path} is {value}, must be {low:g} to {high:g}")
    return value
