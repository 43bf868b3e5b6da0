"""Backup of a cell: what it holds, its return on another machine, and what is refused unwritten."""

import itertools
import json
import os
import random
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.commissioning.bench import Bench
from cell.commissioning.cell_backup import MANIFEST, UNDO, back_up, open_backup, restore
from cell.commissioning.unit import unit_values
from cell.config.file import changed_config, config_text, load_config
from cell.config.model import CellConfig
from cell.config.tactile import link_settings
from cell.control.self_zero import zero_file
from cell.data.files import json_bytes
from cell.data.formats import CELL_BACKUP, checksum, json_text
from cell.errors import CellError
from cell.interfaces.cli.app import app
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.control_unit.search import read_unit
from tactile.sensor.opening import open_sensor
from tests.cell.commissioning.script import SimulatedLines
from tests.cell.conftest import REAL, call

FILES = {
    "commissioning.json": b"{}",
    "commissioning.html": b"<p>signed",
    "backup-servo1.json": b"{}",
    "bolts.npz": b"model" * 1000,
    "bolts.grasps.npz": b"grasps" * 5000,
    "bolts.photos/0a.jpg": b"\xff\xd8\xff",
}


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the folder of a real cell, and go there."""
    folder = tmp_path / "here"
    (folder / "bolts.photos").mkdir(parents=True)
    (folder / "run-20270101-000000").mkdir()
    (folder / "run-20270101-000000" / "recording.mcap").touch()
    config = changed_config(CellConfig(name="press 4"), REAL | {"gripper.force_max_n": 12.0})
    (folder / "tactile-cell.yaml").write_text("# our press\n" + config_text(config))
    for name, content in FILES.items():
        (folder / name).write_bytes(content)
    monkeypatch.chdir(folder)
    zero = zero_file(Path(config.recording.directory), config.name)
    zero.parent.mkdir()
    zero.write_text('{"servos": {"1": 1.1}}')
    return folder


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedLines]:
    """Have the devices of the cell answer on its ports."""
    with SimulatedCell(SimulatorSettings()) as simulated:
        found = SimulatedLines(simulated)
        monkeypatch.setattr("cell.commissioning.bench.LineOpener", lambda: found)
        yield found


def there(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder but for backups and recordings."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix not in (".zip", ".mcap")
    }


def made(folder: Path) -> Path:
    path = folder / "cell.zip"
    config = folder / "tactile-cell.yaml"
    back_up(path, config, load_config(config))
    return path


def test_a_backup_holds_the_cell_and_what_its_devices_have_stored(cell, lines) -> None:
    printed = call("backup", "../cell.zip")
    assert printed == f"../cell.zip: press 4, 8 files, {open_size(cell.parent):.1f} MB\n"
    with open_backup(cell.parent / "cell.zip") as backup:
        manifest = backup.manifest
        held = {name: backup.open(name).read() for name in manifest.members}
    assert held == {
        ("jobs/" + name[4:] if name.startswith("out/") else f"cell/{name}"): content
        for name, content in there(cell).items()
    }
    assert [servo.servo_id for servo in manifest.servos] == [1, 2]
    registers = lines.cell.devices.servo_bus.servos[0].core.registers
    assert manifest.servos[0].found["drive_mode"] == registers.get("drive_mode")
    assert manifest.control_unit["identity"]["serial"]
    assert (manifest.missing, manifest.versions.keys()) == (
        [], {"tactile-cell", "python", "system"},
    )  # fmt: skip
    with pytest.raises(CellError, match="exists; backups are never overwritten"):
        call("backup", "../cell.zip")


def open_size(folder: Path) -> float:
    with open_backup(folder / "cell.zip") as backup:
        return sum(one.n_bytes for one in backup.manifest.members.values()) / 1e6


def test_devices_that_do_not_answer_are_named_and_the_rest_is_backed_up(cell, lines) -> None:
    lines.ports = ()
    said = CliRunner().invoke(app, ["backup", "b.zip"], catch_exceptions=False)
    assert "not in the backup: registers of servo 1: cannot open serial port" in said.output
    assert "objects of the control unit: the servos come first" in said.output
    assert "b.zip: press 4, 8 files" in said.output


def test_a_restore_shows_what_differs_asks_and_is_taken_back(cell) -> None:
    path, before = made(cell), there(cell)
    with pytest.raises(CellError, match="there is nothing to undo: restore-undo"):
        call("restore", "--undo")
    config = cell / "tactile-cell.yaml"
    config.write_text(config.read_text().replace("force_max_n: 12", "force_max_n: 9"))
    (cell / "bolts.npz").write_bytes(b"worse")
    (cell / "commissioning.html").unlink()
    changed = there(cell)
    refused = CliRunner().invoke(app, ["restore", str(path)], input="n\n")
    assert refused.exit_code == 1
    assert "tactile-cell.yaml: gripper.force_max_n: 9.0 -> 12.0" in refused.output
    assert "bolts.npz: file: 5 bytes" in refused.output
    assert "commissioning.html: file: none -> 9 bytes" in refused.output
    assert there(cell) == changed
    assert "3 files of press 4" in call("restore", path, "--yes")
    assert there(cell) == before
    assert "all files are as in the backup" in call("restore", path)
    call("restore", "--undo", "-y")
    assert there(cell) == changed
    call("restore", "--undo", "-y")  # an undo is taken back, too
    assert there(cell) == before


def test_a_machine_with_other_ports_keeps_them(cell, tmp_path) -> None:
    path, other = made(cell), tmp_path / "there"
    other.mkdir()
    config = load_config(cell / "tactile-cell.yaml")
    ports = {"gripper.port": "/dev/ttyACM7", "tactile.channel": "can3"}
    text = config_text(changed_config(config, ports), comments=False)
    (other / "tactile-cell.yaml").write_text(text)
    printed = call("restore", path, "--folder", other, "--yes")
    assert "kept from this machine: gripper.port /dev/ttyACM7" in printed
    assert "kept from this machine: tactile.channel can3" in printed
    found = (other / "tactile-cell.yaml").read_text()
    assert load_config(other / "tactile-cell.yaml") == changed_config(config, ports)
    assert found.startswith("# our press\n")  # comments stay
    for name, content in FILES.items():
        assert (other / name).read_bytes() == content


def test_a_new_machine_gets_all_files_and_an_undo_removes_them(cell, tmp_path) -> None:
    path, other = made(cell), tmp_path / "new"
    restore(path, other, len)
    expected = {k: v for k, v in there(cell).items() if not k.startswith("out/")}
    assert there(other) == expected
    restore(other / UNDO, other, len)
    assert there(other) == {}


def test_registers_of_the_servos_come_back(cell, lines) -> None:
    call("backup", "b.zip")
    registers = lines.cell.devices.servo_bus.servos[0].core.registers
    wanted = registers.get("return_delay_time")
    registers.configure("return_delay_time", wanted + 5)
    printed = call("restore", "b.zip", "--servos", "--yes")
    assert "servo 1: 1 items restored" in printed
    assert registers.get("return_delay_time") == wanted


def test_objects_of_the_control_unit_come_back(cell, lines) -> None:
    config = load_config(cell / "tactile-cell.yaml").tactile
    layout, unit = lines.cell.settings.layout, f"control unit, node {config.node_id}"

    def registers(*, start: bool = False) -> tuple[tuple[str, int], ...]:
        with Bench(cell, lines).can_bus() as bus:
            if start:
                link = link_settings(config)
                with open_sensor(bus, layout, node_id=config.node_id, link=link):
                    pass
            return read_unit(bus, config.node_id).registers

    call("backup", "b.zip")
    before = registers()
    assert "objects of the control unit are as in the backup" in call("restore", "b.zip", "--unit")
    as_set = registers(start=True)
    differing = [(one, two) for one, two in zip(as_set, before, strict=True) if one != two]
    assert len(differing) >= 3, (before, as_set)
    refused = CliRunner().invoke(app, ["restore", "b.zip", "--unit"], input="n\n")
    assert refused.exit_code == 1
    for (name, value), (_, wanted) in differing:
        assert f"{unit}: {name}: {value} -> {wanted}" in refused.output
    assert registers() == as_set
    call("backup", "set.zip")
    printed = call("restore", "b.zip", "--unit", "--servos", "-y")
    assert "all servos are as they were found" in printed
    assert f"unit: {len(differing)} objects as in the backup, until it is switched off" in printed
    assert registers() == before
    call("restore", "set.zip", "--unit", "-y")  # a backup made before is the way back
    assert registers() == registers(start=True) == as_set


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"node_id": 9}, "has node_id 5, the backup has 9: this is another unit"),
        ({"layout_hash": "0"}, "this is another unit, so nothing was written"),
        ({"registers": [["heartbeat (1017h) in ms", 70_000]]}, "an object of 2 bytes"),
        ({"registers": [["heartbeat (1017h) in ms", "x"]]}, "is damaged"),
        ({}, "holds no objects of a control unit"),
    ],
)
def test_objects_of_another_unit_and_values_that_do_not_fit_are_refused(
    cell, lines, changed, message
) -> None:
    bench = Bench(cell, lines)
    kept = json.loads(json_bytes(unit_values(bench) | changed)) if changed else {}
    hostile(cell / "b.zip", "cell/tactile-cell.yaml", control_unit=kept)
    with pytest.raises(CellError, match=re.escape(message)):
        call("restore", "b.zip", "--unit", "-y")
    assert unit_values(bench)["registers"][2] == ("heartbeat (1017h) in ms", 0)


def hostile(path: Path, member: str, content: bytes = b"x", **changes: Any) -> None:
    """Write a backup whose checksums fit, with a member that no cell has."""
    content_of = {member: content}
    values = {
        "name": "c", "made": "", "versions": {}, "config": "cell/c.yaml", "directory": "out",
        "members": {member: {"n_bytes": len(content), "sha256": checksum([content])}},
    } | changes  # fmt: skip
    packing = zipfile.ZIP_DEFLATED if len(content) > 1000 else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", packing) as archive:
        archive.writestr(MANIFEST, json_text(CELL_BACKUP, values))
        for name, data in content_of.items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    "member",
    ["../evil.yaml", "cell/../../evil.yaml", "/etc/evil.yaml", "cell/.bashrc", "cell/a/b.yaml",
     "cell\\..\\evil.yaml", "jobs/evil.py", "jobs/package.json",
     "cell/x.photos/../../y.jpg", "C:/evil.yaml"],
)  # fmt: skip
@pytest.mark.parametrize("absent", [False, True])
def test_files_of_no_cell_are_refused(tmp_path, member, absent) -> None:
    path = tmp_path / "b.zip"
    hostile(path, "cell/c.npz" if absent else member, absent=[member] if absent else [])
    with pytest.raises(CellError, match="not a file of a cell; use another copy"):
        call("restore", path, "--folder", tmp_path / "cell", "-y")
    assert [one.name for one in tmp_path.iterdir()] == ["b.zip"]


def test_bombs_other_formats_and_foreign_files_are_refused(tmp_path) -> None:
    path = tmp_path / "b.zip"
    hostile(path, "cell/a.npz", bytes(100_000_000))
    with pytest.raises(CellError, match="it is compressed, has a file twice"):
        call("restore", path, "-y")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "b")
    with pytest.raises(CellError, match=r"it has no manifest\.json"):
        call("restore", path, "-y")
    text = json.dumps({"format": "tactile-cell-backup/2"})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(MANIFEST, text)
    with pytest.raises(CellError, match=r"reads tactile-cell-backup/1; use another copy"):
        call("restore", path, "-y")
    path.write_bytes(b"no archive")
    with pytest.raises(CellError, match="is damaged"):
        call("restore", path, "-y")


def test_no_damage_gets_past_the_checksums(cell) -> None:
    path = made(cell)
    (cell / "bolts.npz").write_bytes(b"other")
    whole, before, random_ = path.read_bytes(), there(cell), random.Random(7)

    def cut(data: bytearray) -> None:
        del data[random_.randrange(len(data)) :]

    def flip(data: bytearray) -> None:
        data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)

    def gap(data: bytearray) -> None:
        begin = random_.randrange(len(data))
        del data[begin : begin + random_.randrange(1, 5000)]

    ways: list[Callable[[bytearray], None]] = [cut, flip, flip, gap]
    n_refused, other = 0, cell.parent / "other"
    for number in range(200):
        data = bytearray(whole)
        ways[number % 4](data)
        path.write_bytes(data)
        try:
            restore(path, other, len)
        except CellError:
            n_refused += 1
            assert not other.exists()
            continue
        # Times and like fields of the archive do not count.
        held = there(other)
        assert {name: held[name] for name in FILES} == FILES
        shutil.rmtree(other)
    assert n_refused > 160
    assert there(cell) == before


def test_a_restore_that_a_full_disk_ends_is_taken_back(cell, monkeypatch) -> None:
    path = made(cell)
    for name in ("bolts.npz", "commissioning.html"):
        (cell / name).write_bytes(b"other")
    before, written, fsync = there(cell), list[int](), os.fsync

    def limited(handle: int) -> None:
        written.append(handle)
        if len(written) == 3:  # the undo, the first file, and here the second
            raise OSError(28, "No space left on device")
        fsync(handle)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", limited)
        with pytest.raises(CellError, match="no space left"):
            call("restore", path, "-y")
    half = there(cell)
    assert half != before
    call("restore", path, "-y")  # the person goes on, and regrets all of it
    call("restore", "--undo", "-y")
    assert there(cell) == half
    call("restore", "restore-undo.1.zip", "-y")
    assert there(cell) == before


def test_files_that_change_meanwhile_and_names_that_collide_are_refused(cell, monkeypatch) -> None:
    (cell / "else").mkdir()
    (cell / "else" / "bolts.npz").touch()
    with pytest.raises(CellError, match="have the same name"):
        call("backup", "b.zip", "--no-devices", "--model", "else/bolts.npz")
    config = cell / "tactile-cell.yaml"
    sums = map(str, itertools.count())
    monkeypatch.setattr("cell.commissioning.cell_backup.checksum", lambda _pieces: next(sums))
    with pytest.raises(CellError, match="has just changed; make the backup again"):
        back_up(cell / "b.zip", config, load_config(config))
    assert not (cell / "b.zip").exists()
