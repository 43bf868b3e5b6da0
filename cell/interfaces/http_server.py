"""The HTTP server of doors: who is let in, places, limits of time and size, TLS; refusals as JSON.

`cell.interfaces.web_server` and `cell.interfaces.xml_rpc` give it their ASGI applications.
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
from cell.fault_catalogue import BY_NUMBER
from cell.interfaces.access import (
    BUSY_MAX,
    ConnectionPlaces,
    is_for_this_machine,
    may_connect,
    notice_dead_peers,
)

REQUEST_BYTES = 65536
"""Largest request in bytes, without a photo."""
_ACCEPTED_AT_ONCE = BUSY_MAX // 4
"""Connections that are accepted before those that are there are read again."""
_WAITING_MAX = 256
"""Connections that wait until they are accepted; for a further one the system asks again later."""
REMEDIES = {
    401: "Send the token that `serve` has printed, as `Authorization: Bearer TOKEN`.",
    403: "Use an address, name and origin that `serve.allow` and `serve.hosts` have.",
    404: "Read the paths in /openapi.json, and the numbers in GET /api/jobs.",
    405: "Read the methods of each path in /openapi.json.",
    413: "Send less.",
}
"""What to do about refusals that do not come from the cell."""

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


def refusal_values(status: int, text: str, remedy: str = "") -> dict[str, Any]:
    """Return the refusal of a request that has not reached the cell, in the shape of all."""
    number = 514 if status == 401 else 513
    remedy = remedy or REMEDIES.get(status) or BY_NUMBER[number].remedy
    return {"fault_number": number, "error": text, "remedy": remedy}


async def send_answer(send: Send, status: int, body: bytes, media_type: str) -> None:
    """Answer a request."""
    fields = [(b"content-type", media_type.encode()), (b"content-length", b"%d" % len(body))]
    await send({"type": "http.response.start", "status": status, "headers": fields})
    await send({"type": "http.response.body", "body": body})


async def refuse(send: Send, status: int, text: str, remedy: str = "") -> None:
    """Refuse a request that has not reached the cell."""
    body = json.dumps(refusal_values(status, text, remedy)).encode()
    await send_answer(send, status, body, "application/json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """ASGI middleware: refuses clients, names, origins and sizes before anything is read."""

    app: Any
    config: ServeConfig
    """Has the allow-list."""
    longest: Callable[[Scope], int]
    """Returns the largest body in bytes of a request."""
    pages: bool
    """Whether pages of this very origin may ask; requests of other pages are always refused."""

    async def __call__(self, scope: Scope, receive: Any, send: Send) -> None:
        """Pass a request on, or answer 403 or 413."""
        listened = scope["type"] in ("http", "websocket")
        status, reason = self._refusal(scope) if listened else (0, "")
        if not status:
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            await refuse(send, status, reason)

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        client, reached = scope.get("client"), scope.get("server")
        config = self.config
        if client is None or reached is None or not may_connect(client[0], config):
            return 403, "this client is not in serve.allow"
        if not is_for_this_machine(hosts, reached[0], config):
            return 403, f"Host {', '.join(hosts)!r:.80} is not this machine; serve.hosts adds names"
        origin = headers.get(b"origin")
        own = self.pages and (origin or "").partition("://")[2] == headers.get(b"host")
        if origin is not None and not own:
            return 403, f"a page of another origin, {origin!r:.80}"
        length = headers.get(b"content-length", "0")
        longest = self.longest(scope)
        if b"transfer-encoding" in headers or not length.isdecimal() or int(length) > longest:
            return 413, f"a request has a Content-Length of at most {longest}"
        return 0, ""


class HttpConnection(H11Protocol):
    """A connection that has a place at the door, and whose requests have a limit of time.

    Parameters
    ----------
    places
        Those of the door.
    limit_s
        Longest time in s from the first to the last byte of a request; a new connection has as much
        for its first one. What the cell takes for the answer does not count.
    """

    def __init__(self, places: ConnectionPlaces, limit_s: float, **server: Any) -> None:
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
        self._unset_keepalive_if_required()

    def _begin(self) -> None:
        if self._limit is None:
            self._limit = self.loop.call_later(self._limit_s, self.transport.abort)

    def _end(self) -> None:
        self._places.heard(self.transport)
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None


_REASON = json.dumps(refusal_values(400, "this is no HTTP request")).encode()
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


class HttpServer:
    """An application behind the gate, at an address and port, in a thread of its own.

    Raises OSError if it cannot listen there, or a file cannot be read.

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
        Further ones of uvicorn.
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
        places = ConnectionPlaces()
        server = uvicorn.Config(
            Gate(app=app, config=config, longest=longest, pages=pages),
            log_config=None,
            access_log=False,
            lifespan="off",
            http=partial(HttpConnection, places, config.request_timeout_s),  # type: ignore[arg-type]
            timeout_graceful_shutdown=1,
            timeout_keep_alive=idle_s,
            backlog=_ACCEPTED_AT_ONCE,
            **{"ws": "none"} | settings,
        )
        server.load()  # certificates are read here, not in the thread
        family = socket.AF_INET6 if ":" in config.listen else socket.AF_INET
        with socket.create_server((config.listen, port), family=family) as made:
            self._socket = _Listener(fileno=made.detach())
        # asyncio does so only where the protocol of the socket is named. Without it an answer waits
        # 40 ms for the client's delayed acknowledgement.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.port: int = self._socket.getsockname()[1]
        self._server = uvicorn.Server(server)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name=name, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End all connections and the thread."""
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()
