"""The web door on a stub, with any state for the page to show."""

import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from cell.config.model import CellConfig
from cell.fault_catalogue import BY_NUMBER
from cell.interfaces.plugin.goals import TASKS
from cell.interfaces.plugin.plugin import cell_values
from cell.interfaces.service.service import JobView, Service
from cell.interfaces.web import WebDoor
from tactile.layout import paper_layout
from tests.cell.conftest import small_config
from tests.cell.interfaces.stub_plugin import StubPlugin

PORTS = {"serve__modbus_port": None, "serve__xmlrpc_port": None, "serve__http_port": 0}
COMMANDS = (*TASKS, "release", "clear", "reset", "shutdown")
NOT_NOW = {"number": 505, "text": "not allowed now", "remedy": "Read the allowed commands."}
ALLOWED = {
    "IDLE": {"teach", "gauge", "zero", "identify", "grip", "sort", "release", "shutdown"},
    "COMPLETE": {"verify", "release", "shutdown"},
    "HELD": {"release", "shutdown"},
    "ABORTED": {"clear"},
    "RESETTING": {"release", "reset"},
    "STOPPED": {"release", "clear", "reset"},
}


def info_json() -> dict[str, Any]:
    """Return what `GET /api/info` answers: the paper's pads."""
    return cell_values(CellConfig(), paper_layout()) | {
        "name": "Cell 3", "mode": "cell", "version": "0.1.0", "lease_timeout_s": 2.0,
        "labels": ["bolt", "nut", "pin"], "places": ["tray A", "tray B", "box", "rejects"],
        "opening_max_mm": 20.0, "force_cap_n": 15.0, "levels_n": [1.9, 3.8, 5.7, 7.6],
    }  # fmt: skip


def frame_n(force_n: float, at_mm: tuple[float, float] = (24.0, 9.0)) -> np.ndarray:
    """Return the forces of all taxels for a round part between the inner pads, shape (408,)."""
    layout = paper_layout()
    values = np.zeros(layout.n_taxels, dtype="<f4")
    for index in layout.gripping_pads:
        taxels = layout.taxels_of(index)
        xy_mm = 1e3 * layout.taxel_xy_m[taxels]
        xy_mm = xy_mm - xy_mm.min(axis=0)
        away = ((xy_mm - np.array(at_mm)) ** 2).sum(axis=1)
        share = np.exp(-away / (2 * 4.5**2))
        share[share < 0.05] = 0.0
        values[taxels] = force_n * share / share.sum()
    return values


def fault_json(number: int, steps: list[str], detail: str) -> dict[str, Any]:
    """Return a fault as the state shows it."""
    recording = "out/serve-2026-11-21/recording.mcap"
    shown = {"steps": steps, "detail": detail, "since_s": time.time(), "recording": recording}
    return asdict(BY_NUMBER[number]) | shown


def grasp_json() -> dict[str, Any]:
    """Return the curves of a grasp."""
    t_s = np.linspace(0.0, 2.4, 120)
    force_n = np.clip(5.0 * (t_s - 0.5), 0.0, 7.6)
    return {
        "t_s": t_s.tolist(), "force_n": force_n.tolist(),
        "setpoint_n": np.where(t_s > 0.8, force_n, 0.0).tolist(),
        "opening_mm": np.clip(18.0 - 22 * t_s, 6.4, 18.0).tolist(),
        "frame": frame_n(7.6).tolist(),
    }  # fmt: skip


