"""Taught models: files, what a teaching shows, processes that train, and the drift they follow."""

import json
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cell.config.file import changed_config
from cell.control.identification import EarlyDecider, Identification
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.errors import CellError, ModelError
from cell.learning.model import Trained, load_model, save_model
from cell.learning.parallel import workers
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import Separation, separation, teaching_notes
from cell.learning.training import calibrate_model, identify_recorded, train
from cell.recording.dataset import read_grasps
from cell.recording.reader import read_recording
from cell.runtime import tasks
from cell.runtime.goals import IdentifyGoal, TeachGoal
from cell.runtime.tasks import ModelFile, Tasks
from cell.runtime.worker import Report
from gripper.values.outcome import GraspResult
from recognition.drift.drift import Drift, DriftGrid
from recognition.drift.self_zero import drawn_zero
from recognition.errors import ContactError
from recognition.evaluation.evaluation import Evaluation, evaluate
from recognition.evaluation.splits import a_day_later
from recognition.grasp import DRAWING_SOURCE, Grasp
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.level_check import LevelCheckRecognizer, LevelCheckTrainer
from recognition.statistics.fusion import Decision, DecisionKind, StopRule
from tests.cell.cells import REAL, SURE, UNSURE, Scripted, call, plain_grasp, small_config
from tests.cell.served import done
from tests.fuzz.harness import Clock, same_grasps
from tests.recognition.conftest import OBJECTS, make_grasps
from tests.values import make_pads, raising

PADS = make_pads(shapes=((8, 5), (8, 5)), adc_max=255)


GRASPS = make_grasps(4, seed=1, pads=PADS, objects=OBJECTS[:2])


def trained(recognizer: Any, name: str = "level_check") -> Trained:
    return Trained(recognizer=recognizer, trainer_name=name)


@pytest.fixture(scope="module")
def learnt() -> LevelCheckRecognizer:
    return LevelCheckTrainer().fit(GRASPS)


@pytest.fixture(scope="module")
def good(learnt: LevelCheckRecognizer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.npz"
    save_model(path, trained(learnt), GRASPS)
    return path


def test_loaded_model_answers_like_the_taught_one(learnt, good) -> None:
    loaded = load_model(good, PADS)
    assert (loaded.labels, loaded.trainer_name) == (("bar", "block"), "level_check")
    assert loaded.pads.same_as(PADS)
    for grasp in make_grasps(1, seed=2, pads=PADS):
        was, now = learnt.posterior(grasp), loaded.recognizer.posterior(grasp)
        np.testing.assert_array_equal(now.probability, was.probability)
        assert now.unknown == was.unknown
    # The file is plain arrays and JSON.
    with np.load(good, allow_pickle=False) as archive:
        header = json.loads(str(archive["model"]))
        assert all(archive[name].dtype.kind in "biufU" for name in archive.files)
    assert (header["format"], len(header["sha256"])) == ("tactile-cell-model/2", 64)


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
    save_model(tmp_path / "m.npz", trained(learnt), GRASPS)
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
            save_model(tmp_path / "m.npz", trained(recognizer, name), GRASPS)
    assert not list(tmp_path.iterdir())


def test_a_model_replaces_no_data_set(learnt, tmp_path) -> None:
    np.savez(tmp_path / "m.npz", grasp_offsets=np.zeros(3))
    before = (tmp_path / "m.npz").read_bytes()
    with pytest.raises(ModelError, match="a model would replace its grasps"):
        save_model(tmp_path / "m.npz", trained(learnt), GRASPS)
    assert (tmp_path / "m.npz").read_bytes() == before
    (tmp_path / "m.npz").write_bytes(before.replace(b"PK\x01\x02", b"PK\x01\x03"))  # damaged
    save_model(tmp_path / "m.npz", trained(learnt), GRASPS)
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "m.npz").chmod(0o444)
    for name, why in (("pipe.npz", "not a plain file"), ("m.npz", "write-protected")):
        with pytest.raises(ModelError, match=why):
            save_model(tmp_path / name, trained(learnt), GRASPS)


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
        "about 1 of 6 similar untaught",
    ):
        assert part in note
    (note, *_) = teaching_notes([grasp(one, 0) for one in "abcdefg"])
    assert "(now a 1, b 1, c 1, d 1, e 1 and 2 more)" in note
    (note,) = teaching_notes([grasp(one, i) for one in ("a", "b", "c", "d") for i in range(10)])
    assert "in one series" in note
    assert "calibrate --gauge" in note


