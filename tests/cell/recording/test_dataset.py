"""Data sets: what is written comes back, and what is damaged or hostile is refused."""

import errno
import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cell import files
from cell.archive.store import Archive
from cell.commissioning.findings import read_commissioned
from cell.commissioning.servos import read_backup
from cell.config.file import load_config
from cell.config.gripper import measured_drive
from cell.control.zeroing import SelfZeros
from cell.errors import CellError, DatasetError
from cell.files import Format
from cell.learning.model import load_model
from cell.recording.dataset import read_dataset, write_dataset
from cell.recording.reader import read_recording
from gripper.dynamixel.models import XM430_W350
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero
from tests.cell.recording.test_recording import GOOD, foreign
from tests.values import make_pads, raising

PADS = make_pads(((3, 2), (2, 2)), pitch_m=6.5e-3, adc_max=255)
ZERO = SelfZero.from_values([1e-3, 1e-4, 0.1, 0.02, 8.0, 0.2])


def make_grasp(seed: int = 0, n_frames: int = 4, pads: PadArray = PADS, **changes: Any) -> Grasp:
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "pads": pads,
        "counts": rng.integers(0, pads.adc_max + 1, (n_frames, pads.n_taxels)),
        "t_s": np.arange(n_frames) / 32,
        "aperture_m": np.linspace(0.03, 0.01, n_frames),
        "force_n": np.linspace(0.0, 8.0, n_frames),
        "label": "ball",
        "shape": "sphere",
        "source": "test",
        "start_ms": 1_700_000_000_000 + seed,
    }
    return Grasp(**(values | changes))


