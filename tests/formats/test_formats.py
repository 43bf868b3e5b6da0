"""Files of earlier and present versions through the commands, and files of later ones."""

import json
import shutil
import zipfile
from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.config.file import load_config
from cell.config.tactile import layout_from_config
from cell.control.self_zero import kept_zeros
from cell.data import formats
from cell.data.formats import Format
from cell.data.recording_reader import read_recording
from cell.errors import CellError, ConfigError
from cell.interfaces.cli.app import app
from cell.service.history import History, read_day
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tests.cell.commissioning.script import SimulatedLines
from tests.cell.conftest import call
from tests.cell.data.test_recording_messages import GOOD, foreign

HERE = Path(__file__).parent
EARLIER = sorted(path.name for path in HERE.iterdir() if (path / "small.yaml").exists())


@pytest.fixture(params=EARLIER)
def files(request: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the files of an earlier version, and go there."""
    shutil.copytree(HERE / request.param, tmp_path / "files")
    monkeypatch.chdir(tmp_path / "files")
    return tmp_path / "files"


@pytest.mark.parametrize("name", ["small.yaml", "cell/tactile-cell.yaml"])
def test_configs_are_read_once_the_command_that_they_name_has_converted_them(files, name) -> None:
    path, before = files / name, (files / name).read_text()
    with pytest.raises(ConfigError, match=rf"is obsolete: `tactile-cell config convert {path}`"):
        call("config", "check", path)
    said = call("config", "convert", path)
    assert "sequence.candidates: removed" in said
    assert call("config", "check", path).startswith(f"{path}: valid")
    copy = path.with_suffix(".1.yaml")
    assert (copy.read_text(), f"copy of the old file: {copy}" in said) == (before, True)
    left = path.read_text().splitlines()
    gone = [line.strip() for line in before.splitlines() if line not in left]
    assert "candidates: 8" in gone or gone == ["candidates: 24"]
    assert call("config", "convert", path) == f"{path}: no key is obsolete, the file is unchanged\n"


def test_grasps_models_and_recordings_are_read(files) -> None:
    call("config", "convert", "small.yaml")
    for model in ("force_ramp.npz", "again.npz"):
        said = call("identify", "-m", model, "grasps.npz", "-c", "small.yaml")
        named = [line.split()[2] for line in said.splitlines()]
        assert named == ["ball"] * 4 + ["box"] * 4
        said = call("identify", "-m", model, "recording.mcap", "-c", "small.yaml")
        assert said.split()[2] == "ball"
        call("train", "grasps.npz", "--no-early", "-o", "again.npz")
    said = call("identify", "-m", "force_ramp.npz", "-c", "small.yaml", "--object", "ball")
    assert "(it was ball)" in said
    with pytest.raises(CellError, match="the model was taught on 18 taxels in 2 pads"):
        call("identify", "-m", "level_check.npz", "grasps.npz", "-c", "small.yaml")
    assert "bit for bit the same" in call("replay", "recording.mcap", "-c", "small.yaml")
    assert call("report", "recording.mcap") == "report: report.html\n"
    assert "ball" in (files / "report.html").read_text()
    call("teach", "egg", "--from", "recording.mcap", "-o", "grasps.npz")
    assert "complete, nothing is lost" in call("recover", "recording.mcap", "-o", "whole.mcap")
    assert len(read_recording("whole.mcap").grasps) == 1


@pytest.fixture
def commissioned(files: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedCell]:
    """The cell that was commissioned in ``cell``, on the ports of this machine."""
    call("config", "convert", "cell/tactile-cell.yaml")
    config = load_config(files / "cell" / "tactile-cell.yaml")
    layout = layout_from_config(config.tactile)
    settings = SimulatorSettings(layout=layout, noise=NoiseModel(level=0.4), aperture_m=0.03)
    with SimulatedCell(settings) as cell:
        lines = SimulatedLines(cell)
        monkeypatch.setattr("cell.commissioning.bench.LineOpener", lambda: lines)
        yield cell


def test_a_commissioned_cell_is_done_and_its_servos_come_back(files, commissioned) -> None:
    done = call("commission", "cell")
    assert "commissioned: cell/tactile-cell.yaml" in done
    restored = CliRunner().invoke(app, ["commission", "cell", "--restore"], input="y\n")
    assert restored.exit_code == 0, restored.output
    servos = [servo.core.registers for servo in commissioned.devices.servo_bus.servos]
    for number, registers in enumerate(servos, start=1):
        found = json.loads((files / "cell" / f"backup-servo{number}.json").read_text())["found"]
        for name in ("id", "baud_rate", "operating_mode", "return_delay_time"):
            assert registers.get(name) == found[name], name
    kept = json.loads((files / "cell" / "commissioning.json").read_text())
    assert kept["format"] == str(formats.COMMISSIONING)
    # What was found by the restored servos does not hold any more.
    assert "servos" not in kept["steps"]
    assert {"ports", "unit", "pads_law"} < set(kept["steps"])


def test_a_self_zero_is_to_be_measured_again(files) -> None:
    call("config", "convert", "small.yaml")
    said = " ".join(call("doctor", "-c", "small.yaml").split())
    assert "it names no format, expected tactile-cell-self-zero/2; `tactile-cell zero`" in said
    call("zero", "-c", "small.yaml")
    said = call("doctor", "-c", "small.yaml")
    assert "pads meet at" in said
    assert "is not used" not in said


def test_an_archive_is_read_and_added_to(tmp_path) -> None:
    fleet = tmp_path / "fleet"
    shutil.copytree(HERE / "archive-1", fleet)
    call("archive", "export", fleet, "-o", tmp_path / "some.npz", "--object", "ball")
    with np.load(tmp_path / "some.npz") as found:
        assert found["label"].tolist() == ["ball"] * 4
    said = call("archive", tmp_path / "some.npz", "--to", fleet)
    assert "0 grasps of 1 files added" in said
    assert "4 grasps were there already" in said


@pytest.fixture
def current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy files of the formats that are written now, and go there."""
    shutil.copytree(HERE / "63b50b2f", tmp_path / "files")
    monkeypatch.chdir(tmp_path / "files")
    return tmp_path / "files"


def test_files_of_the_present_formats_are_read(current) -> None:
    for name in ("current.yaml", "boards.yaml"):
        assert call("config", "check", name).startswith(f"{name}: valid")
        assert "no key is obsolete" in call("config", "convert", name)
    assert load_config(current / "boards.yaml").tactile.serial_ports == (
        "/dev/ttyUSB1", "/dev/ttyUSB2",
    )  # fmt: skip
    call("train", "grasps.npz", "--recognizer", "shrinkage_lda", "--no-early", "-o", "again.npz")
    for model in ("shrinkage_lda.npz", "again.npz"):
        said = call("identify", "-m", model, "grasps.npz", "-c", "current.yaml")
        assert [line.split()[2] for line in said.splitlines()] == ["ball"] * 4 + ["box"] * 4
    path = Path("out/serve-20261123-140000/recording.mcap")
    path.parent.mkdir()
    path.touch()
    assert f"{path}: MB 0.0, age / days 0.0" in call("recordings", "list", "out")


def test_the_self_zero_and_the_drives_of_the_present_format_count(current) -> None:
    kept = kept_zeros(load_config(current / "current.yaml"), Path("out"), new_hand=False)
    kept.now_s = lambda: kept.measured_s
    assert kept.refused == ""
    assert kept.newest.opening_m == pytest.approx(0.42e-3, abs=1e-5)
    assert [drive.breakaway_a for drive in kept.kept_drives({}).values()] == pytest.approx(
        [0.137, 0.132], abs=1e-3
    )
    said = call("doctor", "-c", "current.yaml")
    assert "self-zero: none of today, the last is of 2026-11-23" in said
    assert "servo 1: friction 0.137 A" in said


def test_a_history_of_the_present_format_is_read_and_goes_on(current) -> None:
    path, day = Path("out/history-small-pads.sqlite3"), date(2026, 11, 23)
    rows = read_day(path, day)
    assert [row["kind"] for row in rows] == ["start", "part", "part"]
    assert [row["label"] for row in rows[1:]] == ["ball", "box"]
    now_s = datetime(2026, 11, 23, 23).timestamp()
    status: Any = SimpleNamespace(n_faults=0, fault=None, fault_number=0)
    kept = History(path, lambda: status, wall_s=lambda: now_s)
    kept.update()
    kept.close()
    assert (kept.values()["today"]["parts"], kept.values()["today"]["starts"]) == (2, 2)


def test_a_backup_of_the_present_format_is_put_back(current, monkeypatch) -> None:
    assert "1 files of press" in call("restore", "cell.zip", "--folder", "new", "--yes")
    config = load_config(current / "new" / "tactile-cell.yaml")
    assert (config.name, config.gripper.port) == ("press", "/dev/ttyUSB0")
    with SimulatedCell(SimulatorSettings(layout=layout_from_config(config.tactile))) as cell:
        monkeypatch.setattr("cell.commissioning.bench.LineOpener", lambda: SimulatedLines(cell))
        cell.devices.servo_bus.servos[0].core.registers.configure("return_delay_time", 99)
        done = call("restore", "cell.zip", "--folder", "new", "--servos", "--unit", "--yes")
    assert "servo 1: 1 items restored" in done
    assert "all objects of the control unit are as in the backup" in done


def later(kind: Format) -> str:
    """Return what a file of the next version names."""
    name, version = kind.text.split("/")
    return f"{name}/{int(version) + 1}"


def later_arrays(path: Path, kind: Format) -> None:
    """Write an archive of the next version."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    for name, array in arrays.items():
        if array.dtype.kind == "U" and not array.ndim:
            arrays[name] = np.array(str(array).replace(kind.text, later(kind)))
    np.savez(path, **arrays)


def later_text(path: Path, kind: Format) -> None:
    """Write a text of the next version, with a key that is not known here."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"format": later(kind), "colour": "blue"}) + "\n")


def later_member(path: Path, kind: Format) -> None:
    """Write a backup of the next version."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.json", json.dumps({"format": later(kind)}))


def later_recording(path: Path, kind: Format) -> None:
    """Write a recording of the next version."""
    foreign(path, b"{}", metadata=GOOD | {"format": later(kind)})


LATER = (
    (formats.CONFIG, later_text, "small.yaml", "config check small.yaml"),
    (formats.DATASET, later_arrays, "grasps.npz", "train grasps.npz -o new.npz"),
    (formats.MODEL, later_arrays, "force_ramp.npz", "identify -m force_ramp.npz grasps.npz"),
    (formats.RECORDING, later_recording, "recording.mcap", "recover recording.mcap"),
    (formats.COMMISSIONING, later_text, "cell/commissioning.json", "commission cell"),
    (formats.SERVO_BACKUP, later_text, "cell/backup-servo1.json", "commission cell --restore"),
    (formats.CELL_BACKUP, later_member, "cell.zip", "restore cell.zip"),
    (formats.RETENTION, later_text, "out/recordings.json", "recordings list out"),
    (formats.ARCHIVE, later_text, "fleet/_archive.json", "archive export fleet -o some.npz"),
)


@pytest.mark.parametrize(("kind", "write", "file", "command"), LATER, ids=[f for *_, f, _ in LATER])
def test_a_file_of_a_later_version_is_refused_with_the_way_to_read_it(
    commissioned, kind, write, file, command
) -> None:
    write(Path(file), kind)
    with pytest.raises(CellError, match=rf"{later(kind)}; this program reads up to {kind}: update"):
        call(*command.split())


def test_a_self_zero_of_a_later_version_does_not_count(files) -> None:
    call("config", "convert", "small.yaml")
    later_text(Path("out/self-zero-small-pads.json"), formats.SELF_ZERO)
    said = " ".join(call("doctor", "-c", "small.yaml").split())
    assert "self-zero/3; this program reads up to tactile-cell-self-zero/2: update" in said


def test_every_format_has_a_file_of_a_later_version() -> None:
    kinds = [kind for kind in vars(formats).values() if isinstance(kind, Format)]
    assert {id(kind) for kind in kinds} == {id(kind) for kind, *_ in LATER} | {
        id(formats.SELF_ZERO)
    }
