"""The gate before every HTTP application: what it refuses, and when it answers."""

import asyncio
from typing import Any

import pytest

from cell.config.serve import ServeConfig
from cell.interfaces.http_server import REQUEST_BYTES, Gate


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

    gate = Gate(
        app=app,
        config=ServeConfig(),
        longest=lambda _: REQUEST_BYTES,
        pages=False,
        whole=lambda _: None,
    )
    scope = {
        "type": "http",
        "headers": [(b"host", host), (b"content-length", str(length).encode())],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 2),
    }
    asyncio.run(gate(scope, receive, send))
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
