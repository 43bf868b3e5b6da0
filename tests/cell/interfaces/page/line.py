"""A line between browser and server: it can be cut, be slow, or lose answers."""

import asyncio
import threading
from contextlib import suppress


class Line:
    """Passes bytes on to a port of this machine, from a port of its own."""

    def __init__(self, to: int) -> None:
        self.delay_s = 0.0
        """Wait in s before each piece of an answer."""
        self.mute = False
        """Whether answers are lost on the way."""
        self._to = to
        self._is_cut = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._opened = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self._thread.start()
        assert self._opened.wait(10)

    async def _run(self) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port: int = server.sockets[0].getsockname()[1]
        self._opened.set()
        await self._over.wait()
        server.close()
        while self._tasks:  # their connections are cut
            await asyncio.wait(self._tasks)

    def cut(self) -> None:
        """End all connections, and take none until `mend`."""
        self._is_cut = True
        done = threading.Event()

        def end() -> None:
            for writer in tuple(self._writers):
                writer.transport.abort()
            done.set()

        self._loop.call_soon_threadsafe(end)
        assert done.wait(10)

    def mend(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._tasks.add(task := asyncio.current_task())  # type: ignore[arg-type]
        task.add_done_callback(self._tasks.discard)  # type: ignore[union-attr]
        self._writers.add(writer)
        with suppress(OSError):
            if not self._is_cut:
                far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._to)
                self._writers.add(far_writer)
                if self._is_cut:
                    far_writer.transport.abort()
                await asyncio.gather(
                    self._pass(reader, far_writer, answers=False),
                    self._pass(far_reader, writer, answers=True),
                )
                self._writers.discard(far_writer)
        writer.transport.abort()
        self._writers.discard(writer)

    async def _pass(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, answers: bool
    ) -> None:
        with suppress(OSError):
            while data := await reader.read(65536):
                if answers and self.mute:
                    continue
                if answers and self.delay_s:
                    await asyncio.sleep(self.delay_s)
                writer.write(data)
                await writer.drain()
        writer.transport.abort()
