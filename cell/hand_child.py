"""The process of the force loop, seen from the program that starts it: its start, messages, end.

It is started afresh (exec, no fork): it shares no lock, thread or interpreter with the program,
and the program's main module is not imported in it.
"""

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import NoReturn

from cell.config import CellConfig
from cell.errors import HandLost
from cell.hand_wire import Boot, EndRamp, Event, Fault, Ready, Request, received_error

_BOOT_S = 60.0
_END_S = 5.0


class LoopProcess:
    """One process of the force loop, from its start to its end.

    Parameters
    ----------
    config
        The cell; its ports are real.

    Attributes
    ----------
    lost
        Why the process is of no use any more; None while it is.
    ready
        Its first message.

    Raises
    ------
    gripper.errors.PortLost, tactile.errors.LinkFault
        If a port or bus cannot be opened.
    HandLost
        If the process does not come up.
    """

    def __init__(self, config: CellConfig) -> None:
        self.lost: HandLost | None = None
        self._watchdog_ms = config.gripper.watchdog_ms
        ours, theirs = socket.socketpair()
        stop_fd, self._stop_fd = os.pipe()
        os.set_blocking(self._stop_fd, False)
        self._connection = Connection(ours.detach())
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from cell.hand_main import main; "
            f"main({theirs.fileno()}, {stop_fd}, {os.getpid()})"
        )
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, "tactile-cell-force-loop"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), stop_fd),
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
        finally:
            theirs.close()
            os.close(stop_fd)
        try:
            self.send(Boot(config=config))
            event = self.next(_BOOT_S)
            if isinstance(event, Fault):
                raise received_error(event.error)
            if not isinstance(event, Ready):
                self.lose(f"says {type(event).__name__} instead of being ready")
        except BaseException:
            self.close()
            raise
        self.ready: Ready = event

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def stop(self) -> None:
        """Let the running command end; safe from any thread and in signal handlers."""
        # A pipe that is full holds requests enough; one that is broken has nobody to stop.
        with suppress(OSError):
            os.write(self._stop_fd, b"s")

    def send(self, message: Request | EndRamp | Boot) -> None:
        """Send a message. Raises HandLost if the process is gone."""
        self.check()
        try:
            self._connection.send(message)
        except OSError:
            self._lose_gone()

    def next(self, patience_s: float) -> Event:
        """Wait for the next event; a process that tells nothing for so long is lost."""
        self.check()
        if not self._connection.poll(patience_s):
            self.lose(f"has told nothing for {patience_s:g} s")
        try:
            event: Event = self._connection.recv()
        except (EOFError, OSError):
            self._lose_gone()
        except BaseException:
            # Half a message may have been read: what follows could not be understood.
            self.abandon(HandLost("the connection to the force loop was cut by an interruption"))
            raise
        return event

    def waiting(self) -> bool:
        """Whether `next` would return or raise at once."""
        self.check()
        return self._connection.poll(0.0)

    def check(self) -> None:
        """Raise HandLost if the process is of no use any more."""
        if self.lost is not None:
            raise self.lost

    def abandon(self, lost: HandLost) -> None:
        """Take the process for lost and end it; a held part stays held."""
        self.lost = lost
        self.close()

    def close(self) -> None:
        """End the process and wait for its end; one that does not end is killed."""
        if not self._connection.closed:
            self._connection.close()
            os.close(self._stop_fd)
            self._stop_fd = -1
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def lose(self, what: str) -> NoReturn:
        """Latch that the process is lost, and say what that means for a part."""
        lost = HandLost(
            f"the process of the force loop (pid {self.pid}) {what}; a part may still be gripped, "
            f"and the servos' bus watchdog acts after {self._watchdog_ms:g} ms. Look at the part, "
            f"then clear the fault: a new process starts and moves nothing"
        )
        self.abandon(lost)
        raise lost

    def _lose_gone(self) -> NoReturn:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        code = self._process.returncode
        if code is None:
            self.lose("closed its connection and does not end")
        if code < 0:
            self.lose(f"was ended by {signal.Signals(-code).name}")
        self.lose(f"has ended with exit code {code}")
