"""Metrics of a service in the text format of Prometheus. Needs the extra ``metrics``."""

import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from cell.service.service import Service
from cell.service.shift import Distribution

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Format of `metrics_text`."""
_QUANTILES = {"0.5": "p50_s", "0.99": "p99_s", "0.999": "p999_s", "1": "max_s"}
"""Quantiles of durations of the force loop, and their names in `loop_values`."""
_COUNTERS = (
    ("frames", "Tactile frames handed out", "tactile", "complete"),
    ("frames_lost", "Tactile frames that were lost", "tactile", "lost"),
    ("frames_damaged", "Tactile frames or messages with a wrong checksum", "tactile", "corrupt"),
    ("frames_torn", "Tactile frames dropped because messages were missing", "tactile", "torn"),
    ("force_messages", "Force messages received", "tactile", "force_received"),
    ("force_messages_lost", "Force messages that were lost", "tactile", "force_lost"),
    ("can_errors", "Errors that the CAN controller reported", "tactile", "error_frames"),
    ("packets", "Transactions on the servo bus", "servo_bus", "transactions"),
    ("packets_lost", "Answers of servos that did not arrive in time", "servo_bus", "timeouts"),
    ("packets_damaged", "Answers of servos that arrived damaged", "servo_bus", "corrupt"),
    ("packets_repeated", "Requests to servos sent a second time", "servo_bus", "retries"),
    ("loop_periods", "Periods of the force loop", "loop", "cycles"),
    ("loop_late", "Periods that began more than half a period late", "loop", "late"),
    ("loop_overruns", "Periods whose work was not done in time", "loop", "overruns"),
    ("loop_missed_reads", "Periods without an answer of the servos", "loop", "missed_reads"),
)
"""Name, meaning, and group and key in `TactileCellPlugin.counters` of each plain counter."""
_DRIVES: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("servo_friction_amperes", "Measured friction of a servo at rest", {"": "breakaway_a"}),
    (
        "servo_amperes_per_newton_metre",
        "Measured growth of a servo's current with a load that rises, or falls",
        {"rising": "rising_a_nm", "falling": "falling_a_nm"},
    ),
    (
        "servo_motor_constant_newton_metres_per_ampere",
        "Torque of a servo for its current, by catalogue and back-EMF",
        {"": "kt_nm_a"},
    ),
    ("servo_measured_seconds", "Unix time of a servo's measurement", {"": "measured_s"}),
)
"""Name and meaning of each measured value of the servos, and its key by direction."""
Value = tuple[tuple[str, ...], float]
"""Values of the labels, and the number."""


def metrics_text(service: Service) -> bytes:
    """Return all metrics of a service now."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Cell(service))
    return generate_latest(registry)


class _Cell(Collector):
    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        yield from _state(self._service)
        yield from _parts(self._service)
        yield from _links(self._service.plugin.cell.health())
        yield from _health(self._service.plugin.health())
        if (free := _free_bytes(self._service)) is not None:
            yield _gauge("disk_free_bytes", "Space left where recordings are written", free)


def _gauge(name: str, meaning: str, value: float) -> Metric:
    return GaugeMetricFamily(f"tactile_cell_{name}", meaning, value=value)


def _labelled(
    kind: Callable[..., Any], name: str, meaning: str, labels: list[str], values: Iterator[Value]
) -> Metric:
    family: Metric = kind(f"tactile_cell_{name}", meaning, labels=labels)
    for names, value in values:
        family.add_metric(names, value)  # type: ignore[attr-defined]
    return family


def _histogram(name: str, meaning: str, found: Distribution) -> Metric:
    buckets = [
        ("+Inf" if edge == float("inf") else str(edge), count) for edge, count in found.cumulated()
    ]
    return HistogramMetricFamily(
        f"tactile_cell_{name}", meaning, buckets=buckets, sum_value=found.sum
    )


def _state(service: Service) -> Iterator[Metric]:
    status = service.plugin.status()
    info = {"version": service.version, "cell": service.config.name}
    yield _labelled(
        GaugeMetricFamily, "info", "Version and name of the cell", list(info),
        iter([(tuple(info.values()), 1.0)]),
    )  # fmt: skip
    yield _gauge("working", "1 while the service works", not service.problem)
    yield _gauge("state", "State of the cell, a PackTags number", status.state_number)
    yield _gauge("holding", "1 while a part may be in the grip", status.holding)
    yield _gauge("fault", "Number of the latched fault; 0 for none", status.fault_number)
    lost = bool(status.recording_fault)
    yield _gauge("recording_lost", "1 while the recording has stopped", lost)
    if (force_n := status.live.force_n) is not None:
        yield _gauge("force_newtons", "Grip force", force_n)


def _parts(service: Service) -> Iterator[Metric]:
    totals = service.totals
    parts = sorted(totals.parts.items())
    yield _labelled(
        CounterMetricFamily, "parts", "Parts by label and result", ["label", "result"], iter(parts)
    )
    yield _histogram("cycle_seconds", "Time of each part", totals.cycles_s)
    yield _histogram(
        "force_error_newtons",
        "Distance of force and set-point at the end of a grasp",
        totals.force_errors_n,
    )


def _links(counters: Mapping[str, Any]) -> Iterator[Metric]:
    for name, meaning, group, key in _COUNTERS:
        yield CounterMetricFamily(f"tactile_cell_{name}", meaning, value=counters[group][key])
    loop, faults = counters["loop"], counters["faults"]
    yield _labelled(
        CounterMetricFamily, "faults", "Faults by number", ["number"],
        (((number,), n) for number, n in faults.items()),
    )  # fmt: skip
    for name, meaning in (
        ("lateness", "How late periods of the force loop began"),
        ("transaction", "How long reading the servos took"),
        ("sensor_age", "Age of the force sample when a step of control used it"),
    ):
        yield _labelled(
            GaugeMetricFamily, f"loop_{name}_seconds", meaning, ["quantile"],
            (((quantile,), loop[f"{name}_{key}"]) for quantile, key in _QUANTILES.items()),
        )  # fmt: skip


def _health(health: Mapping[str, Any]) -> Iterator[Metric]:
    servos, drift = health["servos"], health["drift"]
    for name, meaning, key in (
        ("servo_temperature_celsius", "Temperature of each servo", "temperature_c"),
        ("servo_load_ratio", "Current of each servo, as a share of its limit", "load"),
    ):
        numbered = (((str(n),), value) for n, value in enumerate(servos[key]))
        yield _labelled(GaugeMetricFamily, name, meaning, ["servo"], numbered)
    drives = [(str(n), drive) for n, drive in enumerate(servos.get("drives", ())) if drive]
    for name, meaning, directions in _DRIVES:
        values = (
            ((n, direction) if direction else (n,), drive[key])
            for n, drive in drives
            for direction, key in directions.items()
        )
        labels = ["servo", *([] if "" in directions else ["direction"])]
        yield _labelled(GaugeMetricFamily, name, meaning, labels, values)
    if drift is not None:
        yield _gauge("drift_gain_ratio", "Gain of the pads, as a share of teaching", drift["gain"])
        meaning = "Drift of the zero of the opening since teaching, positive: reads too large"
        yield _gauge("drift_zero_metres", meaning, 1e-3 * drift["opening_mm"])


def _free_bytes(service: Service) -> float | None:
    """Return the free bytes in the folder of the recording; None if the folder is gone."""
    place = service.plugin.recording_path or Path(service.config.recording.directory)
    try:
        there = next(one for one in (place, *place.absolute().parents) if one.exists())
        return shutil.disk_usage(there).free
    except OSError:
        return None
