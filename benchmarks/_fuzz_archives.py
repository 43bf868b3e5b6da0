"""Fuzz targets of the archives that people hand around: grasp data sets and taught models."""

import io
import json
import pickle
import random
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._fuzz_engine import Broken, Target
from benchmarks._fuzz_mutate import mutated
from cell.dataset import read_dataset, write_dataset
from cell.errors import DatasetError, ModelError
from cell.files import savez
from cell.model import _digest, load_model, save_model
from recognition.errors import RecognitionError
from recognition.grasp import Grasp, PadArray
from recognition.recognizers.level_check import LevelCheckTrainer
from recognition.recognizers.shrinkage_lda import ShrinkageLdaTrainer

exploded: list[str] = []
"""What a pickle that was loaded would put here."""

_DTYPES = ("<f8", "<f4", "<f2", "|O", "<i8", "<U200", "<U0", "|S9", "<c16", "|V4", "<M8[s]", "?")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_SMALL_LIMIT = 4 << 20


class Bomb:
    """An object that shows whether its pickle was loaded."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return exploded.append, ("a pickle was loaded",)


def _bomb(_: random.Random) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([Bomb()], dtype=object), allow_pickle=True)
    return stream.getvalue()


class Folder:
    """A folder in memory where there is one, gone with its owner."""

    def __init__(self) -> None:
        memory = Path("/dev/shm")
        self.path = Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def file(self, data: bytes, name: str) -> Path:
        path = self.path / name
        path.write_bytes(data)
        return path


def make_grasps(pads: PadArray, n: int = 6, n_frames: int = 12) -> tuple[Grasp, ...]:
    """Return small grasps of two objects."""
    rng = np.random.default_rng(3)
    share = np.linspace(0.0, 1.0, n_frames)[:, None]
    away_m = np.linalg.norm(pads.taxel_xy_m - pads.taxel_xy_m.mean(axis=0), axis=1)
    grasps = []
    for i in range(n):
        print_ = np.maximum(0.0, 1 - (away_m / (8e-3 if i % 2 else 11e-3)) ** 2)
        counts = (90 + 100 * (i % 2)) * share * print_ + rng.integers(1, 4, (n_frames, len(away_m)))
        grasps.append(
            Grasp(
                pads=pads,
                counts=counts.astype(np.uint16),
                t_s=np.arange(n_frames) / 30,
                aperture_m=np.linspace(0.03, 0.02, n_frames),
                force_n=share[:, 0] * 8,
                label=("ball", "box")[i % 2],
                source="made",
                start_ms=1_700_000_000_000 + i,
            )
        )
    return tuple(grasps)


def small_pads() -> PadArray:
    """Return two pads of 8 x 5 taxels."""
    return PadArray(
        pad_shape=np.array([[8, 5], [8, 5]]),
        taxel_pad=np.repeat([0, 1], 40),
        taxel_xy_m=np.tile([(r * 3e-3, c * 3e-3) for r in range(8) for c in range(5)], (2, 1)),
        adc_max=255,
    )


def members_of(data: bytes) -> dict[str, bytes]:
    """Return the files of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(rng: random.Random, members: dict[str, bytes]) -> bytes:
    """Return an archive with right checksums, sometimes packed in an unusual way."""
    method = zipfile.ZIP_STORED if rng.random() < 0.85 else rng.choice(_METHODS)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return stream.getvalue()


def with_header(rng: random.Random, npy: bytes) -> bytes:
    """Return an array with another header over the same or other bytes."""
    start = npy.index(b"{")
    end = npy.index(b"\n", start)
    choice = rng.randrange(5)
    if choice == 0:
        header = mutated(rng, npy[start:end])
    else:
        descr = rng.choice(_DTYPES) if choice in (1, 2) else "<f8"
        shape = rng.choice(
            ("()", "(0,)", "(1,)", "(-1,)", "(10**9,)", "(1000000000000,)", "(0, 99999999999)",
             "(1,) * 40", "(True,)", "[3]", "(3.0,)", "(1" + 4000 * "0" + ",)", "(" * 2000)
        )  # fmt: skip
        header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return npy[:6] + b"\x01\0" + len(header).to_bytes(2, "little") + header + npy[end:]


def changed(rng: random.Random, members: dict[str, bytes]) -> dict[str, bytes]:
    """Return the files with one or two of them changed, renamed, added or left out."""
    members = dict(members)
    for _ in range(rng.randint(1, 2)):
        name = rng.choice(list(members))
        kind = rng.randrange(9)
        if kind == 0 and len(members) > 1:
            del members[name]
        elif kind == 1:
            members[rng.choice(("x.npy", "../x.npy", "/etc/x.npy", "a", ".npy"))] = members[name]
        elif kind == 2:
            members[name] = _bomb(rng)
        elif kind == 3:
            members[name] = pickle.dumps(Bomb())
        elif kind in (4, 5) and b"{" in members[name][:20] and b"\n" in members[name]:
            members[name] = with_header(rng, members[name])
        elif kind == 6:
            other = rng.choice(list(members))
            members[name] = members[other]
        else:
            members[name] = mutated(rng, members[name])
    return members


class _Archive:
    """Half of the inputs are damaged bytes, the other half whole archives with wrong content."""

    data: bytes
    members: dict[str, bytes]

    def generate(self, rng: random.Random) -> tuple[bool, bytes]:
        chance = rng.random()
        if chance < 0.45:
            return True, mutated(rng, self.data, (self.data,))
        if chance < 0.47:
            return False, pickle.dumps(Bomb())
        return False, self.build(rng)

    def build(self, rng: random.Random) -> bytes:
        return archive_of(rng, changed(rng, self.members))


