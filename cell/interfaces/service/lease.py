"""The lease: the right of one client at a time to command; a silent client loses it."""

import secrets
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from threading import RLock
from typing import Any

from cell.errors import NotInCommand
from gripper.clock import Clock


class Lease:
    """The lease of one cell; every method from any thread.

    Parameters
    ----------
    timeout_s
        Longest silence in s of the client that has it.
    given
        Called with the name of a client that acquires it.
    lost
        Called with the reason when it ends, however it does.
    lock
        A lock that one thread may take twice, held while ``given`` and ``lost`` are called.
    """

    def __init__(
        self,
        timeout_s: float,
        *,
        given: Callable[[str], None],
        lost: Callable[[str], None],
        clock: Clock = time,
        lock: AbstractContextManager[Any] | None = None,
    ) -> None:
        self.number = 0
        self.name = ""
        """Number and name of the client in command; 0 and empty for nobody."""
        self._timeout_s = timeout_s
        self._given = given
        self._lost = lost
        self._clock = clock
        self._lock = lock or RLock()
        self._heard_s = 0.0

    def acquire(self, name: str, *, take: bool = False) -> int:
        """Return the number of a new lease; with ``take`` it is taken from another client.

        Raises NotInCommand if another client has it.
        """
        with self._lock:
            self.look()
            if self.number:
                if not take:
                    raise NotInCommand(
                        f"{self.name!r} is in command; wait until it gives the lease up or is "
                        f"silent for {self._timeout_s:g} s"
                    )
                self._end(f"because {name!r} took command")
            self.number, self.name = 1 + secrets.randbelow(2**31 - 1), name[:60]
            self._heard_s = self._clock.monotonic()
            self._given(self.name)
            return self.number

    def has(self, lease: int) -> bool:
        """Whether a number is that of the lease; looking does not keep it."""
        with self._lock:
            self.look()
            return bool(self.number) and self.number == lease

    def alive(self, lease: int) -> None:
        """Keep the lease. Raises NotInCommand if it is lost: acquire a new one."""
        with self._lock:
            if not self.has(lease):
                raise NotInCommand(
                    f"lease {lease} is not valid"
                    + (f"; {self.name!r} is in command" if self.number else "; acquire one")
                )
            self._heard_s = self._clock.monotonic()

    def give_up(self, lease: int) -> None:
        """Give the lease up. Raises NotInCommand as `alive`."""
        with self._lock:
            self.alive(lease)
            self._end("because its client gave the lease up")

    def look(self) -> None:
        """Notice a client that is silent for too long."""
        with self._lock:
            silent_s = self._clock.monotonic() - self._heard_s
            if self.number and silent_s > self._timeout_s:
                self._end(f"because {self.name!r} was silent for {silent_s:.2f} s")

    def _end(self, reason: str) -> None:
        self.number, self.name = 0, ""
        self._lost(reason)
