"""The service manager: reports to systemd when the cell is ready, works, and stops."""

import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from math import inf

_FEEDS = 4
"""Messages to the watchdog within its time-out: three may be lost or late."""


class ServiceManager:
    """Sends states as sd_notify(3) does; without its environment variables it sends nothing."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the null byte of an abstract address.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        limit_us = environment.get("WATCHDOG_USEC", "") if ours else ""
        self._feed_every_s = 1e-6 * int(limit_us or 0) / _FEEDS
        self._due_s = -inf if limit_us else inf
        self._status = ""

    def ready(self) -> None:
        """Send that the cell accepts commands."""
        self._send("READY=1")

    def stopping(self) -> None:
        """Send that the cell ends on purpose."""
        self._send("STOPPING=1")

    def report(self, status: str, *, working: bool) -> None:
        """Send a new status, one line for people, and feed the watchdog while the cell works."""
        if status != self._status:
            self._status = status
            self._send(f"STATUS={status}")
        now_s = time.monotonic()
        if working and now_s >= self._due_s:
            self._due_s = now_s + self._feed_every_s
            self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if self._address:
            # If the service manager is gone or does not read, the cell has no fault.
            with (
                suppress(OSError),
                socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link,
            ):
                link.sendto(state.encode(), self._address)
