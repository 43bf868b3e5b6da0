"""Metrics of a service in the text format of Prometheus."""

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from cell.service.service import Service

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Format of `metrics_text`."""
_QUANTILES = {"0.5": "p50_s", "0.99": "p99_s", "0.999": "p999_s", "1": "max_s"}
"""Quantiles of the lateness of the force loop, and their names in `Distribution`."""
_COUNTERS = (
    ("frames", "Tactile frames handed out", "tactile", "complete"),
    ("frames_lost", "Tactile frames that were lost", "tactile", "lost"),
    ("force_messages", "Force messages received", "tactile", "force_received"),
    ("force_messages_lost", "Force messages that were lost", "tactile", "force_lost"),
    ("packets_lost", "Answers of servos that did not arrive in time", "servo_bus", "timeouts"),
    ("packets_damaged", "Answers of servos that arrived damaged", "servo_bus", "corrupt"),
    ("packets_repeated", "Requests to servos sent a second time", "servo_bus", "retries"),
    ("loop_late", "Periods that began more than half a period late", "loop", "late"),
    ("loop_overruns", "Periods whose work was not done in time", "loop", "overruns"),
    ("loop_missed_reads", "Periods without an answer of the servos", "loop", "missed_reads"),
)
"""Name, meaning, and group and key in `Cell.health` of each plain counter."""
_DRIVES: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("servo_friction_amperes", "Measured friction of a servo at rest", {"": "breakaway_a"}),
    (
        "servo_amperes_per_newton_metre",
        "Measured growth of a servo's current with a load that rises, or falls",
        {"rising": "rising_a_nm", "falling": "falling_a_nm"},
    ),
)
"""Name and meaning of each measured value of the servos, and its key by direction."""
_Family = tuple[str, str, str, Mapping[str, float]]
"""Name, type and meaning of a metric; its values by what follows the name: nothing, or labels."""


def metrics_text(service: Service) -> str:
    """Return all metrics of a service now."""
    lines = []
    for name, kind, meaning, values in _families(service):
        full = f"tactile_cell_{name}" + ("_total" if kind == "counter" else "")
        lines += [f"# HELP {full} {meaning}", f"# TYPE {full} {kind}"]
        lines += [f"{full}{key} {float(value)!r}" for key, value in values.items()]
    return "\n".join(lines) + "\n"


def _labels(**labels: str) -> str:
    signs = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})
    texts = [f'{name}="{value.translate(signs)}"' for name, value in labels.items()]
    return f"{{{','.join(texts)}}}"


def _families(service: Service) -> Iterator[_Family]:
    plugin, totals = service.plugin, service.totals
    status, counters, health = plugin.status(), plugin.cell.health(), plugin.health()
    servos, drift, loop = health["servos"], health["drift"] or {}, counters["loop"]
    opening_mm = drift.get("opening_mm")
    gauges: tuple[tuple[str, str, float | None], ...] = (
        ("working", "1 while the service works", not service.problem),
        ("state", "State of the cell, a PackTags number", status.state_number),
        ("holding", "1 while a part may be in the grip", status.holding),
        ("fault", "Number of the latched fault; 0 for none", status.fault_number),
        ("recording_lost", "1 while the recording has stopped", bool(status.recording_fault)),
        ("disk_free_bytes", "Space left where recordings are written", _free_bytes(service)),
        ("drift_gain_ratio", "Gain of the pads, as a share of teaching", drift.get("gain")),
        (
            "drift_zero_metres",
            "Drift of the zero of the opening since teaching, positive: reads too large",
            None if opening_mm is None else 1e-3 * opening_mm,
        ),
    )
    for name, meaning, value in gauges:
        if value is not None:
            yield name, "gauge", meaning, {"": value}
    warmth = {_labels(servo=str(n)): value for n, value in enumerate(servos["temperature_c"])}
    yield "servo_temperature_celsius", "gauge", "Temperature of each servo", warmth
    for name, meaning, ways in _DRIVES:
        directed = {
            _labels(**({"direction": way} if way else {}), servo=str(n)): drive[key]
            for n, drive in enumerate(servos.get("drives", ()))
            if drive
            for way, key in ways.items()
        }
        yield name, "gauge", meaning, directed
    late = {_labels(quantile=q): loop["lateness"][key] for q, key in _QUANTILES.items()}
    yield "loop_lateness_seconds", "gauge", "How late periods of the force loop began", late
    parts = sorted(totals.parts.items())
    results = {_labels(label=label, result=result): n for (label, result), n in parts}
    yield "parts", "counter", "Parts by label and result", results
    faults = {_labels(number=number): n for number, n in counters["faults"].items()}
    yield "faults", "counter", "Faults by number", faults
    for name, meaning, group, key in _COUNTERS:
        yield name, "counter", meaning, {"": counters[group][key]}
    yield "cycle_seconds", "summary", "Time of each part", totals.cycles_s
    meaning = "Distance of force and set-point at the end of a grasp"
    yield "force_error_newtons", "summary", meaning, totals.force_errors_n


def _free_bytes(service: Service) -> float | None:
    """Return the free bytes in the folder of the recording; None if the folder is gone."""
    place = service.plugin.recording_path or Path(service.config.recording.directory)
    try:
        there = next(folder for folder in (place, *place.absolute().parents) if folder.exists())
        return shutil.disk_usage(there).free
    except OSError:
        return None
