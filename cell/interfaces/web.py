"""HTTP and WebSocket: the interface for everything else, with an OpenAPI description.

Needs the extra ``serve``. Reading and commanding need the token; `hold` needs none. A page from
elsewhere is refused by its Origin. JSON in and out; what is refused has a fault number.
"""

import asyncio
import json
from dataclasses import asdict
from functools import cache
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import Body, HTTPException, Query, Request
from fastapi.responses import Response
from pydantic import Field, WithJsonSchema

from cell.config.simulator import LONGEST_LABEL
from cell.control.plan import Pose
from cell.control.states import Command
from cell.errors import RequestRefused
from cell.fault_catalogue import CATALOGUE
from cell.interfaces.http_server import REQUEST_BYTES, Scope
from cell.interfaces.live_socket import LiveMessage
from cell.interfaces.web_server import Paths, RequestBody, WebServer
from cell.plugin.goals import goal_schema
from cell.service.photos import LONGEST_PHOTO
from cell.service.service import Service
from cell.service.state import plain_data, state_values

LONGEST_STL = 10_000_100
"""Largest STL file in bytes: 200,000 triangles as binary."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
"""A number in a request."""


JOB_EXAMPLES: dict[str, Any] = {
    task: {"summary": summary, "value": {"lease": 1, "goal": {"task": task} | fields}}
    for task, summary, fields in (
        ("teach", "Grasp a known object ten times.", {"label": "bolt", "grasps": 10}),
        ("gauge", "Measure the drift since teaching on a taught object.", {"label": "bolt"}),
        ("zero", "Close the empty fingers on each other and measure what has changed.", {}),
        ("identify", "Name a part and keep it in the grip.", {"keep": "always"}),
        ("grip", "Grip a part with 3 N and keep it, without a name.", {"force_n": 3.0}),
        ("verify", "Measure whether the kept part is still the one.", {}),
        ("sort", "Name 20 parts and let each go at its place.", {"parts": 20}),
    )
}
"""Examples of `POST /api/jobs` in the description."""


class LeaseBody(RequestBody):
    """The lease, and the number that the job shall have (0: not checked)."""

    lease: int
    job: int = 0


class StartBody(LeaseBody):
    """A goal: ``task`` and its fields, as in `TactileCellPlugin.start`."""

    goal: Annotated[dict[str, Any], WithJsonSchema(goal_schema())]


class CommandBody(LeaseBody):
    """A command; ``release`` needs its key, 20304; ``reboot`` restarts servos at fault."""

    command: Literal[
        Command.RELEASE, Command.CLEAR, Command.RESET, Command.SHUTDOWN, "forget_drift"
    ]
    key: int = 0
    reboot: bool = False


class FaultBody(RequestBody):
    """A fault of the simulated cell, as `serve --fault` takes it."""

    fault: str


class PoseFields(RequestBody):
    """Pose of the object in the grip frame."""

    x_m: Finite = 0.0
    """Offset of its centre along the fingers in m."""
    y_m: Finite = 0.0
    """Offset of its centre across the fingers in m."""
    rotation_rad: Finite = 0.0
    """Turn about the closing axis in rad."""
    roll_rad: Finite = 0.0
    """Turn about the object's own long axis in rad, before the rotation."""


class PoseBody(RequestBody):
    """Whether the pose of that number was reached, or the one (m, rad) reached instead."""

    lease: int
    seq: int
    ok: bool
    pose: PoseFields | None = None


class PartBody(RequestBody):
    """What lies between the fingers of the simulated cell in all jobs from now on."""

    lease: int
    part: str | None = Field(default=None, min_length=1, max_length=LONGEST_LABEL)
    """Name of an object, a shape as ``cylinder:diameter=8mm,length=20mm``, or ``nothing``; null:
    each job brings the next object."""
    pose: PoseFields = PoseFields()
    """How far it lies beside the pose that a job asks for."""


class ResetBody(RequestBody):
    """The lease."""

    lease: int


def taught_values(one: dict[str, Any]) -> dict[str, Any]:
    """Return a taught object with the address of its photo, null for none."""
    address = f"/api/taught/{quote(one['label'], safe='')}/photo"
    found: dict[str, Any] = plain_data(one | {"photo": address if one["photo"] else None})
    return found