def test_further_series_of_some_objects_alone_are_warned_of() -> None:
    first = [grasp(label, i) for label in ("ball", "box", "cone", "disc") for i in range(10)]
    again = [a_day_later(g) for g in first]
    (note,) = teaching_notes([*first, *again[:10]])
    assert note.startswith("taught in several series: ball; in one: 3 of 4")
    assert teaching_notes([*first, *again]) == ()
    bare = [replace(g, aperture_m=np.full_like(g.aperture_m, np.nan)) for g in first]
    assert not any("known opening" in note for note in teaching_notes(bare))
    (*_, note) = teaching_notes([*bare[:8], *first[8:]])
    assert note.startswith("ball: fewer than 3 grasps with a known opening")


def test_grasps_without_a_self_zero_among_others_are_named() -> None:
    bare = [grasp(label, i) for label in ("a", "b", "c", "d") for i in range(10)]
    zeroed = [replace(g, zero=drawn_zero()) for g in bare]
    assert "self-zero" not in teaching_notes(bare)[-1]
    assert "self-zero" not in teaching_notes(zeroed)[-1]
    mixed = teaching_notes([*bare[:4], *zeroed[4:]])
    assert mixed[-1].startswith("4 of 40 grasps have no self-zero")


@pytest.fixture
def model(taught: Any) -> TaughtModel:
    """Ball and box, five grasps each."""
    return TaughtModel(taught.config, taught.result.model)


def test_objects_have_their_grasps_and_the_size_of_the_newest_three(model) -> None:
    assert model.objects()["ball"] == (5, None)  # who asks does not wait
    assert model.unread
    model.read_shapes()
    assert not model.unread
    objects = model.objects()
    assert {label: n for label, (n, _) in objects.items()} == {"ball": 5, "box": 5}
    shape = objects["ball"][1]
    assert (shape.n_grasps, 1e3 * shape.size_m) == (3, pytest.approx(9.5, abs=1.5))
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


def test_a_model_saved_while_an_object_is_forgotten_can_be_loaded(model, tmp_path, monkeypatch):
    def save_before(*args: Any, **options: Any) -> Trained:
        model.save(tmp_path / "m.npz")
        return train(*args, **options)

    monkeypatch.setattr("cell.learning.taught_model.train", save_before)
    model.forget("box")
    objects = TaughtModel(model.config, tmp_path / "m.npz").objects()
    assert objects == {"ball": (5, None), "box": (5, None)}


@dataclass
class Nearsighted:
    """A recognizer that takes every second grasp of a pin for a bolt."""

    labels: tuple[str, ...]

    def fit(self, grasps: Sequence[Grasp]) -> "Nearsighted":
        return Nearsighted(tuple(sorted({grasp.label for grasp in grasps})))

    def posterior(self, grasp: Grasp) -> Posterior:
        likely = "bolt" if grasp.label == "pin" and grasp.start_ms % 2 else grasp.label
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
    assert separation(grasps, "pin", trainer) == Separation(nearest="bolt", mistaken_share=0.5)
    assert separation(grasps, "nut", trainer) == Separation(nearest="bolt", mistaken_share=0.0)
    alone = [grasp for grasp in grasps if grasp.label == "pin"]
    assert separation(alone, "pin", trainer) == Separation(nearest=None, mistaken_share=None)


