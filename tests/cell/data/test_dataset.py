"""Data sets: what is written comes back, and what is damaged or hostile is refused."""

import errno
import os
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.data.dataset import read_dataset, write_dataset
from cell.errors import CellError, DatasetError
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero
from tests.cell.conftest import plain_pads
from tests.values import raising

PADS = plain_pads((3, 2), (2, 2), pitch_m=6.5e-3, adc_max=255)
ZERO = SelfZero.from_values([1e-3, 1e-4, 0.1, 0.02, 8.0, 0.05, 8.0, 0.2])


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
        make_grasp(3, thickness_m=4e-3),
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
        np.testing.assert_allclose(now.t_s, was.t_s, rtol=1e-6)
        np.testing.assert_allclose(now.aperture_m, was.aperture_m, rtol=1e-6)
        np.testing.assert_allclose(now.force_n, was.force_n, rtol=1e-6)
        assert (now.label, now.shape, now.source) == (was.label, was.shape, was.source)
        assert (now.start_ms, now.command, now.zero) == (was.start_ms, was.command, was.zero)
        assert now.thickness_m == pytest.approx(was.thickness_m, rel=1e-6, nan_ok=True)


def test_file_is_the_documented_format_for_numpy_alone(good) -> None:
    arrays = arrays_of(good)
    assert str(arrays["format"]) == "grasp-dataset/1"
    assert arrays["counts"].dtype == np.uint16
    assert arrays["counts"].shape == (13, 10)
    assert arrays["grasp_offsets"].tolist() == [0, 4, 6, 13]
    assert {arrays[name].dtype.name for name in ("aperture_mm", "force_n", "t_s")} == {"float32"}
    assert arrays["aperture_mm"][0] == pytest.approx(30.0)
    with zipfile.ZipFile(good) as archive:
        assert {m.compress_type for m in archive.infolist()} == {zipfile.ZIP_DEFLATED}


def test_optional_arrays_are_left_out_where_nothing_is_known(tmp_path) -> None:
    blank = make_grasp(shape="", source="", force_n=np.full(4, np.nan))
    write_dataset(tmp_path / "d.npz", [blank])
    optional = {"force_n", "shape", "source", "thickness_mm", "pose", "self_zero"}
    assert not optional & set(arrays_of(tmp_path / "d.npz"))
    assert np.all(np.isnan(read_dataset(tmp_path / "d.npz")[0].force_n))


@pytest.mark.shared_data
def test_recorded_grasps_load_and_round_trip(tmp_path) -> None:
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        pytest.skip("TACTILE_CELL_DATA does not name the folder with pinch36.npz")
    grasps = read_dataset(Path(folder) / "pinch36.npz")
    assert (len(grasps), sum(g.n_frames for g in grasps)) == (856, 46_861)
    assert len({g.label for g in grasps}) == 36
    write_dataset(tmp_path / "again.npz", grasps)
    was, now = arrays_of(Path(folder) / "pinch36.npz"), arrays_of(tmp_path / "again.npz")
    assert was.keys() == now.keys()
    for name, array in was.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(now[name], array, rtol=1e-6)
        else:
            np.testing.assert_array_equal(now[name], array)


Change = Callable[[dict[str, NDArray[Any]]], Any]

