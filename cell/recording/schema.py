"""Records of a recording: topics of the MCAP file, a model for each, and its encoding.

A model gives the schema in the file and the check of each message that is read.

Messages are JSON with a schema of plain types (no unions, no references), which Foxglove and other
viewers plot without a plug-in. An unknown value is omitted, never written as NaN or null. Counts
are plain lists of integers, so that a viewer can plot a single taxel
(``/tactile/frame.counts[17]``); equal neighbours cost almost nothing after compression.

``log_time`` of each message is monotonic time in ns; the metadata record `METADATA` relates it to
the wall clock and describes the pads.
"""

import functools
import math
import zlib
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Final, NotRequired

import numpy as np
import pydantic_core
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationInfo, with_config
from typing_extensions import TypedDict

from cell.files import check_text
from cell.recording.grasp_limits import RANGES
from recognition.grasp import COMMAND_COLUMNS, ZERO_COLUMNS

if TYPE_CHECKING:
    from recognition.drift.drift import DriftGrid
    from recognition.shape.answer import ShapeAnswer

METADATA: Final = "tactile-cell"
"""Name of the metadata record with format, clocks and pads."""
RECOVERED: Final = "recovered"
"""Entry of that record in a recovered recording: what the damaged one has lost."""

FRAME: Final = "/tactile/frame"
CYCLE: Final = "/gripper/cycle"
POSE: Final = "/sequence/pose"
EVENT: Final = "/sequence/event"
GRASP: Final = "/sequence/grasp"
STATE: Final = "/cell/state"
LOOP: Final = "/loop/statistics"
RESULT: Final = "/result"
"""The topics: one for each kind of message; their models are in `MODELS`."""

Time = Annotated[float, Field(ge=0.0, le=1e9)]
"""Monotonic time in s, up to that of a machine that has run for 30 years."""
Number = Annotated[float, Field(ge=-1e15, le=1e15)]
"""A number; a factor of 1000 overflows no float."""
Natural = Annotated[int, Field(ge=0, le=1 << 53)]
"""A count or number from 0; a float has it exactly."""
Integer = Annotated[int, Field(ge=-(1 << 63), le=(1 << 63) - 1)]
"""A number of 64 bits."""
Sample = Annotated[int, Field(ge=0, le=0xFFFF)]
"""A raw count of a taxel."""
Durations = dict[str, Number]
"""Quantiles of durations as `gripper.force.timing.Distribution` has them."""


def _within(name: str) -> Any:
    low, high, _ = RANGES[name]
    return Field(ge=low, le=high)


def _text(text: str, info: ValidationInfo) -> str:
    check_text(info.field_name or "text", text)
    return text


Text = Annotated[str, AfterValidator(_text)]
"""A text of a grasp."""
_COMMAND = "commanded pose and force: " + ", ".join(COMMAND_COLUMNS)
_ZERO = "self-zero of the empty fingers before: " + ", ".join(ZERO_COLUMNS)


@with_config(ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False))
class _Record(TypedDict):
    """Base of the records: no unknown field, finite numbers."""


class Frame(_Record):
    """A tactile frame."""

    t_s: Time
    """monotonic time of the frame, s"""
    number: Natural
    """number of the frame in this recording, from 0"""
    counter: Natural
    """counter of the control unit, 16 bit"""
    status: Natural
    """status byte of the control unit"""
    counts: list[Sample]
    """raw counts of all taxels, pad after pad, row-major"""
    extra: NotRequired[list[Sample]]
    """further raw samples of each taxel, such as x and y of a uSkin; left out without any"""


class Cycle(_Record):
    """A period of the force loop."""

    t_s: Time
    """monotonic time of the servo state, s"""
    phase: str
    """phase of the gripper"""
    setpoint_n: NotRequired[Number]
    """set-point of the grip force, N; 0 while no force is controlled"""
    goal_current_a: NotRequired[Number]
    """mean magnitude of the goal currents, A"""
    aperture_m: NotRequired[Number]
    """opening between the fingers, m"""
    aperture_velocity_m_s: NotRequired[Number]
    """its rate, m/s; negative while closing"""
    current_a: NotRequired[Number]
    """mean magnitude of the servo currents, A"""
    force_from_current_n: NotRequired[Number]
    """grip force estimated from the currents, N"""
    temperature_c: NotRequired[Number]
    """warmest servo, degrees Celsius"""
    voltage_v: NotRequired[Number]
    """lowest supply of the servos, V"""
    force_t_s: NotRequired[Time]
    """monotonic time of the tactile force, s"""
    force_n: NotRequired[list[Number]]
    """tactile force on finger 0 and on finger 1, N"""
    force_valid: NotRequired[bool]
    """false: not to be used for control"""
    servos: NotRequired[list[dict[str, Any]]]
    """state of each servo; units are in the names"""