# -- Evaluation spread over processes --------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_two_workers_give_the_same_figures() -> None:
    parts = tuple(make_grasps(6, seed=seed, pads=make_pads()) for seed in (1, 2))
    trainer = make_trainer("level_check")
    alone = evaluate([parts], trainer)
    with workers(2) as mapper:
        spread = evaluate([parts], trainer, mapper=mapper)
    for one in fields(Evaluation):
        np.testing.assert_equal(getattr(spread, one.name), getattr(alone, one.name))


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
    model = TaughtModel(taught.config)
    model.add(taught.grasps)
    bench = make_bench(taught.config)
    bench.controller.start()
    with threadpool_limits(HOST_THREADS, user_api="blas"):
        assert train([], "force_ramp").recognizer.labels == ("ball", "box")
        model.train()
        Tasks(bench.controller, ModelFile(model, None)).named(IdentifyGoal(present="ball"))
        assert noting.seen == [{1}] * 3
        assert threads() == {HOST_THREADS}


# -- A running cell follows the drift of its sensors, says so once, and can keep it ----------------


DRIFT = Drift(gains=(float(np.exp(-1 / 3)),), aperture_offset_m=-4e-3)


@dataclass(frozen=True)
class Follower:
    """Finds a drift likely from the second grasp on, and no more from the fourth."""

    labels: tuple[str, ...] = ("ball", "box")
    zero, ends_early = None, False
    grid: DriftGrid = field(default_factory=DriftGrid)

    def posterior(self, grasp: Grasp) -> Posterior:
        unknown = 0.1 if self.grid.likely else 0.9
        return Posterior(labels=self.labels, probability=np.array([0.9, 0.1]), unknown=unknown)

    def with_grid(self, grid: DriftGrid) -> "Follower":
        return replace(self, grid=grid)

    def with_caution(self, _caution: float) -> "Follower":
        return self

    to_arrays = from_arrays = gauge = with_caution  # nobody asks for them here

    def without_gauges(self) -> "Follower":
        return self.with_grid(DriftGrid())

    def follow(self, grasp: Grasp) -> "Follower":
        n = 3 * self.grid.n_gauged + self.grid.n_followed + 1
        gain, offset = np.log(DRIFT.gain), 1e3 * DRIFT.aperture_offset_m
        off = (self.grid.log_gains[:, None] - gain) ** 2 + (self.grid.offsets_mm - offset) ** 2
        followed = -1e4 * off if 2 <= n < 4 else -self.grid.gauged
        return self.with_grid(replace(self.grid, followed=followed, n_followed=n))


def record(grasp: Grasp, result: GraspResult = GraspResult.FORCE_REACHED, early: bool = False):
    outcome = SimpleNamespace(
        result=result, ended_early=early, final_force_n=5.0, final_aperture_m=0.01, unreached=""
    )
    return SimpleNamespace(grasp=grasp, outcome=outcome, early=None)


def model_of(recognizer: Any, **changes: object) -> TaughtModel:
    """Return a model with that recognizer."""
    model = TaughtModel(small_config(**changes))
    model._trained = Trained(recognizer=recognizer, trainer_name="force_ramp")
    return model


def identified(model: TaughtModel, *records: Any) -> str:
    """Identify once; return the remark."""
    return named(grasping(records[0].grasp, records), model)[1]


def named(controller: Any, model: TaughtModel, **goal: Any) -> tuple[Identification, str]:
    """Identify once; return the answer and the remark."""
    return tasks.Tasks(controller, tasks.ModelFile(model, None)).named(IdentifyGoal(**goal))


def test_only_whole_ramps_that_held_something_teach() -> None:
    model, grasp = model_of(Follower()), plain_grasp("ball")
    weak = record(grasp, GraspResult.FORCE_NOT_REACHED)
    identified(model, weak, record(grasp, early=True))
    assert model.drift.n_followed == 0
    identified(model, weak, record(grasp))
    assert model.drift.n_followed == 1
    model.forget_drift()
    assert model.drift.n_followed == 0


def test_others_stay_as_they_are() -> None:
    one = record(plain_grasp("ball"))
    off: Any = {"recognition.follow_drift": False}
    plain = SimpleNamespace(labels=("ball", "box"), posterior=lambda _grasp: posterior(0.5))
    for model in (model_of(plain), model_of(Follower(), **off)):
        before = model.recognizer
        assert [identified(model, one) for _ in range(3)] == 3 * [""]
        assert model.recognizer is before


