"""Opening the interfaces, who may connect, and the address that a browser opens."""

import asyncio
import itertools
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest

from cell.config.model import CellConfig
from cell.config.serve import ServeConfig
from cell.control.plan import Pose
from cell.errors import CellError
from cell.interfaces.access import (
    BUSY_MAX,
    is_for_this_machine,
    may_connect,
    same_secret,
)
from cell.interfaces.cli.commands.serve import report_until
from cell.interfaces.http_server import REQUEST_BYTES, HttpServer
from cell.interfaces.opening import open_interfaces, running, warnings
from cell.interfaces.page_address import page_address, view_note
from tests.cell.conftest import small_config
from tests.cell.served import pause
from tests.waiting import LIMIT_S, until

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
    number = itertools.count()
    with ExitStack() as undo:

        def connect(port: int, host: str) -> socket.socket:
            pause(next(number))
            place = ("127.0.0.1", port)
            return undo.enter_context(socket.create_connection(place, 20.0, (host, 0)))

        yield connect


def answered(link: socket.socket, request: bytes) -> bytes:
    """Send a request and return its answer; empty for none."""
    with suppress(ConnectionError):
        link.sendall(request)
        return link.recv(4096)
    return b""


LETS_IN = {"modbus": "modbus.protocol", "xmlrpc": "http_server", "http": "http_server"}
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
    for one in links:
        with suppress(ConnectionError):
            assert one.recv(1) == b""


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
        ("127.9.9.9:1", True),
        ("[::1]:5021", True),
        (socket.gethostname(), True),
        ("192.0.2.1:5021", True),  # the address that the connection has reached
        ("192.0.2.2", False),
        ("cell.lan", True),
        ("10.0.0.7", True),
        ("evil.example", False),
        ("evil.cell.lan", False),
        ("cell.lan.evil.example", False),
        ("localhost.evil.example", False),
        ("localhost:5021:evil", False),
        ("127.0.0.1@evil.example", False),
        ("127.1", False),
        ("", False),
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


# -- Opening the interfaces: what keeps one from it, and what is warned of -------------------------


