"""Photos of the taught objects, for people: files beside the model, or in memory without one."""

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from threading import Lock

from cell.errors import RequestRefused
from cell.files import read_plain

LONGEST_PHOTO = 512 * 1024
"""Largest photo in bytes."""
_MOST_IN_MEMORY = 64
"""Most photos without a model file."""
_FIRST_BYTES = {
    b"\xff\xd8\xff": ("image/jpeg", ".jpg"),
    b"\x89PNG\r\n\x1a\n": ("image/png", ".png"),
}
"""Media type and file name by the first bytes, whatever type the client declares."""


class Photos:
    """One photo for each label; every method from any thread.

    They are in ``NAME.photos`` beside the model file; without a model file they are in memory.
    """

    def __init__(self, model: Path | None) -> None:
        self._folder = None if model is None else model.with_name(f"{model.stem}.photos")
        self._kept: dict[str, bytes] = {}
        self._lock = Lock()
        self.revision = 0
        """Changes so far."""

    def get(self, label: str) -> tuple[bytes, str] | None:
        """Return the photo of an object and its media type; None without a photo."""
        photo = self._kept.get(label)
        for path in self._paths(label):
            with suppress(RequestRefused):
                photo = read_plain(
                    path, error=RequestRefused, what="photo", limit_bytes=LONGEST_PHOTO
                )
        return None if photo is None else (photo, _kind(photo)[0])

    def has(self, label: str) -> bool:
        """Whether there is a photo of an object; no file is read."""
        return label in self._kept or any(path.exists() for path in self._paths(label))

    def put(self, label: str, photo: bytes) -> None:
        """Save the photo of an object and replace an earlier one.

        Raises RequestRefused if it is too large, neither JPEG nor PNG, or one too many. Raises
        OSError if it cannot be written.
        """
        if len(photo) > LONGEST_PHOTO:
            raise RequestRefused(f"the photo has {len(photo)} bytes; the limit is {LONGEST_PHOTO}")
        _, ending = _kind(photo)
        with self._lock:
            if self._folder is None:
                if label not in self._kept and len(self._kept) >= _MOST_IN_MEMORY:
                    raise RequestRefused(
                        f"{_MOST_IN_MEMORY} photos are in memory; with --save they become files"
                    )
                self._kept[label] = photo
            else:
                self._folder.mkdir(parents=True, exist_ok=True)
                path = self._folder / f"{_name(label)}{ending}"
                written = path.with_suffix(".new")
                written.write_bytes(photo)
                os.replace(written, path)
                self._remove_files(label, but=path)
            self.revision += 1

    def remove(self, label: str) -> None:
        """Forget the photo of an object, if there is one."""
        with self._lock:
            self._kept.pop(label, None)
            self._remove_files(label)
            self.revision += 1

    def _remove_files(self, label: str, but: Path | None = None) -> None:
        for path in self._paths(label):
            if path != but:
                path.unlink(missing_ok=True)

    def _paths(self, label: str) -> list[Path]:
        if self._folder is None:
            return []
        return [self._folder / f"{_name(label)}{ending}" for _, ending in _FIRST_BYTES.values()]


def _kind(photo: bytes) -> tuple[str, str]:
    for first, kind in _FIRST_BYTES.items():
        if photo.startswith(first):
            return kind
    raise RequestRefused("the photo is neither a JPEG nor a PNG file; send one of these")


def _name(label: str) -> str:
    """Return a valid file name for a label."""
    return hashlib.sha256(label.encode()).hexdigest()[:24]
