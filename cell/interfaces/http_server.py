"""The HTTP server of the interfaces: access, limits of connections, time and size, TLS, refusals.

It serves the ASGI applications of `cell.interfaces.web` and `cell.interfaces.xml_rpc`.
"""

import socket
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from typing import Any

import uvicorn
from starlette.responses import JSONResponse

from cell.config.serve import ServeConfig
from cell.errors import RequestRefused
from cell.fault_catalogue import CATALOGUE
from cell.interfaces.access import (
    ACCEPTED_AT_ONCE,
    Listener,
    is_for_this_machine,
    is_loopback,
    may_connect,
    name_of,
)

REQUEST_BYTES = 65536
"""Largest request in bytes."""
_SEND_BUFFER_BYTES = 65536
"""Send buffer of the system for one connection in bytes. After a stall, a client of the live
WebSocket first receives this amount of old state."""
REMEDIES = {
    "client": "Add the address of this client to `serve.allow`.",
    "host": "Use an address of this machine, or a name that `serve.hosts` has.",
    "origin": "Send the request from a page of this cell.",
    "length": "Send a Content-Length, and the body in one piece.",
    "size": "Send a smaller request.",
    "token": "Send the token of the cell as `Authorization: Bearer TOKEN`.",
    "path": "Read the paths in /openapi.json.",
    "method": "Read the methods of each path in /openapi.json.",
    "job": "Read the numbers in GET /api/jobs.",
    "grasp": "Read the numbers of `shift.answers` in GET /api/state.",
}
"""Remedy for each cause for which a request does not reach the cell."""

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


def refusal(
    status: int, text: str, remedy: str, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return the answer to a request that has not reached the cell, in the common form."""
    number = CATALOGUE[RequestRefused].number
    body = {"fault_number": number, "error": text, "remedy": remedy}
    return JSONResponse(body, status, headers)


def _body_bytes(scope: Scope) -> int | None:
    """Return the announced length of a request's body in bytes; None without a valid length."""
    headers = {name.lower(): value for name, value in scope["headers"]}
    length = headers.get(b"content-length", b"0")
    if b"transfer-encoding" in headers or not length.isdigit():
        return None
    return int(length)


class HttpServer:
    """Serves an application at an address and port.

    It refuses clients, names, origins and sizes before anything is read. Raises OSError if it
    cannot listen there, or if a file cannot be read.

    Parameters
    ----------
    config
        Address, allow-list and limits.
    port
        TCP port; 0: any free one.
    pages
        Whether pages of this origin may send requests; other pages are always refused.
    idle_s
        Silence in s between two requests after which a connection is closed.
    settings
        Further settings of uvicorn.
    """

    def __init__(
        self,
        app: Any,
        config: ServeConfig,
        port: int,
        *,
        pages: bool = False,
        idle_s: int = 5,
        **settings: Any,
    ) -> None:
        self._listener = Listener(config.listen, port, config.request_timeout_s)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self.port = self._listener.port
        self._application, self._config = app, config
        self._pages, self._idle_s = pages, idle_s
        server = uvicorn.Config(
            self,
            log_config=None,
            log_level="error",  # it warns of each bad request
            access_log=False,
            lifespan="off",
            http="h11",
            timeout_graceful_shutdown=1,
            timeout_keep_alive=idle_s,
            proxy_headers=False,  # a client could write the address of another one into them
            backlog=ACCEPTED_AT_ONCE,
            **{"ws": "none"} | settings,
        )
        try:
            server.load()  # certificates are read here, before a client connects
        except BaseException:
            self.close()
            raise
        self._server = uvicorn.Server(server)

    async def serve(self) -> None:
        """Answer clients until `end`."""
        await self._server.serve(sockets=[self._listener])

    def end(self) -> None:
        """End all connections and `serve`."""
        self._server.should_exit = True

    def close(self) -> None:
        """Close the socket."""
        self._listener.close()

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Pass a request on, or answer 403 or 413; this is an ASGI application."""
        length = _body_bytes(scope)
        refused = self._refusal(scope, length)

        async def watched() -> Any:
            message = await receive()
            if not message.get("more_body", False):
                self._listener.note_request(scope["client"])
            return message

        if scope["type"] == "websocket" or not length:
            self._listener.note_request(scope["client"])
        if refused is None:
            await self._application(scope, watched, send)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            # A connection that closes with input unread resets the answer.
            while length and length <= REQUEST_BYTES and (await receive()).get("more_body", False):
                pass
            status, text, cause = refused
            await refusal(status, text, REMEDIES[cause])(scope, receive, send)
        self._listener.expect(scope["client"], self._idle_s + self._config.request_timeout_s)

    def _refusal(self, scope: Scope, length: int | None) -> tuple[int, str, str] | None:
        """Return status, text and cause (of `REMEDIES`) of a refusal; None for no refusal."""
        hosts, origins = (
            [value.decode("latin-1") for name, value in scope["headers"] if name == header]
            for header in (b"host", b"origin")
        )
        client, reached = scope.get("client"), scope.get("server")
        config = self._config
        if client is None or reached is None or not may_connect(client[0], config):
            return 403, "this client is not in serve.allow", "client"
        if not is_for_this_machine(hosts, reached[0], config):
            return 403, f"Host {', '.join(hosts)!r:.80} is not this machine", "host"
        if not all(self._pages and self._is_own(origin, hosts[0], scope) for origin in origins):
            text = f"the request comes from a page of another origin, {', '.join(origins)!r:.80}"
            return 403, text, "origin"
        if length is None:
            return 413, "the request has no valid Content-Length", "length"
        if length > REQUEST_BYTES:
            return 413, f"the body has {length} bytes, more than {REQUEST_BYTES}", "size"
        return None

    def _is_own(self, origin: str, host: str, scope: Scope) -> bool:
        """Whether an origin is that of the cell's own page.

        Its scheme is that of the connection. A proxy with TLS on this machine serves names of
        ``serve.hosts`` over https.
        """
        tls = scope["scheme"] in ("https", "wss")
        proxied = is_loopback(scope["client"][0]) and name_of(host) in self._config.hosts
        schemes = ("https",) if tls else ("http", "https") if proxied else ("http",)
        return origin in (f"{scheme}://{host}" for scheme in schemes)