class FakeCell:
    """A service behind its web door, with a state that the test writes; nothing of it runs.

    Attributes
    ----------
    asked
        Task or command of each job that was asked for, and what was given with it.
    holds
        Clients that have held.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.info = info_json()
        self.state = self.idle()
        self.taught: list[dict[str, Any]] = [
            {"label": label, "n_grasps": 20, "shape": shape, "size_mm": size_mm}
            for label, shape, size_mm in (
                ("bolt", "cylinder", 8.0), ("nut", "flat", 6.4), ("pin", "cylinder", 3.0)
            )
        ]  # fmt: skip
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.holds: list[str] = []
        self.sends = threading.Event()
        self.sends.set()
        self.n_messages = 0
        self.plugin: Any = StubPlugin()
        self.plugin.labels = ("bolt", "nut", "pin", "washer")
        self.plugin.taught = lambda: self.taught
        self.service: Any = Service(self.plugin, small_config(**PORTS))
        self.service.info = lambda: self.info
        self.service.frame_n = self._frame_n
        self.service.shift.grasp = lambda _number: grasp_json()
        self.service.hold_as = lambda name, _latch: self.holds.append(name)
        self.service._begin = self._begin
        patch.setattr("cell.interfaces.web.state_values", lambda _service: self.now())
        self.door = WebDoor(self.service)

    @property
    def url(self) -> str:
        """Address as `serve` prints it."""
        return f"http://127.0.0.1:{self.door.port}/#token={self.door.token}"

    def close(self) -> None:
        self.sends.set()
        self.door.close()
        self.service.close()

    def given(self, task: str) -> list[Mapping[str, Any]]:
        """Return what was given with each job of a task or command."""
        return [given for one, given in self.asked if one == task]

    # -- states ----------------------------------------------------------------------------------

    def idle(self) -> dict[str, Any]:
        """Ready, after an identification."""
        now_s = time.time()
        answers = [
            {
                "id": number, "time_s": now_s - 13 * (20 - number), "task": "identify",
                "label": label, "probability": probability,
                "runner_up": {"label": "pin", "probability": round(1 - probability, 3)},
                "shape": "flat", "size_mm": 6.4, "interval_mm": [6.1, 6.7], "n_grasps": 2,
                "seconds": 9.4, "place": None,
            }
            for number, (label, probability) in enumerate(
                [("nut", 0.98), ("bolt", 0.99), ("nut", 0.97), ("UNKNOWN", 0.93), ("bolt", 0.71),
                 ("nut", 0.96), ("pin", 0.99), ("nut", 0.995), ("nut", 0.98), ("bolt", 0.99),
                 ("nut", 0.97), ("nut", 0.97)],
                start=9,
            )
        ]  # fmt: skip
        return {
            "status": self._status("IDLE", "IDLE"),
            "job": self._job("identify", "SUCCEEDED", label="nut", probability=0.97, number=12),
            "last_answer": self._job("identify", "SUCCEEDED", label="nut", probability=0.97),
            "live": {
                "force_n": 0.02, "force_age_s": 0.01, "setpoint_n": 0.0, "opening_mm": 18.5,
                "temperature_c": 41.0, "frame_age_s": 0.01,
            },
            "held_by": [], "pose_seq": 0, "pose": None, "replay": None,
            "shift": {
                "since_s": now_s - 3600 * 3, "parts": 128, "rejected": 3, "missed": 1, "faults": 0,
                "cycle_s": 11.4, "parts_per_hour": 312.0,
                "counts": {"nut": 71, "bolt": 42, "pin": 12, "UNKNOWN": 3}, "answers": answers,
            },
            "fault": None,
            "health": {
                "servos": {"level": "ok", "temperature_c": [41.0, 40.0], "load": [0.18, 0.2]},
                "can": {"level": "ok", "frames": 182000, "lost": 0, "age_s": 0.012},
                "loop": {"level": "ok", "periods": 120000, "late": 0, "p99_ms": 5.3},
                "drift": {"level": "ok", "gain": 1.01, "opening_mm": 0.02},
                "recording": {"level": "ok", "path": "out/serve/recording.mcap", "text": ""},
            },
        }  # fmt: skip

    def working(self, force_n: float = 5.2) -> dict[str, Any]:
        """The second grasp of an identification."""
        state = self.idle()
        state["status"] = self._status("EXECUTE", "GRIPPING")
        state["job"] = self._job("identify", "EXECUTING", number=13) | {
            "since_s": time.time() - 7,
            "progress": {
                "task": "identify",
                "grasps": 1,
                "of": 4,
                "best": "nut",
                "probability": 0.63,
            },
        }
        state["last_answer"] = None
        state["live"] |= {"force_n": force_n, "setpoint_n": force_n + 0.1, "opening_mm": 6.5}
        return state

    def named(self, label: str = "nut", probability: float = 0.97) -> dict[str, Any]:
        """A part is named and kept."""
        state = self.idle()
        state["status"] = self._status("COMPLETE", "HOLDING")
        job = self._job("identify", "SUCCEEDED", label=label, probability=probability, number=13)
        state["job"], state["last_answer"] = job, job
        newest = dict(state["shift"]["answers"][-1], id=13, label=label, probability=probability)
        newest |= {"time_s": time.time(), "runner_up": {"label": "pin", "probability": 0.02}}
        if label == "UNKNOWN":
            newest |= {"shape": "cylinder", "size_mm": 6.0, "interval_mm": [5.7, 6.3]}
        state["shift"]["answers"] = [*state["shift"]["answers"], newest][-20:]
        state["live"] |= {"force_n": 4.0, "setpoint_n": 4.0, "opening_mm": 6.4}
        return state

    def faulted(self, number: int = 206) -> dict[str, Any]:
        """A fault that is latched, with a part in the grip."""
        state = self.named()
        state["status"] = self._status("ABORTED", "ERROR") | {
            "holding": True, "fault": "the held part slips", "fault_number": number,
        }  # fmt: skip
        state["job"] |= {"outcome": "ABORTED", "fault_number": number, "error": "slips"}
        detail = "PartSlipped: the centre of force moved 3.1 mm in 0.4 s at 4.0 N, limit 2.0 mm"
        steps = ["support_part", "clear", "release", "reset"]
        state["fault"] = fault_json(number, steps, detail)
        state["shift"]["faults"] = 1
        return state

    def teaching(self, grasps: int = 6) -> dict[str, Any]:
        """A washer is taught."""
        state = self.idle()
        state["status"] = self._status("EXECUTE", "GRIPPING")
        each = [
            {"force_n": 3.0 + 0.7 * i, "opening_mm": 2.1 + 0.03 * i, "size_mm": 2.0 + 0.02 * i}
            for i in range(grasps)
        ]
        state["job"] = self._job("teach", "EXECUTING", number=13) | {
            "progress": {
                "task": "teach",
                "label": "washer",
                "grasps": grasps,
                "missed": 1,
                "of": 10,
                "each": each,
            },
        }
        state["live"] |= {"force_n": 3.4, "setpoint_n": 3.5, "opening_mm": 2.2}
        return state

    def sorting(self) -> dict[str, Any]:
        """A sort, the fourth part."""
        state = self.idle()
        state["status"] = self._status("EXECUTE", "HOLDING")
        state["job"] = self._job("sort", "EXECUTING", number=13) | {
            "progress": {
                "task": "sort", "of": 40, "parts": 13, "n_rejected": 1, "n_missed": 0,
                "places": {"tray A": 7, "tray B": 4, "box": 1, "rejects": 1},
                "label": "nut", "place": "tray A", "probability": 0.98,
            },
        }  # fmt: skip
        state["live"] |= {"force_n": 4.0, "setpoint_n": 4.0, "opening_mm": 6.4}
        return state

    def _status(self, state: str, grasp: str) -> dict[str, Any]:
        return {
            "state": state, "state_number": 4, "needs_reset": state == "RESETTING", "grasp": grasp,
            "grasp_number": 0, "holding": grasp == "HOLDING", "fault": None, "fault_number": 0,
            "since_s": time.time() - 42,
        }  # fmt: skip

    def _job(self, task: str, outcome: str, **more: Any) -> dict[str, Any]:
        felt = {"n_grasps": 2, "shape": "flat", "size_mm": 6.4}
        given = {"number": 12, "outcome_number": 4, "since_s": time.time() - 42} | felt | more
        return asdict(JobView(task=task, outcome=outcome, **given))

    # -- the service -----------------------------------------------------------------------------

    def now(self) -> dict[str, Any]:
        """Return the state with its time and what it allows."""
        assert self.sends.wait(60.0)
        self.n_messages += 1
        name = self.state["status"]["state"]
        return {
            "allowed": {one: None if one in ALLOWED.get(name, ()) else NOT_NOW for one in COMMANDS},
            "commander": self.service.lease.name,
            "taught_revision": self.service.photos.revision + len(self.given("forget")),
        } | self.state | {"time_s": time.time()}  # fmt: skip

    def _frame_n(self) -> np.ndarray | None:
        force_n = self.state["live"]["force_n"]
        return None if force_n is None else frame_n(force_n)

    def _begin(
        self, lease: int, task: str, given: Mapping[str, Any], number: int, begin: Any
    ) -> int:
        self.service.lease.alive(lease)
        if task == "release":
            begin()  # checks the key
        if task == "forget":
            (named,) = (one for one in self.taught if one["label"] == given["label"])
            named["n_grasps"] -= 1
            if not given["last"]:
                self.taught.remove(named)
        self.asked.append((task, given))
        self.state["job"] = self.state["job"] | {"number": number}
        return number
