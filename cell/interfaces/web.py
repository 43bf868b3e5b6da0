"""HTTP and WebSocket: the door for everything else, with an OpenAPI description.

Needs the extra ``serve``. Reading and commanding need the token; `hold` needs none. A page from
elsewhere is refused by its Origin. JSON in and out; what is refused has a fault number.
"""

import asyncio
import json
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import asdict
from functools import cached_property, partial
from ipaddress import ip_address
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Annotated, Any, Literal
from urllib.parse import quote

import uvicorn
from fastapi import APIRouter, Body, Depends, FastAPI, HTTPException, Query, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from cell.control.plan import Pose
from cell.control.states import Command
from cell.errors import (
    CellError,
    CellStateError,
    ConfigError,
    HeldByClient,
    NotInCommand,
    RecordingError,
    RequestRefused,
)
from cell.fault_catalogue import BY_NUMBER, CATALOGUE, Refusal
from cell.interfaces.live_socket import LiveFeed, LiveLink
from cell.interfaces.page import mount_page
from cell.interfaces.plugin.goals import goal_schema
from cell.interfaces.service.doors import (
    BUSY_MAX,
    Places,
    is_for_this_machine,
    may_connect,
    notice_dead_peers,
    read_secret,
    same_secret,
)
from cell.interfaces.service.photos import LONGEST_PHOTO
from cell.interfaces.service.replay import UPLOAD_BYTES, Replay
from cell.interfaces.service.service import Service
from cell.interfaces.service.state import plain, state_values
from gripper.errors import GripperError
from tactile.errors import TactileError

LONGEST = 65536
"""Largest request in bytes, without a photo."""
_ACCEPTED_AT_ONCE = BUSY_MAX // 4
"""Connections that are accepted before those that are there are read again."""
_WAITING_MAX = 256
"""Connections that wait until they are accepted; for a further one the system asks again later."""
_SUBPROTOCOL = "tactile-cell"
"""Subprotocol of the WebSocket."""
_STATUS = {
    NotInCommand: 403,
    CellStateError: 409,
    HeldByClient: 409,
    RequestRefused: 422,
    ConfigError: 422,
}
"""HTTP status of refusals; 500 for all others."""
_ERRORS = (CellError, GripperError, TactileError, OSError)
"""Errors that leave the cell on purpose."""
_REMEDIES = {
    401: "Send the token that `serve` has printed, as `Authorization: Bearer TOKEN`.",
    403: "Use an address, name and origin that `serve.allow` and `serve.hosts` have.",
    404: "Read the paths in /openapi.json, and the numbers in GET /api/jobs.",
    405: "Read the methods of each path in /openapi.json.",
    413: "Send less.",
}
"""What to do about refusals that do not come from the cell."""

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


Finite = Annotated[float, Field(allow_inf_nan=False)]
"""A number in a request."""


JOB_EXAMPLES: dict[str, Any] = {
    task: {"summary": summary, "value": {"lease": 1, "goal": {"task": task} | fields}}
    for task, summary, fields in (
        ("teach", "Grasp a known object ten times.", {"label": "bolt", "grasps": 10}),
        ("gauge", "Measure the drift since teaching on a taught object.", {"label": "bolt"}),
        ("identify", "Name a part and keep it in the grip.", {"keep": "always"}),
        ("grip", "Grip a part with 3 N and keep it, without a name.", {"force_n": 3.0}),
        ("verify", "Measure whether the kept part is still the one.", {}),
        ("sort", "Name 20 parts and let each go at its place.", {"parts": 20}),
    )
}
"""Examples of `POST /api/jobs` in the description."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class AcquireBody(_Body):
    """Who wants to command; ``take`` takes it from another client, at this machine only."""

    name: str
    take: bool = False


class LeaseBody(_Body):
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


class ReplayBody(_Body):
    """To pause or go on; seconds of the recording in a real one; number of a grasp, from 1."""

    pause: bool | None = None
    speed: Finite | None = None
    grasp: int | None = None


class PoseFields(_Body):
    """Pose of the object in the grip frame."""

    x_m: Finite = 0.0
    """Offset of its centre along the fingers in m."""
    y_m: Finite = 0.0
    """Offset of its centre across the fingers in m."""
    rotation_rad: Finite = 0.0
    """Turn about the closing axis in rad."""
    roll_rad: Finite = 0.0
    """Turn about the object's own long axis in rad, before the rotation."""


class RefusalBody(_Body):
    """What is refused, in one shape for all paths."""

    fault_number: int
    """Number in the fault catalogue, `GET /api/faults`."""
    error: str
    """Cause, with value and limit."""
    remedy: str
    """What to do next."""


