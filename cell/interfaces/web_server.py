"""Server of web pages and their API: token, lease, live socket.

Its interfaces (`cell.interfaces.web`, `cell.interfaces.wizard`) add their paths. All refusals have
the same form, with a fault number.
"""

import asyncio
import json
import secrets
from collections.abc import Callable
from ipaddress import ip_address
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.websockets import WebSocketDisconnect

from cell.config.serve import ServeConfig
from cell.errors import (
    CellError,
    CellStateError,
    ConfigError,
    HeldByClient,
    NotInCommand,
    RequestRefused,
)
from cell.fault_catalogue import Refusal
from cell.interfaces.access import read_secret, same_secret, view_token
from cell.interfaces.http_server import REQUEST_BYTES, HttpServer, Scope, refusal_values
from cell.interfaces.live_socket import LiveFeed, LiveMessage
from cell.interfaces.page import mount_page
from cell.interfaces.page_address import page_address, qr_code, view_note
from cell.plugin.lease import Lease
from gripper.errors import GripperError
from tactile.errors import TactileError

_SUBPROTOCOL = "tactile-cell"
"""Subprotocol of the WebSocket."""
_STATUS = {
    NotInCommand: 403,
    CellStateError: 409,
    HeldByClient: 409,
    RequestRefused: 422,
    ConfigError: 422,
}
"""HTTP status of refusals; 500 for all other errors."""
_ERRORS = (CellError, GripperError, TactileError, OSError)
"""Expected errors of the cell."""
Paths = tuple[tuple[str, str, Callable[..., Any]], ...]
"""Path below ``/api``, method and call of each."""


