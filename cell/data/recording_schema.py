"""Schema of recordings: topics of the MCAP file and the JSON schema of each message.

Messages are JSON with a schema of plain types (no unions), which Foxglove and other viewers plot
without a plug-in. An unknown value is omitted, never written as NaN or null. Counts are plain lists
of integers, so that a viewer can plot a single taxel (``/tactile/frame.counts[17]``); equal
neighbours cost almost nothing after compression.

``log_time`` of each message is monotonic time in ns; the metadata record `METADATA` relates it to
the wall clock and describes the pads.
"""

import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import COMMAND_COLUMNS, ZERO_COLUMNS

METADATA: Final = "tactile-cell"
"""Name of the metadata record with format, clocks and pads."""

FRAME: Final = "/tactile/frame"
CYCLE: Final = "/gripper/cycle"
POSE: Final = "/sequence/pose"
EVENT: Final = "/sequence/event"
GRASP: Final = "/sequence/grasp"
STATE: Final = "/cell/state"
LOOP: Final = "/loop/statistics"
RESULT: Final = "/result"
"""The topics: one for each kind of message; their schemas are in `SCHEMAS`."""


def counts_crc32(counts: NDArray[np.uint16]) -> int:
    """Return the CRC-32 over counts as little-endian uint16, frame after frame."""
    return zlib.crc32(np.asarray(counts, dtype="<u2").tobytes())


def metadata_crc32(entries: Mapping[str, str]) -> str:
    """Return the CRC-32 over the metadata other than ``crc32``: MCAP does not protect them."""
    lines = [f"{key}={value}\n" for key, value in sorted(entries.items()) if key != "crc32"]
    return f"{zlib.crc32(''.join(lines).encode()):08x}"


def _number(text: str) -> dict[str, Any]:
    return {"type": "number", "description": text}


def _integer(text: str) -> dict[str, Any]:
    return {"type": "integer", "minimum": 0, "description": text}


def _text(text: str) -> dict[str, Any]:
    return {"type": "string", "description": text}


def _numbers(text: str, item: str = "number") -> dict[str, Any]:
    return {"type": "array", "items": {"type": item}, "description": text}


def _durations(name: str, text: str) -> dict[str, dict[str, Any]]:
    """Return the schema of the four figures of a distribution of durations."""
    shares = {"p50_s": "50 % at most", "p99_s": "99 % at most", "p999_s": "99.9 % at most"}
    return {
        f"{name}_{key}": _number(f"{text}, s: {share}")
        for key, share in (shares | {"max_s": "the longest"}).items()
    }


def _counts(text: str) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": {"type": "integer"}, "description": text}


def _shape(text: str) -> dict[str, Any]:
    """Return an object of kind, thickness and dimensions; a viewer plots its numbers."""
    size = {
        "size_m": _number("thickness along the closing axis, m: the diameter of what is round"),
        "low_m": _number("lower end of the interval that holds it with 90 %, m"),
        "high_m": _number("upper end, m"),
        "n_grasps": _integer("grasps that met it"),
    }
    return {
        "type": "object",
        "description": text,
        "properties": {
            "kind": _text("sphere, oval, cylinder, flat, dumbbell or unclear"),
            "probability": _number("probability of the likeliest kind"),
            **size,
            "thicknesses": {"type": "array", "items": {"type": "object", "properties": size}},
            "dimensions_m": {
                "type": "object",
                "additionalProperties": {"type": "number"},
                "description": "dimensions of the likeliest kind by their names, m",
            },
        },
        "additionalProperties": False,
    }


def _schema(title: str, required: tuple[str, ...], **properties: Any) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