class PoseBody(_Body):
    """Whether the pose of that number was reached, or the one (m, rad) reached instead."""

    lease: int
    seq: int
    ok: bool
    pose: PoseFields | None = None


def taught_values(one: dict[str, Any]) -> dict[str, Any]:
    """Return a taught object with the address of its photo, null for none."""
    address = f"/api/taught/{quote(one['label'], safe='')}/photo"
    found: dict[str, Any] = plain(one | {"photo": address if one["photo"] else None})
    return found


class StateMoment:
    """State and newest frame of a service at one moment; implements `live_socket.Moment`."""

    def __init__(self, service: Service) -> None:
        self.text = json.dumps(state_values(service), allow_nan=False)
        self._service = service

    def frame(self, kind: str) -> bytes | None:
        """Return counts (``1``) or ``newtons`` of the taxels as bytes; None for other kinds."""
        if kind == "newtons":
            return self._newtons
        counts = self._service.status().live.counts if kind == "1" else None
        return None if counts is None else counts.astype("<u2").tobytes()

    @cached_property
    def _newtons(self) -> bytes | None:
        force_n = self._service.frame_n()
        return None if force_n is None else force_n.astype("<f4").tobytes()


class Api:
    """The paths below ``/api``; the first lines of the methods are the OpenAPI description.

    Parameters
    ----------
    service
        The cell.
    token
        What clients authenticate with.
    """

    def __init__(self, service: Service, token: str) -> None:
        self._service = service
        self._token = token
        self._feed = LiveFeed(lambda: StateMoment(service))

    def app(self) -> FastAPI:
        """Return the application."""
        refusals: dict[int | str, dict[str, Any]] = {
            status: {"model": RefusalBody} for status in (401, 403, 404, 409, 413, 422, 500)
        }
        app = FastAPI(title="tactile-cell", docs_url=None, redoc_url=None, responses=refusals)
        for kind in (StarletteHTTPException, RequestValidationError, *_ERRORS, Exception):
            app.add_exception_handler(kind, _refused)
        guarded = APIRouter(prefix="/api", dependencies=[Depends(self._authorize)])
        for path, method, call in (
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
            ("/lease", "POST", self.acquire),
            ("/lease/{lease}/alive", "POST", self.alive),
            ("/lease/{lease}", "DELETE", self.give_up),
            ("/jobs", "POST", self.start),
            ("/commands", "POST", self.command),
            ("/pose", "POST", self.pose),
        ):
            guarded.add_api_route(path, call, methods=[method])
        if self._service.replay is not None:
            guarded.add_api_route("/replay", self.control_replay, methods=["POST"])
            guarded.add_api_route("/replay", self.load_replay, methods=["PUT"])
        app.include_router(guarded)
        app.add_api_route("/api/hold", self.hold, methods=["POST"])
        app.add_api_websocket_route("/api/live", self.live)
        mount_page(app)
        return app

    def _authorize(
        self, found: Annotated[HTTPAuthorizationCredentials, Depends(HTTPBearer())]
    ) -> None:
        if not same_secret(found.credentials, self._token):
            raise HTTPException(401, "wrong token")

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
        """Return the curves of the last grasp of an answer by its id in ``shift.answers``.

        ``frame`` has the force in N on each taxel under the highest load.
        """
        found = self._service.shift.grasp(number)
        if found is None:
            raise HTTPException(404, f"grasp {number} is not kept; GET /api/state has the ids")
        return found

    def jobs(self) -> list[dict[str, Any]]:
        """List the newest jobs, oldest first."""
        return [plain(asdict(job)) for job in self._service.jobs()]

    def job(self, number: int) -> dict[str, Any]:
        """One job: outcome, progress, answer."""
        try:
            found: dict[str, Any] = plain(asdict(self._service.job(number)))
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

    def acquire(self, body: AcquireBody, request: Request) -> dict[str, int]:
        """Acquire the lease to command with."""
        if body.take and not _is_here(request):
            raise NotInCommand("the lease can be taken from another client at this machine only")
        return {"lease": self._service.acquire(body.name, take=body.take)}

    def alive(self, lease: int) -> dict[str, int]:
        """Keep the lease."""
        self._service.alive(lease)
        return {"lease": lease}

    def give_up(self, lease: int) -> dict[str, int]:
        """Give the lease up; a job that runs is held."""
        self._service.give_up(lease)
        return {"lease": 0}

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

    def control_replay(self, body: ReplayBody) -> dict[str, Any]:
        """Pause the replay, set its speed, or go to a grasp; all clients see the same."""
        self._replay.control(**body.model_dump())
        return self._replay.values()

    async def load_replay(self, request: Request) -> dict[str, Any]:
        """Play the recording in the body instead, from this machine only."""
        if not _is_here(request):
            raise NotInCommand("a recording is taken from this machine only")
        with NamedTemporaryFile(suffix=".mcap") as file:
            async for piece in request.stream():
                file.write(piece)
            file.flush()
            try:
                await asyncio.to_thread(self._replay.load, Path(file.name), "the recording sent")
            except RecordingError as error:
                text = str(error).replace(file.name, "the file")
                raise RequestRefused(f"this cannot be played: {text}") from error
        return self._replay.values()

    @property
    def _replay(self) -> Replay:
        if self._service.replay is None:  # its paths are there with a replay only
            raise RequestRefused("this is a cell, no replay")
        return self._service.replay

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

    async def live(self, link: WebSocket) -> None:
        """Send the state as JSON, with ``?frames=1`` the newest counts too, uint16, little-endian.

        ``?frames=newtons``: the force on each taxel in N, float32, little-endian.

        The token is a subprotocol ``token.TOKEN`` beside ``tactile-cell``, or ``?token=``, or the
        first message ``{"token": TOKEN}``. Each message is the newest there is when the client can
        take it: a slow one misses some.
        """
        serve = self._service.config.serve
        offered = link.scope.get("subprotocols", [])
        chosen = _SUBPROTOCOL if _SUBPROTOCOL in offered else None
        tokens = [one.removeprefix("token.") for one in offered if one.startswith("token.")]
        tokens += link.query_params.getlist("token")
        if tokens and not any(same_secret(token, self._token) for token in tokens):
            await link.close(1008, "wrong token")
            return
        await link.accept(chosen)
        try:
            if not tokens:
                async with asyncio.timeout(serve.request_timeout_s):
                    first = await link.receive_text()
                if not same_secret(_token_of(first), self._token):
                    await link.close(1008, "wrong token")
                    return
            await self._feed.send_to(link, link.query_params.get("frames", ""))
        except (WebSocketDisconnect, TimeoutError, RuntimeError, KeyError):
            return  # the client is gone, takes nothing, or has not named its token


