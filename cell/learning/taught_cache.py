"""The taught model of the built-in simulated cell, kept for the next start in the user's cache.

A model is found only with the same config and version of the program.
"""

import hashlib
import os
import shutil
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from cell.config.model import CellConfig
from cell.errors import CellError
from cell.learning.taught_model import TaughtModel

MODEL_FILE = "model.npz"
"""Name of the model in its folder; its training set is beside it."""
_NOT_OF_THE_MODEL = {"serve", "recording"}
"""Sections of a config that do not affect the taught model."""


def cached_model(config: CellConfig) -> Path | None:
    """Return the kept model for a config, or None.

    A damaged model, or one without its training set, is removed.
    """
    folder = _folder(config)
    path = folder / MODEL_FILE
    try:
        if not path.exists():
            return None
        if TaughtModel.load(config, path).extendable:
            return path
    except (CellError, OSError):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    return None


def keep_model(config: CellConfig, write: Callable[[Path], object]) -> Path:
    """Keep a model for the next start, replace the previous one, and return its path.

    ``write`` writes `MODEL_FILE` and its training set into the given folder. Raises OSError or
    CellError if the files cannot be written: the next start then teaches again.
    """
    folder = _folder(config)
    folder.parent.mkdir(parents=True, exist_ok=True)
    # The clean-up finds nothing once the folder has been moved to its place.
    with TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as new:
        write(Path(new))
        shutil.rmtree(folder, ignore_errors=True)
        Path(new).rename(folder)
    return folder / MODEL_FILE


def _folder(config: CellConfig) -> Path:
    """Return the folder of a config's model below ``XDG_CACHE_HOME`` (XDG Base Directory 0.8)."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    cache = named if named.is_absolute() else Path.home() / ".cache"
    key = hashlib.sha256(config.model_dump_json(exclude=_NOT_OF_THE_MODEL).encode())
    return cache / "tactile-cell" / f"taught-{version('tactile-cell')}-{key.hexdigest()[:16]}"