DAMAGE: dict[str, tuple[Change, str]] = {
    "other format": (lambda a: a.update(format=np.array("dataset/1")), "expected grasp-"),
    "format not text": (lambda a: a.update(format=np.array(1)), "its format is"),
    "array missing": (lambda a: a.pop("counts"), "counts missing"),
    "a model": (lambda a: a.update(model=a.pop("counts")), "is a model: name the data sets"),
    "misspelt array": (lambda a: a.update(force_N=a.pop("force_n")), "unknown arrays 'force_N'"),
    "wide counts": (lambda a: a.update(counts=a["counts"].astype(np.int32)), "expected uint16"),
    "flat counts": (lambda a: a.update(counts=a["counts"].ravel()), "shape"),
    "counts over full scale": (lambda a: a.update(adc_max=np.array(100)), "adc_max is 100"),
    "no full scale": (lambda a: a.update(adc_max=np.array(0)), "from 1 to 65535"),
    "taxel without pad": (lambda a: a.update(taxel_pad=a["taxel_pad"] + 1), "name pads"),
    "taxel on wrong pad": (lambda a: a.update(taxel_pad=a["taxel_pad"] * 0), "pad_shape has"),
    "empty pad": (lambda a: a.update(pad_shape=a["pad_shape"] * 0), "rows and columns"),
    "taxel nowhere": (lambda a: a.update(taxel_xy_mm=a["taxel_xy_mm"] * np.nan), "not finite"),
    "infinite aperture": (lambda a: a.update(aperture_mm=a["t_s"] + np.inf), "not finite"),
    "time runs back": (lambda a: a.update(t_s=-a["t_s"]), "never fall"),
    "time starts late": (lambda a: a.update(t_s=a["t_s"] + 1), "start at 0"),
    "integer time": (lambda a: a.update(t_s=a["t_s"].astype(int)), "expected kind f"),
    "offsets beyond": (lambda a: a.update(grasp_offsets=a["grasp_offsets"] + 1), "run from 0"),
    "empty grasp": (lambda a: a.update(grasp_offsets=np.array([0, 4, 4, 13])), "must rise"),
    "label as bytes": (lambda a: a.update(label=a["label"].astype("S")), "expected kind U"),
    "label unprintable": (lambda a: a.update(label=np.array(["\x1b[2J"] * 3)), "not printable"),
    "label reserved": (lambda a: a.update(label=np.array(["", "b", "UNKNOWN"])), "leave it empty"),
    "label endless": (lambda a: a.update(label=np.array(["x" * 300] * 3)), "limit 200"),
    "label no text": (
        lambda a: a.update(label=np.full(3, 0x7FFFFFFF, dtype="<u4").view("<U1")),
        "not a character",
    ),
    "label too few": (lambda a: a.update(label=a["label"][:2]), "shape"),
    "pose with too few numbers": (lambda a: a.update(pose=np.zeros((3, 4))), "shape"),
    "pose known in part": (
        lambda a: a.update(pose=np.where(np.eye(3, 5), np.nan, 0.1)),
        "with some NaN",
    ),
    "pose in mm": (lambda a: a.update(pose=np.full((3, 5), 2.0)), "offsets stand in m"),
    "infinite pose": (lambda a: a.update(pose=np.full((3, 5), np.inf)), "not finite"),
    "openings in metres": (
        lambda a: a.update(aperture_mm=a["aperture_mm"] * 1e-3),
        r"never exceeds 0\.03, expected 0\.2 .* in mm, not in m",
    ),
    "openings far below zero": (
        lambda a: a.update(aperture_mm=-10.0 * a["aperture_mm"]),
        "is -300 at 0, must be from -100",
    ),
    "openings in micrometres": (
        lambda a: a.update(aperture_mm=a["aperture_mm"] * 1e3),
        "is 30000 at 0, must be from -100 to 1000: openings stand in mm",
    ),
    "force far below zero": (
        lambda a: a.update(force_n=-1e3 - a["force_n"]),
        "is -1000 at 0, must be from -100",
    ),
    "places in metres": (
        lambda a: a.update(taxel_xy_mm=a["taxel_xy_mm"] * 1e-3),
        r"the 6 taxels of pad 0 over 0\.013, .* in mm, not in m",
    ),
    "places far away": (lambda a: a.update(taxel_xy_mm=a["taxel_xy_mm"] * 1e30), "must be from"),
    "time in ms": (
        lambda a: a.update(t_s=a["t_s"] * 1e3),
        r"a frame each 31\.25 s in the mean of grasp 0, .* in s",
    ),
    "no time": (lambda a: a.update(t_s=a["t_s"] * 0), "a frame each 0 s"),
    "start in the far future": (
        lambda a: a.update(start_ms=np.full(3, np.iinfo(np.int64).max)),
        "in ms since 1970",
    ),
    "start beyond 64 bits": (
        lambda a: a.update(start_ms=np.full(3, 2**64 - 1, dtype=np.uint64)),
        "64 bits",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_refused_naming_file_and_array(name, good, tmp_path) -> None:
    change, says = DAMAGE[name]
    arrays = arrays_of(good)
    change(arrays)
    np.savez(tmp_path / "bad.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match=says) as caught:
        read_dataset(tmp_path / "bad.npz")
    assert "bad.npz" in str(caught.value)


class Bomb:
    exploded = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (Bomb, "exploded", True)


def test_pickle_in_disguise_is_refused_and_not_run(good, tmp_path) -> None:
    arrays = arrays_of(good) | {"label": np.array([Bomb()] * 3, dtype=object)}
    np.savez(tmp_path / "evil.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match="no pickled objects"):
        read_dataset(tmp_path / "evil.npz")
    assert not Bomb.exploded


def npy(header: bytes, version: int = 1, length: int | None = None) -> bytes:
    stated = (len(header) if length is None else length).to_bytes(2 * version, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + stated + header


LIE = npy(b"{'descr': '<u2', 'fortran_order': False, 'shape': (99999999999, 99), }") + bytes(64)


@pytest.mark.parametrize(
    ("members", "says"),
    [
        ({"a.txt": b"x"}, "not an array"),
        ({"a.npy": b"x"}, "no .npy header"),
        ({"a.npy": npy(bytes(9), 2, 0xFFFFFF)}, "header of"),
        ({"a.npy": npy(b"{1}\n")}, "header cannot be read"),
        ({"a.npy": npy(b"(" * 4032)}, "header cannot be read"),
        ({"counts.npy": LIE}, "do not fill shape"),
        ({f"{i}.npy": b"" for i in range(600)}, "the limit is 512"),
        (
            {f"a{i}.npy": bytes(5_000_000) for i in range(4)},
            "unpacks to 20000000 bytes, the limit is 10000000",
        ),
    ],
)
def test_archives_of_something_else_or_beyond_a_limit_are_refused(members, says, tmp_path) -> None:
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(DatasetError, match=says):
        read_dataset(tmp_path / "x.npz", limit_bytes=10_000_000)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "check the path"),
        (
            b"label: ball\n",
            "is not a grasp data set: it is not an npz archive; name a grasp data set",
        ),
        (b"", "is not a grasp data set: it is empty; name"),
        (b"PK\x03\x04", "is a damaged grasp data set .*; take another copy"),
        (b"\x89MCAP0\r\n" + bytes(100), r"is a recording, not a grasp data set; .* in \.mcap"),
    ],
)
def test_what_is_no_archive_is_refused_with_advice(content, says, tmp_path) -> None:
    if content is not None:
        (tmp_path / "x.npz").write_bytes(content)
    for path in (tmp_path / "x.npz", *([] if content else [tmp_path])):
        with pytest.raises(DatasetError, match=says if path.suffix else "check the path"):
            read_dataset(path)


def test_what_could_not_be_read_again_is_not_written(tmp_path) -> None:
    other = replace(PADS, adc_max=256)
    for grasps, says in (
        ([], "no grasp"),
        ([make_grasp(), make_grasp(pads=other)], "grasp 1 was taken on other pads"),
        ([make_grasp(label="a\0")], "label of grasp 0 is .*not printable"),
        ([make_grasp(label="UNKNOWN")], "label of grasp 0 is .*leave it empty"),
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
    assert issubclass(DatasetError, CellError)
