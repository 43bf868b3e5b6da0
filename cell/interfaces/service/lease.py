"""The lease: the right of one client at a time to command; a silent client loses it."""

import secrets
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import KW_ONLY, dataclass, field
from threading import RLock
from typing import Any

from cell.errors import NotInCommand
from gripper.clock import Clock


@dataclass
class Lease:
    """The lease of one cell; every method from any thread."""

    timeout_s: float
    """Longest silence in s of the client that has it."""
    _: KW_ONLY
    given: Callable[[str], None]
    """Called with the name of a client that acquires it."""
    lost: Callable[[str], None]
    """Called with the reason when it ends, however it does."""
    clock: Clock = time
    lock: AbstractContextManager[Any] = field(default_factory=RLock)
    """A lock that one thread may take twice, held while ``given`` and ``lost`` are called."""
    number: int = 0
    name: str = ""
    """Number and name of the client in command; 0 and empty for nobody."""
    _heard_s: float = 0.0

    def acquire(self, name: str, *, take: bool = False) -> int:
        """Return the number of a new lease; with ``take`` it is taken from another client.

        Raises NotInCommand if another client has it.
        """
        with self.lock:
            self.look()
            if self.number:
                if not take:
                    raise NotInCommand(
                        f"{self.name!r} is in command; wait until it gives the lease up or is "
                        f"silent for {self.timeout_s:g} s"
                    )
                self._end(f"because {name!r} took command")
            self.number, self.name = 1 + secrets.randbelow(2**31 - 1), name[:60]
            self._heard_s = self.clock.monotonic()
            self.given(self.name)
            return self.number

    def has(self, lease: int) -> bool:
        """Whether a number is that of the lease; looking does not keep it."""
        with self.lock:
            self.look()
            return bool(self.number) and self.number == lease

    def alive(self, lease: int) -> None:
        """Keep the lease. Raises NotInCommand if it is lost: acquire a new one."""
        with self.lock:
            if not self.has(lease):
                raise NotInCommand(
                    f"lease {lease} is not valid"
                    + (f"; {self.name!r} is in command" if self.number else "; acquire one")
                )
            self._heard_s = self.clock.monotonic()

    def give_up(self, lease: int) -> None:
        """Give the lease up. Raises NotInCommand as `alive`."""
        with self.lock:
            self.alive(lease)
            self._end("because its client gave the lease up")

    def look(self) -> None:
        """Notice a client that is silent for too long."""
        with self.lock:
            silent_s = self.clock.monotonic() - self._heard_s
            if self.number and silent_s > self.timeout_s:
                self._end(f"because {self.name!r} was silent for {silent_s:.2f} s")

    def _end(self, reason: str) -> None:
        self.number, self.name = 0, ""
        self.lost(reason)