def test_recorded_grasps_are_followed_in_the_order_of_time() -> None:
    times = {"b": 30, "c": 40, "a": 20, "d": 10}
    grasps = [replace(plain_grasp("ball"), source=k, start_ms=t) for k, t in times.items()]
    model: Any = SimpleNamespace(recognizer=Follower(), pads=grasps[0].pads)
    answers = identify_recorded(model, grasps, follow=True)
    drifts = [drift for *_, drift in answers if drift]
    assert [drift.n_followed for drift in drifts] == [2, 3, 1, 0]
    assert [answer.name for answer, *_ in answers] == ["ball", "ball", "UNKNOWN", "UNKNOWN"]
    assert drifts[0].values["gain"] == pytest.approx(0.72, abs=0.01)
    assert [answer.name for answer, *_ in identify_recorded(model, grasps)] == 4 * ["UNKNOWN"]


def grasping(grasp: Grasp, records: Sequence[Any] = ()) -> Any:
    """Return a controller whose grasps are given."""

    def identify(recognizer: Follower, *_: object, **__: object) -> Identification:
        posterior = recognizer.posterior(grasp)
        return Identification(
            label="ball",
            decision=Decision(kind=DecisionKind.DECIDED, label="ball", probability=0.9),
            posteriors=(posterior,),
            fused=posterior,
            records=tuple(records) or (record(grasp),),
            drift=getattr(recognizer, "grid", None),
        )

    take = lambda _step, *, label: record(replace(grasp, label=label))  # noqa: E731
    return Mock(clock=Clock(), journal=Mock(brought=None), identify=identify, grasp=take)


def test_a_session_says_each_drift_once_and_takes_it_off_what_is_taught_then(monkeypatch) -> None:
    taught_with: list[list[Grasp]] = []

    def train(grasps: list[Grasp], name: str, **_options: object) -> Trained:
        taught_with.append(list(grasps))
        return Trained(recognizer=Follower(), trainer_name=name)

    monkeypatch.setattr("cell.learning.taught_model.train", train)
    grasp = plain_grasp("ball")
    controller = grasping(grasp)
    # One grasp is enough for this recognizer.
    model, told = TaughtModel(small_config(recognition__recognizer="level_check")), list[Any]()
    cell = tasks.Tasks(controller, tasks.ModelFile(model, None))
    report = Report(1, lambda **now: told.append(now))
    cell.teach(TeachGoal(label="ball", grasps=1), report)
    assert np.array_equal(taught_with[0][0].counts, grasp.counts)
    answers = []
    for _ in range(3):
        answers.append(cell.identify(IdentifyGoal(), report))
    drifted = "the sensors have drifted since teaching: gain 0.72, opening -4.0 mm"
    assert [answer.remark for answer in answers] == ["", drifted, ""]
    controller.journal.note.assert_called_once_with("drift", drifted)
    assert [a.drift.likely for a in answers if a.drift] == [False, False, True]
    cell.teach(TeachGoal(label="box", grasps=1), report)
    first, second = taught_with[1]
    assert np.array_equal(first.counts, grasp.counts)
    assert second.aperture_m == pytest.approx(grasp.aperture_m + 4e-3, abs=1e-4)
    assert (model.drift.n_gauged, model.drift.n_followed) == (1, 0)  # of the model from now on
    again = [cell.identify(IdentifyGoal(), report).remark for _ in range(2)]
    assert again == ["the sensors are again as at the teaching", ""]


def test_a_plugin_saves_what_was_taught_or_what_it_followed(plugin, taught, tmp_path) -> None:
    answer = done(plugin, IdentifyGoal(max_grasps=1, present="ball", whole_ramps=True))
    plugin.save(tmp_path / "taught.npz")
    plugin.save(tmp_path / "followed.npz", followed=True)
    plugin.result(plugin.forget_drift(), 5.0)
    plugin.save(tmp_path / "forgotten.npz", followed=True)
    assert answer.drift is not None
    names = ("taught", "followed", "forgotten")
    before, same, followed, forgotten = (
        load_model(path).recognizer.grid.drift  # type: ignore[attr-defined]
        for path in (taught.result.model, *(tmp_path / f"{name}.npz" for name in names))
    )
    assert before == same == forgotten
    assert followed != before


