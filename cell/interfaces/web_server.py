"""Server of web pages and their API: who is let in, tokens, the lease, limits of time and size.

A door (`cell.interfaces.web`, `cell.interfaces.wizard`) gives it an application; what is refused
has one shape, with a fault number.
"""

import asyncio
import json
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from functools import partial
from ipaddress import ip_address
from typing import Annotated, Any, Protocol

import uvicorn
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from cell.config.serve import ServeConfig
from cell.errors import (
    CellError,
    CellStateError,
    ConfigError,
    HeldByClient,
    NotInCommand,
    RequestRefused,
)
from cell.fault_catalogue import BY_NUMBER, Refusal
from cell.interfaces.live_socket import LiveFeed, LiveLink, Moment
from cell.interfaces.service.doors import (
    BUSY_MAX,
    Places,
    is_for_this_machine,
    may_connect,
    notice_dead_peers,
    read_secret,
    same_secret,
)
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
Paths = tuple[tuple[str, str, Callable[..., Any]], ...]
"""Path below ``/api``, method and call of each."""


class RequestBody(BaseModel):
    """Body of a request; a field that it does not have is refused."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class AcquireBody(RequestBody):
    """Who wants to command; ``take`` takes it from another client, at this machine only."""

    name: str
    take: bool = False


class RefusalBody(RequestBody):
    """What is refused, in one shape for all paths."""

    fault_number: int
    """Number in the fault catalogue, `GET /api/faults`."""
    error: str
    """Cause, with value and limit."""
    remedy: str
    """What to do next."""


class Leased(Protocol):
    """What clients command under a lease."""

    def acquire(self, name: str, *, take: bool = False) -> int:
        """Return the number of a new lease; raises NotInCommand while another client has it."""

    def alive(self, lease: int) -> None:
        """Keep the lease; raises NotInCommand if it is lost."""

    def give_up(self, lease: int) -> None:
        """Give the lease up; raises NotInCommand if it is lost."""


class GuardedApi:
    """Paths below ``/api`` that all doors have: the token, the live state and the lease.

    The first lines of the methods are the OpenAPI description.

    Parameters
    ----------
    leased
        Who gives the lease.
    config
        Limits of time, and the file of the token.
    look
        Returns what a WebSocket shows now; called in another thread than that of the connections.

    Attributes
    ----------
    token
        What clients authenticate with.

    Raises
    ------
    OSError, ConfigError
        If the file of the token cannot be read, or holds none.
    """

    def __init__(self, leased: Leased, config: ServeConfig, look: Callable[[], Moment]) -> None:
        file = config.token_file
        self.token = read_secret(file) if file else secrets.token_urlsafe(24)
        self._leased = leased
        self._request_timeout_s = config.request_timeout_s
        self._feed = LiveFeed(look)

    def guarded(self, paths: Paths) -> FastAPI:
        """Return an application with these paths and those of the lease, which need the token."""
        refusals: dict[int | str, dict[str, Any]] = {
            status: {"model": RefusalBody} for status in (401, 403, 404, 409, 413, 422, 500)
        }
        app = FastAPI(title="tactile-cell", docs_url=None, redoc_url=None, responses=refusals)
        for kind in (StarletteHTTPException, RequestValidationError, *_ERRORS, Exception):
            app.add_exception_handler(kind, _refused)
        router = APIRouter(prefix="/api", dependencies=[Depends(self._authorize)])
        lease: Paths = (
            ("/lease", "POST", self.acquire),
            ("/lease/{lease}/alive", "POST", self.alive),
            ("/lease/{lease}", "DELETE", self.give_up),
        )
        for path, method, call in (*paths, *lease):
            router.add_api_route(path, call, methods=[method])
        app.include_router(router)
        app.add_api_websocket_route("/api/live", self.live)
        return app

    def _authorize(
        self, found: Annotated[HTTPAuthorizationCredentials, Depends(HTTPBearer())]
    ) -> None:
        if not same_secret(found.credentials, self.token):
            raise HTTPException(401, "wrong token")

    def acquire(self, body: AcquireBody, request: Request) -> dict[str, int]:
        """Acquire the lease to command with."""
        if body.take and not is_here(request):
            raise NotInCommand("the lease can be taken from another client at this machine only")
        return {"lease": self._leased.acquire(body.name, take=body.take)}

    def alive(self, lease: int) -> dict[str, int]:
        """Keep the lease."""
        self._leased.alive(lease)
        return {"lease": lease}

    def give_up(self, lease: int) -> dict[str, int]:
        """Give the lease up; a job that runs is held."""
        self._leased.give_up(lease)
        return {"lease": 0}

    async def live(self, link: WebSocket) -> None:
        """Send the state as JSON, with ``?frames=1`` the newest counts too, uint16, little-endian.

        ``?frames=newtons``: the force on each taxel in N, float32, little-endian.

        The token is a subprotocol ``token.TOKEN`` beside ``tactile-cell``, or ``?token=``, or the
        first message ``{"token": TOKEN}``. Each message is the newest there is when the client can
        take it: a slow one misses some.
        """
        offered = link.scope.get("subprotocols", [])
        chosen = _SUBPROTOCOL if _SUBPROTOCOL in offered else None
        tokens = [one.removeprefix("token.") for one in offered if one.startswith("token.")]
        tokens += link.query_params.getlist("token")
        if tokens and not any(same_secret(token, self.token) for token in tokens):
            await link.close(1008, "wrong token")
            return
        await link.accept(chosen)
        try:
            if not tokens:
                async with asyncio.timeout(self._request_timeout_s):
                    first = await link.receive_text()
                if not same_secret(_token_of(first), self.token):
                    await link.close(1008, "wrong token")
                    return
            await self._feed.send_to(link, link.query_params.get("frames", ""))
        except (WebSocketDisconnect, TimeoutError, RuntimeError, KeyError):
            return  # the client is gone, takes nothing, or has not named its token


def is_here(request: Request) -> bool:
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
    config
        Has the allow-list.
    longest
        Returns the largest body in bytes of a request from a client.
    """

    def __init__(self, app: Any, config: ServeConfig, longest: Callable[[Scope, str], int]) -> None:
        self._app = app
        self._config = config
        self._longest = longest

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
        config = self._config
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


class WebServer:
    """An application behind the gate, at the configured address and port, in a thread of its own.

    Parameters
    ----------
    app
        The application.
    config
        Address, port, allow-list, limits and certificate.
    longest
        Returns the largest body in bytes of a request from a client.

    Raises
    ------
    OSError
        If it cannot listen at the configured address and port, or a file cannot be read.
    """

    def __init__(
        self,
        app: FastAPI,
        config: ServeConfig,
        longest: Callable[[Scope, str], int] = lambda _scope, _client: LONGEST,
    ) -> None:
        places = Places[asyncio.Transport](
            lambda link: link.abort(), lambda link: link.is_closing()
        )
        settings = uvicorn.Config(
            Gate(app, config, longest),
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