class Pose(_Record):
    """A pose of the positioner."""

    t_s: Time
    """monotonic time at which the pose was reached, s"""
    x_m: NotRequired[Number]
    """along the finger, m"""
    y_m: NotRequired[Number]
    """across the finger, m"""
    rotation_rad: NotRequired[Number]
    """about the closing axis, rad"""
    roll_rad: NotRequired[Number]
    """about the object's long axis, rad"""


class Event(_Record):
    """An event, for people."""

    t_s: Time
    """monotonic time, s"""
    kind: str
    """kind of the event"""
    text: str
    """what happened, for people"""
    fault_number: NotRequired[Natural]
    """number in the fault catalogue; left out where there is no fault"""


class State(_Record):
    """A change of the state of cell or grip."""

    t_s: Time
    """monotonic time at which one of the two states changed, s"""
    state: str
    """state of the cell (PackML)"""
    state_number: Natural
    """its number in PackTags (OPC 30050)"""
    grasp: str
    """state of the grip"""
    grasp_number: Natural
    """its number, 0 to 7"""
    wall_ns: Integer
    """wall clock, ns since 1970; for people only"""


class LoopStatistics(_Record):
    """Counts and times of the force loop and both links."""

    t_s: Time
    """monotonic time; all counts are since the loop was made, s"""
    cycles: Natural
    """periods of the force loop"""
    overruns: Natural
    """periods whose work was not done when the next one was due"""
    late: Natural
    """periods that began more than half a period late"""
    missed_reads: Natural
    """periods without feedback"""
    undelivered: Natural
    """periods that did not reach the recording"""
    derated: Natural
    """periods in which the heat of a winding lowered the cap of the current"""
    lateness: Durations
    """how late periods began, s: number, largest of 50, 99 and 99.9 %, the longest"""
    transaction: Durations
    """time to read the servos, s: the same"""
    sensor_age: Durations
    """age of the force when it was used, s: the same"""
    tactile: NotRequired[dict[str, Integer]]
    """frames, messages and requests of the tactile sensor since its last start"""
    servo_bus: NotRequired[dict[str, Integer]]
    """transactions and wrong answers of the servo bus since it was opened"""


class Grasp(_Record):
    """A grasp: which frames are its frames, and what is known of it."""

    t_s: Time
    """monotonic time at which its frames were recorded, s"""
    label: Text
    """what was grasped; empty where unknown"""
    shape: Text
    """class of shape; empty where unknown"""
    source: Text
    """where it came from"""
    start_ms: Annotated[int, _within("start_ms")]
    """wall clock of the first frame, ms"""
    first_frame: Natural
    """number of the first frame"""
    n_frames: Natural
    """frames of the grasp, consecutive numbers"""
    aperture_m: NotRequired[list[Annotated[float, _within("aperture_m")]]]
    """opening at each frame, m; left out unless known for each"""
    force_n: NotRequired[list[Annotated[float, _within("force_n")]]]
    """commanded grip force at each frame, N; left out unless known for each"""
    command: NotRequired[Annotated[list[Number], Field(description=_COMMAND)]]
    zero: NotRequired[Annotated[list[Number], Field(description=_ZERO)]]


class Thickness(_Record, total=False):
    """A thickness along the closing axis."""

    size_m: Number
    """thickness along the closing axis, m: the diameter of what is round"""
    low_m: Number
    """lower end of the interval that holds it with 90 %, m"""
    high_m: Number
    """upper end, m"""
    n_grasps: Natural
    """grasps that met it"""


class Shape(Thickness, total=False):
    """Shape and size of a part; a viewer plots its numbers."""

    kind: str
    """sphere, oval, cylinder, flat, dumbbell or unclear"""
    probability: Number
    """probability of the likeliest kind"""
    thicknesses: list[Thickness]
    """every thickness that was met"""
    dimensions_m: dict[str, Number]
    """dimensions of the likeliest kind by their names, m"""


class GraspAnswer(_Record, total=False):
    """The answer to one grasp."""

    probabilities: list[Number]
    """probability of each taught label"""
    unknown: Number
    """probability that the object was never taught"""
    dependence: Number
    """how far further grasps repeat this one, 0 to 1"""