def _is_here(request: Request) -> bool:
    """Whether a request comes from this machine."""
    return request.client is not None and ip_address(request.client.host).is_loopback


def _token_of(message: str) -> str:
    """Return the token in the first message of a WebSocket; empty where there is none."""
    try:
        found = json.loads(message)["token"]
    except (ValueError, KeyError, TypeError):
        return ""
    return found if isinstance(found, str) else ""


def _refused(_request: Request, error: Exception) -> JSONResponse:
    """Return a refusal in the one shape of all refusals: number, text, remedy."""
    match error:
        case StarletteHTTPException():
            return refusal_answer(error.status_code, str(error.detail))
        case RequestValidationError():
            complaints = "; ".join(
                f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()
            )
            return refusal_answer(422, complaints)
    status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), 500)
    refusal = Refusal.of(error)
    return _answer(status, refusal.number, refusal.text, refusal.remedy)


def refusal_answer(status: int, text: str) -> JSONResponse:
    """Return the refusal of a request that has not reached the cell."""
    number = 514 if status == 401 else 513
    return _answer(status, number, text, _REMEDIES.get(status) or BY_NUMBER[number].remedy)


def _answer(status: int, number: int, text: str, remedy: str) -> JSONResponse:
    return JSONResponse({"fault_number": number, "error": text, "remedy": remedy}, status)