def state_moment(service: Service) -> LiveMessage:
    """Return the state of a service now; frames are counts (``1``) or ``newtons`` of the taxels."""

    @cache
    def frame(kind: str) -> bytes | None:
        if kind == "newtons":
            force_n = service.frame_n()
            return None if force_n is None else force_n.astype("<f4").tobytes()
        counts = service.status().live.counts if kind == "1" else None
        return None if counts is None else counts.astype("<u2").tobytes()

    state = state_values(service)
    return LiveMessage(json.dumps(state, allow_nan=False), frame, tuple(state["shift"]["answers"]))


class WebInterface(WebServer):
    """The cell behind HTTP and WebSocket, below ``/api``.

    Raises OSError or ConfigError as `WebServer`.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        paths: Paths = (
            ("/info", "GET", self.info),
            ("/state", "GET", self.state),
            ("/faults", "GET", self.faults),
            ("/grasps/{number}", "GET", self.grasp),
            ("/jobs", "GET", self.jobs),
            ("/jobs/{number}", "GET", self.job),
            ("/taught", "GET", self.taught),
            ("/taught/{label:path}/photo", "GET", self.photo),
            ("/taught/{label:path}/photo", "PUT", self.put_photo),
            ("/taught/{label:path}/last", "DELETE", self.take_back),
            ("/taught/{label:path}", "DELETE", self.forget),
            ("/jobs", "POST", self.start),
            ("/commands", "POST", self.command),
            ("/pose", "POST", self.pose),
        )
        if service.simulated:
            paths += (
                ("/simulation/faults", "GET", self.simulated_faults),
                ("/simulation/faults", "POST", self.begin_fault),
                ("/simulation/faults", "DELETE", self.end_fault),
                ("/simulation/part", "GET", self.simulated_part),
                ("/simulation/part", "POST", self.choose_part),
                ("/simulation/objects/{label:path}", "PUT", self.define_object),
                ("/simulation/reset", "POST", self.reset_simulation),
            )
        config = service.config.serve
        super().__init__(service.lease, config, lambda: state_moment(service), paths)

    def longest(self, scope: Scope) -> int:
        """Return the most bytes of a body: more for a photo or an STL file."""
        if scope.get("method") != "PUT":
            return REQUEST_BYTES
        if scope["path"].startswith("/api/simulation/objects/"):
            return LONGEST_STL
        return LONGEST_PHOTO if scope["path"].endswith("/photo") else REQUEST_BYTES

    def info(self) -> dict[str, Any]:
        """Name, mode, version, pads, limits, forces, taught objects, labels by id, places."""
        return self._service.info() | {"objects": self.taught()}

    def state(self) -> dict[str, Any]:
        """States, newest job, last answer, live values (null: not measured), pose waited for.

        ``allowed`` has null for each task and command that is allowed to the client in command.
        """
        return state_values(self._service)

    def faults(self) -> list[dict[str, Any]]:
        """List the fault catalogue: number, text, cause, remedy, what the grip does, steps."""
        return [asdict(fault) for fault in sorted(CATALOGUE.values(), key=lambda one: one.number)]

    def grasp(self, number: int) -> dict[str, Any]:
        """Return the curves of the last grasp of a part by its number in ``shift.answers``.

        ``frame`` has the force in N on each taxel under the highest load.
        """
        part = self._service.shift.part(number)
        if part is None or part.curves is None:
            raise HTTPException(404, f"grasp {number} is not kept; GET /api/state has the numbers")
        return part.curves

    def jobs(self) -> list[dict[str, Any]]:
        """List the newest jobs, oldest first."""
        return [plain_data(asdict(job)) for job in self._service.jobs()]

    def job(self, number: int) -> dict[str, Any]:
        """One job: outcome, progress, answer."""
        try:
            found: dict[str, Any] = plain_data(asdict(self._service.job(number)))
        except RequestRefused as error:
            raise HTTPException(404, str(error)) from error
        return found

    def taught(self) -> list[dict[str, Any]]:
        """List the taught objects: grasps at hand, shape and size in mm, address of the photo."""
        return [taught_values(one) for one in self._service.taught()]

    def forget(self, label: str, lease: int) -> dict[str, int]:
        """Start to forget a taught object; it is forgotten when the job has succeeded."""
        return {"job": self._service.forget(lease, label)}

    def take_back(self, label: str, lease: int) -> dict[str, int]:
        """Start to take the newest grasp of a taught object back."""
        return {"job": self._service.forget(lease, label, last=True)}

    def photo(self, label: str) -> Response:
        """Return the photo of a taught object."""
        found = self._service.photos.get(label)
        if found is None:
            raise HTTPException(404, f"{label!r:.80} has no photo")
        photo, kind = found
        headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
        return Response(photo, media_type=kind, headers=headers)

    async def put_photo(self, label: str, lease: int, request: Request) -> dict[str, Any]:
        """Keep a photo of a taught object, JPEG or PNG of at most 512 kB, as the body."""
        photo = await request.body()
        await asyncio.to_thread(self._service.put_photo, lease, label, photo)
        return {}

    def start(
        self, body: Annotated[StartBody, Body(openapi_examples=JOB_EXAMPLES)]
    ) -> dict[str, int]:
        """Start a job."""
        return {"job": self._service.start(body.lease, body.goal, number=body.job)}

    def command(self, body: CommandBody) -> dict[str, int]:
        """Start to release the part (it may fall), to clear, to reset or to shut down.

        ``forget_drift`` follows the drift of the sensors anew, as after work on them.
        """
        if body.command == "forget_drift":
            return {"job": self._service.forget_drift(body.lease, number=body.job)}
        number = self._service.command(
            body.lease, body.command, key=body.key, reboot=body.reboot, number=body.job
        )
        return {"job": number}

    def pose(self, body: PoseBody) -> dict[str, int]:
        """Answer the pose that is waited for."""
        reached = None if body.pose is None else Pose(**body.pose.model_dump())
        self._service.pose_reached(body.lease, body.seq, ok=body.ok, pose=reached)
        return {"seq": body.seq}

    def simulated_faults(self) -> dict[str, Any]:
        """List the kinds of faults that fit this simulated cell, and the faults that run.

        A fault is a text ``NAME[=VALUE][@START[..END]]``; one that waits has not begun.
        """
        return self._service.simulated_faults()

    def begin_fault(self, body: FaultBody) -> dict[str, Any]:
        """Begin a fault of the simulated cell; it needs no lease. Returns what GET does."""
        self._service.simulate_fault(body.fault)
        return self._service.simulated_faults()

    def end_fault(self, fault: str) -> dict[str, Any]:
        """End the faults with this text or name, those of `serve --fault` too."""
        self._service.simulate_fault(fault, end=True)
        return self._service.simulated_faults()

    def simulated_part(self) -> dict[str, Any]:
        """Return the chosen part and its pose, what lies between the fingers, and all objects."""
        return self._service.simulated_part()

    def choose_part(self, body: PartBody) -> dict[str, Any]:
        """Put a part between the open fingers, for all jobs from now on. Returns what GET does.

        A part in the grip is not exchanged: release it first.
        """
        self._service.choose_part(body.lease, body.part, Pose(**body.pose.model_dump()))
        return self._service.simulated_part()

    async def define_object(self, label: str, lease: int, request: Request) -> dict[str, Any]:
        """Add an object to the simulated cell, an STL file in mm of at most 10 MB as the body."""
        stl = await request.body()
        return {"objects": await asyncio.to_thread(self._service.define_object, lease, label, stl)}

    def reset_simulation(self, body: ResetBody) -> dict[str, int]:
        """Start to make the simulated cell ready: faults end, the part is let go and taken away."""
        return {"job": self._service.reset_simulation(body.lease)}

    def hold(
        self,
        request: Request,
        latch: bool | None = None,
        name: Annotated[str, Query(max_length=60)] = "",
    ) -> dict[str, Any]:
        """Stop what runs and keep the grip; anyone may, without token and lease.

        With ``latch=true`` nothing that moves starts until the same client, by address and name,
        asks with ``latch=false``. A pressed button repeats it at least each serve.lease_timeout_s.
        """
        host = "" if request.client is None else request.client.host
        self._service.hold_as(f"HTTP {host} {name}".rstrip(), latch)
        return {"state": self._service.status().state, "held_by": self._service.held_by}
