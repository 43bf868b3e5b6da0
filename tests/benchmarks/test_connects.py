"""A short run of connections: the remains of clients in an interface show after two blocks."""

import os
import subprocess
import sys
from contextlib import closing
from typing import Any

import pytest

from benchmarks.performance import connects
from cell.interfaces.http_server import HttpConnection
from cell.interfaces.opening import open_interfaces

pytestmark = pytest.mark.long

N = 60
"""Connections to each interface."""


SHORT = f"""
from contextlib import closing
from benchmarks.performance import connects
from cell.interfaces.opening import open_interfaces

connects.BLOCK, connects.REST_S = {N // 2}, 0.0
with closing(connects.serve()) as service, open_interfaces(service) as found:
    for name, interface in connects.requests(found).items():
        first, last = connects.hammer(service, name, interface, {N})
        assert (first.done, last.done) == ({N // 2}, {N})
        print(name, "left nothing behind")
"""
"""In a process of its own: the threads and files of other tests are none of it."""


def test_connections_leave_nothing_behind_and_the_part_is_held() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SHORT], capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("left nothing behind") == 3


def test_a_interface_that_keeps_its_connections_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, made = [], HttpConnection.connection_made

    def keep(connection: Any, transport: Any) -> None:
        kept.append(os.dup(transport.get_extra_info("socket").fileno()))
        made(connection, transport)

    monkeypatch.setattr(HttpConnection, "connection_made", keep)
    monkeypatch.setattr(connects, "BLOCK", N // 2)
    monkeypatch.setattr(connects, "REST_S", 0.0)
    with closing(connects.serve()) as service, open_interfaces(service) as found:
        monkeypatch.setattr(connects, "PATIENCE_S", 2.0)
        interface = connects.requests(found)["xmlrpc"]
        with pytest.raises(SystemExit, match=r"xmlrpc (has descriptors|gives no answer)"):
            list(connects.hammer(service, "xmlrpc", interface, N))
    for descriptor in kept:
        os.close(descriptor)