class DatasetTrial(_Archive):
    """Grasp data sets."""

    def __init__(self) -> None:
        self.folder = Folder()
        self.grasps = make_grasps(small_pads())
        path = self.folder.path / "good.npz"
        write_dataset(path, self.grasps)
        self.data = path.read_bytes()
        self.grasps = read_dataset(path)
        self.members = members_of(self.data)

    def check(self, item: tuple[bool, bytes]) -> str:
        damaged, data = item
        try:
            grasps = read_dataset(self.folder.file(data, "x.npz"), limit_bytes=_SMALL_LIMIT)
        except DatasetError:
            return "refused: DatasetError"
        finally:
            if exploded:
                raise Broken(exploded.pop())
        if damaged and not _same(grasps, self.grasps):
            raise Broken("a damaged data set was read as something else")
        return "read: the damage is in no value" if damaged else "read: another valid data set"


def _same(ours: tuple[Grasp, ...], others: tuple[Grasp, ...]) -> bool:
    return len(ours) == len(others) and all(
        a.label == b.label
        and a.source == b.source
        and a.start_ms == b.start_ms
        and a.pads.same_as(b.pads)
        and all(
            np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name != "counts")
            for name in ("counts", "t_s", "aperture_m", "force_n")
        )
        for a, b in zip(ours, others, strict=True)
    )


class ModelTrial(_Archive):
    """Model files of two kinds; changed ones get a right checksum, as a forger would give them."""

    def __init__(self) -> None:
        self.folder = Folder()
        self.pads = small_pads()
        self.grasps = make_grasps(self.pads, 12)
        self.kinds = []
        for name, trainer in (
            ("level_check", LevelCheckTrainer()),
            ("shrinkage_lda", ShrinkageLdaTrainer()),
        ):
            recognizer = trainer.fit(self.grasps)
            path = self.folder.path / f"{name}.npz"
            save_model(path, recognizer, trainer_name=name, pads=self.pads)
            data = path.read_bytes()
            self.kinds.append((data, members_of(data), recognizer.posterior(self.grasps[0])))
        self.turn = 0

    def generate(self, rng: random.Random) -> tuple[bool, bytes]:
        self.data, self.members, self.right = rng.choice(self.kinds)
        return super().generate(rng)

    def build(self, rng: random.Random) -> bytes:
        if rng.random() < 0.4:
            return archive_of(rng, changed(rng, self.members))
        arrays = {
            name[:-4]: np.load(io.BytesIO(data), allow_pickle=False)
            for name, data in self.members.items()
        }
        header = json.loads(str(arrays.pop("model")))
        for _ in range(rng.randint(1, 2)):
            name = rng.choice(list(arrays))
            arrays[name] = _other_values(rng, arrays[name])
        if rng.random() < 0.1:
            key = rng.choice(list(header))
            header[key] = rng.choice((None, 1, "force_ramp", [], {}, "__import__", "RuntimeError"))
        header["sha256"] = _digest(arrays)
        stream = io.BytesIO()
        savez(stream, {"model": np.array(json.dumps(header)), **arrays})
        return stream.getvalue()

    def check(self, item: tuple[bool, bytes]) -> str:
        damaged, data = item
        try:
            model = load_model(self.folder.file(data, "x.npz"), self.pads)
        except ModelError:
            return "refused: ModelError"
        finally:
            if exploded:
                raise Broken(exploded.pop())
        try:
            posterior = model.recognizer.posterior(self.grasps[0])
        except RecognitionError as error:
            return f"refused when asked: {type(error).__name__}"
        if not np.all(np.isfinite(posterior.probability)):
            raise Broken(f"probabilities {posterior.probability}")
        if damaged and not np.array_equal(posterior.probability, self.right.probability):
            raise Broken("a damaged model answers differently")
        return "read: the damage is in no value" if damaged else "read: a model with other values"


def _other_values(  # noqa: PLR0911  one return for each way to change an array
    rng: random.Random, array: NDArray[Any]
) -> NDArray[Any]:
    kind = rng.randrange(7)
    if kind == 0:
        return np.array(rng.choice((float("nan"), float("inf"), -1.0, 1e300, 10**9, -(10**9))))
    if kind == 1:
        return array.reshape(-1)[: rng.randint(0, max(0, array.size - 1))]
    if kind == 2:
        return np.array(["x"] * rng.randint(0, 3))
    if kind == 3 and array.ndim:
        return np.concatenate([array, array])
    if kind == 4:
        return array.astype(np.float64) if array.dtype.kind in "iuf" else array
    if array.dtype.kind == "f" and array.size:
        out = array.copy()
        out.reshape(-1)[rng.randrange(out.size)] = rng.choice((np.nan, np.inf, -1e9, 0.0, 1e-300))
        return out
    if array.dtype.kind in "iu" and array.size:
        out = array.copy().astype(np.int64)
        out.reshape(-1)[rng.randrange(out.size)] = rng.choice((-1, 0, 1, 1 << 40, -(1 << 62)))
        return out
    return array[None]


TARGETS = (
    Target(
        name="dataset",
        parser="cell.dataset, cell.files",
        inputs="bytes changed, cut, spliced; whole archives with other headers, types, names, "
        "packings, pickles",
        make=DatasetTrial,
    ),
    Target(
        name="model",
        parser="cell.model, cell.files",
        inputs="as data sets; changed arrays and headers under a right checksum, then asked",
        make=ModelTrial,
    ),
)
