"""The live stream for Foxglove: the channels of a recording, with their schemas, as they are made.

Needs the extra ``foxglove``. For engineers at this machine: it listens on loopback alone and shows
what is recorded to whoever connects; nothing can be commanded over it.
"""

import json
import threading
import time
from collections import deque
from collections.abc import Callable

import foxglove
from foxglove import Channel, Context

from cell.data.recording_schema import SCHEMAS
from cell.errors import CellError

_HOST = "127.0.0.1"
_WAITING_MAX = 4096
"""Messages that wait for the thread; the oldest go first. Some ten seconds of a grasp."""
_LOOK_S = 0.02
"""Period in s in which waiting messages are sent: that of the frames."""
_JUMP_S = 0.5
"""Difference in s between the cell's clock and real time after which both are related anew."""


class FoxgloveDoor:
    """Serves the channels of a recording to Foxglove; implements `cell.data.recorder.Tap`.

    Messages are put aside in the thread that makes them, and sent by a thread of its own. Port 0 is
    any free one. ``log_time`` of each message is the cell's clock related to unix time. Raises
    CellError if the port cannot be opened.
    """

    def __init__(self, port: int, wall_clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._wall_clock_ns = wall_clock_ns
        self._offset_ns: int | None = None
        self._waiting: deque[tuple[str, int, bytes]] = deque(maxlen=_WAITING_MAX)
        self._over = threading.Event()
        self._context = context = Context()  # its channels end with it
        self._channels = {
            topic: Channel(
                topic,
                schema=foxglove.Schema(
                    name=schema["title"],
                    encoding="jsonschema",
                    data=json.dumps(schema).encode(),
                ),
                message_encoding="json",
                context=context,
            )
            for topic, schema in SCHEMAS.items()
        }
        try:
            self._server = foxglove.start_server(
                name="tactile-cell", host=_HOST, port=port, context=context
            )
        except RuntimeError as error:
            raise CellError(
                f"Foxglove's door at {_HOST}:{port} (serve.foxglove_port) cannot be opened: "
                f"{error}; --foxglove PORT takes another one, 0 any free one"
            ) from error
        self.port: int = self._server.port
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()

    def wants(self, topic: str) -> bool:
        """Whether a client looks at a topic."""
        return self._channels[topic].has_sinks()

    def take(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Put a message aside for the thread; never waits."""
        self._waiting.append((topic, stamp_ns, data))

    def close(self) -> None:
        """Send what waits, and end all connections and the thread. A second call does nothing."""
        if not self._over.is_set():
            self._over.set()
            self._thread.join()
            self._server.stop()

    def _run(self) -> None:
        over = False
        while not over:
            over = self._over.wait(_LOOK_S)
            while self._waiting:
                topic, stamp_ns, data = self._waiting.popleft()
                self._channels[topic].log(data, log_time=self._log_time_ns(stamp_ns))

    def _log_time_ns(self, stamp_ns: int) -> int:
        """Return a time of the cell's clock, in ns, as unix time in ns."""
        present_ns = self._wall_clock_ns() - stamp_ns
        if self._offset_ns is None or abs(present_ns - self._offset_ns) > 1e9 * _JUMP_S:
            self._offset_ns = present_ns
        return max(0, self._offset_ns + stamp_ns)