SCHEMAS: Final[Mapping[str, Mapping[str, Any]]] = {
    FRAME: _schema(
        "tactile_cell.Frame",
        ("t_s", "number", "counter", "status", "counts"),
        t_s=_number("monotonic time of the frame, s"),
        number=_integer("number of the frame in this recording, from 0"),
        counter=_integer("counter of the control unit, 16 bit"),
        status=_integer("status byte of the control unit"),
        counts=_numbers("raw counts of all taxels, pad after pad, row-major", "integer"),
        extra=_numbers(
            "further raw samples of each taxel in the same order, such as x and y of a uSkin; left "
            "out where the sensor has none",
            "integer",
        ),
    ),
    CYCLE: _schema(
        "tactile_cell.Cycle",
        ("t_s", "phase"),
        t_s=_number("monotonic time of the servo state, s"),
        phase=_text("phase of the gripper"),
        level=_integer("level of the ramp that is held; left out while the force changes"),
        setpoint_n=_number("set-point of the grip force, N; 0 while no force is controlled"),
        goal_current_a=_number("mean magnitude of the goal currents, A"),
        aperture_m=_number("opening between the fingers, m"),
        aperture_velocity_m_s=_number("its rate, m/s; negative while closing"),
        current_a=_number("mean magnitude of the servo currents, A"),
        force_from_current_n=_number("grip force estimated from the currents, N"),
        temperature_c=_number("warmest servo, degrees Celsius"),
        voltage_v=_number("lowest supply of the servos, V"),
        force_t_s=_number("monotonic time of the tactile force, s"),
        force_n=_numbers("tactile force on finger 0 and on finger 1, N"),
        force_valid={"type": "boolean", "description": "false: not to be used for control"},
        servos={
            "type": "array",
            "items": {"type": "object"},
            "description": "state of each servo; units are in the names",
        },
    ),
    POSE: _schema(
        "tactile_cell.Pose",
        ("t_s",),
        t_s=_number("monotonic time at which the pose was reached, s"),
        x_m=_number("along the finger, m"),
        y_m=_number("across the finger, m"),
        rotation_rad=_number("about the closing axis, rad"),
        roll_rad=_number("about the object's long axis, rad"),
    ),
    EVENT: _schema(
        "tactile_cell.Event",
        ("t_s", "kind", "text"),
        t_s=_number("monotonic time, s"),
        kind=_text("kind of the event"),
        text=_text("what happened, for people"),
        fault_number=_integer("number in the fault catalogue; left out where there is no fault"),
    ),
    STATE: _schema(
        "tactile_cell.State",
        ("t_s", "state", "state_number", "grasp", "grasp_number", "wall_ns"),
        t_s=_number("monotonic time at which one of the two states changed, s"),
        state=_text("state of the cell (PackML)"),
        state_number=_integer("its number in PackTags (OPC 30050)"),
        grasp=_text("state of the grip"),
        grasp_number=_integer("its number, 0 to 7"),
        wall_ns={"type": "integer", "description": "wall clock, ns since 1970; for people only"},
    ),
    LOOP: _schema(
        "tactile_cell.LoopStatistics",
        ("t_s", "cycles", "overruns", "late", "missed_reads", "undelivered"),
        t_s=_number("monotonic time; all counts are since the loop was made, s"),
        cycles=_integer("periods of the force loop"),
        overruns=_integer("periods whose work was not done when the next one was due"),
        late=_integer("periods that began more than half a period late"),
        missed_reads=_integer("periods without feedback"),
        undelivered=_integer("periods that did not reach the recording"),
        worst_lateness_s=_number("largest lateness, s"),
        **_durations("lateness", "how late periods began"),
        **_durations("transaction", "time to read the servos"),
        **_durations("sensor_age", "age of the force when it was used"),
        tactile=_counts("frames, messages and requests of the tactile sensor since its last start"),
        servo_bus=_counts("transactions and wrong answers of the servo bus since it was opened"),
    ),
    GRASP: _schema(
        "tactile_cell.Grasp",
        (
            "t_s",
            "label",
            "shape",
            "source",
            "start_ms",
            "first_frame",
            "n_frames",
            "frame_t_s",
            "counts_crc32",
        ),
        t_s=_number("monotonic time of the grasp's first frame, s"),
        label=_text("what was grasped; empty where unknown"),
        shape=_text("class of shape; empty where unknown"),
        source=_text("where it came from"),
        start_ms={"type": "integer", "description": "wall clock of the first frame, ms"},
        first_frame=_integer("number of the first frame"),
        n_frames=_integer("frames of the grasp, consecutive numbers"),
        frame_t_s=_numbers("time of each frame since the first, s"),
        aperture_m=_numbers("opening at each frame, m; left out unless known for each"),
        force_n=_numbers("commanded grip force at each frame, N; left out unless known for each"),
        asked=_numbers("pose and force asked for: " + ", ".join(COMMAND_COLUMNS)),
        self_zero=_numbers("what the empty fingers showed before: " + ", ".join(ZERO_COLUMNS)),
        counts_crc32=_integer("CRC-32 over the counts of all frames as uint16, little endian"),
    ),
    RESULT: _schema(
        "tactile_cell.Result",
        ("t_s", "label", "probability", "labels", "probabilities", "unknown", "n_grasps"),
        t_s=_number("monotonic time of the decision, s"),
        label=_text("the answer: a taught label, or UNKNOWN"),
        probability=_number("probability of the answer"),
        labels=_numbers("the taught labels", "string"),
        probabilities=_numbers("probability of each taught label"),
        unknown=_number("probability that the object was never taught"),
        n_grasps=_integer("grasps that led to the decision"),
        n_ended_early=_integer("those of them whose ramp ended early, because it sufficed"),
        held=_text("what the positioner has brought; left out where nobody has named it"),
        grasp_answers={
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "probabilities": _numbers("probability of each taught label"),
                    "unknown": _number("probability that the object was never taught"),
                    "dependence": _number("how far further grasps repeat this one, 0 to 1"),
                },
                "additionalProperties": False,
            },
            "description": "answer to each grasp by itself, in order",
        },
        shape=_shape("shape and size after all grasps; left out where no grasp has one"),
        grasp_shapes={
            "type": "array",
            "items": _shape("shape and size by one grasp; empty where it has none"),
            "description": "of each grasp of the sequence, in order",
        },
        drift_gain=_number("gain of the pads since teaching that the answer rests on"),
        drift_aperture_m=_number("offset of the opening since teaching that it rests on, m"),
        drift_unchanged=_number("probability that nothing has drifted"),
        drift_n_grasps=_integer("grasps of the shift, named by nobody, that show it"),
    ),
}
"""JSON schema of the messages of each topic."""
