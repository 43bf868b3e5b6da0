"""A socketcand client that notices when its server is gone.

The driver it derives from takes a closed connection for silence, spins on it, and tries for 10 s to
connect to a server that refuses.
"""

import contextlib
import logging
import socket

import can
from can.interfaces.socketcand import SocketCanDaemonBus

_ANSWER_S = 2.0
_GREETING = b"< hi >"
_DRIVERS_SOCKET = "_SocketCanDaemonBus__socket"


class WatchedSocketcandBus(SocketCanDaemonBus):
    """Raises ``can.CanOperationError`` when the server has closed the connection."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message: can.Message | None
        message, filtered = super()._recv_internal(timeout)  # type: ignore[no-untyped-call]
        if message is None:
            self._check_server()
        return message, filtered

    def _check_server(self) -> None:
        connection: socket.socket = vars(self)[_DRIVERS_SOCKET]
        with contextlib.suppress(BlockingIOError):
            if not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                raise can.CanOperationError("the socketcand server has closed the connection")


def open_socketcand(address: str) -> can.BusABC:
    """Connect to a socketcand server.

    Parameters
    ----------
    address
        ``HOST:PORT/CHANNEL``.

    Raises
    ------
    OSError, ValueError, can.CanError
        When the address is none, or the server refuses or does not answer within 2 s.
    """
    place, _, channel = address.partition("/")
    host, _, port = place.rpartition(":")
    if not channel or not host:
        raise ValueError("not of the form HOST:PORT/CHANNEL")
    with socket.create_connection((host, int(port)), _ANSWER_S) as knock:
        # The driver waits without end for a server that accepts but is stopped.
        if knock.recv(len(_GREETING)) != _GREETING:
            raise can.CanInitializationError("the server does not speak socketcand")
    # Each message that two packets share is a warning there.
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)
    return WatchedSocketcandBus(  # type: ignore[no-untyped-call]
        channel, host=host, port=int(port), tcp_tune=True
    )
