"""The file of a recording: it ends with a whole record even on a full disk."""

import errno
import fcntl
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Queue

from cell.fault_catalogue import error_text

MAX_WAITING_BYTES = 16 << 20
"""Bytes that may wait for a slow disk before the recording stops."""
CLOSE_TIMEOUT_S = 10.0
"""Longest time in s that a disk may take for the rest at the end."""

LEFT_BYTES = 1 << 20
"""Free bytes below which the disk is nearly full: room for the end of a recording."""
_END_SHARE = 32
"""Bytes of a recording for each byte of its end, an index: twice the need."""


def free_bytes(place: Path | int) -> int:
    """Return the free bytes of the disk of a folder or an open file; OSError if it is gone."""
    disk = os.statvfs(place)
    return disk.f_bavail * disk.f_frsize


def in_use(path: Path) -> bool:
    """Return whether a program still writes to a recording. Raises OSError if it is gone."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False  # a file system without locks
    finally:
        os.close(handle)
    return False


class RecordingSink:
    """File of the MCAP writer: one thread writes whole records.

    In the ``background`` a slow disk never delays the force loop; else `write` waits for the disk.
    A failed write leaves no half record behind; it is in `error`, never raised. So is a disk that
    is too slow in the background: more than `MAX_WAITING_BYTES` wait, or `close` does.

    Raises FileExistsError if the file exists: no recording is ever overwritten.
    """

    def __init__(self, path: Path, *, background: bool) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self.path = path
        self._handle = os.open(path, flags, 0o666)
        with suppress(OSError):  # a file system without locks; the lock ends with the program
            # `in_use` of another program may hold the lock for a moment.
            fcntl.flock(self._handle, fcntl.LOCK_EX)
        self._background = background
        self._queue: Queue[bytes | None] = Queue()
        self._taken_bytes = self._length = 0
        self._ended = False
        self.error: OSError | None = None
        """Why the file takes no more bytes; None while it does."""
        self.nearly_full = False
        """Whether the last write left less than the end of the file needs."""
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether the disk has not taken all bytes yet."""
        return self._thread.is_alive() and (self._ended or self._taken_bytes > self._length)

    def write(self, data: bytes, /) -> int:
        """Queue the bytes; after an error or the end do nothing."""
        waiting_bytes = self._taken_bytes - self._length
        if self.error is None and waiting_bytes + len(data) > MAX_WAITING_BYTES:
            self.error = OSError(
                f"the disk is too slow: {waiting_bytes} bytes wait to be written, the limit is "
                f"{MAX_WAITING_BYTES}"
            )
        if self.error is None and not self._ended:
            self._taken_bytes += len(data)
            self._queue.put(bytes(data))
            if not self._background:
                self._queue.join()
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes taken."""
        return self._taken_bytes

    def flush(self) -> None:
        """Do nothing: the thread writes."""

    def end(self) -> None:
        """Let the thread write what waits, then close the file; do not wait for it."""
        self._ended = True
        self._queue.put(None)

    def close(self) -> None:
        """Wait until all is written and the file is closed; a second call does nothing.

        A write that fails, or a file that was moved or removed, is an `error`.
        """
        self.end()
        self._thread.join(CLOSE_TIMEOUT_S if self._background else None)
        if self._thread.is_alive():
            text = f"the disk did not take the rest within {CLOSE_TIMEOUT_S} s"
            self.error = self.error or OSError(text)

    def _run(self) -> None:
        writes = True
        while (data := self._queue.get()) is not None:
            if writes:
                writes = False
                with self._noted():
                    self._write_whole(data)
                    writes = True
            self._queue.task_done()
        with self._noted(), os.fdopen(self._handle, "wb"):
            os.fsync(self._handle)

    def _write_whole(self, data: bytes) -> None:
        """Write all bytes, or none and raise OSError."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._handle, rest) :]
            if os.fstat(self._handle).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was written")
            free = free_bytes(self._handle)
        except OSError:
            os.ftruncate(self._handle, self._length)
            raise
        self._length += len(data)
        self.nearly_full = free < LEFT_BYTES + self._length // _END_SHARE

    @contextmanager
    def _noted(self) -> Iterator[None]:
        """Note the first error."""
        try:
            yield
        except OSError as error:
            self.error = self.error or error
        except Exception as error:
            self.error = self.error or OSError(f"its thread failed: {error_text(error)}")
