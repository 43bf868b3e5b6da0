"""The lease of a cell: the right of one client at a time to command. A silent client loses it."""

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

from cell.errors import NotInCommand
from cell.fault_catalogue import error_text
from gripper.clock import Clock

_LOOKS = 10
"""Checks of the lease per time-out: a loss is noticed at most a tenth of the time-out late."""


@dataclass
class Lease:
    """The lease of one cell; every method from any thread.

    A silent client loses it at the next call; `watch` looks in a thread.
    """

    timeout_s: float
    """Longest silence in s of the client with the lease."""
    _: KW_ONLY
    given: Callable[[str], None]
    """Called with the name of a client that acquires it."""
    lost: Callable[[str], None]
    """Called with the reason at each end of the lease."""
    clock: Clock = time
    """Time of the clients: real time even if the cell's time is virtual."""
    lock: AbstractContextManager[Any] = field(default_factory=threading.RLock)
    """A reentrant lock, held while ``given`` and ``lost`` are called."""
    number: int = 0
    name: str = ""
    """Number and name of the client in command; 0 and empty for nobody."""
    _heard_s: float = 0.0
    _inside: int = 0
    _over: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def acquire(self, name: str, *, take: bool = False) -> int:
        """Return the number of a new lease; with ``take`` it is taken from another client.

        Raises NotInCommand if another client has it.
        """
        name = str(name).strip()[:60] or "a client without a name"
        with self.lock:
            self._check_expiry()
            if self.number:
                if not take:
                    raise NotInCommand(
                        f"{self.name!r} is in command; wait until it gives up the lease or is "
                        f"silent for {self.timeout_s:g} s"
                    )
                self._end(f"because {name!r} took command")
            self.number, self.name = 1 + secrets.randbelow(2**31 - 1), name
            self._heard_s = self.clock.monotonic()
            self.given(self.name)
            return self.number

    def has(self, lease: int) -> bool:
        """Whether a number is that of the lease; does not renew it."""
        with self.lock:
            self._check_expiry()
            return bool(self.number) and self.number == lease

    def alive(self, lease: int) -> None:
        """Renew the lease. Raises NotInCommand if it is lost: acquire a new one."""
        with self.lock:
            if not self.has(lease):
                raise NotInCommand(
                    f"lease {lease} is not valid"
                    + (f"; {self.name!r} is in command" if self.number else "; acquire one")
                )
            self._heard_s = self.clock.monotonic()

    def give_up(self, lease: int) -> None:
        """Give up the lease. Raises NotInCommand as `alive`."""
        with self.lock:
            self.alive(lease)
            self._end("because its client gave up the lease")

    @contextmanager
    def calling(self, name: str) -> Iterator[None]:
        """Give command to a client within this program, which is not silent during its call.

        The lease is acquired if it is free.
        """
        with self.lock:
            self._inside += 1
            if not self.number:
                self.acquire(name)
        try:
            yield
        finally:
            with self.lock:
                self._inside -= 1
                self._heard_s = self.clock.monotonic()

    def _check_expiry(self) -> None:
        """End the lease of a client that is silent for too long."""
        with self.lock:
            silent_s = self.clock.monotonic() - self._heard_s
            if self.number and not self._inside and silent_s > self.timeout_s:
                self._end(f"because {self.name!r} was silent for {silent_s:.2f} s")

    def watch(self, note: Callable[[str], None]) -> None:
        """Start the checks in a thread; ``note`` gets its errors."""

        def run() -> None:
            while not self._over.wait(self.timeout_s / _LOOKS):
                try:
                    self._check_expiry()
                except Exception as error:  # the watch must survive every error
                    note(f"watch over the lease: {error_text(error)}")

        self._thread = threading.Thread(target=run, name="lease", daemon=True)
        self._thread.start()

    def end_watch(self) -> None:
        """Let the thread of the watch end, without waiting for it."""
        self._over.set()

    def close(self) -> None:
        """End the supervision of the lease."""
        self.end_watch()
        if self._thread is not None:
            self._thread.join()

    def _end(self, reason: str) -> None:
        self.number, self.name = 0, ""
        self.lost(reason)