class RequestBody(BaseModel):
    """Body of a request; an unknown field is refused."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class LeasedBody(RequestBody):
    """A command under the lease."""

    lease: int


class AcquireBody(RequestBody):
    """Name of the new client in command; ``take``, on this machine only, takes the lease."""

    name: str
    take: bool = False


class RefusalBody(RequestBody):
    """A refusal, in the same form for all paths."""

    fault_number: int
    """Number in the fault catalogue, `GET /api/faults`."""
    error: str
    """Cause, with value and limit."""
    remedy: str
    """Remedy."""


class WebServer(HttpServer):
    """Serves a page and its API below ``/api``: token, lease, live state, further paths.

    The docstrings of the methods are the OpenAPI description. `hold` needs no token. TLS is on if a
    certificate is configured. Raises OSError or ConfigError if it cannot listen at the configured
    address and port, cannot read a file, or the file of the token is bad.

    Parameters
    ----------
    lease
        Lease of the client in command.
    config
        Address, port, allow-list, limits, certificate, and the file of the token.
    look
        Returns the state for a WebSocket; called in another thread than the connections.
    paths
        Further paths, which need the token.
    page
        File of the page.
    public
        Paths outside ``/api`` that need no token, or check it themselves.
    """

    hold: Callable[..., Any]
    """Stops the running job: the path ``/hold``."""

    def __init__(
        self,
        lease: Lease,
        config: ServeConfig,
        look: Callable[[], LiveMessage],
        paths: Paths,
        *,
        page: str = "index.html",
        public: Paths = (),
    ) -> None:
        file = config.token_file
        self.token = read_secret(file) if file else secrets.token_urlsafe(24)
        """Token of clients."""
        self.view_token = view_token(self.token)
        """Token of clients that only read."""
        self._config = config
        self._lease = lease
        self._request_timeout_s = config.request_timeout_s
        self._feed = LiveFeed(look, config.request_timeout_s)
        refusals: dict[int | str, dict[str, Any]] = {
            status: {"model": RefusalBody} for status in (401, 403, 404, 409, 413, 422, 500)
        }
        app = FastAPI(title="tactile-cell", docs_url=None, redoc_url=None, responses=refusals)
        for kind in (StarletteHTTPException, RequestValidationError, *_ERRORS, Exception):
            app.add_exception_handler(kind, _refused)
        router = APIRouter(prefix="/api", dependencies=[Depends(self.authorize)])
        leasing: Paths = (
            ("/access", "GET", self.access),
            ("/lease", "POST", self.acquire),
            ("/lease/{lease}/alive", "POST", self.alive),
            ("/lease/{lease}", "DELETE", self.give_up),
        )
        for path, method, call in (*paths, *leasing):
            router.add_api_route(path, call, methods=[method])
        app.include_router(router)
        app.add_api_websocket_route("/api/live", self.live)
        app.add_api_route("/api/hold", self.hold, methods=["POST"])
        for path, method, call in public:
            app.add_api_route(path, call, methods=[method])
        mount_page(app, page)
        super().__init__(
            app,
            config,
            config.http_port or 0,
            name="http",
            longest=self.longest,
            pages=True,
            ws="websockets-sansio",
            ws_max_size=REQUEST_BYTES,
            ws_per_message_deflate=False,  # on a local network it costs more than it saves
            ssl_certfile=config.tls_certificate or None,
            ssl_keyfile=config.tls_key or None,
        )

    def longest(self, scope: Scope) -> int:
        """Return the largest body in bytes of a request."""
        return REQUEST_BYTES

    def authorize(
        self,
        found: Annotated[HTTPAuthorizationCredentials, Depends(HTTPBearer())],
        request: Request,
    ) -> None:
        """Raise HTTPException or NotInCommand if the token does not permit the request."""
        if not self._may_read(found.credentials):
            raise HTTPException(401, "wrong token")
        request.state.commands = same_secret(found.credentials, self.token)
        if request.method != "GET" and not request.state.commands:
            raise NotInCommand(
                "this token is view only: open the page with the address that `serve` prints "
                "after `page`"
            )

    def _may_read(self, token: str) -> bool:
        return any(same_secret(token, one) for one in (self.token, self.view_token))

    def access(self, request: Request) -> dict[str, Any]:
        """Return whether this token commands, and the view-only link for a second person.

        ``qr`` has the rows of its QR code, 1 for dark. ``note`` has the settings to change if no
        other machine reaches the link.
        """
        address = page_address({"http_port": self.port, "token": self.view_token}, self._config)
        return {
            "commands": request.state.commands,
            "address": address,
            "note": view_note(self._config),
            "qr": ["".join(map(str, row)) for row in qr_code(address or "").matrix],
        }

    def acquire(self, body: AcquireBody, request: Request) -> dict[str, int]:
        """Acquire the lease for commands."""
        if body.take and not _is_here(request):
            raise NotInCommand("only a client on this machine can take the lease from another")
        return {"lease": self._lease.acquire(body.name, take=body.take)}

    def alive(self, lease: int) -> dict[str, int]:
        """Keep the lease."""
        self._lease.alive(lease)
        return {"lease": lease}

    def give_up(self, lease: int) -> dict[str, int]:
        """Give the lease up; a running job is put on hold."""
        self._lease.give_up(lease)
        return {"lease": 0}

    async def live(self, link: WebSocket) -> None:
        """Send the state as JSON, with ``?frames=1`` the newest counts too, uint16, little-endian.

        ``?frames=newtons``: the force on each taxel in N, float32, little-endian.
        ``?parts_after=N``: each part with a higher number, once, as ``{"event": "part", ...}``.

        The token is a subprotocol ``token.TOKEN`` beside ``tactile-cell``, or ``?token=``, or the
        first message ``{"token": TOKEN}``. A slow client skips messages and gets the newest.
        """
        offered = link.scope.get("subprotocols", [])
        chosen = _SUBPROTOCOL if _SUBPROTOCOL in offered else None
        tokens = [one.removeprefix("token.") for one in offered if one.startswith("token.")]
        tokens += link.query_params.getlist("token")
        if tokens and not any(map(self._may_read, tokens)):
            await link.close(1008, "wrong token")
            return
        await link.accept(chosen)
        try:
            if not tokens:
                async with asyncio.timeout(self._request_timeout_s):
                    first = await link.receive_text()
                if not self._may_read(_token_of(first)):
                    await link.close(1008, "wrong token")
                    return
            after = link.query_params.get("parts_after", "")
            if after and not after.isdecimal():
                await link.close(1008, "parts_after is not a part number")
                return
            frames = link.query_params.get("frames", "")
            await self._feed.send_to(link, frames, int(after) if after else None)
        except (WebSocketDisconnect, TimeoutError, RuntimeError, KeyError):
            return  # the client is gone, takes nothing, or has not named its token


def _is_here(request: Request) -> bool:
    """Whether a request comes from this machine."""
    return request.client is not None and ip_address(request.client.host).is_loopback


def _token_of(message: str) -> str:
    """Return the token in the first message of a WebSocket; empty without a token."""
    try:
        found = json.loads(message)["token"]
    except (ValueError, KeyError, TypeError):
        return ""
    return found if isinstance(found, str) else ""


def _refused(_request: Request, error: Exception) -> JSONResponse:
    """Return a refusal in the common form: number, text, remedy."""
    match error:
        case StarletteHTTPException():
            return JSONResponse(
                refusal_values(error.status_code, str(error.detail)), error.status_code
            )
        case RequestValidationError():
            complaints = "; ".join(
                f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()
            )
            return JSONResponse(refusal_values(422, complaints), 422)
    status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), 500)
    refusal = Refusal.of(error)
    shown = {"fault_number": refusal.number, "error": refusal.text, "remedy": refusal.remedy}
    return JSONResponse(shown, status)
