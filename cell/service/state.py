"""The state of a service as plain data, for interfaces that show all of it."""

import time
from dataclasses import asdict, fields
from functools import partial
from typing import Any

from pydantic_core import to_jsonable_python

from cell.control.states import CellStatus
from cell.fault_catalogue import BY_NUMBER, Refusal
from cell.runtime.host_status import HostStatus
from cell.service.service import Service

plain_data = partial(to_jsonable_python, inf_nan_mode="null")
"""Returns JSON types, also of dataclasses; null for each number that is not finite."""


def state_values(service: Service) -> dict[str, Any]:
    """Return everything except the taxels: JSON types, null for a number that is not finite."""
    now = service.snapshot()
    live = now.status.live
    state: dict[str, Any] = plain_data(
        {
            "time_s": time.time(),
            "status": {one.name: getattr(now.status, one.name) for one in fields(CellStatus)},
            "job": now.job,
            "last_answer": now.last_answer,
            "live": {name: getattr(live, name) for name in live.__slots__ if name != "counts"},
            "commander": now.commander,
            "held_by": now.held_by,
            "held_part": now.held_part,
            "pose_seq": now.pose_seq,
            "pose": now.pose,
            "allowed": {
                task: None if error is None else Refusal.of(error)
                for task, error in service.allowed().items()
            },
            "fault": _fault(service, now.status),
            "taught_revision": service.taught_revision,
            "health": service.health(),
            "shift": service.shift.values(),
        }
    )
    return state


def _fault(service: Service, status: HostStatus) -> dict[str, Any] | None:
    if status.fault is None or not status.fault_number:
        return None
    path = service.plugin.recording_path
    return asdict(BY_NUMBER[status.fault_number]) | {
        "detail": status.fault,
        "since_s": status.fault_since_s,
        "recording": None if path is None else str(path),
    }
