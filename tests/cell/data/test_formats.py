"""Files of another version: each reader refuses them, with both versions and a next step."""

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.archive.store import Archive
from cell.checks.findings import read_commissioned
from cell.commissioning.backup import since_backup
from cell.config.file import load_config
from cell.control.self_zero import SelfZeros
from cell.data import formats
from cell.data.dataset import read_dataset
from cell.data.formats import Format
from cell.data.recording_reader import read_recording
from cell.errors import CellError
from cell.learning.model import load_model
from cell.service.history import VERSION, read_day
from tests.cell.data.test_recording_messages import GOOD, foreign

PROGRAM = f"tactile-cell {version('tactile-cell')}"


def text(path: Path, form: str) -> None:
    """Write a text, JSON or YAML, with a key that this version does not have."""
    path.write_text(json.dumps({"format": form, "colour": "blue"}) + "\n")


def dataset(path: Path, form: str) -> None:
    with path.open("wb") as file:
        np.savez(file, format=np.array(form))


def model(path: Path, form: str) -> None:
    with path.open("wb") as file:
        np.savez(file, model=np.array(json.dumps({"format": form})))


def recording(path: Path, form: str) -> None:
    foreign(path, b"{}", metadata=GOOD | {"format": form})


def archive(path: Path, form: str) -> None:
    path.mkdir()
    text(path / "_archive.json", form)


def self_zero(path: Path) -> None:
    """Read a self-zero; a cell starts without the one that it cannot read."""
    raise CellError(SelfZeros(path=path).refused)


def servo_backup(path: Path) -> None:
    since_backup(path.parent, None, 1)  # type: ignore[arg-type]  # its file is read first


KINDS: list[tuple[Format, Callable[[Path, str], None], Callable[[Path], Any]]] = [
    (formats.CONFIG, text, load_config),
    (formats.DATASET, dataset, read_dataset),
    (formats.MODEL, model, load_model),
    (formats.RECORDING, recording, read_recording),
    (formats.COMMISSIONING, text, read_commissioned),
    (formats.SERVO_BACKUP, text, servo_backup),
    (formats.SELF_ZERO, text, self_zero),
    (formats.ARCHIVE, archive, lambda path: Archive(str(path))),
]
"""A format, what writes a file of another one, and what reads the file."""


@pytest.mark.parametrize("step", [-1, 1], ids=["earlier", "later"])
@pytest.mark.parametrize(("kind", "write", "read"), KINDS, ids=[str(k.what) for k, *_ in KINDS])
def test_a_file_of_another_version_is_refused(kind, write, read, step, tmp_path) -> None:
    name, number = kind.text.split("/")
    other, path = f"{name}/{int(number) + step}", tmp_path / "backup-servo1.json"
    write(path, other)
    with pytest.raises(CellError) as refused:
        read(path)
    said = str(refused.value)
    assert f"{path}: its format is '{other}', but {PROGRAM} reads {kind}; {kind.remedy}" in said


def test_every_format_has_its_row() -> None:
    every = [kind for kind in vars(formats).values() if isinstance(kind, Format)]
    assert sorted(kind.text for kind, *_ in KINDS) == sorted(kind.text for kind in every)


def test_a_history_of_another_version_is_refused(tmp_path) -> None:
    path = tmp_path / "history.sqlite3"
    with closing(sqlite3.connect(path)) as link:
        link.execute(f"PRAGMA user_version = {VERSION + 1}")
    with pytest.raises(CellError, match=rf"version {VERSION + 1}, but {PROGRAM} reads version"):
        read_day(path, date(2027, 3, 1))
