"""Taught models: their files, what a teaching shows, and the processes and threads that train."""

import json
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cell.errors import CellError, ModelError, RequestRefused
from cell.learning.model import Trained, load_model, save_model
from cell.learning.parallel import workers
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import ToldApart, teaching_notes, told_apart
from cell.learning.training import train
from cell.runtime.goals import IdentifyGoal
from cell.runtime.tasks import ModelFile, Tasks
from recognition.drift.self_zero import drawn_zero
from recognition.evaluation.evaluation import Evaluation, evaluate
from recognition.evaluation.splits import a_day_later
from recognition.grasp import DRAWING_SOURCE, Grasp
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.level_check import LevelCheckRecognizer, LevelCheckTrainer
from tests.cell.cells import SURE, Scripted, plain_grasp
from tests.recognition.conftest import OBJECTS, make_grasps
from tests.values import make_pads

PADS = make_pads(shapes=((8, 5), (8, 5)), adc_max=255)


def trained(recognizer: Any, name: str = "level_check", **more: Any) -> Trained:
    return Trained(recognizer=recognizer, trainer_name=name, **more)


@pytest.fixture(scope="module")
def learnt() -> LevelCheckRecognizer:
    return LevelCheckTrainer().fit(make_grasps(4, seed=1, pads=PADS, objects=OBJECTS[:2]))


