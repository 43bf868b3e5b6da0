"""Ten thousand connections to each interface of `tactile-cell serve`, in which nothing grows.

    python -m benchmarks.performance.connects [--connects N]        (make soak)

One service on the simulated cell with a part in its grip. Most clients connect and go; some send
half a request first, some a whole one and read its answer. After each block of connections the
process is looked at, as in the soak of grasps, and a new client gets an answer. The part is held.
"""

import argparse
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import Any
from xmlrpc.client import dumps

from benchmarks._measure import line
from benchmarks.performance.soak import ResourceUse, look, show_growth
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.states import CellState
from cell.interfaces.opening import open_interfaces
from cell.service.opening import open_service
from cell.service.service import Service

BLOCK = 1000
"""Connections between two looks."""
REST_S = 6.0
"""Time in s before a look: uvicorn keeps the timer of a connection that has ended for 5 s."""
LIMITS = {"rss_kib": 0.1, "objects": 0.01, "descriptors": 0.001, "threads": 0.001}
"""Growth allowed for each connection."""
PATIENCE_S = 20.0
"""Longest wait in s until an interface has ended the connections of a block."""
_GRIP_N = 3.0
_READ = bytes.fromhex("000100000006010400000001")
"""Modbus: read the first input register."""
_ANSWER = 100
"""Bytes of an answer that a client reads at most before it goes."""

_KINDS = 5
"""Kinds of clients, see `connect`."""
_AT_ONCE = 16
"""Clients that ask at once before the measure: they fill the interface's pool of threads."""
_QUIET_S = 0.2
"""Time in s in which threads and descriptors stay as they are before they are the measure."""
Interface = tuple[int, bytes]
"""Port, and a whole request that changes nothing."""


def requests(found: dict[str, Any]) -> dict[str, Interface]:
    """Return port and request of each interface."""
    body = dumps((), "state").encode()
    head = b"POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/xml\r\n"
    call = head + b"Content-Length: %d\r\n\r\n" % len(body) + body
    token = b"Authorization: Bearer " + found["token"].encode()
    get = b"GET /api/info HTTP/1.1\r\nHost: localhost\r\n" + token + b"\r\n\r\n"
    return {
        "modbus": (found["modbus_port"], _READ),
        "xmlrpc": (found["xmlrpc_port"], call),
        "http": (found["http_port"], get),
    }


def connect(interface: Interface, number: int) -> None:
    """Connect once: one in five sends half a request, one in five gets its answer."""
    port, request = interface
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as link:
        try:
            match number % _KINDS:
                case 3:
                    link.sendall(request[: 1 + number % (len(request) - 1)])
                case 4:
                    link.sendall(request)
                    link.recv(_ANSWER)
        except ConnectionError:
            pass  # an interface that is full ends the oldest connection


def gets_answer(interface: Interface) -> bool:
    """Whether a new client gets an answer."""
    port, request = interface
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as link:
            link.sendall(request)
            return bool(link.recv(_ANSWER))
    except OSError:
        return False


def settle(true: Callable[[], bool], what: str) -> None:
    """Wait until something is true; SystemExit where it takes too long."""
    end_s = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > end_s:
            raise SystemExit(f"{what}, {PATIENCE_S:g} s after a block of connections")
        time.sleep(0.01)


def hammer(
    service: Service, name: str, interface: Interface, n_connects: int
) -> Iterator[ResourceUse]:
    """Connect so often to an interface, and yield a sample after each block."""
    # What an interface makes at its first clients and keeps, a thread or a file, is none of theirs.
    with ThreadPoolExecutor(_AT_ONCE) as clients:
        list(clients.map(lambda _number: gets_answer(interface), range(4 * _AT_ONCE)))
    for number in range(_KINDS):
        connect(interface, number)
    settle(lambda: gets_answer(interface), f"{name} gives no answer")
    first, before = look(0, 0.0), None
    while before is None or _open(first) != _open(before):
        time.sleep(_QUIET_S)
        first, before = look(0, 0.0), first
    for done in range(BLOCK, n_connects + 1, BLOCK):
        for number in range(done - BLOCK, done):
            connect(interface, number)
        settle(lambda: gets_answer(interface), f"{name} gives no answer")
        time.sleep(REST_S)
        settle(lambda: _idle(first), f"{name} has descriptors or threads left")
        status = service.status()
        if status.state != CellState.COMPLETE or not status.holding:
            raise SystemExit(f"{name}: the part is not held any more: {status}")
        yield look(done, 0.0)


def _open(sample: ResourceUse) -> tuple[int, int]:
    return sample.descriptors, sample.threads


def _idle(first: ResourceUse) -> bool:
    now = look(0, 0.0)
    return now.descriptors <= first.descriptors and now.threads <= first.threads


def serve() -> Service:
    """Return a service that holds a part."""
    ports = {f"serve.{interface}_port": 0 for interface in ("modbus", "xmlrpc", "http")}
    service = open_service(changed_config(CellConfig(), ports | {"serve.lease_timeout_s": 60.0}))
    lease = service.lease.acquire("soak")
    number = service.start(lease, {"task": "grip", "force_n": _GRIP_N})
    settle(lambda: service.job(number).outcome_number >= 4, "the grip is not over")
    if not service.job(number).kept:
        raise SystemExit(f"nothing was gripped: {service.job(number).error}")
    return service


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.performance.connects", description=__doc__
    )
    parser.add_argument("--connects", type=int, default=10_000)
    wanted = parser.parse_args(arguments)
    bad: list[str] = []
    with closing(serve()) as service, open_interfaces(service) as found:
        for name, interface in requests(found).items():
            begin_s = time.monotonic()
            samples = list(hammer(service, name, interface, wanted.connects))
            line(name, f"{samples[-1].done} connections in {time.monotonic() - begin_s:.1f} s")
            bad += [f"{name}: {text}" for text in show_growth(samples, LIMITS)]
    if bad:
        sys.exit("; ".join(bad))


if __name__ == "__main__":
    main()
