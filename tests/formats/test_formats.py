"""Files of each release go through the commands of this version."""

import json
import shutil
import sqlite3
from contextlib import closing
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.commissioning.findings import read_commissioned
from cell.commissioning.servos import backup_file, read_backup
from cell.config.file import load_config
from cell.control.zeroing import stored_zeros
from cell.errors import ModelError
from cell.service.history import read_day
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer
from recognition.recognizers.level_check import LevelCheckRecognizer
from tests.cell.cells import call
from tests.formats.write import numbers

RELEASES = sorted(one for one in Path(__file__).parent.iterdir() if one.name[0].isdigit())
MOST_BYTES = 300_000
FEATURES = {kind.__name__: kind.version for kind in (ForceRampRecognizer, LevelCheckRecognizer)}
"""Version of the features of each recognizer."""


@pytest.fixture(params=RELEASES, ids=lambda folder: folder.name)
def release(request: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files of a release, copied to the working folder."""
    folder: Path = shutil.copytree(request.param, tmp_path / "cell")
    monkeypatch.chdir(folder)
    return folder


def test_the_files_of_a_release_are_small() -> None:
    assert RELEASES
    for folder in RELEASES:
        n_bytes = sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())
        assert 0 < n_bytes <= MOST_BYTES, folder.name


@pytest.mark.usefixtures("release")
def test_numbers_of_faults_and_states_stay() -> None:
    now = numbers()
    for kind, of_release in json.loads(Path("numbers.json").read_text()).items():
        assert of_release.items() <= now[kind].items()


@pytest.mark.slow
def test_config_data_set_and_models_are_used(release: Path) -> None:
    assert "valid: press-4" in " ".join(call("config", "check", "tactile-cell.yaml").split())
    call("model", "train", "parts.npz", "-o", "new.npz")
    for model in ("parts.model.npz", "default.model.npz", "new.npz"):
        with np.load(model) as arrays:
            of_today = (
                arrays["learnt.version"] == FEATURES[json.loads(str(arrays["model"]))["class"]]
            )
        if not of_today:
            # Other features name other models; the data set trains a new one.
            with pytest.raises(ModelError, match="train again"):
                call("identify", "parts.npz", "-m", model)
            continue
        text = call("identify", "parts.npz", "-m", model)
        assert text.count("(was ball)") + text.count(": ball ") >= 4, model
    call("model", "evaluate", "parts.npz", "--train", "parts.npz", "--recognizer", "level_check")


@pytest.mark.slow
def test_recording_and_archive_are_read(release: Path) -> None:
    (recording,) = release.glob("jobs/identify-*/recording.mcap")
    assert "identify-" in call("recording", "list", "jobs")
    call("recording", "report", recording)
    assert "complete" in call("recording", "recover", recording, "-o", "again.mcap")
    assert "ball" in call("identify", recording, "-m", "parts.model.npz")
    call("archive", "report", "archive", "--json", "archive.json")
    assert json.loads(Path("archive.json").read_text())
    assert call("archive", "add", recording, "parts.npz", "--to", "archive").startswith("1 grasps")


def test_what_the_cell_keeps_is_used_again(release: Path) -> None:
    zeros = stored_zeros(load_config(Path("tactile-cell.yaml")), Path("jobs"), new_hand=False)
    zeros.now_s = lambda: zeros.measured_s + 3600.0  # it is used for a day
    assert zeros.newest is not None
    path = Path("jobs/history-press-4.sqlite3")
    with closing(sqlite3.connect(path)) as table:
        ((day,),) = table.execute("SELECT DISTINCT day FROM events").fetchall()
    assert [row["kind"] for row in read_day(path, date.fromisoformat(day))] == ["start"]


def test_findings_and_backups_of_the_commissioning_are_read(release: Path) -> None:
    folder = release / "commissioned"
    assert len(read_commissioned(folder / "commissioning.json").steps) == 8
    for servo_id in (1, 2):
        registers = read_backup(backup_file(folder, servo_id))
        assert registers is not None
        assert registers["model_number"] == 1020
    assert load_config(folder / "tactile-cell.yaml").tactile.board_serial_numbers == (1, 2)
