"""The state of a service as plain data, for interfaces that show all of it."""

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from cell.control.answer import HostStatus
from cell.control.states import CellStatus
from cell.fault_catalogue import BY_NUMBER, Refusal
from cell.service.service import Service


def state_values(service: Service) -> dict[str, Any]:
    """Return everything except the taxels: JSON types, null for a number that is not finite."""
    now = service.snapshot()
    live = now.status.live
    state: dict[str, Any] = plain_data(
        {
            "time_s": time.time(),
            "status": {one.name: getattr(now.status, one.name) for one in fields(CellStatus)},
            "job": asdict(now.job),
            "last_answer": None if now.last_answer is None else asdict(now.last_answer),
            "live": {name: getattr(live, name) for name in live.__slots__ if name != "counts"},
            "commander": now.commander,
            "held_by": now.held_by,
            "held_part": now.held_part,
            "pose_seq": now.pose_seq,
            "pose": None if now.pose is None else now.pose.as_dict(),
            "allowed": {
                task: None if error is None else asdict(Refusal.of(error))
                for task, error in service.allowed().items()
            },
            "fault": _fault(service, now.status),
            "taught_revision": service.taught_revision,
            "health": service.health(),
            "shift": service.shift.values(),
        }
    )
    return state


def plain_data(value: Any) -> Any:
    """Return plain data with null for each number that is not finite, because JSON has none."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: plain_data(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain_data(one) for one in value]
    return value


def _fault(service: Service, status: HostStatus) -> dict[str, Any] | None:
    if status.fault is None or not status.fault_number:
        return None
    path = service.recording_path
    return asdict(BY_NUMBER[status.fault_number]) | {
        "detail": status.fault,
        "since_s": status.fault_since_s,
        "recording": None if path is None else str(path),
    }
