"""Model files: what was learnt comes back; what is damaged, foreign or hostile is refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.errors import ModelError
from cell.learning.model import layout_hash, load_model, save_model
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import Posterior
from recognition.recognizers.level_check import LevelCheckRecognizer, LevelCheckTrainer
from tests.cell.conftest import plain_pads
from tests.cell.data.test_dataset import Bomb

PADS = plain_pads((8, 5), (8, 5), adc_max=255)


def press(label: str, *, height: float, width_m: float, seed: int = 0) -> Grasp:
    """Press a round thing in the middle of both pads, ever harder."""
    rng = np.random.default_rng(seed)
    away_m = np.linalg.norm(PADS.taxel_xy_m - PADS.taxel_xy_m.mean(axis=0), axis=1)
    share = np.concatenate([np.zeros(6), np.linspace(0, 1, 30)])
    print_ = np.maximum(0.0, 1 - (away_m / width_m) ** 2)
    counts = height * share[:, None] * print_ + rng.integers(1, 4, (36, 80))
    return Grasp(
        pads=PADS,
        counts=counts.astype(np.uint16),
        t_s=np.arange(36) / 30,
        aperture_m=np.linspace(0.03, 0.02, 36),
        force_n=share * 8,
        label=label,
    )


@pytest.fixture(scope="module")
def taught() -> LevelCheckRecognizer:
    return LevelCheckTrainer().fit(
        [press("ball", height=90, width_m=8e-3, seed=s) for s in range(4)]
        + [press("box", height=200, width_m=11e-3, seed=s) for s in range(4, 8)]
    )


@pytest.fixture(scope="module")
def good(taught: LevelCheckRecognizer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.npz"
    save_model(path, taught, trainer_name="level_check", pads=PADS)
    return path


def test_loaded_model_answers_like_the_taught_one(taught, good) -> None:
    loaded = load_model(good, PADS)
    assert loaded.labels == ("ball", "box")
    assert loaded.trainer_name == "level_check"
    assert loaded.pads.same_as(PADS)
    for seed in range(20, 24):
        grasp = press("?", height=90 + 20 * (seed - 20), width_m=9e-3, seed=seed)
        was, now = taught.posterior(grasp), loaded.recognizer.posterior(grasp)
        np.testing.assert_array_equal(now.probability, was.probability)
        assert now.unknown == was.unknown


def test_sections_come_back(taught, good, tmp_path) -> None:
    path = tmp_path / "more.npz"
    more = {"memory": {"a": np.arange(3), "b.c": np.ones(2)}, "other": {"a": np.zeros(1)}}
    save_model(path, taught, trainer_name="level_check", pads=PADS, sections=more)
    loaded = load_model(path, PADS)
    assert set(loaded.sections) == {"memory", "other"}
    assert loaded.sections["memory"]["b.c"].tolist() == [1.0, 1.0]
    assert load_model(good).sections == {}
    for name in ("learnt", "a.b"):
        with pytest.raises(ValueError, match="not a valid name of a section"):
            save_model(path, taught, trainer_name="level_check", pads=PADS, sections={name: {}})


def test_file_is_plain_arrays_and_json(good) -> None:
    with np.load(good, allow_pickle=False) as archive:
        header = json.loads(str(archive["model"]))
        assert all(archive[name].dtype.kind in "biufU" for name in archive.files)
    assert header["format"] == "tactile-cell-model/1"
    assert header["layout_hash"] == layout_hash(PADS)
    assert len(header["sha256"]) == 64


def other_pads(**changes: Any) -> PadArray:
    return replace(PADS, **changes)


@pytest.mark.parametrize(
    "pads",
    [
        other_pads(adc_max=4095),
        other_pads(taxel_xy_m=PADS.taxel_xy_m * 1.1),
        other_pads(pad_shape=PADS.pad_shape[:, ::-1]),
        other_pads(taxel_pad=PADS.taxel_pad[::-1]),
    ],
)
def test_model_of_other_pads_is_refused(pads, good) -> None:
    assert layout_hash(pads) != layout_hash(PADS)
    with pytest.raises(ModelError, match=r"was taught on 8x5 \+ 8x5 .*; teach again"):
        load_model(good, pads)


def rewrite(
    good: Path, path: Path, change: Callable[[dict[str, Any], dict[str, NDArray[Any]]], Any]
) -> None:
    """Change header and arrays of a model, leaving its checksum as it was."""
    with np.load(good, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(str(arrays.pop("model")))
    change(header, arrays)
    np.savez(path, model=np.array(json.dumps(header)), **arrays)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda h, _: h.update(format="other/1"), "its format is 'other/1'"),
        (lambda h, _: h.update(trainer="os"), "installed are .*force_ramp"),
        (lambda h, _: h.update({"class": "np"}), "no recogniser named 'np'"),
        (lambda h, _: h.update({"class": "Posterior"}), "no recogniser named"),
        (lambda h, _: h.update(labels=["ball", "egg"]), "names other labels"),
        (lambda h, _: h.update(layout_hash="0" * 16), "layout hash"),
        (lambda _, a: a.update({"learnt.mean": a["learnt.mean"] + 1}), "checksum"),
        (lambda _, a: a.pop("learnt.mean"), "checksum"),
    ],
)
def test_changed_model_is_refused(change, says, good, tmp_path) -> None:
    rewrite(good, tmp_path / "m.npz", change)
    with pytest.raises(ModelError, match=says):
        load_model(tmp_path / "m.npz")


@pytest.mark.parametrize(
    "change",
    [
        {"level_check_version": np.array(99)},
        {"mean": None},
        {"mean": np.array("x")},
        {"labels": np.array(["ball", "UNKNOWN"])},
        {"labels": np.array(["ball", "\x1b[2J"])},
    ],
)
def test_model_of_another_version_is_refused(change, taught, tmp_path, monkeypatch) -> None:
    arrays = {n: a for n, a in (taught.to_arrays() | change).items() if a is not None}
    monkeypatch.setattr(LevelCheckRecognizer, "to_arrays", lambda _self: arrays)
    save_model(tmp_path / "m.npz", taught, trainer_name="level_check", pads=PADS)
    with pytest.raises(ModelError, match=r"does not fit tactile-cell.*train it again"):
        load_model(tmp_path / "m.npz")


def test_damaged_pads_are_refused(taught, tmp_path, monkeypatch) -> None:
    save_model(tmp_path / "m.npz", taught, trainer_name="level_check", pads=PADS)
    monkeypatch.setattr("cell.learning.model._PADS", "elsewhere.")
    with pytest.raises(ModelError, match="pads cannot be read"):
        load_model(tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"model": np.array([Bomb()], dtype=object)}, "Object arrays cannot be loaded"),
        ({"counts": np.zeros(3)}, "it has no header; train a model first"),
        ({"grasp_offsets": np.zeros(3)}, "is a data set: `tactile-cell train"),
        ({"model": np.zeros(3)}, "it has no header"),
        ({"model": np.array("{")}, "not JSON"),
        ({"model": np.array("[" * 100_000)}, "not JSON"),
        ({"model": np.array("[1]")}, "not an object"),
    ],
)
def test_what_is_no_model_is_refused_and_never_run(arrays, says, tmp_path) -> None:
    np.savez(tmp_path / "m.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=says):
        load_model(tmp_path / "m.npz")
    assert not Bomb.exploded


def test_recogniser_of_unknown_kind_is_not_written(taught, tmp_path) -> None:
    class Guess:
        labels = ("ball",)

        def posterior(self, grasp: Grasp) -> Posterior:
            raise NotImplementedError

        def to_arrays(self) -> dict[str, NDArray[Any]]:
            raise NotImplementedError

        @classmethod
        def from_arrays(cls, arrays: Any) -> "Guess":
            raise NotImplementedError

    for recognizer, name, says in (
        (taught, "magic", "installed are .*force_ramp"),
        (taught, "shrinkage_lda", "has no recogniser named"),
        (Guess(), "level_check", "has no recogniser named 'Guess'"),
    ):
        with pytest.raises(ModelError, match=says):
            save_model(tmp_path / "m.npz", recognizer, trainer_name=name, pads=PADS)
    assert not list(tmp_path.iterdir())
