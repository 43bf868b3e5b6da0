"""Lock files that keep a second program off a serial device."""

import fcntl
import hashlib
import os
import tempfile
from pathlib import Path


def lock_device(device: str) -> int:
    """Take the lock file of a device; the operating system drops it when the program ends."""
    digest = hashlib.sha256(device.encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"serial-port-{digest}.lock"
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        # Without O_CREAT the file of another user can be opened, too.
        lock_fd = os.open(path, flags)
    except FileNotFoundError:
        lock_fd = os.open(path, flags | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        os.close(lock_fd)
        raise
    return lock_fd
