"""The HTTP server of the interfaces: access, limits of connections, time and size, TLS, refusals.

It serves the ASGI applications of `cell.interfaces.web` and `cell.interfaces.xml_rpc`.
"""

import asyncio
import json
import socket
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from cell.config.serve import ServeConfig
from cell.errors import RequestRefused
from cell.fault_catalogue import CATALOGUE
from cell.interfaces.access import (
    BUSY_MAX,
    ConnectionPlaces,
    is_for_this_machine,
    is_loopback,
    may_connect,
    name_of,
    notice_dead_peers,
)

REQUEST_BYTES = 65536
"""Largest request in bytes, without a photo."""
_ACCEPTED_AT_ONCE = BUSY_MAX // 4
"""Connections that may wait; all of them are accepted before the others are read again. More could
take all places at once."""
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
    "photo": "Send a photo with PUT to this path.",
}
"""Remedy for each cause for which a request does not reach the cell."""

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


def refusal_values(text: str, remedy: str) -> dict[str, Any]:
    """Return the refusal of a request that has not reached the cell, in the common form."""
    return {"fault_number": CATALOGUE[RequestRefused].number, "error": text, "remedy": remedy}


async def send_answer(send: Send, status: int, body: bytes, media_type: str) -> None:
    """Answer a request."""
    fields = [(b"content-type", media_type.encode()), (b"content-length", b"%d" % len(body))]
    await send({"type": "http.response.start", "status": status, "headers": fields})
    await send({"type": "http.response.body", "body": body})