def test_the_recording_names_the_drift_of_each_answer(taught) -> None:
    results = read_recording(taught.result.recording).results
    assert results[0]["drift_n_grasps"] == 0 < results[1]["drift_n_grasps"]
    assert all(result["drift_gain"] == pytest.approx(1.0, abs=0.1) for result in results)
    assert all(result["drift_unchanged"] > 0.4 for result in results)
    assert taught.result.as_json()["drift"]["n_grasps"] > results[1]["drift_n_grasps"]
    assert not taught.result.as_json()["remarks"]


def test_what_is_taught_beside_a_gauged_model_keeps_the_gauge(taught, tmp_path) -> None:
    model = load_model(taught.result.model)
    drift = Drift(gains=(0.8,), aperture_offset_m=-1e-3)
    balls = [drift.apply(grasp) for grasp in taught.grasps if grasp.label == "ball"]
    after = replace(model, recognizer=calibrate_model(model, {"ball": balls}))
    save_model(tmp_path / "m.npz", after, taught.grasps)
    gauged = TaughtModel(taught.config, tmp_path / "m.npz")
    before = gauged.drift.drift
    assert before.aperture_offset_m < -0.3e-3
    gauged.train()
    assert gauged.drift.drift == before
    late = replace(balls[-1], start_ms=balls[-1].start_ms + 50_000_000, zero=None)  # 14 h
    gauged.add([late])
    assert gauged.training_set[-1] is late


@pytest.mark.usefixtures("made_up_zero")
def test_a_model_that_was_taught_without_a_self_zero_is_named_once(taught, make_bench) -> None:
    bench = make_bench(small_config(self_zero="always")).ready()
    model = TaughtModel(bench.config, taught.result.model)
    goal = {"present": "ball", "max_grasps": 1}
    first, second = (named(bench.controller, model, **goal)[1] for _ in range(2))
    assert "was taught without a self-zero" in first
    assert "without a self-zero" not in second


def test_a_model_has_the_selected_grasps_of_its_data_sets_for_further_models(
    taught, tmp_path
) -> None:
    one, path = tmp_path / "one.npz", taught.result.model
    call("model", "train", taught.result.recording, "--object", "box", "-o", one)
    assert TaughtModel(taught.config, one).objects() == {"box": (5, None)}
    # A model of older features is trained again from itself, here with another model.
    call("model", "train", one, path, "--recognizer", "level_check", "-o", one)
    assert TaughtModel(taught.config, one).objects() == {"box": (10, None), "ball": (5, None)}
    call("model", "calibrate", path, "--gauge", "ball", "-m", path, "-o", one)
    assert same_grasps(read_grasps(one), taught.grasps)


# -- Ramps that end as soon as the data so far suffice ---------------------------------------------


STEP = GraspStep(pose=Pose(), force_n=6.0)
LIKELY = (0.999, 0.01)
UNLIKELY = (0.001, 0.01)


def posterior(share: float, unknown: float = 0.01) -> Posterior:
    probability = np.array([share, 1.0 - share])
    return Posterior(labels=("ball", "box"), probability=probability, unknown=unknown)


