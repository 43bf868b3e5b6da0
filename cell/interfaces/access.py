"""Access to all interfaces: clients, names, secrets, and places for connections."""

import hmac
import re
import socket
import time
from asyncio import WriteTransport
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import IPv4Address, IPv6Address, ip_address, ip_network
from pathlib import Path
from threading import Lock
from typing import Any

from cell.config.serve import ServeConfig
from cell.data.files import read_plain
from cell.errors import ConfigError

BUSY_MAX = 64
"""Most connections at once on one interface; a further connection replaces another one: see
`ConnectionPlaces`."""
_PEER_IDLE_S, _PEER_ASKED_S, _PEER_ASKED_MAX = 10, 5, 4
"""TCP keep-alive: silence in s before the first probe, time in s between two probes, number of
probes. A peer without power is detected after 30 s."""
_SECRET_MIN = 16
"""Fewest characters of a token or secret."""
_SECRET_BYTES = 4096
"""Largest size in bytes of a file with a token or secret."""


def may_connect(host: str, config: ServeConfig) -> bool:
    """Whether a host may connect: this machine, or a host of the allow-list."""
    found = _address(host)
    return found is not None and (
        found.is_loopback or any(found in ip_network(one) for one in config.allow)
    )


def is_loopback(host: str) -> bool:
    """Whether an address is one of this machine alone."""
    found = _address(host)
    return found is not None and found.is_loopback


def name_of(host: str) -> str:
    """Return the name or address in a header ``Host``, in small letters; empty if it has none."""
    found = re.fullmatch(r"(\[[^]]*\]|[^][:]+)(:\d*)?", host)
    return "" if found is None else found[1].strip("[]").rstrip(".").lower()


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
    try:
        found = data.decode("ascii").strip()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: a token or secret needs ASCII characters ({error})") from error
    if len(found) < _SECRET_MIN:
        raise ConfigError(
            f"{path}: a token or secret needs at least {_SECRET_MIN} characters, not {len(found)}"
        )
    return found


def view_token(token: str) -> str:
    """Return the view-only token, a one-way hash of the token that commands.

    It is valid as long as that token.
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


class ConnectionPlaces:
    """The connections of an interface: if all places are taken, a new connection replaces another.

    It replaces a connection of the address with most connections, so that no address blocks others.
    Of these it takes the one with the oldest complete request, first one without any request. So
    silent connections never block a client that sends a hold.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._heard_s: dict[WriteTransport, float] = {}
        self._hosts: dict[WriteTransport, str] = {}

    def enter(self, one: WriteTransport, host: str) -> None:
        """Give a new connection from an address its place."""
        leaves = None
        with self._lock:
            for other in [other for other in self._hosts if other.is_closing()]:
                self._leave(other)
            if len(self._hosts) >= BUSY_MAX:
                crowd = Counter(self._hosts.values())
                rank = {o: (-crowd[at], self._heard_s[o]) for o, at in self._hosts.items()}
                leaves = min(rank, key=rank.__getitem__)
                self._leave(leaves)
            self._heard_s[one], self._hosts[one] = 0.0, host
        if leaves is not None:
            leaves.abort()

    def _leave(self, one: WriteTransport) -> None:
        del self._heard_s[one], self._hosts[one]

    def heard(self, one: WriteTransport) -> None:
        """Note the time of a complete request."""
        with self._lock:
            if one in self._heard_s:
                self._heard_s[one] = time.monotonic()