def arrays_of(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "good.npz"
    write_dataset(path, [make_grasp(0), make_grasp(1, 2), make_grasp(2, 7, label="box")])
    return path


def test_what_is_written_comes_back(tmp_path) -> None:
    grasps = [
        make_grasp(0),
        make_grasp(1, 1, label="", shape="", source="", force_n=np.array([np.nan])),
        make_grasp(2, 9, aperture_m=np.full(9, np.nan), label="Müller's <b>Kugel</b>"),
        make_grasp(3, thickness_m=4e-3, series="apple 2"),
        make_grasp(4, command=GraspCommand.from_values([1e-3, -2e-3, 0.5, 6.0, 4.0])),
        *(make_grasp(i, zero=ZERO) for i in (5, 6)),
    ]
    write_dataset(tmp_path / "d.npz", grasps)
    back = read_dataset(tmp_path / "d.npz")
    assert len(back) == 7
    assert back[5].zero is back[6].zero
    assert all(grasp.pads is back[0].pads for grasp in back)
    assert back[0].pads.same_as(PADS)
    for was, now in zip(grasps, back, strict=True):
        np.testing.assert_array_equal(now.counts, was.counts)
        for name in ("t_s", "aperture_m", "force_n", "thickness_m"):
            np.testing.assert_allclose(getattr(now, name), getattr(was, name), rtol=1e-6)
        for name in ("label", "shape", "source", "series", "start_ms", "command", "zero"):
            assert getattr(now, name) == getattr(was, name)


def test_file_is_the_documented_format_for_numpy_alone(good) -> None:
    arrays = arrays_of(good)
    assert (str(arrays["format"]), arrays["counts"].dtype) == ("grasp-dataset/1", np.uint16)
    assert (arrays["counts"].shape, arrays["grasp_offsets"].tolist()) == ((13, 10), [0, 4, 6, 13])
    assert {arrays[name].dtype.name for name in ("aperture_mm", "force_n", "t_s")} == {"float32"}
    assert arrays["aperture_mm"][0] == pytest.approx(30.0)
    with zipfile.ZipFile(good) as archive:
        assert {m.compress_type for m in archive.infolist()} == {zipfile.ZIP_DEFLATED}


def test_optional_arrays_are_left_out_where_nothing_is_known(tmp_path) -> None:
    blank = make_grasp(shape="", source="", force_n=np.full(4, np.nan))
    write_dataset(tmp_path / "d.npz", [blank])
    optional = {"force_n", "shape", "source", "series", "thickness_mm", "pose", "self_zero"}
    assert not optional & set(arrays_of(tmp_path / "d.npz"))
    assert np.all(np.isnan(read_dataset(tmp_path / "d.npz")[0].force_n))


DAMAGE: list[tuple[str, Callable[[Any], Any], str]] = [
    ("counts", lambda _: None, "counts missing"),
    ("model", lambda _: "x", "is a model, not a data set"),
    ("force_N", lambda _: np.zeros(13), "unknown arrays 'force_N'"),
    ("counts", lambda a: a.astype(np.int32), "expected kind u"),
    ("counts", np.ravel, "shape"),
    ("adc_max", lambda _: 100, "adc_max = 100"),
    ("taxel_pad", lambda a: a + 1, "names other pads"),
    ("pad_shape", lambda a: a * 0, "rows and columns of a pad"),
    ("taxel_xy_mm", lambda a: a * np.nan, "not finite"),
    ("taxel_xy_mm", lambda a: a * 1e-3, r"the 6 taxels of pad 0 over 0\.013, .* in mm, not in m"),
    ("taxel_xy_mm", lambda a: a * 1e3, "-6500 at 0, must be from -1000 to 1000: places of .* mm"),
    ("aperture_mm", lambda a: a + np.inf, "is inf at 0, must be from"),
    ("aperture_mm", lambda a: a * 1e-3, r"never exceeds 0\.03, expected 0\.2 .* in mm, not in m"),
    ("aperture_mm", lambda a: -10.0 * a, "aperture_mm is -300 at 0, must be from -100 to 1000"),
    ("t_s", np.negative, "never fall"),
    ("t_s", lambda a: a + 1, "start at 0"),
    ("t_s", lambda a: a * 1e3, r"a frame each 31\.25 s in the mean of grasp 0, .* in s"),
    ("start_ms", lambda _: np.full(3, np.iinfo(np.int64).max), "in ms since 1970"),
    ("start_ms", lambda _: np.full(3, 2**64 - 1, dtype=np.uint64), "in ms since 1970"),
    ("grasp_offsets", lambda a: a + 1, "rise from 0 to the 13"),
    ("grasp_offsets", lambda _: [0, 4, 4, 13], "which rise"),
    ("label", lambda _: ["\x1b[2J"] * 3, "not printable"),
    ("label", lambda _: ["", "b", "UNKNOWN"], "leave it empty"),
    ("label", lambda _: ["x" * 300] * 3, "longer than 200"),
    ("label", lambda _: np.full(3, 0x7FFFFFFF, dtype="<u4").view("<U1"), "not a character"),
    ("pose", lambda _: np.where(np.eye(3, 5), np.nan, 0.1), "must be finite"),
    ("pose", lambda _: np.full((3, 5), 2.0), "pose is 2 at 0, .* offsets in m"),
]
"""Array, what becomes of it (None: it is missing), and the complaint."""


@pytest.mark.parametrize(
    ("name", "change", "says"), DAMAGE, ids=[f"{n}: {t}" for n, _, t in DAMAGE]
)
def test_damage_is_refused_naming_file_and_array(name, change, says, good, tmp_path) -> None:
    arrays = arrays_of(good)
    arrays[name] = change(arrays.get(name))
    if name == "model":  # which has no counts
        del arrays["counts"]
    np.savez(tmp_path / "bad.npz", **{n: a for n, a in arrays.items() if a is not None})
    with pytest.raises(DatasetError, match=says) as caught:
        read_dataset(tmp_path / "bad.npz")
    assert "bad.npz" in str(caught.value)


def npy(header: bytes) -> bytes:
    return b"\x93NUMPY\2\0" + len(header).to_bytes(4, "little") + header


LIE = npy(b"{'descr': '<u2', 'fortran_order': False, 'shape': (99999999999, 99), }") + bytes(64)
VALUE = npy(b"{'descr': '<u2', 'fortran_order': False, 'shape': (1,), }") + bytes(2)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"a.txt": b"x"}, r"array a\.txt: .* expected 8 bytes got 1"),
        ({"a.npy": b""}, "array a: EOF"),
        ({"a.npy": b"PK\5\6" + bytes(18)}, "array a: the magic string is not correct"),
        ({"a.npy": npy(b" " * 20_000)}, "array a: Header"),
        ({"counts.npy": LIE}, "array counts: (Unable to allocate|EOF)"),
        ({"a": VALUE, "a.npy": VALUE}, "1 arrays found, 2 stated"),
        ({"a": VALUE + b"x"}, r"array a: shape \(1,\) does not fit"),
        (
            {f"a{i}.npy": bytes(5_000_000) for i in range(4)},
            "unpacks to 20000000 bytes, the limit is 10000000",
        ),
        (
            b"label: ball\n",
            "is not a grasp data set: it is not an npz archive; name a grasp data set",
        ),
        (b"", "is not a grasp data set: it is empty; name"),
        (b"PK\x03\x04", "is a damaged grasp data set .*; take another copy"),
        (b"\x89MCAP0\r\n" + bytes(100), r"is a recording, not a grasp data set; .* in \.mcap"),
    ],
)
def test_files_of_something_else_or_beyond_a_limit_are_refused(content, says, tmp_path) -> None:
    """An archive of these members, or a file of these bytes."""
    if isinstance(content, bytes):
        (tmp_path / "x.npz").write_bytes(content)
    else:
        with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in content.items():
                archive.writestr(name, data)
    with pytest.raises(DatasetError, match=says):
        read_dataset(tmp_path / "x.npz", limit_bytes=10_000_000)


