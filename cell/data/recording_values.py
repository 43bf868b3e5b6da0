"""The messages of a recording: values of the cell as plain JSON values, without NaN."""

import json
import math
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from cell.data.formats import RECORDING
from cell.data.recording_schema import (
    METADATA,
    MODELS,
    counts_crc32,
    json_schema,
    metadata_crc32,
)

if TYPE_CHECKING:
    from mcap.writer import Writer

    from gripper.values.state import Cycle
    from recognition.drift.grid import DriftGrid
    from recognition.grasp import Grasp, PadArray
    from recognition.shape.answer import ShapeAnswer

CHUNK_BYTES = 64 << 10
"""Size of a chunk in bytes before compression: the largest loss of a killed program."""
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False, ensure_ascii=False)


def to_json(value: Any) -> str:
    """Return compact JSON. Raises ValueError for NaN and infinity."""
    return _ENCODER.encode(value)


def to_ns(t_s: float) -> int:
    """Return a monotonic time in ns. Raises ValueError if it is negative or not finite."""
    if not (math.isfinite(t_s) and t_s >= 0):
        raise ValueError(f"{t_s} s is not a monotonic time; it must be finite and not negative")
    return round(t_s * 1e9)


def known(**values: float | None) -> dict[str, float]:
    """Return the known values, to 1e-7 of their unit; None and NaN are omitted."""
    return {
        name: round(float(value), 7)
        for name, value in values.items()
        if value is not None and math.isfinite(value)
    }


def cycle_values(cycle: "Cycle") -> dict[str, Any]:
    """Return one period of the force loop as plain values; fields as in `recording_schema`."""
    state = cycle.state
    values: dict[str, Any] = {"phase": cycle.phase.name}
    if cycle.level is not None:
        values["level"] = cycle.level
    values |= known(
        setpoint_n=cycle.setpoint_n,
        goal_current_a=cycle.goal_current_a,
        aperture_m=state.aperture_m,
        aperture_velocity_m_s=state.aperture_velocity_m_s,
        current_a=state.current_a,
        force_from_current_n=state.force_from_current_n,
        temperature_c=state.temperature_c,
        voltage_v=state.voltage_v,
    )
    if cycle.force is not None:
        values["force_t_s"] = round(cycle.force.t_s, 9)
        values["force_valid"] = cycle.force.valid
        if all(map(math.isfinite, cycle.force.force_n)):
            values["force_n"] = [round(float(f), 7) for f in cycle.force.force_n]
    values["servos"] = [plain_fields(servo) for servo in state.servos]
    return values


def grasp_values(grasp: "Grasp", *, first_frame: int) -> dict[str, Any]:
    """Return the recorded values of a grasp without its frames; ``first_frame`` is their start."""
    values: dict[str, Any] = {
        "label": grasp.label,
        "shape": grasp.shape,
        "source": grasp.source,
        "start_ms": grasp.start_ms,
        "first_frame": first_frame,
        "n_frames": grasp.n_frames,
        "frame_t_s": grasp.t_s.round(9).tolist(),
        "counts_crc32": counts_crc32(grasp.counts),
    }
    for name in ("aperture_m", "force_n"):
        array = getattr(grasp, name)
        if np.all(np.isfinite(array)):
            values[name] = array.round(9).tolist()
    if grasp.command is not None:
        values["asked"] = [round(value, 9) for value in grasp.command.values]
    if grasp.zero is not None:
        values["self_zero"] = [round(value, 9) for value in grasp.zero.values]
    return values


def shape_values(shape: "ShapeAnswer | None") -> dict[str, Any]:
    """Return the recorded values of shape and size; empty without a shape."""
    if shape is None:
        return {}
    return {
        "kind": shape.kind,
        "probability": round(shape.probability[shape.likeliest], 7),
        **known(size_m=shape.size_m, low_m=shape.low_m, high_m=shape.high_m),
        "n_grasps": shape.n_grasps,
        "thicknesses": [plain_fields(thickness) for thickness in shape.thicknesses],
        "dimensions_m": known(**shape.dimensions_m),
    }


def estimate_values(drift: "DriftGrid") -> dict[str, float]:
    """Return the sensor drift that an answer assumes."""
    return {
        "drift_gain": drift.drift.gain,
        "drift_aperture_m": drift.drift.aperture_offset_m,
        "drift_unchanged": drift.unchanged,
        "drift_n_grasps": drift.n_followed,
    }


def metadata_values(pads: "PadArray", wall_ns: int, monotonic_ns: int) -> dict[str, str]:
    """Return the metadata of a recording: its format, its start by both clocks, its pads."""
    described = {
        "pad_shape": pads.pad_shape.tolist(),
        "taxel_pad": pads.taxel_pad.tolist(),
        "taxel_xy_m": pads.taxel_xy_m.round(9).tolist(),
        "adc_max": pads.adc_max,
    }
    return {
        "format": str(RECORDING),
        "wall_clock_start_ns": str(wall_ns),
        "monotonic_start_ns": str(monotonic_ns),
        "pads": to_json(described),
    }


def start_recording(writer: "Writer", entries: Mapping[str, str]) -> dict[str, int]:
    """Write the start of a recording; return the channel of each topic."""
    writer.start(profile="", library="tactile-cell")
    writer.add_metadata(METADATA, {**entries, "crc32": metadata_crc32(entries)})
    channels = {}
    for topic in MODELS:
        content = json_schema(topic)
        number = writer.register_schema(content["title"], "jsonschema", to_json(content).encode())
        channels[topic] = writer.register_channel(topic, "json", number)
    return channels


def plain_fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass of numbers and texts, without unknown ones."""
    plain = {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return {name: item for name, item in plain.items() if item is not None}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(float(value), 7) if math.isfinite(value) else None
    return value
