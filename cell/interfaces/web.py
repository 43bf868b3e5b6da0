"""HTTP and WebSocket: the interface for all other programs, with an OpenAPI description.

Needs the extra ``serve``. Reading and commanding need the token; `hold` does not. Pages of another
Origin are refused. Requests and answers are JSON; a refusal has a fault number.
"""

import asyncio
import json
import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import date
from functools import cache, partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Depends, FastAPI, HTTPException, Query, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.websockets import WebSocketDisconnect

from cell.control.plan import Pose
from cell.errors import (
    CellStateError,
    ConfigError,
    HeldByClient,
    ModelError,
    NotInCommand,
    PlanRefused,
    RequestRefused,
)
from cell.fault_catalogue import CATALOGUE, EXPECTED_ERRORS, Refusal
from cell.files import MAX_TEXT
from cell.interfaces.access import is_loopback, read_secret, same_secret, view_token
from cell.interfaces.http_server import REMEDIES, REQUEST_BYTES, HttpServer, refusal
from cell.interfaces.metrics import CONTENT_TYPE, metrics_text
from cell.interfaces.opening import page_address, qr_code, view_note
from cell.interfaces.page import mount_page
from cell.runtime.goals import complaints, goal_schema
from cell.service.service import Service, plain_data, state_values

_SUBPROTOCOL = "tactile-cell"
"""Subprotocol of the WebSocket."""
_STATUS = {
    NotInCommand: 403,
    CellStateError: 409,
    HeldByClient: 409,
    RequestRefused: 422,
    ConfigError: 422,
    PlanRefused: 422,
    ModelError: 422,
}
"""HTTP status of refusals; 500 for all other errors."""
_CAUSES = {401: "token", 404: "path", 405: "method"}
"""Causes of `REMEDIES` for refusals of the framework, by status."""
RATE_HZ = 30.0
"""Messages per second to one WebSocket."""
Text = Annotated[str, Field(max_length=REQUEST_BYTES)]
"""A text in a request; with a limit it is also checked for lone surrogates, which JSON answers
cannot have."""


JOB_EXAMPLES: dict[str, Any] = {
    task: {"summary": summary, "value": {"lease": 1, "goal": {"task": task} | fields}}
    for task, summary, fields in (
        ("teach", "Grasp a known object ten times.", {"label": "bolt", "grasps": 10}),
        ("gauge", "Measure the drift since teaching on a taught object.", {"label": "bolt"}),
        ("zero", "Close the empty fingers on each other and measure zero, gains and foam.", {}),
        ("identify", "Name a part and keep it in the grip.", {"keep": "always"}),
        ("grip", "Grip a part with 3 N and keep it, without a name.", {"force_n": 3.0}),
        ("verify", "Measure whether the kept part is still the same.", {}),
        ("sort", "Identify 20 parts and release each at its place.", {"parts": 20}),
    )
}
"""Examples of `POST /api/jobs` in the description."""