def test_what_could_not_be_read_again_is_not_written(tmp_path) -> None:
    other = replace(PADS, adc_max=256)
    for grasps, says in (
        ([], "no grasp"),
        ([make_grasp(), make_grasp(pads=other)], "grasp 1 was taken on other pads"),
        ([make_grasp(label="a\0")], "label is .*not printable"),
        (
            [make_grasp(), make_grasp(start_ms=2 * 10**15)],
            r"cannot write .* start_ms is 2e\+15 at 1, must be",
        ),
    ):
        with pytest.raises(DatasetError, match=says):
            write_dataset(tmp_path / "d.npz", grasps)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "says"),
    [(errno.ENOSPC, "no space left"), (errno.EROFS, "not writable"), (errno.EIO, "Input/output")],
)
def test_full_disk_leaves_the_old_file(number, says, good, tmp_path, monkeypatch) -> None:
    path = tmp_path / "d.npz"
    path.write_bytes(good.read_bytes())
    path.chmod(0o640)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", raising(OSError(number, os.strerror(number))))
        with pytest.raises(DatasetError, match=f"{says}.*unchanged"):
            write_dataset(path, [make_grasp()])
    assert path.read_bytes() == good.read_bytes()
    assert list(tmp_path.iterdir()) == [path]
    write_dataset(path, [make_grasp()])
    assert len(read_dataset(path)) == 1
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_missing_folder_and_what_is_no_plain_file_are_refused(tmp_path) -> None:
    with pytest.raises(DatasetError, match="does not exist; make it first"):
        write_dataset(tmp_path / "nowhere" / "d.npz", [make_grasp()])
    with pytest.raises(DatasetError, match="not a plain file"):
        write_dataset(tmp_path, [make_grasp()])
    for path in (tmp_path, tmp_path / "x.npz"):
        with pytest.raises(DatasetError, match="check the path"):
            read_dataset(path)
    assert issubclass(DatasetError, CellError)


# -- Files of another version: each reader refuses them, with both versions and a next step --------


PROGRAM = f"tactile-cell {version('tactile-cell')}"


def text(path: Path, form: str) -> None:
    """Write a text, JSON or YAML, with a key that this version does not have."""
    path.write_text(json.dumps({"format": form, "colour": "blue"}) + "\n")


def arrays(path: Path, form: str) -> None:
    """Write an archive that begins as a data set, and as a model."""
    with path.open("wb") as file:
        np.savez(file, format=np.array(form), model=np.array(json.dumps({"format": form})))


def recording(path: Path, form: str) -> None:
    foreign(path, b"{}", metadata=GOOD | {"format": form})


def archive(path: Path, form: str) -> None:
    path.mkdir()
    text(path / "_archive.json", form)


def self_zero(path: Path) -> None:
    """Read a self-zero; a cell starts without the one that it cannot read."""
    raise CellError(SelfZeros(path=path).refused)


KINDS: list[tuple[Format, Callable[[Path, str], None], Callable[[Path], Any]]] = [
    (files.CONFIG, text, load_config),
    (files.DATASET, arrays, read_dataset),
    (files.MODEL, arrays, load_model),
    (files.RECORDING, recording, read_recording),
    (files.COMMISSIONING, text, read_commissioned),
    (files.SERVO_BACKUP, text, read_backup),
    (files.SERVO_BENCH, text, lambda path: measured_drive(path, XM430_W350)),
    (files.SELF_ZERO, text, self_zero),
    (files.ARCHIVE, archive, lambda path: Archive(str(path))),
]
"""A format, what writes a file of another one, and what reads the file."""


@pytest.mark.parametrize(("kind", "write", "read"), KINDS, ids=[str(k.what) for k, *_ in KINDS])
def test_a_file_of_another_version_is_refused(kind, write, read, tmp_path) -> None:
    name, number = kind.text.split("/")
    other, path = f"{name}/{int(number) + 1}", tmp_path / "backup-servo1.json"
    write(path, other)
    with pytest.raises(CellError) as refused:
        read(path)
    said = str(refused.value)
    assert f"{path}: its format is '{other}', but {PROGRAM} reads {kind}; {kind.remedy}" in said
    every = [kind for kind in vars(files).values() if isinstance(kind, Format)]
    assert len(every) == len(KINDS)
