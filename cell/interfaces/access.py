"""Access to all interfaces: clients, names, secrets, and places for connections."""

import hmac
import re
import socket
import time
from asyncio import TimerHandle, get_running_loop
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address, ip_network
from pathlib import Path
from typing import Any

from cell.config.serve import ServeConfig
from cell.errors import ConfigError
from cell.files import read_plain

BUSY_MAX = 64
"""Most connections at once on one interface; a further connection replaces another one."""
ACCEPTED_AT_ONCE = BUSY_MAX // 4
"""Connections that may wait; all of them are accepted before the others are read again. More could
take all places at once."""
_PEER_IDLE_S, _PEER_ASKED_S, _PEER_ASKED_MAX = 10, 5, 4
"""TCP keep-alive: silence in s before the first probe, time in s between two probes, number of
probes. A peer without power is detected after 30 s."""
_SECRET = re.compile(r"[\w.~-]{16,}", re.ASCII)
"""A token or secret: an address, a header and the handshake of a browser take it as it is."""
_SECRET_BYTES = 4096
"""Largest size in bytes of a file with a token or secret."""


def may_connect(host: str, config: ServeConfig) -> bool:
    """Whether a host may connect: this machine, or a host of the allow-list."""
    address = _address(host)
    return address is not None and (
        address.is_loopback or any(address in ip_network(network) for network in config.allow)
    )


def is_loopback(host: str) -> bool:
    """Whether an address is one of this machine alone."""
    address = _address(host)
    return address is not None and address.is_loopback


def name_of(host: str) -> str:
    """Return the name or address in a header ``Host``, in small letters; empty if it has none."""
    match = re.fullmatch(r"(\[[^]]*\]|[^][:]+)(:\d*)?", host)
    return "" if match is None else match[1].strip("[]").rstrip(".").lower()


def is_for_this_machine(hosts: Sequence[str], reached: str, config: ServeConfig) -> bool:
    """Whether the header ``Host`` of a request names this machine.

    A browser writes the name in the address of the page into that header. The check refuses pages
    of other sites whose name was pointed to this machine (DNS rebinding).

    Parameters
    ----------
    hosts
        All values of ``Host`` in the request; anything but one value is refused.
    reached
        Address of this machine on which the connection arrived.
    config
        Contains further names in ``hosts``.
    """
    name = name_of(hosts[0]) if len(hosts) == 1 else ""
    if not name:
        return False
    address = _address(name)
    if address is None:
        return name in ("localhost", socket.gethostname().lower(), *config.hosts)
    return address.is_loopback or address == _address(reached) or str(address) in config.hosts


def _address(text: str) -> IPv4Address | IPv6Address | None:
    """Return an IP address, an IPv4 address within IPv6 as IPv4; None for other texts."""
    try:
        address = ip_address(text.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def read_secret(path: str) -> str:
    """Return the token or secret in a file. Raises ConfigError if it is bad or missing."""
    what = "token or secret"
    data = read_plain(Path(path), error=ConfigError, what=what, limit_bytes=_SECRET_BYTES)
    secret = data.decode("ascii", "replace").strip()
    if not _SECRET.fullmatch(secret):
        raise ConfigError(
            f"{path}: a token or secret has at least 16 letters, digits or -._~ and no other "
            "characters; `openssl rand -hex 16` writes one"
        )
    return secret


def view_token(token: str) -> str:
    """Return the view-only token, a one-way hash of the token that commands.

    It is valid as long as the token.
    """
    return hmac.new(token.encode(), b"view only", "sha256").hexdigest()[:32]


def same_secret(given: str, secret: str) -> bool:
    """Whether both are the same; the time does not depend on where they differ."""
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), secret.encode())


def notice_dead_peers(link: Any) -> None:
    """Let the system end a connection whose peer no longer answers, for example without power.

    ``link`` is the socket, or an object with its ``setsockopt``.
    """
    with suppress(OSError):  # already closed
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            ("TCP_KEEPIDLE", _PEER_IDLE_S),
            ("TCP_KEEPINTVL", _PEER_ASKED_S),
            ("TCP_KEEPCNT", _PEER_ASKED_MAX),
            # The same limit for unacknowledged data: keep-alive sends no probe then.
            ("TCP_USER_TIMEOUT", 1000 * (_PEER_IDLE_S + _PEER_ASKED_S * _PEER_ASKED_MAX)),
        ):
            if hasattr(socket, option):  # not every system has all options
                link.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


@dataclass(slots=True)
class _Place:
    """A connection, the time of its last complete request, and the timer that ends it."""

    link: socket.socket
    heard_s: float = 0.0
    timer: TimerHandle | None = None

    def end(self) -> None:
        """End the connection: its server reads the end of the stream."""
        with suppress(OSError):  # already closed
            self.link.shutdown(socket.SHUT_RDWR)


class Listener(socket.socket):
    """A listening socket with `BUSY_MAX` places, for any server of asyncio that takes a socket.

    If all places are taken, a new connection replaces one of the address with most connections, so
    that no address blocks others. Of these it takes the one with the oldest complete request, first
    one without any request. So silent connections never block a client that sends a hold. All
    methods belong to the thread of the event loop. Raises OSError if it cannot listen there.

    Parameters
    ----------
    address, port
        Where it listens; port 0: any free port.
    limit_s
        Time in s after which a new connection without a complete request ends; None: no limit.
    """

    def __init__(self, address: str, port: int, limit_s: float | None = None) -> None:
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        super().__init__(fileno=socket.create_server((address, port), family=family).detach())
        # Each connection inherits these options. TCP_NODELAY avoids a wait of 40 ms for the
        # client's delayed acknowledgement.
        self.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        notice_dead_peers(self)
        self._limit_s = limit_s
        self._places: dict[tuple[str, int], _Place] = {}

    @property
    def port(self) -> int:
        """Port at which it listens."""
        return int(self.getsockname()[1])

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection and give it a place."""
        link, client = super().accept()
        for gone in [at for at, place in self._places.items() if place.link.fileno() < 0]:
            del self._places[gone]
        if len(self._places) >= BUSY_MAX:
            crowd = Counter(host for host, _ in self._places)
            rank = {at: (-crowd[at[0]], place.heard_s) for at, place in self._places.items()}
            self._places.pop(min(rank, key=rank.__getitem__)).end()
        self._places[client[:2]] = _Place(link)
        self.expect(client, self._limit_s)
        return link, client

    def note_request(self, client: Sequence[Any] | None) -> None:
        """Note a complete request of a client: its connection keeps its place longest."""
        if client is not None and (place := self._places.get((client[0], client[1]))) is not None:
            place.heard_s = time.monotonic()
            if place.timer is not None:
                place.timer.cancel()

    def expect(self, client: Sequence[Any] | None, limit_s: float | None) -> None:
        """End the connection of a client if its next request is not complete in time."""
        if client is None or limit_s is None:
            return
        if (place := self._places.get((client[0], client[1]))) is not None:
            place.timer = get_running_loop().call_later(limit_s, place.end)
