"""Connections of all interfaces: no address keeps another one out, and dead peers leave."""

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from cell.interfaces.access import (
    BUSY_MAX,
    ConnectionPlaces,
    is_for_this_machine,
    may_connect,
    same_secret,
)
from tests.cell.conftest import small_config
from tests.waiting import until

HOLD = struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 7, 1)
CALL = b"<methodCall><methodName>hold</methodName></methodCall>"
HEAD = b"POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/xml\r\n"
HEAD += b"Content-Length: %d\r\n\r\n" % len(CALL)
PRESS = b"POST /api/hold HTTP/1.1\r\nHost: localhost\r\n\r\n"
INTERFACES = {
    "modbus": (HOLD, HOLD[:5]),
    "xmlrpc": (HEAD + CALL, HEAD[:40]),
    "http": (PRESS, PRESS[:-2]),
}
"""A whole request of each interface, and one that never ends."""


@pytest.fixture
def link(serve: Any) -> Iterator[Callable[..., socket.socket]]:
    """Return what connects to an interface from an address of this machine."""
    with ExitStack() as undo:

        def connect(port: int, host: str) -> socket.socket:
            place = ("127.0.0.1", port)
            return undo.enter_context(socket.create_connection(place, 20.0, (host, 0)))

        yield connect


def answered(link: socket.socket, request: bytes) -> bytes:
    """Send a request and return its answer; empty for none."""
    with suppress(ConnectionError):
        link.sendall(request)
        return link.recv(4096)
    return b""


LETS_IN = {"modbus": "modbus.registers", "xmlrpc": "http_server", "http": "http_server"}
"""Module of each interface that asks who may connect."""


@pytest.mark.parametrize("interface", INTERFACES)
def test_other_hosts_are_refused(serve, link, monkeypatch, interface) -> None:
    port = serve(interface).interfaces[f"{interface}_port"]
    monkeypatch.setattr(f"cell.interfaces.{LETS_IN[interface]}.may_connect", lambda *_: False)
    found = answered(link(port, "127.0.0.1"), INTERFACES[interface][0])
    assert found.startswith(b"HTTP/1.1 403 ") if interface != "modbus" else not found


@pytest.mark.parametrize("interface", INTERFACES)
def test_one_address_with_all_places_keeps_no_other_out(serve, link, interface) -> None:
    request, half = INTERFACES[interface]
    port = serve(interface, serve__request_timeout_s=60.0).interfaces[f"{interface}_port"]
    quiet, heard = link(port, "127.0.0.2"), link(port, "127.0.0.1")
    assert answered(heard, request)
    for _ in range(BUSY_MAX + 10):
        with suppress(ConnectionError):
            link(port, "127.0.0.1").sendall(half)
    for _ in range(BUSY_MAX):  # says nothing at all
        link(port, "127.0.0.4")
    assert answered(link(port, "127.0.0.3"), request)
    assert answered(quiet, request)  # has kept its place, though it never said a word
    assert answered(link(port, "127.0.0.1"), request)
    if interface != "http":  # which ends an idle connection after 5 s
        assert answered(heard, request)  # of a crowd those that were heard stay


@pytest.mark.parametrize("interface", INTERFACES)
def test_half_sent_requests_leave_within_their_time(serve, link, interface) -> None:
    _, half = INTERFACES[interface]
    port = serve(interface, serve__request_timeout_s=0.2).interfaces[f"{interface}_port"]
    links = [link(port, "127.0.0.1") for _ in range(8)]
    for one in links:
        one.sendall(half)
        with suppress(ConnectionError):
            assert one.recv(1) == b""


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="the timers of Linux are looked at")
@pytest.mark.parametrize("interface", INTERFACES)
def test_the_system_asks_whether_a_peer_is_still_there(serve, link, interface) -> None:
    port = serve(interface).interfaces[f"{interface}_port"]
    link(port, "127.0.0.1")

    def timer() -> list[str]:
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return [row[5] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "01"]

    kind, ticks = until(lambda: [one for one in timer() if one[:2] == "02"])[0].split(":")
    assert kind == "02"  # keep-alive
    assert int(ticks, 16) <= 10 * 100


def test_places_go_to_those_who_have_fewest() -> None:
    places, gone = ConnectionPlaces(), list[int]()
    links = [Mock(**{"is_closing.return_value": False}) for _ in range(BUSY_MAX + 3)]
    for number, link in enumerate(links):
        link.abort.side_effect = partial(gone.append, number)
    for number, link in enumerate(links[:BUSY_MAX]):
        places.enter(link, "crowd" if number % 4 else f"host {number}")
    places.heard(links[1])
    places.enter(links[-3], "late")
    places.enter(links[-2], "later")
    assert gone == [2, 3]  # of the crowd, those that were never heard, from the oldest on
    places.enter(links[-1], "crowd")
    assert gone == [2, 3, 5]


# -- who may connect ---------------------------------------------------------------------------


def test_hosts_are_this_machine_and_those_allowed() -> None:
    config = small_config(
        serve__listen="0.0.0.0", serve__allow=["192.168.1.10", "10.1.0.0/16", "fd00::/8"]
    ).serve
    for host, may in {
        "127.0.0.1": True,
        "::1": True,
        "::ffff:127.0.0.1": True,
        "192.168.1.10": True,
        "::ffff:192.168.1.10": True,
        "192.168.1.11": False,
        "10.1.2.3": True,
        "10.2.0.1": False,
        "fd12::3": True,
        "fe80::1%eth0": False,
    }.items():
        assert may_connect(host, config) is may, host


@pytest.mark.parametrize(
    ("host", "may"),
    [
        ("localhost", True),
        ("LocalHost.:5021", True),
        ("127.0.0.1", True),
        ("127.9.9.9:1", True),
        ("[::1]", True),
        ("[::1]:5021", True),
        (socket.gethostname(), True),
        ("192.0.2.1:5021", True),  # the address that the connection has reached
        ("192.0.2.2", False),
        ("cell.lan", True),
        ("CELL.lan:80", True),
        ("10.0.0.7", True),
        ("evil.example", False),
        ("evil.cell.lan", False),
        ("cell.lan.evil.example", False),
        ("localhost.evil.example", False),
        ("localhost:5021:evil", False),
        ("127.0.0.1@evil.example", False),
        ("127.1", False),
        ("0.0.0.0", False),
        ("", False),
        (".", False),
        ("[::1", False),
        ("localhost\n", False),
    ],
)
def test_requests_name_this_machine(host, may) -> None:
    config = small_config(serve__hosts=["cell.lan", "10.0.0.7"]).serve
    assert is_for_this_machine([host], "192.0.2.1", config) is may
    assert not is_for_this_machine([host, host], "192.0.2.1", config)
    assert not is_for_this_machine([], "192.0.2.1", config)


@pytest.mark.parametrize("given", ["", "\ud800", "a\udfff", "\u00fc" * 16, "\0", "secret "])
def test_no_other_text_is_the_secret(given: str) -> None:
    assert not same_secret(given, "secret")
    assert same_secret("secret", "secret")