@pytest.fixture(scope="module")
def good(learnt: LevelCheckRecognizer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.npz"
    save_model(path, trained(learnt), PADS)
    return path


def test_loaded_model_answers_like_the_taught_one(learnt, good, tmp_path) -> None:
    loaded = load_model(good, PADS)
    assert (loaded.labels, loaded.trainer_name) == (("bar", "block"), "level_check")
    assert loaded.pads.same_as(PADS)
    for grasp in make_grasps(1, seed=2, pads=PADS):
        was, now = learnt.posterior(grasp), loaded.recognizer.posterior(grasp)
        np.testing.assert_array_equal(now.probability, was.probability)
        assert now.unknown == was.unknown
    section = {"file": np.array("a.npz")}
    save_model(tmp_path / "more.npz", trained(learnt, training_set=section), PADS)
    assert load_model(tmp_path / "more.npz", PADS).training_set == section
    assert loaded.training_set == {}
    # The file is plain arrays and JSON.
    with np.load(good, allow_pickle=False) as archive:
        header = json.loads(str(archive["model"]))
        assert all(archive[name].dtype.kind in "biufU" for name in archive.files)
    assert (header["format"], len(header["sha256"])) == ("tactile-cell-model/1", 64)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"adc_max": 4095}, "a full scale of 4095 instead of 255"),
        ({"taxel_xy_m": PADS.taxel_xy_m * 1.1}, "at other places"),
        ({"pad_shape": PADS.pad_shape[:, ::-1]}, ""),
    ],
)
def test_model_of_other_pads_is_refused(change, says, good) -> None:
    taught = r"was taught on 80 taxels in 2 pads, "
    with pytest.raises(ModelError, match=f"{taught}.*{says}.*; teach again"):
        load_model(good, replace(PADS, **change))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda h, _: h.update(trainer="os"), "installed are .*force_ramp"),
        (lambda h, _: h.update({"class": "np"}), "no recognizer named 'np'"),
        (lambda h, _: h.update({"class": "Posterior"}), "no recognizer named"),
        (lambda _, a: a.pop("learnt.mean"), "checksum"),
    ],
)
def test_changed_model_is_refused(change, says, good, tmp_path) -> None:
    """Its header or an array is another one, its checksum is as it was."""
    with np.load(good, allow_pickle=False) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays.pop("model")))
    change(header, arrays)
    np.savez(tmp_path / "m.npz", model=np.array(json.dumps(header)), **arrays)
    with pytest.raises(ModelError, match=says):
        load_model(tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": np.array(99)}, "version 99"),
        ({"mean": None}, "lacks the array 'mean'"),
        ({"mean": np.array([1.0])}, "mean has shape"),
        ({"mean": np.array("x")}, ""),
        ({"labels": np.array(["bar", "UNKNOWN"])}, ""),
        ({"labels": np.array(["bar", "\x1b[2J"])}, ""),
    ],
)
def test_model_of_another_version_is_refused(change, says, learnt, tmp_path, monkeypatch) -> None:
    arrays = {n: a for n, a in (learnt.to_arrays() | change).items() if a is not None}
    monkeypatch.setattr(LevelCheckRecognizer, "to_arrays", lambda _self: arrays)
    save_model(tmp_path / "m.npz", trained(learnt), PADS)
    with pytest.raises(ModelError, match=rf"does not fit tactile-cell.*{says}.*train it again"):
        load_model(tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"counts": np.zeros(3)}, "it has no header; train a model first"),
        ({"grasp_offsets": np.zeros(3)}, "is a data set: `tactile-cell model train"),
        ({"model": np.array("{")}, "not JSON"),
        ({"model": np.array("[" * 100_000)}, "not JSON"),
        ({"model": np.array("[1]")}, "it has no object"),
    ],
)
def test_what_is_no_model_is_refused(arrays, says, tmp_path) -> None:
    np.savez(tmp_path / "m.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=says):
        load_model(tmp_path / "m.npz")


def test_recognizer_of_unknown_kind_is_not_written(learnt, tmp_path) -> None:
    for recognizer, name, says in (
        (learnt, "magic", "installed are .*force_ramp"),
        (learnt, "force_ramp", "has no recognizer named"),
    ):
        with pytest.raises(ModelError, match=says):
            save_model(tmp_path / "m.npz", trained(recognizer, name), PADS)
    assert not list(tmp_path.iterdir())


def test_a_model_replaces_no_data_set(learnt, tmp_path) -> None:
    np.savez(tmp_path / "m.npz", grasp_offsets=np.zeros(3))
    before = (tmp_path / "m.npz").read_bytes()
    with pytest.raises(ModelError, match="a model would replace its grasps"):
        save_model(tmp_path / "m.npz", trained(learnt), PADS)
    assert (tmp_path / "m.npz").read_bytes() == before


# -- What a teaching does not show is named, and what a taught model shows of its objects ----------


def grasp(label: str, number: int) -> Grasp:
    return plain_grasp(label, start_ms=10_000 * number)


def test_few_grasps_objects_and_series_and_drawings_are_said_to_need_more() -> None:
    ball = [grasp("ball", i) for i in range(6)]
    pin = [replace(grasp("pin", i), source=DRAWING_SOURCE) for i in range(60)]
    note = teaching_notes([*ball, *pin])[0]
    assert note.startswith("teach 10 grasps of each object")
    for part in (
        "(now ball 6)",
        "4 objects (now 2)",
        "drawn objects (pin)",
        "one in six of similar untaught",
    ):
        assert part in note
    (note,) = teaching_notes([grasp(one, i) for one in ("a", "b", "c", "d") for i in range(10)])
    assert "in one series" in note
    assert "calibrate --gauge" in note


def test_further_series_of_some_objects_alone_are_warned_of() -> None:
    first = [grasp(label, i) for label in ("ball", "box", "cone", "disc") for i in range(10)]
    again = [a_day_later(g) for g in first]
    (note,) = teaching_notes([*first, *again[:10]])
    assert note.startswith("taught in several series: ball; in one: the 3 others")
    assert teaching_notes([*first, *again]) == ()


def test_grasps_without_a_self_zero_among_others_are_named() -> None:
    bare = [grasp(label, i) for label in ("a", "b", "c", "d") for i in range(10)]
    zeroed = [replace(g, zero=drawn_zero()) for g in bare]
    assert "self-zero" not in teaching_notes(bare)[-1]
    assert "self-zero" not in teaching_notes(zeroed)[-1]
    mixed = teaching_notes([*bare[:4], *zeroed[4:]])
    assert mixed[-1].startswith("4 of 40 grasps have no self-zero")


def test_a_grasp_without_label_has_no_notes() -> None:
    with pytest.raises(ValueError, match="no label"):
        teaching_notes([grasp("", 0)])


@pytest.fixture
def model(taught: Any) -> TaughtModel:
    """Ball and box, five grasps each."""
    return TaughtModel.load(taught.config, taught.result.model)


def test_objects_have_their_grasps_and_the_size_of_the_newest(model) -> None:
    assert model.objects()["ball"] == (5, None)  # who asks does not wait
    assert not model.shapes_read
    model.read_shapes()
    assert model.shapes_read
    objects = model.objects()
    assert {label: n for label, (n, _) in objects.items()} == {"ball": 5, "box": 5}
    shape = objects["ball"][1]
    assert 1e3 * shape.size_m == pytest.approx(9.5, abs=1.0)
    revision = model.revision
    model.read_shapes()
    assert (model.objects()["ball"][1] is shape, model.revision) == (True, revision)  # read once


def test_what_leaves_too_few_grasps_changes_nothing(model) -> None:
    boxes = [grasp for grasp in model.training_set if grasp.label == "box"]
    for _ in range(2):
        model.forget("box", last=True)
    with pytest.raises(CellError, match="'box' is unchanged"):
        model.forget("box", last=True)
    assert [grasp for grasp in model.training_set if grasp.label == "box"] == boxes[:3]
    assert model.labels == ("ball", "box")
    with pytest.raises(RequestRefused, match="'nut' is not taught; ball, box"):
        model.forget("nut")


@dataclass
class Nearsighted:
    """A recognizer that takes every second grasp of a pin for a bolt."""

    labels: tuple[str, ...]

    def fit(self, grasps: Sequence[Grasp]) -> "Nearsighted":
        return Nearsighted(tuple(sorted({grasp.label for grasp in grasps})))

    def posterior(self, grasp: Grasp) -> Posterior:
        wrong = grasp.label == "pin" and grasp.start_ms % 2
        likely = "bolt" if wrong else grasp.label
        weights = np.array([10.0 if one == likely else 1.0 for one in self.labels])
        if "bolt" in self.labels:
            weights[self.labels.index("bolt")] += 0.5
        return Posterior(labels=self.labels, probability=weights / weights.sum(), unknown=0.0)


def test_the_nearest_object_is_that_which_grasps_look_like() -> None:
    grasps = [
        plain_grasp(label, start_ms=number)
        for label in ("nut", "pin", "bolt")
        for number in range(1, 9)
    ]
    trainer: Any = Nearsighted(())
    assert told_apart(grasps, "pin", trainer) == ToldApart(nearest="bolt", mistaken_share=0.5)
    assert told_apart(grasps, "nut", trainer) == ToldApart(nearest="bolt", mistaken_share=0.0)
    alone = [grasp for grasp in grasps if grasp.label == "pin"]
    assert told_apart(alone, "pin", trainer) == ToldApart(nearest=None, mistaken_share=None)


# -- Evaluation spread over processes --------------------------------------------------------------


def test_one_process_works_here() -> None:
    seen: list[int] = []
    with workers(1) as mapper:
        list(mapper(seen.append, [3, 1, 2]))
    assert seen == [3, 1, 2]


def test_a_number_of_processes_below_none_is_refused() -> None:
    with pytest.raises(CellError, match="--jobs is -1"), workers(-1):
        pass


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_two_workers_give_the_same_figures() -> None:
    parts = tuple(make_grasps(6, seed=seed, pads=make_pads()) for seed in (1, 2))
    trainer = make_trainer("level_check")
    alone = evaluate([parts], trainer)
    with workers(2) as mapper:
        spread = evaluate([parts], trainer, mapper=mapper)
    for field in fields(Evaluation):
        np.testing.assert_equal(getattr(spread, field.name), getattr(alone, field.name))


@pytest.mark.slow
def test_work_that_ends_its_process_is_an_error() -> None:
    def dies(_item: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with workers(2) as mapper, pytest.raises(CellError, match="ended at its work"):
        list(mapper(dies, [1, 2, 3]))


# -- Threads of the linear algebra -----------------------------------------------------------------


HOST_THREADS = 2


def threads() -> set[int]:
    """Threads of each BLAS library of this process."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_training_and_answering_have_one_thread(make_bench, taught, monkeypatch) -> None:
    noting: Any = Scripted(SURE, look=threads)
    noting.fit = lambda _grasps: noting.seen.append(threads()) or noting
    monkeypatch.setattr("cell.learning.training.RECOGNIZERS", {"force_ramp": lambda **_: noting})
    model = TaughtModel(taught.config, training_set=taught.grasps)
    bench = make_bench(taught.config)
    bench.controller.start()
    with threadpool_limits(HOST_THREADS, user_api="blas"):
        assert train([], "force_ramp").recognizer.labels == ("ball", "box")
        model.train()
        Tasks(bench.controller, ModelFile(model, None)).named(IdentifyGoal(present="ball"))
        assert noting.seen == [{1}] * 3
        assert threads() == {HOST_THREADS}
