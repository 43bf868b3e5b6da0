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
"""Connections at once on one interface; a further one takes the place of another: see
`ConnectionPlaces`."""
_PEER_IDLE_S, _PEER_ASKED_S, _PEER_ASKED_MAX = 10, 5, 4
"""Silence in s after which the system asks whether a peer is still there (TCP keep-alive), time
between two questions, and questions without an answer: one without power is gone after 30 s."""
_SECRET_MIN = 16
"""Fewest characters of a token or secret."""
_SECRET_BYTES = 4096
"""Largest file of one."""


def may_connect(host: str, config: ServeConfig) -> bool:
    """Whether a host may connect: this machine, or one of the allow-list."""
    found = _address(host)
    return found is not None and (
        found.is_loopback or any(found in ip_network(one) for one in config.allow)
    )


def is_for_this_machine(hosts: Sequence[str], reached: str, config: ServeConfig) -> bool:
    """Whether a request over HTTP names this machine, as a page of another site cannot make it.

    A browser writes the name in the address of the page into the header ``Host``. With a name of
    its own that leads to this machine (DNS rebinding) a page of any site would else be let in.

    Parameters
    ----------
    hosts
        All values of ``Host`` in the request; anything but one value is refused.
    reached
        Address of this machine that the connection has reached.
    config
        Has further names in ``hosts``.
    """
    found = re.fullmatch(r"(\[[^]]*\]|[^][:]+)(:\d*)?", hosts[0]) if len(hosts) == 1 else None
    if found is None:
        return False
    name = found[1].strip("[]").rstrip(".").lower()
    address = _address(name)
    if address is None:
        return name in ("localhost", socket.gethostname().lower(), *config.hosts)
    return address.is_loopback or address == _address(reached) or str(address) in config.hosts


def _address(text: str) -> IPv4Address | IPv6Address | None:
    """Return an IP address, one of IPv4 within IPv6 as that of IPv4; None for what is none."""
    try:
        address = ip_address(text.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def read_secret(path: str) -> str:
    """Return the token or secret in a file. Raises ConfigError for a bad one, or no file."""
    what = "token or secret"
    data = read_plain(Path(path), error=ConfigError, what=what, limit_bytes=_SECRET_BYTES)
    try:
        found = data.decode("ascii").strip()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: a token or secret is of ASCII characters ({error})") from error
    if len(found) < _SECRET_MIN:
        raise ConfigError(
            f"{path}: a token or secret has at least {_SECRET_MIN} characters, not {len(found)}"
        )
    return found


def view_token(token: str) -> str:
    """Return the token that may read and not command, made of the one that may: no way leads back.

    It stays as long as the other one does.
    """
    return hmac.new(token.encode(), b"view only", "sha256").hexdigest()[:32]


def same_secret(given: str, secret: str) -> bool:
    """Whether both are the same, in a time that does not depend on where they differ."""
    return hmac.compare_digest(given.encode(), secret.encode())


def notice_dead_peers(link: Any) -> None:
    """Have the system end a connection whose peer answers nothing any more, as without power.

    It is the socket, or what has its ``setsockopt``.
    """
    with suppress(OSError):  # it is closed already
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            ("TCP_KEEPIDLE", _PEER_IDLE_S),
            ("TCP_KEEPINTVL", _PEER_ASKED_S),
            ("TCP_KEEPCNT", _PEER_ASKED_MAX),
            # The same where it has not taken what was sent: it is not asked then.
            ("TCP_USER_TIMEOUT", 1000 * (_PEER_IDLE_S + _PEER_ASKED_S * _PEER_ASKED_MAX)),
        ):
            if hasattr(socket, option):  # not every system has all of them
                link.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


class ConnectionPlaces:
    """The connections of an interface: where all places are taken, a new one takes that of another.

    It is one of the address that has most of them, so that no address keeps another one out, and
    of these the one whose last whole request is longest ago, first of all one that never made any:
    connections that say nothing keep no client from a hold.
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
        """Take note of a whole request."""
        with self._lock:
            if one in self._heard_s:
                self._heard_s[one] = time.monotonic()