class RequestBody(BaseModel):
    """Body of a request; an unknown field is refused."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class LeasedBody(RequestBody):
    """A command under the lease."""

    lease: int


class AcquireBody(RequestBody):
    """Name of the new client in command; ``take``, on this machine only, takes the lease."""

    name: Text
    take: bool = False


class RefusalBody(RequestBody):
    """A refusal, in the same form for all paths."""

    fault_number: int
    """Number in the fault catalogue, `GET /api/faults`."""
    error: str
    """Cause, with value and limit."""
    remedy: str
    """Remedy."""


class JobBody(LeasedBody):
    """The lease, and the expected number of the job (0: not checked)."""

    job: int = 0


class StartBody(JobBody):
    """A goal: ``task`` and its fields, as in `TactileCellPlugin.start`."""

    goal: Annotated[dict[str, Any], WithJsonSchema(goal_schema())]


class CommandBody(JobBody):
    """A command; ``release`` needs its key, 20304; ``reboot`` restarts servos with a fault."""

    command: Literal["release", "clear", "reset", "shutdown", "forget_drift"]
    key: int = 0
    reboot: bool = False


class FaultBody(RequestBody):
    """A fault of the simulated cell, as for `serve --fault`."""

    fault: Text


class PoseBody(LeasedBody):
    """Whether the pose with that number was reached, or the pose (m, rad) reached instead."""

    seq: int
    ok: bool
    pose: Pose | None = None


class PartBody(LeasedBody):
    """Part between the fingers of the simulated cell, for all jobs from now on."""

    part: str | None = Field(default=None, min_length=1, max_length=MAX_TEXT)
    """Name of an object, a shape, for example ``cylinder:diameter=8mm,length=20mm``, or
    ``nothing``; null: each job brings the next object."""
    pose: Pose = Pose()
    """Offset of the part from the pose of the job."""


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """State of the cell at one moment, for all clients."""

    text: str
    """The state as JSON."""
    frame: Callable[[str], bytes | None]
    """Returns the newest frame of the requested kind; None without a frame."""
    parts: tuple[dict[str, Any], ...]
    """The newest parts by their ``number``, oldest first."""


class LiveFeed:
    """Reads the cell `RATE_HZ` times per second while clients listen, once for all of them.

    It reads in another thread than the connections. A client that takes no message for ``limit_s``
    s is dropped with TimeoutError.
    """

    def __init__(self, look: Callable[[], LiveMessage], limit_s: float) -> None:
        self._look = look
        self._limit_s = limit_s
        self._listeners = 0
        self._looking: asyncio.Task[None] | None = None
        self._next: asyncio.Future[LiveMessage]

    async def send_to(self, link: WebSocket, frames: str, after: int | None = None) -> None:
        """Send the newest state and its frame repeatedly until the client is gone.

        With ``after`` each part with a higher number is sent once, before the state that shows it.
        Errors while reading the cell are raised.
        """
        self._listeners += 1
        if self._looking is None or self._looking.done():
            self._next = asyncio.get_running_loop().create_future()
            self._looking = asyncio.create_task(self._look_on())
        gone = asyncio.create_task(_until_gone(link))
        try:
            while True:
                coming = self._next
                await asyncio.wait((gone, coming), return_when=asyncio.FIRST_COMPLETED)
                if gone.done():
                    return
                moment = coming.result()
                async with asyncio.timeout(self._limit_s):
                    if after is not None and moment.parts:
                        newest = moment.parts[-1]["number"]
                        seen = 0 if after > newest else after  # higher: of an earlier start
                        for part in moment.parts:
                            if part["number"] > seen:
                                await link.send_text(json.dumps({"event": "part", "part": part}))
                        after = newest
                    await link.send_text(moment.text)
                    if (frame := moment.frame(frames)) is not None:
                        await link.send_bytes(frame)
        finally:
            self._listeners -= 1
            gone.cancel()

    async def _look_on(self) -> None:
        loop = asyncio.get_running_loop()
        while self._listeners:
            due_s = loop.time() + 1.0 / RATE_HZ
            try:
                moment = await asyncio.to_thread(self._look)
            except BaseException as error:
                self._next.set_exception(error)
                return
            present, self._next = self._next, loop.create_future()
            present.set_result(moment)
            await asyncio.sleep(due_s - loop.time())


async def _until_gone(link: WebSocket) -> None:
    while (await link.receive())["type"] != "websocket.disconnect":
        pass


def state_moment(service: Service) -> LiveMessage:
    """Return the state of a service now; frames are counts (``1``) or ``newtons`` of the taxels."""

    @cache
    def frame(kind: str) -> bytes | None:
        if kind == "newtons":
            force_n = None if counts is None else service.plugin.newtons.of(counts)
            return None if force_n is None else force_n.astype("<f4").tobytes()
        return counts.astype("<u2").tobytes() if kind == "1" and counts is not None else None

    state, counts = state_values(service), service.plugin.status().live.counts
    return LiveMessage(json.dumps(state, allow_nan=False), frame, tuple(state["shift"]["answers"]))


class NotThere(RequestRefused):
    """What a path names does not exist: status 404."""

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(text)
        self.remedy = REMEDIES[cause]


class WebInterface(HttpServer):
    """The cell behind HTTP and WebSocket, below ``/api``: token, lease, live state, page.

    The docstrings of the methods are the OpenAPI description. TLS is on if a certificate is
    configured. Raises OSError or ConfigError if it cannot listen at the configured address, cannot
    read a file, or the file of the token is bad.
    """

    def __init__(self, service: Service) -> None:
        self._service, self._plugin = service, service.plugin
        config = service.config.serve
        file = config.token_file
        self.token = read_secret(file) if file else secrets.token_urlsafe(24)
        """Token of clients."""
        self.view_token = view_token(self.token)
        """Token of clients that only read."""
        self._feed = LiveFeed(lambda: state_moment(service), config.request_timeout_s)
        super().__init__(
            self._app(),
            config,
            config.http_port or 0,
            pages=True,
            ws="websockets-sansio",
            ws_max_size=REQUEST_BYTES,
            ws_per_message_deflate=False,  # on a local network it costs more than it saves
            ssl_certfile=config.tls_certificate or None,
            ssl_keyfile=config.tls_key or None,
        )

    def _app(self) -> FastAPI:
        service = self._service
        codes = (400, 401, 403, 404, 405, 409, 413, 422, 500)
        refusals: dict[int | str, Any] = {code: {"model": RefusalBody} for code in codes}
        app = FastAPI(
            title="tactile-cell",
            version=service.version,
            docs_url=None,
            redoc_url=None,
            responses=refusals,
        )
        for kind in (*EXPECTED_ERRORS, OSError, StarletteHTTPException, RequestValidationError):
            app.add_exception_handler(kind, _refused)
        app.add_exception_handler(Exception, _refused)
        allowed = [Depends(self.authorize)]
        router = APIRouter(prefix="/api", dependencies=allowed)
        paths: tuple[tuple[str, str, Callable[..., Any]], ...] = (
            ("/info", "GET", self.info),
            ("/state", "GET", self.state),
            ("/history", "GET", self.history),
            ("/faults", "GET", self.faults),
            ("/grasps/{number}", "GET", self.grasp),
            ("/jobs", "GET", self.jobs),
            ("/jobs/{number}", "GET", self.job),
            ("/taught", "GET", self.taught),
            ("/taught/{label:path}", "DELETE", self.forget),
            ("/jobs", "POST", self.start),
            ("/commands", "POST", self.command),
            ("/pose", "POST", self.pose),
        )
        if service.config.simulated:
            paths += (
                ("/simulation/faults", "GET", self.simulated_faults),
                ("/simulation/faults", "POST", self.begin_fault),
                ("/simulation/faults", "DELETE", self.end_fault),
                ("/simulation/part", "GET", self.simulated_part),
                ("/simulation/part", "POST", self.choose_part),
                ("/simulation/reset", "POST", self.reset_simulation),
            )
        paths += (
            ("/access", "GET", self.access),
            ("/lease", "POST", self.acquire),
            ("/lease/{lease}/alive", "POST", self.alive),
            ("/lease/{lease}", "DELETE", self.give_up),
        )
        for path, method, call in paths:
            router.add_api_route(path, call, methods=[method])
        app.include_router(router)
        app.add_api_websocket_route("/api/live", self.live)
        app.add_api_route("/api/hold", self.hold, methods=["POST"])
        app.add_api_route("/healthz", self.healthz, methods=["GET"])
        app.add_api_route("/healthz", self.healthz, methods=["HEAD"], include_in_schema=False)
        app.add_api_route("/metrics", self.metrics, methods=["GET"], dependencies=allowed)
        mount_page(app)
        return app

    def authorize(
        self,
        bearer: Annotated[HTTPAuthorizationCredentials, Depends(HTTPBearer())],
        request: Request,
    ) -> None:
        """Raise HTTPException or NotInCommand if the token does not permit the request."""
        if not self._may_read(bearer.credentials):
            raise HTTPException(401, "wrong token", {"WWW-Authenticate": "Bearer"})
        request.state.commands = same_secret(bearer.credentials, self.token)
        if request.method != "GET" and not request.state.commands:
            raise NotInCommand(
                "this token is view only: open the page with the address that `serve` prints "
                "after `page`"
            )

    def _may_read(self, token: str) -> bool:
        return any(same_secret(token, secret) for secret in (self.token, self.view_token))

    def access(self, request: Request) -> dict[str, Any]:
        """Return whether this token commands, and the view-only link for a second person.

        ``qr`` has the rows of its QR code, 1 for dark. ``note`` has the settings to change if no
        other machine reaches the link.
        """
        address = page_address(
            {"http_port": self.port, "token": self.view_token}, self._service.config.serve
        )
        return {
            "commands": request.state.commands,
            "address": address,
            "note": view_note(self._service.config.serve),
            "qr": ["".join(map(str, row)) for row in qr_code(address or "").matrix],
        }

    def acquire(self, body: AcquireBody, request: Request) -> dict[str, int]:
        """Acquire the lease for commands."""
        if body.take and not (request.client and is_loopback(request.client.host)):
            raise NotInCommand("only a client on this machine can take the lease from another")
        return {"lease": self._service.lease.acquire(body.name, take=body.take)}

    def alive(self, lease: int) -> dict[str, int]:
        """Keep the lease."""
        self._service.lease.alive(lease)
        return {"lease": lease}

    def give_up(self, lease: int) -> dict[str, int]:
        """Give the lease up; a running job is put on hold."""
        self._service.lease.give_up(lease)
        return {"lease": 0}

    async def live(self, link: WebSocket) -> None:
        """Send the state as JSON, with ``?frames=1`` the newest counts too, uint16, little-endian.

        ``?frames=newtons``: the force on each taxel in N, float32, little-endian.
        ``?parts_after=N``: each part with a higher number, once, as ``{"event": "part", ...}``. N
        counts from the start of the program whose ``boot`` of `info` is given: ``&boot=B``.

        The token is a subprotocol ``token.TOKEN`` beside ``tactile-cell``, or ``?token=``. A slow
        client skips messages and gets the newest.
        """
        offered = link.scope.get("subprotocols", [])
        chosen = _SUBPROTOCOL if _SUBPROTOCOL in offered else None
        tokens = [name.removeprefix("token.") for name in offered if name.startswith("token.")]
        tokens += link.query_params.getlist("token")
        if not any(map(self._may_read, tokens)):
            await link.close(1008, "wrong token")
            return
        await link.accept(chosen)
        try:
            after = link.query_params.get("parts_after", "")[:20]
            if after and not after.isdecimal():
                await link.close(1008, "parts_after is not a part number")
                return
            boot = str(self._service.boot)
            if after and link.query_params.get("boot", boot) != boot:
                after = "0"
            frames = link.query_params.get("frames", "")
            await self._feed.send_to(link, frames, int(after) if after else None)
        except (WebSocketDisconnect, TimeoutError, RuntimeError):
            return  # the client is gone, or takes nothing

    def healthz(self) -> JSONResponse:
        """Whether the service works; needs no token. 503: its ``problem`` has the reason.

        With a fault the answer is 200 with the number of the fault: a restart does not help.
        """
        status, problem = self._plugin.status(), self._service.problem
        body = {
            "working": not problem,
            "problem": problem,
            "state": status.state,
            "fault_number": status.fault_number,
            "holding": status.holding,
        }
        return JSONResponse(body, 503 if problem else 200)

    def metrics(self) -> Response:
        """Metrics for Prometheus; the token is the bearer."""
        return Response(metrics_text(self._service), media_type=CONTENT_TYPE)

    def info(self) -> dict[str, Any]:
        """Name, mode, version, boot, pads, limits, forces, taught objects, labels by id, places."""
        return self._plugin.info() | {
            "mode": "cell",
            "version": self._service.version,
            "boot": self._service.boot,
            "lease_timeout_s": self._service.config.serve.lease_timeout_s,
            "objects": self.taught(),
        }

    def state(self) -> dict[str, Any]:
        """States, newest job, last answer, live values (null: not measured), awaited pose.

        ``allowed`` has null for each task and command that the client in command may start.
        """
        return state_values(self._service)

    def history(self, day: date | None = None) -> dict[str, Any]:
        """Return the sums of today, yesterday and this week, and the confused objects.

        With a ``day``, for example 2027-01-15, its ``rows``: each start, part, miss and fault.
        """
        history = self._service.history
        return dict(plain_data(history.values() if day is None else {"rows": history.day(day)}))

    def faults(self) -> list[dict[str, Any]]:
        """List the fault catalogue: number, text, cause, remedy, state of the grip, steps."""
        return [asdict(fault) for fault in sorted(CATALOGUE.values(), key=lambda row: row.number)]

    def grasp(self, number: int) -> Mapping[str, Any]:
        """Return the curves of the last grasp of a part by its number in ``shift.answers``.

        ``frame`` has the force in N on each taxel under the highest load.
        """
        curves = self._service.shift.curves(number)
        if curves is None:
            raise NotThere(f"grasp {number} is not stored", "grasp")
        return curves

    def jobs(self) -> list[dict[str, Any]]:
        """List the newest jobs, oldest first."""
        return list(plain_data(self._plugin.jobs()))

    def job(self, number: int) -> dict[str, Any]:
        """One job: outcome, progress, answer."""
        try:
            values: dict[str, Any] = plain_data(self._plugin.job(number))
        except RequestRefused as error:
            raise NotThere(str(error), "job") from error
        return values

    def taught(self) -> list[dict[str, Any]]:
        """List the taught objects: stored grasps, shape and size in mm."""
        return list(plain_data(self._plugin.taught()))

    def forget(self, label: str, lease: int, last: bool = False, job: int = 0) -> dict[str, int]:
        """Start to delete a taught object, or with ``last=true`` its newest grasp.

        It is deleted when the job has succeeded.
        """
        start = partial(self._plugin.forget, label, last=last)
        given = {"label": label, "last": last}
        return {"job": self._service.begin(lease, "forget", start, number=job, given=given)}

    def start(
        self, body: Annotated[StartBody, Body(openapi_examples=JOB_EXAMPLES)]
    ) -> dict[str, int]:
        """Start a job."""
        return {"job": self._service.start(body.lease, body.goal, number=body.job)}

    def command(self, body: CommandBody) -> dict[str, int]:
        """Start to release the part (it may fall), to clear, to reset or to shut down.

        ``forget_drift`` discards the estimated drift, for example after work on the sensors.
        """
        lease, name, number = body.lease, body.command, body.job
        if name == "forget_drift":
            start = self._plugin.forget_drift
            return {"job": self._service.begin(lease, name, start, number=number)}
        given = {"key": body.key, "reboot": body.reboot}
        return {"job": self._service.request(lease, name, number=number, **given)}

    def pose(self, body: PoseBody) -> dict[str, int]:
        """Answer the awaited pose."""
        self._service.pose_reached(body.lease, body.seq, ok=body.ok, pose=body.pose)
        return {"seq": body.seq}

    def simulated_faults(self) -> dict[str, Any]:
        """List the possible faults of this simulated cell, and the active faults.

        A fault is a text ``NAME[=VALUE][@START[..END]]``; a waiting fault has not begun.
        """
        injected = self._plugin.simulate({"state": True})["faults"]
        running = [
            {"fault": text, "begun": began_s is not None} for text, began_s in injected.items()
        ]
        return self._plugin.simulate({"kinds": True}) | {"running": running}

    def begin_fault(self, body: FaultBody) -> dict[str, Any]:
        """Begin a fault of the simulated cell; it needs no lease. Returns the same as GET."""
        return self._simulate_fault("inject", body.fault)

    def end_fault(self, fault: str) -> dict[str, Any]:
        """End the faults with this text or name, also those of `serve --fault`."""
        return self._simulate_fault("clear", fault)

    def _simulate_fault(self, act: str, fault: str) -> dict[str, Any]:
        self._plugin.simulate({act: fault})
        self._plugin.remark("simulation", f"{act} {fault}")
        return self.simulated_faults()

    def simulated_part(self) -> dict[str, Any]:
        """Return the chosen part and its pose, the part between the fingers, and all objects."""
        state = self._plugin.simulate({"state": True})
        pose = {name: state["offset"][name] for name in asdict(Pose())}
        chosen = {name: state[name] for name in ("placed", "objects")}
        return {"part": self._service.chosen_part, "pose": pose} | chosen

    def choose_part(self, body: PartBody) -> dict[str, Any]:
        """Put a part between the open fingers, for all jobs from now on. Returns the same as GET.

        Release a part in the grip first: it cannot be replaced.
        """
        self._service.choose_part(body.lease, body.part, body.pose)
        return self.simulated_part()

    def reset_simulation(self, body: LeasedBody) -> dict[str, int]:
        """Start to reset the simulated cell: faults end, the part is released and removed."""
        start = self._plugin.begin_simulation_reset
        return {"job": self._service.begin(body.lease, "simulation_reset", start)}

    def hold(
        self,
        request: Request,
        latch: Annotated[bool | str | None, Query(union_mode="left_to_right")] = None,
        name: str = "",
    ) -> dict[str, Any]:
        """Stop the running job and keep the grip; needs no token and no lease.

        After ``latch=true`` no motion starts until the same client, by address and name, sends
        ``latch=false``. A pressed button repeats it within each serve.lease_timeout_s. Another
        ``latch`` stops once, and is refused.
        """
        host = "" if request.client is None else request.client.host
        latched = None if isinstance(latch, str) else latch
        self._service.stop_as(f"HTTP {host} {name[:60]}".rstrip(), latched)
        if isinstance(latch, str):
            raise RequestRefused(f"latch is {latch!r:.40}: write true or false; it stopped once")
        return {"state": self._plugin.status().state, "held_by": self._service.held_by}


def _refused(_request: Request, error: Exception) -> JSONResponse:
    """Return a refusal in the common form: number, text, remedy."""
    match error:
        case NotThere():
            return refusal(404, str(error), error.remedy)
        case StarletteHTTPException():
            cause = _CAUSES.get(error.status_code)
            remedy = CATALOGUE[RequestRefused].remedy if cause is None else REMEDIES[cause]
            return refusal(error.status_code, str(error.detail), remedy, error.headers)
        case RequestValidationError():
            return refusal(422, complaints(error.errors()), CATALOGUE[RequestRefused].remedy)
    status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), 500)
    why = Refusal.of(error)
    body = {"fault_number": why.number, "error": why.text, "remedy": why.remedy}
    return JSONResponse(body, status)