def test_interfaces_that_cannot_be_opened_say_why(serve, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, content in {"bad": b"\xff" * 20, "long": b"x" * 65, "short": b"short"}.items():
        (tmp_path / name).write_bytes(content)
    for interface, key, file, says in (
        ("http", "token_file", "missing", r"cannot read token or secret .*missing"),
        ("modbus", "secret_file", "pipe", "pipe: not a plain file"),
        ("http", "token_file", "pipe", "pipe: not a plain file"),
        ("http", "tls_key", "pipe", "pipe: not a plain file"),
        ("xmlrpc", "secret_file", "bad", "needs ASCII characters"),
        ("modbus", "secret_file", "long", "at most 64 characters"),
        ("http", "token_file", "short", "at least 16 characters"),
    ):
        more = {"serve__tls_certificate": "missing"} if key == "tls_key" else {}
        with pytest.raises(CellError, match=says):
            serve(interface, **more, **{f"serve__{key}": str(tmp_path / file)})


def test_an_address_for_others_is_warned_of(serve) -> None:
    assert warnings(serve("modbus", "xmlrpc", "http").service) == ()
    others = {"serve__listen": "0.0.0.0", "serve__allow": ["192.0.2.1"]}
    modbus, http = warnings(serve(serve__modbus_port=0, serve__http_port=0, **others).service)
    assert "Modbus and XML-RPC authenticate nobody: any program on 192.0.2.1" in modbus
    assert "without TLS" in http
    assert warnings(serve(**others).service) == ()


@pytest.mark.parametrize("interface", ["modbus", "xmlrpc", "http"])
def test_a_taken_port_names_the_key_that_sets_another(serve, interface: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port, key = taken.getsockname()[1], f"serve__{interface}_port"
        ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
        served = serve(**ports | {key: port})
        complaint = f"127.0.0.1:{port} .*set serve.{interface}_port to another port"
        with pytest.raises(CellError, match=complaint), open_interfaces(served.service):
            pass


class Ended:
    """An interface that serves nobody."""

    def __init__(self) -> None:
        self._over = threading.Event()

    async def serve(self) -> None:
        while not self._over.is_set():
            await asyncio.sleep(0)

    def end(self) -> None:
        self._over.set()


def test_an_interface_that_dies_is_a_problem_and_its_error_is_shown(serve, caplog) -> None:
    service = serve().service
    broken = SimpleNamespace(serve=AsyncMock(side_effect=OSError("no more files")), end=Mock())
    with running(service, {"modbus_port": broken, "http_port": Ended()}):
        until(lambda: "serve.modbus_port has ended" in service.problem)
    assert "no more files" in caplog.text


def test_a_program_with_a_problem_stops_its_job_and_feeds_no_watchdog(serve, capsys) -> None:
    served = serve("modbus")
    lease = served.service.lease.acquire("host")
    served.plugin.pause()
    served.service.start(lease, {"task": "identify"})
    reports: list[tuple[str, bool]] = []
    manager = SimpleNamespace(report=lambda text, *, working: reports.append((text, working)))
    turns = iter([True, True, False, False, True])

    def wait(_time_s: float) -> bool:
        """Have a cell that works in some turns."""
        served.plugin.working = next(turns, None)
        return served.plugin.working is None

    report_until(SimpleNamespace(wait=wait), served.service, manager)  # type: ignore[arg-type]
    assert [working for _, working in reports] == [True, True, False, False, True]
    assert reports[2][0].startswith("the thread of the cell hangs")
    assert "stopped because the thread of the cell hangs" in served.ended().error
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("the thread of the cell hangs") == 1


def test_a_host_may_take_its_time_for_a_pose(serve) -> None:
    served = serve()
    served.plugin.working = False  # the thread of the cell waits for the host
    assert served.service.problem
    reached = served.ask_pose(Pose())
    assert served.service.problem == ""
    served.service.pose_reached(served.service.lease.acquire("host"), 1)
    assert reached.result(LIMIT_S) is True


# -- The address of the page: one that a browser opens, here and elsewhere -------------------------


TLS = {"tls_certificate": "c", "tls_key": "k"}


@pytest.mark.parametrize(
    ("listen", "allow", "more", "address", "note"),
    [
        ("127.0.0.1", (), {}, "http://127.0.0.1:7", "set serve.listen"),
        ("::1", (), TLS, "https://[::1]:7", "set serve.listen"),
        ("10.0.0.3", ("10.0.0.0/8",), {}, "http://10.0.0.3:7", ""),
        ("0.0.0.0", ("10.0.0.0/8",), {"hosts": ("cell3.lan",)}, "http://cell3.lan:7", ""),
        ("0.0.0.0", ("127.0.0.1",), {}, f"http://{socket.gethostname()}:7", "set serve.hosts"),
    ],
)
def test_the_address_of_the_page_suits_a_browser(*, listen, allow, more, address, note) -> None:
    config = CellConfig(serve={"listen": listen, "allow": allow} | more).serve
    assert page_address({"http_port": 7, "token": "t"}, config) == f"{address}/#token=t"
    assert page_address({"modbus_port": 7}, config) is None
    assert note in view_note(config)
    assert bool(note) is bool(view_note(config))


def test_the_address_for_others_is_that_of_this_machine_on_their_way(monkeypatch) -> None:
    asked = []

    class Link(socket.socket):
        def connect(self, address: Any) -> None:
            asked.append(address[0])
            if address[0].startswith("10."):
                raise OSError("no route")

        def getsockname(self) -> Any:
            return ("192.168.7.3", 40000)

    monkeypatch.setattr(socket, "socket", Link)
    config = CellConfig(
        serve={"listen": "0.0.0.0", "allow": ("10.0.0.0/8", "192.168.7.0/24")}
    ).serve
    found = page_address({"http_port": 7, "view_token": "v"}, config, "view_token")
    assert (found, view_note(config)) == ("http://192.168.7.3:7/#token=v", "")
    assert asked[:2] == ["10.128.0.0", "192.168.7.128"]


# -- What the server refuses before every HTTP application, and when it answers --------------------


def order_of(length: int, host: bytes) -> tuple[list[str], int]:
    """Return what happens to a request whose body comes in two pieces, and its status."""
    order: list[str] = []
    status: list[int] = []
    pieces = iter([True, False])

    async def receive() -> dict[str, Any]:
        order.append("read")
        return {"type": "http.request", "body": b"x", "more_body": next(pieces)}

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            order.append("answered")
            status.append(message["status"])

    async def app(scope: Any, receive: Any, send: Any) -> None:
        raise AssertionError("the request has passed")

    scope = {
        "type": "http",
        "headers": [(b"host", host), (b"content-length", str(length).encode())],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 2),
    }
    with closing(HttpServer(app, ServeConfig(), 0)) as server:
        asyncio.run(server(scope, receive, send))
    return order, status[0]


@pytest.mark.parametrize(
    ("length", "host", "wanted"),
    [
        (2, b"evil.example", (["read", "read", "answered"], 403)),
        (0, b"evil.example", (["answered"], 403)),
        (REQUEST_BYTES + 1, b"127.0.0.1", (["answered"], 413)),
    ],
)
def test_a_refusal_follows_the_body_unless_it_is_too_long(length, host, wanted) -> None:
    assert order_of(length, host) == wanted