def test_a_ramp_ends_where_it_suffices_with_the_answer_of_that_moment(make_bench, tmp_path) -> None:
    bench = make_bench(folder=tmp_path).ready()
    recognizer = Scripted(UNSURE, LIKELY, UNLIKELY)
    answer = bench.controller.identify(recognizer, [STEP], early=True)
    (record,) = answer.records
    assert record.outcome.ended_early
    assert (answer.label, answer.posteriors) == ("ball", (record.early,))
    first, last = recognizer.grasps
    assert first.n_frames < last.n_frames <= record.grasp.n_frames
    assert first.contact_frame == last.contact_frame == record.grasp.contact_frame
    assert record.grasp.contact_frame is not None
    assert first.force_n[-1] == pytest.approx(3.0, abs=0.4)
    assert last.force_n[-1] == pytest.approx(4.5, abs=0.4)
    assert record.cycles[-1].setpoint_n < 5.0
    assert record.outcome.final_force_n == pytest.approx(record.cycles[-1].setpoint_n, abs=0.5)
    assert (bench.controller.life.state, bench.grip_n) == (CellState.IDLE, 0.0)
    bench.cell.close()
    recording = read_recording(tmp_path / "recording.mcap")
    assert [event["text"] for event in recording.events if event["kind"] == "ramp"] == [
        f"ended early at {record.cycles[-1].setpoint_n:.1f} N"
    ]
    assert [result["n_ended_early"] for result in recording.results] == [1]
    assert len(recording.grasps[0].counts) == record.grasp.n_frames


@pytest.mark.parametrize(
    ("answer", "options"),
    [
        (LIKELY, {"look": raising(ContactError("no contact yet"))}),
        ((0.999, 0.05), {}),  # Enough for the end of a sequence.
        (LIKELY, {"drawn_m": (9.5e-3,)}),  # The size of a whole ramp is compared with it.
        ((0.9, 0.01), {}),
    ],
)
def test_nothing_but_a_sure_name_suffices(answer, options) -> None:
    recognizer = Scripted(answer, **options)
    decider = EarlyDecider(recognizer, (), StopRule(error_rate=0.02))
    grasp = plain_grasp("")
    assert not any(decider.suffices(share, lambda: grasp) for share in np.linspace(0.0, 1.0, 50))
    assert (decider.answer, decider.error) == (None, None)
    assert len(recognizer.grasps) == 2


def test_earlier_grasps_count_and_each_share_is_checked_once() -> None:
    grasp, rule = plain_grasp(""), StopRule(error_rate=0.03)
    for earlier, n_checks in (((), 2), ((posterior(0.95), posterior(0.95)), 1)):
        recognizer = Scripted((0.95, 0.01))
        decider = EarlyDecider(recognizer, earlier, rule)
        suffices = [decider.suffices(share, lambda: grasp) for share in (0.49, 0.5, 0.6, 0.9, 0.95)]
        assert suffices == [False, n_checks == 1, False, False, False]
        assert len(recognizer.grasps) == n_checks
    against = EarlyDecider(Scripted((0.95, 0.01)), (posterior(0.02),), rule)
    assert not against.suffices(0.8, lambda: grasp)


def test_a_check_that_fails_is_a_complaint_and_the_ramp_goes_on(bench) -> None:
    bench.ready()
    looks = iter([raising(CellError("a broken model")), bool, bool])

    def look() -> object:
        return next(looks)()

    recognizer = Scripted((0.9, 0.01), look=look)
    answer = bench.controller.identify(recognizer, [STEP], early=True)
    (record,) = answer.records
    assert (answer.label, record.early, record.outcome.ended_early) == ("ball", None, False)
    assert record.cycles[-1].setpoint_n == 6.0
    assert answer.complaints == ("early checks of the ramp of grasp 1: a broken model",)
    assert len(recognizer.grasps) == 3
    assert bench.controller.life.fault is None


def test_by_touch_alone_and_for_other_kinds_ramps_are_whole(taught) -> None:
    for name, use_aperture in (("force_ramp", True), ("level_check", True), ("force_ramp", False)):
        changes = {"recognition.recognizer": name, "recognition.use_aperture": use_aperture}
        model = TaughtModel(changed_config(taught.config, changes))
        model.add(taught.grasps)
        model.train()
        assert model.ends_early is (name == "force_ramp" and use_aperture)


def test_ramps_are_whole_where_the_loop_would_wait_for_answers() -> None:
    assert small_config().decides_early
    assert not small_config(**REAL, loop__own_process=False).decides_early
    assert small_config(**REAL, loop__own_process=True).decides_early