class Gate:
    """ASGI middleware: refuses clients, names, origins and sizes before anything is read.

    Parameters
    ----------
    app
        The application behind.
    service
        Has the allow-list.
    """

    def __init__(self, app: Any, service: Service) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Pass a request on, or answer 403 or 413."""
        listened = scope["type"] in ("http", "websocket")
        status, reason = self._refusal(scope) if listened else (0, "")
        if not status:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            await refusal_answer(status, reason)(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        client, reached = scope.get("client"), scope.get("server")
        config = self._service.config.serve
        if client is None or reached is None or not may_connect(client[0], config):
            return 403, "this client is not in serve.allow"
        if not is_for_this_machine(hosts, reached[0], config):
            return 403, f"Host {', '.join(hosts)!r:.80} is not this machine; serve.hosts adds names"
        origin = headers.get(b"origin")
        if origin is not None and origin.partition("://")[2] != headers.get(b"host"):
            return 403, f"a page of another origin, {origin!r:.80}"
        length = headers.get(b"content-length", "0")
        longest = self._longest(scope, client[0])
        if b"transfer-encoding" in headers or not length.isdecimal() or int(length) > longest:
            return 413, f"a request has a Content-Length of at most {longest}"
        return 0, ""

    def _longest(self, scope: Scope, client: str) -> int:
        """Return the most bytes of a body: more for a photo, and for a recording to a replay."""
        if scope.get("method") == "PUT" and scope["path"].endswith("/photo"):
            return LONGEST_PHOTO
        sends = (scope.get("method"), scope["path"]) == ("PUT", "/api/replay")
        taken = sends and self._service.replay is not None and ip_address(client).is_loopback
        return UPLOAD_BYTES if taken else LONGEST


class Connection(H11Protocol):
    """A connection that has a place at the door, and whose requests have a limit of time.

    Parameters
    ----------
    places
        Those of the door.
    limit_s
        Longest time in s from the first to the last byte of a request; a new connection has as much
        for its first one. What the cell takes for the answer does not count.
    """

    def __init__(self, places: Places[asyncio.Transport], limit_s: float, **server: Any) -> None:
        super().__init__(**server)
        self._places = places
        self._limit_s = limit_s
        self._limit: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin."""
        super().connection_made(transport)
        notice_dead_peers(transport.get_extra_info("socket"))
        self._places.enter(transport, (transport.get_extra_info("peername") or ("",))[0])
        self._begin()

    def data_received(self, data: bytes) -> None:
        """Take bytes, the first ones of a request too."""
        self._begin()
        super().data_received(data)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Hand the connection on; the limits of a WebSocket are those of its messages."""
        self._end()
        super().handle_websocket_upgrade(event)

    def handle_events(self) -> None:
        """Take what has come of requests; one that is whole keeps its place until its answer."""
        super().handle_events()
        cycle = self.cycle
        if cycle is not None and not (cycle.more_body or cycle.response_complete):
            self._end()

    def on_response_complete(self) -> None:
        """Go on to the next request, of which bytes may be there already."""
        super().on_response_complete()
        if self.conn.trailing_data[0]:
            self._begin()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no request, in the shape of all refusals."""
        self.transport.write(_NO_REQUEST)
        self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._end()
        super().connection_lost(exc)

    def _begin(self) -> None:
        if self._limit is None:
            self._limit = self.loop.call_later(self._limit_s, self.transport.abort)

    def _end(self) -> None:
        self._places.heard(self.transport)
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None


_REASON = bytes(refusal_answer(400, "this is no HTTP request").body)
_NO_REQUEST = (
    b"HTTP/1.1 400 Bad Request\r\nContent-Type: application/json\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(_REASON), _REASON)
)


class _Listener(socket.socket):
    """A socket at which many connections may wait, however few the server accepts at once.

    asyncio takes one number for both. Connections that are accepted in one go before any of them is
    read could take all places, and with them that of a hold.
    """

    def listen(self, _accepted_at_once: int = 0) -> None:
        """Let as many connections wait as are dealt with in some tenths of a second."""
        super().listen(_WAITING_MAX)


class WebDoor:
    """The cell behind HTTP and WebSocket.

    Parameters
    ----------
    service
        The cell.

    Raises
    ------
    OSError
        If it cannot listen at the configured address and port, or a file cannot be read.
    """

    def __init__(self, service: Service) -> None:
        config = service.config.serve
        places = Places[asyncio.Transport](
            lambda link: link.abort(), lambda link: link.is_closing()
        )
        file = config.token_file
        self.token = read_secret(file) if file else secrets.token_urlsafe(24)
        settings = uvicorn.Config(
            Gate(Api(service, self.token).app(), service),
            log_config=None,
            access_log=False,
            lifespan="off",
            http=partial(Connection, places, config.request_timeout_s),  # type: ignore[arg-type]
            ws=partial(LiveLink, config.request_timeout_s),  # type: ignore[arg-type]
            ws_max_size=LONGEST,
            ws_per_message_deflate=False,  # on a local network it costs more than it saves
            timeout_graceful_shutdown=1,
            backlog=_ACCEPTED_AT_ONCE,
            ssl_certfile=config.tls_certificate or None,
            ssl_keyfile=config.tls_key or None,
        )
        settings.load()  # certificates are read here, not in the thread
        family = socket.AF_INET6 if ":" in config.listen else socket.AF_INET
        with socket.create_server((config.listen, config.http_port or 0), family=family) as made:
            self._socket = _Listener(fileno=made.detach())
        # asyncio does so only where the protocol of the socket is named. Without it an answer waits
        # 40 ms for the client's delayed acknowledgement.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.port: int = self._socket.getsockname()[1]
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name="http", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End all connections and the thread."""
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()
