"""Server of web pages and their API: the token, the lease, the live socket.

Its interfaces (`cell.interfaces.web`, `cell.interfaces.wizard`) add their paths; a refusal has one
shape, with a fault number.
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
"""HTTP status of refusals; 500 for all others."""
_ERRORS = (CellError, GripperError, TactileError, OSError)
"""Errors that leave the cell on purpose."""
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


class WebServer(HttpServer):
    """A page and its API below ``/api``: the token, the lease, the live state, paths of its own.

    The first lines of the methods are the OpenAPI description. `hold` needs no token. It has TLS
    where a certificate is configured. Raises OSError or ConfigError if it cannot listen at the
    configured address and port, or a file cannot be read, or that of the token holds none.

    Parameters
    ----------
    lease
        What clients command under.
    config
        Address, port, allow-list, limits, certificate, and the file of the token.
    look
        Returns what a WebSocket shows now; called in another thread than that of the connections.
    paths
        Further paths, which need the token.
    page
        File of the page.
    """

    hold: Callable[..., Any]
    """Stops what runs: the path ``/hold``."""

    def __init__(
        self,
        lease: Lease,
        config: ServeConfig,
        look: Callable[[], LiveMessage],
        paths: Paths,
        page: str = "index.html",
    ) -> None:
        file = config.token_file
        self.token = read_secret(file) if file else secrets.token_urlsafe(24)
        """What clients authenticate with."""
        self.view_token = view_token(self.token)
        """What clients authenticate with that read and do not command."""
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
        router = APIRouter(prefix="/api", dependencies=[Depends(self._authorize)])
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
        """Return the most bytes of the body of a request."""
        return REQUEST_BYTES

    def _authorize(
        self,
        found: Annotated[HTTPAuthorizationCredentials, Depends(HTTPBearer())],
        request: Request,
    ) -> None:
        if not self._may_read(found.credentials):
            raise HTTPException(401, "wrong token")
        request.state.commands = same_secret(found.credentials, self.token)
        if request.method != "GET" and not request.state.commands:
            raise NotInCommand(
                "this token reads and does not command: open the page with the address that "
                "`serve` prints after `page`"
            )

    def _may_read(self, token: str) -> bool:
        return any(same_secret(token, one) for one in (self.token, self.view_token))

    def access(self, request: Request) -> dict[str, Any]:
        """Return whether this token commands, and the link for a second person, who only reads.

        ``qr`` has the rows of its QR code, 1 for dark; ``note`` is what to set where no other
        machine reaches it.
        """
        address = page_address({"http_port": self.port, "token": self.view_token}, self._config)
        return {
            "commands": request.state.commands,
            "address": address,
            "note": view_note(self._config),
            "qr": ["".join(map(str, row)) for row in qr_code(address or "").matrix],
        }

    def acquire(self, body: AcquireBody, request: Request) -> dict[str, int]:
        """Acquire the lease to command with."""
        if body.take and not _is_here(request):
            raise NotInCommand("the lease can be taken from another client at this machine only")
        return {"lease": self._lease.acquire(body.name, take=body.take)}

    def alive(self, lease: int) -> dict[str, int]:
        """Keep the lease."""
        self._lease.alive(lease)
        return {"lease": lease}

    def give_up(self, lease: int) -> dict[str, int]:
        """Give the lease up; a job that runs is held."""
        self._lease.give_up(lease)
        return {"lease": 0}

    async def live(self, link: WebSocket) -> None:
        """Send the state as JSON, with ``?frames=1`` the newest counts too, uint16, little-endian.

        ``?frames=newtons``: the force on each taxel in N, float32, little-endian.
        ``?parts_after=N``: each part with a higher number, once, as ``{"event": "part", ...}``.

        The token is a subprotocol ``token.TOKEN`` beside ``tactile-cell``, or ``?token=``, or the
        first message ``{"token": TOKEN}``. Each message is the newest there is when the client can
        take it: a slow one misses some.
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
                await link.close(1008, "parts_after is no part number")
                return
            frames = link.query_params.get("frames", "")
            await self._feed.send_to(link, frames, int(after) if after else None)
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
