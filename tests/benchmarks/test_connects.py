"""A short run of connections: what a client leaves behind in a door shows after two blocks."""

from contextlib import closing
from typing import Any

import pytest

from benchmarks.performance import connects
from cell.interfaces.service.serving import open_doors
from cell.interfaces.xml_rpc import _Server

N = 60
"""Connections to each door."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connects, "BLOCK", N // 2)
    monkeypatch.setattr(connects, "REST_S", 0.0)


def test_connections_leave_nothing_behind_and_the_part_is_held() -> None:
    with closing(connects.serve()) as service, open_doors(service) as found:
        for name, door in connects.requests(found).items():
            first, last = connects.hammer(service, name, door, N)
            assert (first.done, last.done) == (N // 2, N)
            assert (last.descriptors, last.threads) <= (first.descriptors, first.threads)


def test_a_door_that_keeps_its_connections_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []

    def keep(_server: Any, request: Any) -> None:
        kept.append(request)

    monkeypatch.setattr(_Server, "shutdown_request", keep)
    monkeypatch.setattr(connects, "PATIENCE_S", 2.0)
    with closing(connects.serve()) as service, open_doors(service) as found:
        door = connects.requests(found)["xmlrpc"]
        with pytest.raises(SystemExit, match=r"xmlrpc (has descriptors|gives no answer)"):
            list(connects.hammer(service, "xmlrpc", door, N))
    for request in kept:
        request.close()
