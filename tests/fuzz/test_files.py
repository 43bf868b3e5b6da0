"""Bad files that people hand around: grasp data sets, taught models, recordings."""

import functools
import io
import json
import pickle
import tempfile
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from numpy.typing import NDArray

from cell.errors import DatasetError, ModelError, RecordingError
from cell.learning.model import _digest, load_model, save_model
from cell.learning.training import train
from cell.recording.dataset import IN_MODEL, read_dataset, write_dataset
from cell.recording.reader import Recording, read_recording, recover_recording
from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from tests.cell.recording.test_recording import record
from tests.fuzz.harness import bad_input, damages, good_grasps, same_grasps, spoilt

pytestmark = pytest.mark.filterwarnings(
    "ignore:Reading `.npy` or `.npz` file required additional header:UserWarning",
    "ignore:Data type alias 'a' was deprecated:DeprecationWarning",
)
"""A damaged header may look like one of old versions of numpy."""

TRAINERS = ("level_check", "force_ramp")


class Bomb:
    """An object that shows whether its pickle was loaded."""

    exploded = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (Bomb, "exploded", True)


def npy_of(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


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


@functools.cache
def good_dataset() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_dataset(Path(folder) / "good.npz", good_grasps())
        return (Path(folder) / "good.npz").read_bytes()


def grasps_of(path: Path, data: bytes) -> tuple[Grasp, ...] | None:
    """Return the grasps of a data set; None where it is refused."""
    path.write_bytes(data)
    try:
        return read_dataset(path, limit_bytes=4 << 20)
    except DatasetError:
        return None


@bad_input(harm=damages(), sound={"harm": []})
def test_a_damaged_data_set_is_refused_or_unchanged(tmp_path, harm):
    grasps = grasps_of(tmp_path / "x.npz", spoilt(good_dataset(), harm))
    assert grasps is None or same_grasps(grasps, grasps_of(tmp_path / "good.npz", good_dataset()))
    return "refused" if grasps is None else "unchanged"


@functools.cache
def good_model(kind: str) -> tuple[bytes, dict[str, NDArray[Any]]]:
    """Return a model file, and what was learnt."""
    trained = train(good_grasps(), kind)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.npz"
        save_model(path, trained, good_grasps())
        return path.read_bytes(), dict(trained.recognizer.to_arrays())


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
    assert np.all(np.isfinite(probability))
    arrays, right = recognizer.to_arrays(), good_model(kind)[1]
    same = arrays.keys() == right.keys() and all(
        np.array_equal(arrays[n], right[n], equal_nan=right[n].dtype.kind == "f") for n in right
    )
    return "unchanged" if same else "another model"


def forged(members: dict[str, bytes]) -> dict[str, bytes]:
    """Return a model's files with the right checksum in its header."""
    arrays = {name[:-4]: np.load(io.BytesIO(data)) for name, data in members.items()}
    header = json.loads(str(arrays.pop("model"))) | {"sha256": _digest(arrays)}
    return members | {"model.npy": npy_of(np.array(json.dumps(header)))}


@bad_input(kind=st.sampled_from(TRAINERS), harm=damages(), examples=40, limit_s=2.0)
def test_a_damaged_model_is_refused_or_unchanged(tmp_path, kind, harm):
    outcome = loaded(tmp_path / "x.npz", spoilt(good_model(kind)[0], harm), kind)
    assert outcome != "another model"
    return outcome


@pytest.mark.parametrize("read", [read_dataset, load_model])
@pytest.mark.parametrize("data", [pickle.dumps(Bomb()), npy_of(np.array([Bomb()]))])
def test_no_pickle_is_loaded(tmp_path, read, data):
    for good in (good_dataset(), good_model("level_check")[0]):
        members = members_of(good)
        for name in (one for one in members if not one.startswith(IN_MODEL)):
            (tmp_path / "x.npz").write_bytes(archive_of(members | {name: data}))
            with pytest.raises((DatasetError, ModelError)):
                read(tmp_path / "x.npz")
    assert not Bomb.exploded


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
        data = archive_of(forged(members | {f"{array}.npy": npy_of(value)}))
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


# -- Bad recordings: damaged MCAP files ------------------------------------------------------------


@functools.cache
def good() -> tuple[bytes, Recording]:
    """Return the bytes of a recording of two short grasps, and what is read of it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.mcap"
        record(path, n_grasps=2)
        data, recording = path.read_bytes(), read_recording(path)
    assert (recording.complete, len(recording.grasps)) == (True, 2)
    return data, recording


def same(ours: Recording, other: Recording) -> bool:
    return (
        np.array_equal(ours.frames.counts, other.frames.counts)
        and np.array_equal(ours.frames.t_s, other.frames.t_s)
        and np.array_equal(ours.cycles.setpoint_n, other.cycles.setpoint_n)
        and np.array_equal(ours.cycles.phase, other.cycles.phase)
        and ours.events == other.events
        and ours.metadata == other.metadata
        and same_grasps(ours.grasps, other.grasps)
    )


@bad_input(harm=damages(), sound={"harm": []}, examples=100)
def test_a_damaged_recording_is_refused_unchanged_or_salvaged(tmp_path, harm):
    data, right = good()
    path, recovered = tmp_path / "x.mcap", tmp_path / "recovered.mcap"
    path.write_bytes(spoilt(data, harm))
    try:
        recording = read_recording(path)
    except RecordingError:
        return "refused"
    if recording.complete:
        assert same(recording, right)
        return "unchanged"
    assert len(recording.grasps) <= len(right.grasps)
    for grasp in recording.grasps:
        assert any(same_grasps([grasp], [other]) for other in right.grasps)
    recovered.unlink(missing_ok=True)
    try:
        recover_recording(path, recovered)
    except RecordingError:
        return "nothing to salvage"
    whole = read_recording(recovered)
    assert whole.complete
    assert same_grasps(whole.grasps, recording.grasps)
    return "salvaged"
