"""The server of the positioner's Unix socket: JSON lines, without own loop."""

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from simulator.errors import EndpointError, SimulatorError

_READ_BYTES = 65536
"""Most bytes of one read."""

Handler = Callable[[dict[str, Any]], dict[str, Any]]
"""Carries out one request and returns the reply; a SimulatorError becomes an error reply."""


class PositionerServer:
    """Serves requests of other processes on this machine.

    Request and reply are JSON objects, each on one line; a refusal is ``{"error": text}``. Only the
    owner can use the socket. Raises EndpointError if the socket cannot be created.

    Parameters
    ----------
    path
        Path of the socket; an existing socket is replaced.
    """

    def __init__(self, path: Path, handle: Handler) -> None:
        self.path = path
        self._handle = handle
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        """Connection and incomplete line of each client by its descriptor."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            if path.is_socket():
                path.unlink()
            self._listener.bind(str(path))
            os.chmod(path, 0o600)
            self._listener.listen()
        except OSError as error:
            self._listener.close()
            raise EndpointError(f"no socket for the positioner at {path}: {error}") from error

    def filenos(self) -> list[int]:
        """Return the descriptors to wait on."""
        return [self._listener.fileno(), *self._clients]

    def poll(self, readable: list[int]) -> None:
        """Serve the ready descriptors; never waits."""
        for descriptor in readable:
            if descriptor == self._listener.fileno():
                self._accept()
            elif descriptor in self._clients:
                self._serve(*self._clients[descriptor])

    def close(self) -> None:
        """Disconnect all clients and remove the socket; a second call has no effect."""
        for connection, _ in list(self._clients.values()):
            self._drop(connection)
        if self._listener.fileno() >= 0:
            self._listener.close()
            self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        connection.setblocking(False)
        self._clients[connection.fileno()] = (connection, bytearray())

    def _serve(self, connection: socket.socket, received: bytearray) -> None:
        try:
            data = connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
            return
        received += data
        *lines, received[:] = received.split(b"\n")
        replies = b"".join(self._answer(bytes(line)) for line in lines if line.strip())
        try:
            connection.sendall(replies)
        except OSError:
            self._drop(connection)  # a client that does not take its replies is gone

    def _answer(self, line: bytes) -> bytes:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError) as error:
            return _line({"error": f"the request is not valid JSON: {error}"})
        if not isinstance(request, dict):
            return _line({"error": "a request is a JSON object"})
        try:
            return _line(self._handle(request))
        except SimulatorError as error:
            return _line({"error": str(error)})

    def _drop(self, connection: socket.socket) -> None:
        self._clients.pop(connection.fileno(), None)
        connection.close()


def _line(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, allow_nan=False).encode() + b"\n"