async def refuse(send: Send, status: int, text: str, remedy: str) -> None:
    """Refuse a request that has not reached the cell."""
    body = json.dumps(refusal_values(text, remedy)).encode()
    await send_answer(send, status, body, "application/json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """ASGI middleware: refuses clients, names, origins and sizes before anything is read."""

    app: Any
    config: ServeConfig
    """Contains the allow-list."""
    longest: Callable[[Scope], int]
    """Returns the largest body in bytes of a request."""
    pages: bool
    """Whether pages of this origin may send requests; other pages are always refused."""
    whole: Callable[[Any], None]
    """Called with the client when its request has arrived completely."""

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Pass a request on, or answer 403 or 413."""
        length = _body_bytes(scope)
        refused = self._refusal(scope, length)

        async def watched() -> Any:
            message = await receive()
            if not message.get("more_body", False):
                self.whole(scope["client"])
            return message

        if scope["type"] == "websocket" or not length:
            self.whole(scope["client"])
        if refused is None:
            await self.app(scope, watched, send)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            # A connection that closes with input unread resets the answer.
            while length and length <= REQUEST_BYTES and (await receive()).get("more_body", False):
                pass
            status, text, cause = refused
            await refuse(send, status, text, REMEDIES[cause])
        self.whole(scope["client"])

    def _refusal(self, scope: Scope, length: int | None) -> tuple[int, str, str] | None:
        """Return status, text and cause (of `REMEDIES`) of a refusal; None for no refusal."""
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        client, reached = scope.get("client"), scope.get("server")
        config = self.config
        if client is None or reached is None or not may_connect(client[0], config):
            return 403, "this client is not in serve.allow", "client"
        if not is_for_this_machine(hosts, reached[0], config):
            return 403, f"Host {', '.join(hosts)!r:.80} is not this machine", "host"
        origin = headers.get(b"origin")
        if origin is not None and not (self.pages and self._is_own(origin, hosts[0], scope)):
            text = f"the request comes from a page of another origin, {origin!r:.80}"
            return 403, text, "origin"
        if length is None:
            return 413, "the request has no valid Content-Length", "length"
        longest = self.longest(scope)
        if length > longest:
            return 413, f"the body has {length} bytes, more than {longest}", "size"
        return None

    def _is_own(self, origin: str, host: str, scope: Scope) -> bool:
        """Whether an origin is that of the cell's own page.

        Its scheme is that of the connection. A proxy with TLS on this machine serves names of
        ``serve.hosts`` over https.
        """
        tls = scope["scheme"] in ("https", "wss")
        proxied = is_loopback(scope["client"][0]) and name_of(host) in self.config.hosts
        schemes = ("https",) if tls else ("http", "https") if proxied else ("http",)
        return origin in (f"{scheme}://{host}" for scheme in schemes)


def _body_bytes(scope: Scope) -> int | None:
    """Return the announced length of a request's body in bytes; None without a valid length."""
    headers = {name.lower(): value for name, value in scope["headers"]}
    length = headers.get(b"content-length", b"0")
    if b"transfer-encoding" in headers or not length.isdigit():
        return None
    return int(length)


class HttpConnection(H11Protocol):
    """A connection with a place among `Connections` and a time limit for each request.

    It overrides only the callbacks of `asyncio.Protocol`.
    """

    def __init__(self, connections: "Connections", **server: Any) -> None:
        super().__init__(**server)
        self._connections = connections
        self._limit: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a place and start the time limit of the first request."""
        super().connection_made(transport)
        self._connections.add(self)
        self._begin()

    def data_received(self, data: bytes) -> None:
        """Take bytes; the first bytes of a request start its time limit."""
        self._begin()
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place back."""
        self.end_limit()
        self._connections.remove(self)
        super().connection_lost(exc)

    def _begin(self) -> None:
        if self._limit is None:
            self._limit = self.loop.call_later(self._connections.limit_s, self.transport.abort)

    def end_limit(self) -> None:
        """End the time limit: the request is complete."""
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None


class Connections:
    """The connections of a server by the address of their client.

    Parameters
    ----------
    limit_s
        Longest time in s from the first to the last byte of a request, and until the first request
        of a new connection. The time of the cell for the answer does not count.
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._places = ConnectionPlaces()
        self._open: dict[tuple[str, int], HttpConnection] = {}

    def add(self, connection: HttpConnection) -> None:
        """Add a new connection; if all places are taken, another connection is closed."""
        # A connection that became a WebSocket does not report its end.
        for client in [at for at, other in self._open.items() if other.transport.is_closing()]:
            del self._open[client]
        client = _client_of(connection)
        self._open[client] = connection
        self._places.enter(connection.transport, client[0])

    def remove(self, connection: HttpConnection) -> None:
        """Remove a connection that ended."""
        self._open.pop(_client_of(connection), None)

    def request_is_whole(self, client: Any) -> None:
        """End the time limit of a client's request; its connection now keeps its place longest."""
        if client is not None and (connection := self._open.get(tuple(client))) is not None:
            self._places.heard(connection.transport)
            connection.end_limit()


def _client_of(connection: HttpConnection) -> tuple[str, int]:
    """Return address and port of a client in the form of ASGI."""
    host, port, *_ = connection.transport.get_extra_info("peername") or ("", 0)
    return host, port


class HttpServer:
    """Serves an application behind the gate, at an address and port, in its own thread.

    Raises OSError if it cannot listen there, or if a file cannot be read.

    Parameters
    ----------
    config
        Address, allow-list and limits.
    port
        TCP port; 0: any free one.
    longest
        Returns the largest body in bytes of a request.
    pages
        As `Gate`.
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
        name: str,
        longest: Callable[[Scope], int] = lambda _scope: REQUEST_BYTES,
        pages: bool = False,
        idle_s: int = 5,
        **settings: Any,
    ) -> None:
        connections = Connections(config.request_timeout_s)
        gate = Gate(
            app=app,
            config=config,
            longest=longest,
            pages=pages,
            whole=connections.request_is_whole,
        )
        server = uvicorn.Config(
            gate,
            log_config=None,
            access_log=False,
            lifespan="off",
            http=partial(HttpConnection, connections),  # type: ignore[arg-type]
            timeout_graceful_shutdown=1,
            timeout_keep_alive=idle_s,
            proxy_headers=False,  # a client could write the address of another one into them
            backlog=_ACCEPTED_AT_ONCE,
            **{"ws": "none"} | settings,
        )
        server.load()  # certificates are read here, not in the thread
        family = socket.AF_INET6 if ":" in config.listen else socket.AF_INET
        self._socket = socket.create_server((config.listen, port), family=family)
        # Each connection inherits these options. TCP_NODELAY avoids a wait of 40 ms for the
        # client's delayed acknowledgement.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        notice_dead_peers(self._socket)
        self.port: int = self._socket.getsockname()[1]
        self._server = uvicorn.Server(server)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name=name, daemon=True
        )
        self._thread.start()

    def works(self) -> bool:
        """Whether the thread of the interface runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End all connections and the thread."""
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()
