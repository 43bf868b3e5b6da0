"""The WebSocket of the web door: each message is the newest one, however slow its client is."""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fastapi import WebSocket
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

RATE_HZ = 30.0
"""Messages a second to one WebSocket, whatever the source."""
_SEND_BUFFER_BYTES = 65536
"""Send buffer of the system for one WebSocket in bytes: a dozen messages, which a client that
stalled still gets before the newest one."""


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """What is shown of the cell at one moment, for all clients."""

    text: str
    """The state as JSON."""
    frame: Callable[[str], bytes | None] = lambda _kind: None
    """Returns the newest frame as a client has asked for it; None where there is none."""


class LiveFeed:
    """Looks at the cell `RATE_HZ` times a second while a client listens, once for all of them.

    It looks in another thread than that of the connections.
    """

    def __init__(self, look: Callable[[], LiveMessage]) -> None:
        self._look = look
        self._listeners = 0
        self._looking: asyncio.Task[None] | None = None
        self._next: asyncio.Future[LiveMessage]

    async def send_to(self, link: WebSocket, frames: str) -> None:
        """Send the newest moment and its frame, again and again until the client is gone.

        What goes wrong with the look at the cell is raised.
        """
        self._listeners += 1
        if self._looking is None or self._looking.done():
            self._next = asyncio.get_running_loop().create_future()
            self._looking = asyncio.create_task(self._look_on())
        gone = asyncio.create_task(_until_gone(link))
        try:
            while True:
                coming = self._next
                await asyncio.wait((gone, coming), return_when=asyncio.FIRST_COMPLETED)
                if gone.done():
                    return
                moment = coming.result()
                await link.send_text(moment.text)
                if (frame := moment.frame(frames)) is not None:
                    await link.send_bytes(frame)
        finally:
            self._listeners -= 1
            gone.cancel()

    async def _look_on(self) -> None:
        loop = asyncio.get_running_loop()
        while self._listeners:
            due_s = loop.time() + 1.0 / RATE_HZ
            try:
                moment = await asyncio.to_thread(self._look)
            except BaseException as error:
                self._next.set_exception(error)
                return
            shown, self._next = self._next, loop.create_future()
            shown.set_result(moment)
            await asyncio.sleep(due_s - loop.time())


async def _until_gone(link: WebSocket) -> None:
    while (await link.receive())["type"] != "websocket.disconnect":
        pass


class LiveLink(WebSocketsSansIOProtocol):
    """A WebSocket without a queue: a message waits until the client has taken the one before.

    After ``limit_s`` s of waiting the connection is cut.
    """

    def __init__(self, limit_s: float, *server: Any, **settings: Any) -> None:
        super().__init__(*server, **settings)
        self._limit_s = limit_s

    def connection_made(self, transport: Any) -> None:
        """Begin, with little room for messages that are not the newest any more."""
        super().connection_made(transport)
        # Not 0: with TLS asyncio (3.11) would pause at an empty buffer, and nothing would end that.
        transport.set_write_buffer_limits(high=1, low=0)
        link = transport.get_extra_info("socket")
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)

    async def send(self, message: Any) -> None:
        """Send a message once the client has taken the one before; cut one that does not."""
        try:
            async with asyncio.timeout(self._limit_s):
                await super().send(message)
        except TimeoutError:
            self.transport.abort()
            raise
