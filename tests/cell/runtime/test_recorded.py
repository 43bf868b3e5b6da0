"""Jobs over recorded grasps: evaluate, identify, gauge, calibrate."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from cell.config.file import changed_config, config_text
from cell.errors import CellError, ConfigError, ModelError, NoPartFound, RequestRefused
from cell.evaluation import evaluate_recognizers
from cell.files import json_bytes
from cell.interfaces.cli.session import job_folder
from cell.learning.labelled_grasps import name_recorded, read_labelled_grasps
from cell.learning.model import load_model
from cell.learning.parallel import silent
from cell.learning.taught_model import TaughtModel
from cell.learning.training import calibrate_model, identify_recorded, train
from cell.recording.dataset import read_dataset, read_grasps, write_dataset
from cell.recording.reader import read_recording
from cell.report.confusion import BASELINE, score, score_tables
from cell.runtime import tasks
from cell.runtime.goals import GaugeGoal
from cell.runtime.main_job import baseline
from cell.runtime.tasks import Collection, drawn_object
from cell.runtime.worker import Report
from gripper.values.outcome import GraspResult
from recognition.drift.drift import Drift
from recognition.grasp import DRAWING_SOURCE, ZERO_COLUMNS, SelfZero
from recognition.recognizer import UNKNOWN, Posterior
from recognition.recognizers import make_trainer
from tests.cell.cells import call, plain_grasp, small_config

# -- evaluate ------------------------------------------------------------------------------------


def evaluated(grasps: Any, **changes: Any) -> Any:
    options = {"split": "chronological:0.6", "names": ["force_ramp"], "progress": silent}
    return evaluate_recognizers(grasps, **options | changes)


def test_a_file_to_train_on_replaces_the_split_and_grasps_of_a_drawing_test_nothing(taught) -> None:
    told: list[tuple[str, int, int]] = []
    options = {"names": ["level_check"], "progress": lambda *step: told.append(step)}
    drawn = replace(taught.grasps[0], source=DRAWING_SOURCE)
    result = evaluated([drawn, *taught.grasps[1:9]], train=taught.grasps, **options)
    assert (result.split, result.n_train, result.n_test) == ("separate files", 10, 8)
    (level_check,) = result.recognizers.values()
    assert level_check.full.n == 8
    assert level_check.without_aperture is level_check.full  # it has no opening to leave out
    assert told[-1] == ("evaluate", 2, 2)


def test_what_cannot_be_evaluated_says_why(taught: Any) -> None:
    with pytest.raises(CellError, match="not understood"):
        evaluated(taught.grasps, split="halves")
    with pytest.raises(CellError, match="has no label"):
        evaluated([plain_grasp("")])
    with pytest.raises(CellError, match=r"to train and .* to test, .*; both need a labelled"):
        evaluated(taught.grasps, train=())
    with pytest.raises(CellError, match="different pads"):
        evaluated(taught.grasps, train=[plain_grasp("ball")])
    with pytest.raises(CellError, match="force_ramp cannot be evaluated"):
        evaluated(taught.grasps[:3], train=taught.grasps[:2])


# -- identify -------------------------------------------------------------------------------------


def test_recorded_grasps_are_answered_one_by_one(taught: Any) -> None:
    model = load_model(taught.result.model)
    answers = identify_recorded(model, [taught.grasps[0], replace(taught.grasps[9], label="")])
    assert [posterior.name for posterior, *_ in answers] == ["ball", "box"]
    assert answers[0][0].name_probability > 0.5
    assert answers[1][1:] == (None, None)
    with pytest.raises(ModelError, match=r"taught on 408 taxels in 10 pads, these .* 24 in 2"):
        identify_recorded(model, [plain_grasp("a")])


def test_a_real_cell_is_not_told_what_it_holds() -> None:
    assert drawn_object(small_config(positioner__kind="operator")) is None
    assert drawn_object(small_config()) in ("ball", "box")


# -- Taking a drift off: calibrate -----------------------------------------------------------------


DRIFT = Drift(gains=(0.8,), aperture_offset_m=-1e-3)


@pytest.fixture
def drifted(taught: Any, tmp_path: Path) -> Path:
    path = tmp_path / "drifted.npz"
    write_dataset(path, [DRIFT.apply(grasp) for grasp in taught.grasps])
    return path


def test_a_running_cell_is_gauged_and_expects_the_drift_from_then_on(taught, tmp_path) -> None:
    balls = [grasp for grasp in taught.grasps if grasp.label == "ball"]
    model = TaughtModel(taught.config, taught.result.model)
    path, told = tmp_path / "gauged.npz", list[Any]()
    goal = GaugeGoal(label="ball", grasps=len(balls))
    report = Report(1, lambda **now: told.append(now["progress"]))

    def gauge(drift: Drift) -> Drift:
        outcome = SimpleNamespace(result=GraspResult.FORCE_REACHED, unreached="")
        records = [SimpleNamespace(grasp=drift.apply(g), outcome=outcome) for g in balls]
        controller = Mock(grasp=Mock(side_effect=records))
        file: Any = tasks.ModelFile(model, path)
        return tasks.Tasks(controller, file).gauge(goal, report)

    gauged = gauge(DRIFT)
    assert -3e-3 < gauged.aperture_offset_m < -0.5e-3
    assert [one["grasps"] for one in told] == [*range(len(balls) + 1), len(balls)]
    reported = {"gain": gauged.gain, "opening_mm": 1e3 * gauged.aperture_offset_m}
    before = {"gain": pytest.approx(1.0), "opening_mm": pytest.approx(0.0, abs=1e-9)}
    assert told[-1]["gauged"] == {"label": "ball", "before": before, "after": reported}
    assert model.drift.drift == gauged
    assert load_model(path).recognizer.grid.drift == gauged  # type: ignore[attr-defined]
    with pytest.raises(CellError, match="with ball: these grasps are more like box"):
        model.gauge("ball", [grasp for grasp in taught.grasps if grasp.label == "box"])
    again = gauge(Drift())
    assert told[-1]["gauged"]["before"] == reported
    assert again.gain == pytest.approx(1.0, rel=0.1)
    assert again.aperture_offset_m > gauged.aperture_offset_m
    with pytest.raises(RequestRefused, match="'nut' was not taught: gauge with one of ball, box"):
        model.check_gauge("nut")


def test_what_cannot_be_gauged_or_followed_says_why(taught, drifted, tmp_path) -> None:
    command, into = ("model", "calibrate", "-m", taught.result.model), ("-o", tmp_path / "m.npz")
    write_dataset(tmp_path / "few.npz", read_dataset(drifted)[:4])
    zero = SelfZero(**dict.fromkeys(ZERO_COLUMNS, 0.01))
    old = [replace(grasp, zero=zero, start_ms=0) for grasp in taught.grasps[:5]]
    write_dataset(tmp_path / "old.npz", [*old, *taught.grasps[5:]])
    for arguments, error, complaint in (
        ((taught.result.model, "--gauge", "ghost"), CellError, "no 'ghost', but 'ball', 'box'"),
        ((tmp_path / "old.npz", "--gauge", "ball"), CellError, "no 'ball', but 'box'"),
        ((tmp_path / "few.npz",), CellError, "4 grasps are too few for a drift"),
        ((), ConfigError, "--gauge"),
        (("--gauge", "cube"), CellError, "'cube' was not taught: gauge with one of ball, box"),
    ):
        with pytest.raises(error, match=complaint):
            call(*command, *arguments, *into)
    with pytest.raises(ConfigError, match="--model"):
        call("model", "calibrate", "--gauge", "ball", "-o", tmp_path / "m.npz")
    model = load_model(taught.result.model)
    plain = make_trainer("level_check").fit(taught.grasps)
    with pytest.raises(ModelError, match="cannot follow or gauge a drift"):
        calibrate_model(
            replace(model, recognizer=plain, trainer_name="level_check"), {"ball": taught.grasps}
        )


@pytest.fixture
def calibrate(taught: Any, tmp_path: Path) -> Callable[..., tuple[str, Any, Any]]:
    """Return what calibrates the taught model: what it prints, its JSON, the new recognizer."""
    new, report = tmp_path / "new.npz", tmp_path / "c.json"

    def run(*arguments: object) -> tuple[str, Any, Any]:
        files = ("-m", taught.result.model, "-o", new, "--json", report)
        text = call("model", "calibrate", *arguments, *files)
        return text, json.loads(report.read_text(encoding="utf-8")), load_model(new).recognizer

    return run


def test_calibrate_writes_a_model_that_expects_the_drift(calibrate, drifted) -> None:
    text, report, recognizer = calibrate(drifted, "--gauge", "ball")
    assert "5 grasps of ball: gain" in text
    assert report["aperture_mm"] == pytest.approx(-1.0, abs=2.0 * report["aperture_sd_mm"])
    assert report["aperture_mm"] < 0.0
    answers = [(recognizer.posterior(grasp), grasp.label) for grasp in read_dataset(drifted)]
    assert all(posterior.best == label for posterior, label in answers)
    assert sum(posterior.name == label for posterior, label in answers) >= 7
    text, report, _ = calibrate(drifted)
    assert "10 grasps of a shift: gain" in text
    assert (report["gauge"], report["aperture_mm"] < 0.0) == (None, True)


def test_calibrate_on_the_cell_finds_that_nothing_drifted(taught, calibrate, tmp_path) -> None:
    config = tmp_path / "cell.yaml"
    changes = {"recording.directory": str(tmp_path / "out")}
    config.write_text(config_text(changed_config(taught.config, changes)))
    _, report, recognizer = calibrate("--gauge", "ball", "-n", 3, "-c", config)
    assert report["n_grasps"] == 3
    assert abs(report["aperture_mm"]) < 2.0 * report["aperture_sd_mm"]
    assert recognizer.labels == ("ball", "box")


# -- The main job: teach, train, identify; its files, its figures, its page ------------------------


def test_the_papers_check_names_the_likeliest_also_in_doubt() -> None:
    doubtful = Posterior(labels=("ball", "box"), probability=np.array([0.55, 0.45]), unknown=0.6)
    first = {"force_ramp": doubtful, BASELINE: doubtful}
    scores = score_tables([("ball", "ball", first)], ("ball", "box"), "force_ramp")
    assert scores[BASELINE].counts.tolist() == [[1, 0, 0], [0, 0, 0]]
    assert scores["force_ramp_one_grasp"].counts.tolist() == [[0, 0, 1], [0, 0, 0]]


def test_what_was_taught_is_written(taught) -> None:
    assert [grasp.label for grasp in taught.grasps] == ["ball"] * 5 + ["box"] * 5
    loaded = load_model(taught.result.model, taught.grasps[0].pads)
    assert (loaded.trainer_name, loaded.labels) == ("force_ramp", ("ball", "box"))
    recording = read_recording(taught.result.recording)
    assert recording.complete
    n_identified = sum(len(trial.records) for trial in taught.result.trials)
    assert (len(recording.grasps), len(recording.results)) == (10 + n_identified, 2)
    for was, now in zip(taught.grasps, recording.grasps, strict=False):
        np.testing.assert_array_equal(was.counts, now.counts)
        assert was.command
        assert now.command
        assert was.command.values == pytest.approx(now.command.values, abs=1e-9)
    assert len({grasp.command for grasp in taught.grasps}) == 10
    poses = [pose["x_m"] for pose in recording.poses]
    assert len(set(poses)) == len(poses)  # no pose of teaching is met again
    last = {task: (done, total) for task, done, total in taught.progress}
    taken = {"teach ball": (5, 5), "teach box": (5, 5), "train": (2, 2)}
    assert last == taken | {"identify ball": (1, 1), "identify box": (1, 1)}


def test_json_has_what_was_promised(taught) -> None:
    data = json.loads(json_bytes(taught.result.as_json()))
    assert data["seconds"] >= 0.0
    assert (data["n_taught"], data["n_trials"], data["labels"]) == (10, 2, ["ball", "box"])
    assert set(data["recognizers"]) == {"force_ramp", "force_ramp_one_grasp", BASELINE}
    assert (data["default"], data["recognizers"]["force_ramp"]["accuracy"]) == ("force_ramp", 1.0)
    for figures in data["recognizers"].values():
        assert 0.0 <= figures["accuracy"] <= 1.0
        assert np.array(figures["confusion"]).shape == (2, 3)
        assert figures["confusion_columns"] == ["ball", "box", UNKNOWN]
    assert 1.0 <= data["grasps_per_trial"] <= 4.0
    identifications = data["identifications"]
    assert [one["presented"] for one in identifications] == ["ball", "box"]
    kinds = [part.shape.kind for part in taught.result.parts]
    assert [one["shape"] for one in identifications] == kinds
    assert kinds[0] in ("sphere", "oval")  # one ball in forty is felt as an oval
    assert kinds[1] == "flat"
    for name in ("recording", "model"):
        assert Path(data[name]).is_file()
    assert data["report"] is None
    assert baseline(BASELINE, ()) == {}, "as default it is trained once"


# -- scores ------------------------------------------------------------------------------------


def test_scores_count_rows_of_truth_and_columns_of_answers() -> None:
    result = score("", ["a", "a", "b", "b"], ["a", UNKNOWN, "a", "b"], ["a", "b"])
    assert result.counts.tolist() == [[1, 0, 1], [1, 1, 0]]
    assert (result.n, result.n_right, result.accuracy) == (4, 2, 0.5)
    low, high = result.interval
    assert low < 0.5 < high
    # Answers that were not asked for are unknown, and strange truths do not count.
    result = score("", ["a", "z"], ["c", "a"], ["a", "b"])
    assert (result.counts.tolist(), result.n) == ([[0, 0, 1], [0, 0, 0]], 1)
    nothing = score("", [], [], ["a"])
    assert np.isnan(nothing.accuracy)
    assert nothing.interval == (0.0, 1.0)


# -- teaching ----------------------------------------------------------------------------------


def test_teaching_goes_on_after_a_grasp_without_a_part_and_ends_where_none_has_one() -> None:
    held, missed = SimpleNamespace(grasp=plain_grasp("box")), NoPartFound("no contact")
    told: list[tuple[int, int]] = []

    def teach(*grasps: Any) -> Collection:
        taken = Collection(label="box", n_planned=len(grasps))
        controller, sequence = Mock(grasp=Mock(side_effect=grasps)), small_config().sequence
        taken.fill(
            *(controller, sequence),
            seed=1,
            on_grasp=lambda now: told.append((len(now.records), now.n_missed)),
        )
        return taken

    taken = teach(missed, missed, held, missed)
    assert [grasp.label for grasp in taken.grasps] == ["box"]
    assert told == [(0, 1), (0, 2), (1, 2), (1, 3)]
    for grasps in ([missed], [held, missed, missed, missed, held]):
        with pytest.raises(NoPartFound):
            teach(*grasps)


def test_recorded_grasps_get_their_label_and_go_in_wherever_data_sets_do(taught, tmp_path) -> None:
    recording, named = taught.result.recording, tmp_path / "named.npz"
    n_identified = sum(len(trial.records) for trial in taught.result.trials)
    notes: list[str] = []
    assert {g.label for g in read_labelled_grasps(recording, notes.append)} == {"ball", "box"}
    assert notes == [f"{recording}: {n_identified} grasps without a label are left out"]
    unnamed = tmp_path / "unnamed.npz"
    write_dataset(unnamed, [grasp for grasp in read_grasps(recording) if not grasp.label][1:])
    with pytest.raises(CellError, match=r"tactile-cell teach LABEL --from .*unnamed\.npz -o"):
        read_labelled_grasps(unnamed, notes.append)
    assert name_recorded(unnamed, "other", named, "second") == (n_identified - 1, 0)
    assert name_recorded(recording, "thing", named) == (1, n_identified - 1)
    with pytest.raises(CellError, match="has each of its grasps"):
        name_recorded(recording, "third", named)
    both = {(g.label, g.series) for g in read_labelled_grasps(named, notes.append)}
    assert both == {("thing", ""), ("other", "second")}
    with pytest.raises(CellError, match="each of its grasps has a label"):
        name_recorded(named, "thing", tmp_path / "again.npz")


def test_training_on_too_little_says_what_is_missing(taught) -> None:
    with pytest.raises(CellError, match=r"cannot be trained on these 2 grasps: .*at least 3"):
        train([taught.grasps[0], taught.grasps[5]], "force_ramp")
    with pytest.raises(CellError, match="cannot be trained on these 0 grasps"):
        train([], "level_check")


def test_folders_of_jobs_are_never_shared(tmp_path: Path) -> None:
    folders = {job_folder(tmp_path / "out", "run") for _ in range(3)}
    assert len(folders) == 3
    assert all(folder.is_dir() for folder in folders)
