"""Backup of a cell: what it has, its restore in a new folder, and what is refused unwritten."""

import io
import os
import random
import re
import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest
import trimesh

from cell.commissioning.cell_backup import restore
from cell.config.file import changed_config, config_text
from cell.config.model import CellConfig
from cell.errors import CellError
from tests.cell.conftest import REAL, call, small_config

FILES = {
    "commissioning.json": b"{}",
    "commissioning.md": b"<p>signed",
    "backup-servo1.json": b"{}",
    "bolts.npz": b"model" * 1000,
    "bolts.grasps.npz": b"grasps" * 5000,
    "bolts.photos/0a.jpg": b"\xff\xd8\xff",
    "out/self-zero-press-4.json": b'{"servos": {"1": 1.1}}',
}
CONFIG = "tactile-cell.yaml"


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the folder of a real cell, and go there."""
    folder = tmp_path / "here"
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "out" / "run-20270101-000000").mkdir()
    (folder / "out" / "run-20270101-000000" / "recording.mcap").touch()
    (folder / "token").write_text("secret")
    config = changed_config(CellConfig(name="press-4"), REAL | {"serve.token_file": "token"})
    (folder / CONFIG).write_text("# our press\n" + config_text(config))
    monkeypatch.chdir(folder)
    return folder


def there(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_restored_folder_has_the_files_of_the_cell_but_no_recording_and_no_secret(cell) -> None:
    assert re.fullmatch(
        r"\.\./cell\.tar: 8 files, 0\.\d MB\n", call("service", "backup", "../cell.tar")
    )
    assert (
        call("service", "restore", "../cell.tar", "../new/4")
        == "../new/4: 8 files of ../cell.tar\n"
    )
    expected = FILES | {CONFIG: (cell / CONFIG).read_bytes()}
    assert there(cell.parent / "new") == {f"4/{name}": data for name, data in expected.items()}
    (cell.parent / "empty").mkdir()
    call("service", "restore", "../cell.tar", "../empty")
    assert there(cell.parent / "empty") == expected


def test_a_model_of_another_folder_is_in_the_backup_with_its_data_set_and_photos(cell) -> None:
    elsewhere = cell.parent / "else"
    (elsewhere / "[1].photos").mkdir(parents=True)
    names = ("[1].npz", "[1].grasps.npz", "[1].photos/ff.png")
    for name in names:
        (elsewhere / name).write_text(name)
    (elsewhere / "1.npz").touch()
    call("service", "backup", "b.tar", "--model", "../else/[1].npz")
    call("service", "restore", "b.tar", "../new")
    added = {name: name.encode() for name in names}
    assert there(cell.parent / "new") == FILES | added | {CONFIG: (cell / CONFIG).read_bytes()}


@pytest.mark.slow
def test_shapes_that_the_config_names_are_found_again(tmp_path, monkeypatch) -> None:
    (before := tmp_path / "before").mkdir()
    monkeypatch.chdir(before)
    trimesh.creation.box((16.0, 9.0, 9.0)).export("part.stl")

    def config(mesh: str) -> str:
        objects = [{"label": "part", "shape": f"mesh:file={mesh}"}]
        return config_text(changed_config(small_config(), {"simulator.objects": objects}))

    Path("press.yaml").write_text(config("part.stl"))
    call("service", "backup", "../cell.tar", "-c", "press.yaml")
    call("service", "restore", "../cell.tar", "../after")
    shutil.rmtree(before)
    monkeypatch.chdir(tmp_path / "after")
    call("config", "check", CONFIG)
    Path("elsewhere.yaml").write_text(config("../part.stl"))
    with pytest.raises(CellError, match=r"\.\./part\.stl is outside of the folder of the config"):
        call("service", "backup", "../other.tar", "-c", "elsewhere.yaml")


def test_what_cannot_be_backed_up_is_named_and_nothing_is_written(cell) -> None:
    (cell / "else").mkdir()
    (cell / "else" / "bolts.npz").touch()
    for arguments, message in (
        (("--model", "else/bolts.npz"), "bolts.npz and else/bolts.npz have the same name; rename"),
        (("--model", "gone.npz"), "cannot read file gone.npz: No such file"),
        (("-c", "gone.yaml"), "cannot read config gone.yaml"),
    ):
        with pytest.raises(CellError, match=message):
            call("service", "backup", "b.tar", *arguments)
    assert not (cell / "b.tar").exists()
    (cell / "b.tar").write_text("other")
    with pytest.raises(CellError, match="exists; backups are never overwritten, name another"):
        call("service", "backup", "b.tar")
    assert (cell / "b.tar").read_text() == "other"
    (cell / CONFIG).unlink()
    with pytest.raises(CellError, match=f"cannot read config {CONFIG}"):
        call("service", "backup", "c.tar")


def member(name: str, kind: bytes = tarfile.REGTYPE, **values: Any) -> tarfile.TarInfo:
    made = tarfile.TarInfo(name)
    made.type = kind
    for key, value in values.items():
        setattr(made, key, value)
    return made


HOSTILE = {
    "beside": [member("../x")],
    "beside, from below": [member("a/../../x")],
    "absolute": [member("/tmp/tactile-cell-x")],
    "link": [member("x", tarfile.SYMTYPE, linkname="/etc/passwd")],
    "through a link": [member("x", tarfile.SYMTYPE, linkname=".."), member("x/y")],
    "hard link": [member("x", tarfile.LNKTYPE, linkname=CONFIG)],
    "pipe": [member("x", tarfile.FIFOTYPE)],
    "device": [member("x", tarfile.CHRTYPE, devmajor=1, devminor=5)],
    "larger than the backup": [member("x", tarfile.GNUTYPE_SPARSE)],
    "less than nothing": [member("x", size=-1024)],
}


@pytest.mark.parametrize("members", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("form", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_paths_that_leave_the_folder_links_and_devices_are_refused(tmp_path, members, form) -> None:
    path = tmp_path / "b.tar"
    with tarfile.open(path, "w", format=form) as archive:
        archive.addfile(member(CONFIG, size=2), io.BytesIO(b"{}"))
        for one in members:
            archive.addfile(one)
    leaves = members[0].name != "x"
    reason = "leaves the folder" if leaves else "is a link, a device or another special file"
    with pytest.raises(
        CellError, match=f"b.tar: '{members[0].name}' {reason}; nothing was written"
    ):
        call("service", "restore", path, tmp_path / "folder" / "cell")
    assert [one.name for one in tmp_path.iterdir()] == ["b.tar"]
    assert not Path("/tmp/tactile-cell-x").exists()


def test_a_folder_with_files_is_refused_and_stays(cell) -> None:
    call("service", "backup", "../b.tar")
    before = there(cell)
    for folder in (cell, cell / "token"):
        with pytest.raises(CellError, match="is not an empty folder; name a new folder"):
            call("service", "restore", "../b.tar", folder)
    assert there(cell) == before


@pytest.mark.slow
def test_a_damaged_backup_leaves_nothing_behind(cell) -> None:
    call("service", "backup", "../b.tar")
    path, new, random_ = cell.parent / "b.tar", cell.parent / "new", random.Random(7)
    whole, before = path.read_bytes(), there(cell)
    end = whole.rindex(b"our press")
    for length in (0, 1, 512, *(random_.randrange(end) for _ in range(20))):
        path.write_bytes(whole[:length])
        with pytest.raises(CellError, match="use another copy of"):
            restore(path, new)
        assert sorted(one.name for one in cell.parent.iterdir()) == ["b.tar", "here"]
    n_refused = 0
    for _ in range(100):
        data = bytearray(whole)
        for _ in range(8):
            data[512 * random_.randrange(len(data) // 512) + random_.randrange(265)] ^= 0x2F
        path.write_bytes(data)
        try:
            restore(path, new)
        except CellError:
            n_refused += 1
        shutil.rmtree(new, ignore_errors=True)
        assert sorted(one.name for one in cell.parent.iterdir()) == ["b.tar", "here"]
    assert n_refused > 10
    assert there(cell) == before
    path.write_bytes(b"PK\x03\x04 no tar" * 100)
    with pytest.raises(CellError, match=r"cannot restore .*; use another copy of the backup"):
        call("service", "restore", path, new)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CellError, match="not a plain file"):
        call("service", "restore", path, new)


def test_a_full_disk_leaves_nothing_behind(cell, monkeypatch) -> None:
    call("service", "backup", "../b.tar")

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(tarfile, "copyfileobj", full)
        with pytest.raises(CellError, match=r"No space left on device; use .* another folder"):
            call("service", "restore", "../b.tar", "../new")
        with pytest.raises(CellError, match="no space left"):
            call("service", "backup", "../c.tar")
    assert sorted(one.name for one in cell.parent.iterdir()) == ["b.tar", "here"]
