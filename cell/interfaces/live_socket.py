"""The WebSocket of the web interface: a slow client skips messages and gets the newest."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fastapi import WebSocket

RATE_HZ = 30.0
"""Messages per second to one WebSocket."""


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """State of the cell at one moment, for all clients."""

    text: str
    """The state as JSON."""
    frame: Callable[[str], bytes | None]
    """Returns the newest frame of the requested kind; None without a frame."""
    parts: tuple[dict[str, Any], ...]
    """The newest parts by their ``number``, oldest first."""


class LiveFeed:
    """Reads the cell `RATE_HZ` times per second while clients listen, once for all of them.

    It reads in another thread than the connections. A client that takes no message for ``limit_s``
    s is dropped with TimeoutError.
    """

    def __init__(self, look: Callable[[], LiveMessage], limit_s: float) -> None:
        self._look = look
        self._limit_s = limit_s
        self._listeners = 0
        self._looking: asyncio.Task[None] | None = None
        self._next: asyncio.Future[LiveMessage]

    async def send_to(self, link: WebSocket, frames: str, after: int | None = None) -> None:
        """Send the newest state and its frame repeatedly until the client is gone.

        With ``after`` each part with a higher number is sent once, before the state that shows it.
        Errors while reading the cell are raised.
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
                async with asyncio.timeout(self._limit_s):
                    if after is not None and moment.parts:
                        newest = moment.parts[-1]["number"]
                        seen = 0 if after > newest else after  # higher: of an earlier start
                        for part in moment.parts:
                            if part["number"] > seen:
                                await link.send_text(json.dumps({"event": "part", "part": part}))
                        after = newest
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
