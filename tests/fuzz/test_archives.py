"""Bad archives that people hand around: grasp data sets and taught models."""

import contextlib
import functools
import io
import json
import pickle
import tempfile
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from cell.errors import DatasetError, ModelError
from cell.learning.model import _digest, load_model, save_model
from cell.learning.training import train
from cell.recording.dataset import read_dataset, write_dataset
from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from tests.fuzz.harness import (
    bad_input,
    damages,
    good_grasps,
    json_values,
    limits,
    same_grasps,
    spoilt,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore:Reading `.npy` or `.npz` file required additional header:UserWarning",
    "ignore:Data type alias 'a' was deprecated:DeprecationWarning",
)
"""A damaged header may look like one of old versions of numpy."""

TRAINERS = ("level_check", "force_ramp")
exploded: list[str] = []
"""What a pickle that is loaded puts here."""


class Bomb:
    """An object that shows whether its pickle was loaded."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return exploded.append, ("a pickle was loaded",)


def npy_of(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def npy_with(header: str) -> bytes:
    text = header.encode()
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text


def array_of(data: bytes) -> NDArray[Any]:
    return np.load(io.BytesIO(data), allow_pickle=False)


def members_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return a whole archive with right checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return stream.getvalue()


sizes = st.integers(-2, 10**13) | st.sampled_from([10**300, True, 3.0])
headers = st.fixed_dictionaries(
    {
        "descr": st.sampled_from(["<f8", "<f2", "<U4", "<U0", "|O", "<i8", ">u2", "|V8", "<m8[s]"])
        | st.lists(st.tuples(st.just("a"), st.just("<f8")), max_size=2)
        | st.none(),
        "shape": st.lists(sizes, max_size=4).map(tuple) | st.none() | st.text(max_size=4),
        "fortran_order": st.booleans() | st.none(),
    }
).map(repr) | st.sampled_from(["{'descr': '<f8', 'shape': (1,) * 40}", "{" * 100, "(" * 2000])
names = st.sampled_from(["x.npy", "../x.npy", "/etc/x.npy", "a", ".npy"])
whole = hnp.arrays(
    st.sampled_from([np.float64, np.uint16, np.int64, np.dtype("U3"), np.bool_]),
    hnp.array_shapes(min_dims=0, max_dims=2, min_side=0, max_side=9),
)
elements = st.tuples(
    st.integers(0, 9999),
    st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1.0, 1e300, 1e-300, 1e9, -1e9]),
)
bombs = st.sampled_from([pickle.dumps(Bomb()), npy_of(np.array([Bomb()]))])
ways = st.none() | names | bombs | headers.map(npy_with) | damages(at_least=1) | whole | elements
changes = st.lists(st.tuples(st.integers(0, 99), ways | elements), max_size=2)
"""Number of a file, and what becomes of it: nothing, a copy with that name, other bytes, damage,
another array, or one with another element."""


def changed(good: dict[str, bytes], changes: list[tuple[int, Any]]) -> dict[str, bytes]:
    """Return the files with some of them changed, added or left out."""
    members = dict(good)
    for number, way in changes:
        name = list(members)[number % len(members)]
        data = members[name]
        if way is None and len(members) > 1:
            del members[name]
        elif isinstance(way, str):
            members[way] = data
        elif isinstance(way, bytes):
            members[name] = way
        elif isinstance(way, list):
            members[name] = spoilt(data, way)
        elif isinstance(way, np.ndarray):
            members[name] = npy_of(way)
        elif isinstance(way, tuple) and data is good.get(name):
            members[name] = npy_of(with_element(array_of(data), *way))
    return members


def with_element(array: NDArray[Any], place: int, value: float) -> NDArray[Any]:
    out = array.copy()
    if out.size and out.dtype.kind in "iuf":
        if out.dtype.kind != "f":
            value = min(max(np.nan_to_num(value), 0), np.iinfo(out.dtype).max)
        with np.errstate(over="ignore"):
            out.reshape(-1)[place % out.size] = value
    return out


@functools.cache
def good_dataset() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_dataset(Path(folder) / "good.npz", good_grasps())
        return (Path(folder) / "good.npz").read_bytes()


def grasps_of(path: Path, data: bytes) -> tuple[Grasp, ...] | None:
    """Return the grasps of a data set; None where it is refused. No pickle may have run."""
    path.write_bytes(data)
    try:
        return read_dataset(path, limit_bytes=4 << 20)
    except DatasetError:
        return None
    finally:
        assert not exploded


@bad_input(harm=damages(), sound={"harm": []})
def test_a_damaged_data_set_is_refused_or_unchanged(tmp_path, harm):
    found = grasps_of(tmp_path / "x.npz", spoilt(good_dataset(), harm))
    right = grasps_of(tmp_path / "good.npz", good_dataset())
    assert found is None or same_grasps(found, right)
    return "refused" if found is None else "unchanged"


@pytest.mark.slow
@bad_input(changes=changes, sound={"changes": []})
def test_a_data_set_of_other_arrays_is_refused_or_valid(tmp_path, changes):
    members = changed(members_of(good_dataset()), changes)
    found = grasps_of(tmp_path / "x.npz", archive_of(members))
    return "refused" if found is None else "read"


@functools.cache
def good_model(kind: str) -> tuple[bytes, dict[str, NDArray[Any]]]:
    """Return a model file, and what was learnt."""
    recognizer = train(good_grasps(), kind).recognizer
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.npz"
        pads = good_grasps()[0].pads
        save_model(path, recognizer, trainer_name=kind, pads=pads)
        return path.read_bytes(), dict(recognizer.to_arrays())


def loaded(path: Path, data: bytes, kind: str) -> str:
    """Return what became of a model in a good one's place: it gives numbers, or is refused."""
    path.write_bytes(data)
    grasp = good_grasps()[0]
    try:
        recognizer = load_model(path, grasp.pads).recognizer
        probability = recognizer.posterior(grasp).probability
    except ModelError:
        return "refused"
    except RecognitionError:
        return "refused when asked"
    finally:
        assert not exploded
    assert np.all(np.isfinite(probability))
    found, right = recognizer.to_arrays(), good_model(kind)[1]
    same = found.keys() == right.keys() and all(
        np.array_equal(found[n], right[n], equal_nan=right[n].dtype.kind == "f") for n in right
    )
    return "unchanged" if same else "another model"