class Result(_Record):
    """The answer of an identification."""

    t_s: Time
    """monotonic time of the decision, s"""
    label: str
    """the answer: a taught label, or UNKNOWN"""
    probability: Number
    """probability of the answer"""
    labels: list[str]
    """the taught labels"""
    probabilities: list[Number]
    """probability of each taught label"""
    unknown: Number
    """probability that the object was never taught"""
    n_grasps: Natural
    """grasps that led to the decision"""
    n_ended_early: NotRequired[Natural]
    """those of them whose ramp ended early, because it sufficed"""
    held: NotRequired[str]
    """what the positioner has brought; left out where nobody has named it"""
    grasp_answers: NotRequired[list[GraspAnswer]]
    """answer to each grasp by itself, in order"""
    shape: NotRequired[Shape]
    """shape and size after all grasps; left out where no grasp has one"""
    grasp_shapes: NotRequired[list[Shape]]
    """shape and size by each grasp of the sequence, in order; empty where it has none"""
    drift_gain: NotRequired[Number]
    """gain of the pads since teaching that the answer rests on"""
    drift_aperture_m: NotRequired[Number]
    """offset of the opening since teaching that it rests on, m"""
    drift_unchanged: NotRequired[Number]
    """probability that nothing has drifted"""
    drift_n_grasps: NotRequired[Natural]
    """grasps of the shift, named by nobody, that show it"""


MODELS: Final[Mapping[str, TypeAdapter[Any]]] = {
    FRAME: TypeAdapter(Frame),
    CYCLE: TypeAdapter(Cycle),
    POSE: TypeAdapter(Pose),
    EVENT: TypeAdapter(Event),
    STATE: TypeAdapter(State),
    LOOP: TypeAdapter(LoopStatistics),
    GRASP: TypeAdapter(Grasp),
    RESULT: TypeAdapter(Result),
}
"""Model of the messages of each topic."""


def json_schema(topic: str) -> dict[str, Any]:
    """Return the JSON schema of the messages of a topic, without references."""
    schema = MODELS[topic].json_schema()
    parts = schema.pop("$defs", {})

    def inlined(value: Any) -> Any:
        if isinstance(value, list):
            return [inlined(item) for item in value]
        if not isinstance(value, dict):
            return value
        part = parts.get(value.get("$ref", "").rpartition("/")[2], {})
        left_out = ("$ref", "title")
        return {key: inlined(item) for key, item in (part | value).items() if key not in left_out}

    return {**inlined(schema), "title": f"tactile_cell.{schema['title']}"}


def to_json(value: Any) -> bytes:
    """Return compact JSON, numbers to 1e-9 of their unit.

    A value that is None, NaN or infinite is left out, as is an array with one.
    """
    return pydantic_core.to_json(_plain(value))


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(float(value), 9) if math.isfinite(value) else None
    if value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype.kind in "iu" else _plain(value.tolist())
    if isinstance(value, list | tuple):
        plain = [_plain(item) for item in value]
        return None if None in plain else plain
    if not isinstance(value, Mapping):
        value = {name: getattr(value, name) for name in _names(value.__class__)}
    return {name: plain for name in value if (plain := _plain(value[name])) is not None}


@functools.cache
def _names(dataclass: Any) -> list[str]:
    return [field.name for field in fields(dataclass)]


def to_ns(t_s: float) -> int:
    """Return a monotonic time in ns. Raises ValueError if it is negative or not finite."""
    if not (math.isfinite(t_s) and t_s >= 0):
        raise ValueError(f"{t_s} s is not a monotonic time; it must be finite and not negative")
    return round(t_s * 1e9)


def shape_values(shape: "ShapeAnswer | None") -> dict[str, Any]:
    """Return the recorded values of shape and size; empty without a shape."""
    if shape is None:
        return {}
    names = ("kind", "size_m", "low_m", "high_m", "n_grasps", "thicknesses", "dimensions_m")
    probability = shape.probability[shape.likeliest]
    return {name: getattr(shape, name) for name in names} | {"probability": probability}


def estimate_values(drift: "DriftGrid") -> dict[str, float]:
    """Return the sensor drift that an answer assumes."""
    return {
        "drift_gain": drift.drift.gain,
        "drift_aperture_m": drift.drift.aperture_offset_m,
        "drift_unchanged": drift.unchanged,
        "drift_n_grasps": drift.n_followed,
    }


def metadata_crc32(entries: Mapping[str, str]) -> str:
    """Return the CRC-32 over the metadata other than ``crc32``: MCAP does not protect them."""
    lines = [f"{key}={value}\n" for key, value in sorted(entries.items()) if key != "crc32"]
    return f"{zlib.crc32(''.join(lines).encode()):08x}"
