"""One program at a time on a CAN interface or on the serial port of its adapter.

The exclusive mode of a serial port does not keep out a program with the rights of an
administrator, and a CAN interface of the system has none: both would answer the same control unit.
"""

import fcntl
import hashlib
import os
import tempfile
from contextlib import suppress
from pathlib import Path

_SHARED = ("virtual",)
"""Interfaces within one program."""


class BusLock:
    """A lock file that the operating system drops when the program ends.

    Parameters
    ----------
    interface, channel
        As for `tactile.can_bus.open_bus`.

    Raises
    ------
    OSError
        BlockingIOError when another program holds it; FileNotFoundError for a serial port that is
        not there.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._handle: int | None = None
        if interface in _SHARED:
            return
        # The lock follows the device, not the link that names it; servo ports have the same.
        name = os.path.realpath(channel, strict=True) if interface == "slcan" else channel
        digest = hashlib.sha256(name.encode()).hexdigest()[:16]
        handle = _open(Path(tempfile.gettempdir()) / f"serial-port-{digest}.lock")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException:
            os.close(handle)
            raise
        self._handle = handle

    def release(self) -> None:
        """Give the lock back; a second time nothing happens."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None


def _open(path: Path) -> int:
    """Open a lock file, also one that another user has made."""
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW
    with suppress(FileNotFoundError):
        return os.open(path, flags)
    return os.open(path, flags | os.O_CREAT, 0o644)