def forged(members: dict[str, bytes], entries: dict[str, Any]) -> dict[str, bytes]:
    """Return a model's files with other entries in its header, and the right checksum there."""
    arrays = {name[:-4]: array_of(data) for name, data in members.items()}
    header = json.loads(str(arrays.pop("model"))) | entries | {"sha256": _digest(arrays)}
    return members | {"model.npy": npy_of(np.array(json.dumps(header)))}


@pytest.mark.slow
@bad_input(
    kind=st.sampled_from(TRAINERS),
    changes=changes,
    entries=st.none()
    | st.just({})
    | st.dictionaries(st.sampled_from(["format", "trainer", "class", "labels"]), json_values),
    examples=40,
    limit_s=2.0,
)
def test_a_model_of_other_arrays_is_refused_or_answers(tmp_path, kind, changes, entries):
    members = changed(members_of(good_model(kind)[0]), changes)
    if entries is not None:
        with contextlib.suppress(Exception):  # of arrays that numpy cannot read
            members = forged(members, entries)
    outcome = loaded(tmp_path / "x.npz", archive_of(members), kind)
    assert entries is not None or outcome != "another model"
    return outcome


@pytest.mark.parametrize(
    ("kinds", "array", "value"),
    [
        (TRAINERS, "pads.adc_max", np.array(np.inf)),
        (TRAINERS, "pads.taxel_xy_m", np.full((80, 2), np.nan)),
        (TRAINERS, "pads.taxel_pad", np.full(80, 10**9)),
        (["level_check"], "learnt.labels", np.array(["ball", "box", "x"])),
        (["level_check"], "learnt.labels", np.array("ball")),
        (["force_ramp"], "learnt.rest_counts", np.full(80, 1e300)),
        (["force_ramp"], "learnt.touch_temperature", np.array(-1.0)),
        (["force_ramp"], "learnt.touch_limit", np.zeros(0)),
        (["force_ramp"], "learnt.touch_limit", np.array([0.0, np.nan])),
        (["force_ramp"], "learnt.both_model_sizes_unit_mm", np.zeros(2)),
        (["force_ramp"], "learnt.drawn_m", np.array(["x", "y"])),
        (["force_ramp"], "learnt.rest_gripping", np.zeros(0, dtype=np.int64)),
        (["force_ramp"], "learnt.rest_gripping", np.array([0, 7])),
    ],
)
def test_a_model_that_could_not_answer_is_refused_when_it_is_loaded(tmp_path, kinds, array, value):
    for kind in kinds:
        members = members_of(good_model(kind)[0])
        assert f"{array}.npy" in members
        data = archive_of(forged(members | {f"{array}.npy": npy_of(value)}, {}))
        with limits(2.0):
            assert loaded(tmp_path / "x.npz", data, kind) == "refused"


@pytest.mark.slow
@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_packings_that_unpack_without_a_bound_are_refused(tmp_path: Path, method: int) -> None:
    data = bytearray(archive_of({"counts.npy": bytes(30 << 20)}, method))
    directory = data.rindex(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = (100).to_bytes(4, "little")
    (tmp_path / "x.npz").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match="packed by method"):
            read_dataset(tmp_path / "x.npz")
        assert tracemalloc.get_traced_memory()[1] < 4 << 20  # nothing large is unpacked
    finally:
        tracemalloc.stop()
