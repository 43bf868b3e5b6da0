"""A server that shows the page any state: the paths below ``/api`` without a cell behind them."""

import asyncio
import math
import socket
import threading
import time
from dataclasses import asdict
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Request, WebSocket
from fastapi.responses import JSONResponse, Response
from starlette.websockets import WebSocketDisconnect

from cell.config.model import CellConfig
from cell.fault_catalogue import BY_NUMBER
from cell.interfaces.page import mount_page
from cell.interfaces.plugin.goals import TASKS
from cell.interfaces.plugin.plugin import cell_values
from cell.interfaces.service.service import JobView
from tactile.layout import paper_layout

TOKEN = "token-of-the-test"
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


class FakeCell:
    """Server of the page with a state that the test writes; requests are kept in `asked`."""

    def __init__(self) -> None:
        self.info = info_json()
        self.state = self.idle()
        self.taught: list[dict[str, Any]] = [
            {"label": label, "label_id": number, "n_grasps": 20, "shape": shape, "size_mm": size_mm,
             "photo": None}
            for number, (label, shape, size_mm) in enumerate(
                [("bolt", "cylinder", 8.0), ("nut", "flat", 6.4), ("pin", "cylinder", 3.0)], start=1
            )
        ]  # fmt: skip
        self.photos: dict[str, bytes] = {}
        self.asked: list[tuple[str, str, Any]] = []
        self.lease = 0
        self.alive_s = math.inf
        self.sends = True
        self.n_messages = 0
        self.refusals: dict[str, tuple[int, int, str]] = {}
        app = FastAPI()
        app.add_api_websocket_route("/api/live", self._live)
        app.add_api_route(
            "/api/{path:path}", self._answer, methods=["GET", "POST", "PUT", "DELETE"]
        )
        mount_page(app)
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        config = uvicorn.Config(
            app,
            log_config=None,
            lifespan="off",
            ws="websockets-sansio",
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), daemon=True
        )
        self._thread.start()

    @property
    def url(self) -> str:
        """Address as `serve` prints it."""
        return f"http://127.0.0.1:{self.port}/#token={TOKEN}"

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()

    def sent(self, method: str, start: str) -> list[Any]:
        """Return the bodies of all requests of a method to paths that begin so."""
        return [body for way, path, body in self.asked if way == method and path.startswith(start)]

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
            "commander": "", "held_by": [], "pose_seq": 0, "pose": None,
            "taught_revision": 1, "replay": None,
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

    # -- the server ------------------------------------------------------------------------------

    def now(self) -> dict[str, Any]:
        """Return the state with its time and what it allows."""
        name = self.state["status"]["state"]
        allowed = {one: None if one in ALLOWED.get(name, ()) else NOT_NOW for one in COMMANDS}
        return {"allowed": allowed} | self.state | {"time_s": time.time()}

    async def _live(self, link: WebSocket) -> None:
        if f"token.{TOKEN}" not in link.scope["subprotocols"]:
            await link.close(1008)
            return
        await link.accept(subprotocol="tactile-cell")
        try:
            while True:
                if self.sends:
                    await link.send_json(self.now())
                    self.n_messages += 1
                    force_n = self.state["live"]["force_n"]
                    if force_n is not None:
                        await link.send_bytes(frame_n(force_n).astype("<f4").tobytes())
                await asyncio.sleep(1 / 30)
        except (WebSocketDisconnect, RuntimeError):
            return

    async def _answer(self, path: str, request: Request) -> Response:
        raw = await request.body()
        kind = request.headers.get("content-type", "")
        body = await request.json() if raw and kind == "application/json" else raw
        way = request.method
        self.asked.append((way, path, body))
        if path == "hold":
            return JSONResponse({"state": "HELD", "held_by": []})
        if request.headers.get("authorization") != f"Bearer {TOKEN}":
            return JSONResponse({"error": "wrong token"}, 401)
        status, number, text = self.refusals.get(path.partition("/")[0], (0, 0, ""))
        if status:
            return JSONResponse({"fault_number": number, "error": text, "remedy": ""}, status)
        found = self._found(way, path, body)
        return found if isinstance(found, Response) else JSONResponse(found)

    def _found(self, way: str, path: str, body: Any) -> Any:  # noqa: PLR0911, PLR0912
        part = path.split("/")
        match way, part:
            case "GET", ["info"]:
                return self.info
            case "GET", ["state"]:
                return self.now()
            case "GET", ["taught"]:
                return self.taught
            case "GET", ["taught", label, "photo"]:
                return Response(self.photos[label], media_type="image/jpeg")
            case "PUT", ["taught", label, "photo"]:
                self.photos[label] = body
                next(one for one in self.taught if one["label"] == label)["photo"] = f"/api/{path}"
                self.state["taught_revision"] += 1
                return {}
            case "DELETE", ["taught", label]:
                self.taught = [one for one in self.taught if one["label"] != label]
                self.state["taught_revision"] += 1
                return {}
            case "DELETE", ["taught", label, "last"]:
                next(one for one in self.taught if one["label"] == label)["n_grasps"] -= 1
                self.state["taught_revision"] += 1
                return {}
            case "GET", ["grasps", _]:
                t_s = np.linspace(0.0, 2.4, 120)
                force_n = np.clip(5.0 * (t_s - 0.5), 0.0, 7.6)
                return {
                    "t_s": t_s.tolist(), "force_n": force_n.tolist(),
                    "setpoint_n": np.where(t_s > 0.8, force_n, 0.0).tolist(),
                    "opening_mm": np.clip(18.0 - 22 * t_s, 6.4, 18.0).tolist(),
                    "frame": frame_n(7.6).tolist(),
                }  # fmt: skip
            case "POST", ["lease"]:
                if self.lease and not body["take"]:
                    return JSONResponse(
                        {"fault_number": 514, "error": "another is in command"}, 403
                    )
                self.lease += 1
                self.state["commander"] = body["name"]
                return {"lease": self.lease}
            case "POST", ["lease", number, "alive"]:
                if int(number) != self.lease or not self.state["commander"]:
                    return JSONResponse({"fault_number": 514, "error": "lease lost"}, 403)
                return {"lease": self.lease}
            case "DELETE", ["lease", _]:
                self.state["commander"], self.lease = "", 0
                return {"lease": 0}
            case "POST", ["jobs" | "commands"]:
                self.state["job"] = self.state["job"] | {"number": body["job"]}
                return {"job": body["job"]}
        return {}
