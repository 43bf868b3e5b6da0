"""The main job: teach, train, identify; its files, its figures, its page."""

import json
from pathlib import Path

import numpy as np
import pytest

from cell.errors import CellError, NoPartFound
from cell.files import json_bytes
from cell.interfaces.cli.session import job_folder
from cell.learning.labelled_grasps import name_recorded, read_labelled_grasps
from cell.learning.model import load_model
from cell.learning.training import train
from cell.recording.dataset import read_grasps, write_dataset
from cell.recording.reader import read_recording
from cell.report.confusion import BASELINE, score, score_tables
from cell.runtime.main_job import baseline
from cell.runtime.tasks import Collection
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN, Posterior


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


def test_no_pose_of_teaching_is_met_again(taught) -> None:
    poses = [pose["x_m"] for pose in read_recording(taught.result.recording).poses]
    assert len(set(poses)) == len(poses)


def test_progress_reaches_its_end(taught) -> None:
    last = {task: (done, total) for task, done, total in taught.progress}
    assert last == {
        "teach ball": (5, 5),
        "teach box": (5, 5),
        "train": (2, 2),
        "identify ball": (1, 1),
        "identify box": (1, 1),
    }


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
    felt = data["identifications"]
    assert [one["presented"] for one in felt] == ["ball", "box"]
    kinds = [part.shape.kind for part in taught.result.parts]
    assert [one["shape"] for one in felt] == kinds
    assert kinds[0] in ("sphere", "oval")  # one ball in forty is felt as an oval
    assert kinds[1] == "flat"
    for name in ("recording", "dataset", "model"):
        assert Path(data[name]).is_file()
    assert data["report"] is None


def test_the_baseline_as_default_is_trained_once() -> None:
    assert baseline(BASELINE, ()) == {}


# -- scores ------------------------------------------------------------------------------------


def test_scores_count_rows_of_truth_and_columns_of_answers() -> None:
    result = score("", ["a", "a", "b", "b"], ["a", UNKNOWN, "a", "b"], ["a", "b"])
    assert result.counts.tolist() == [[1, 0, 1], [1, 1, 0]]
    assert (result.n, result.n_right, result.accuracy) == (4, 2, 0.5)
    low, high = result.interval
    assert low < 0.5 < high


def test_answers_that_were_not_asked_for_are_unknown_and_strange_truths_do_not_count() -> None:
    result = score("", ["a", "z"], ["c", "a"], ["a", "b"])
    assert (result.counts.tolist(), result.n) == ([[0, 0, 1], [0, 0, 0]], 1)


def test_nothing_asked_is_no_accuracy() -> None:
    result = score("", [], [], ["a"])
    assert np.isnan(result.accuracy)
    assert result.interval == (0.0, 1.0)


# -- teaching ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_teaching_goes_on_after_a_grasp_without_a_part_and_ends_where_none_has_one(bench) -> None:
    bench.controller.start()
    bench.once_in(GripperPhase.APPROACHING, bench.simulated.remove)
    told: list[tuple[int, int]] = []

    def tell(now: Collection) -> None:
        told.append((len(now.records), now.n_missed))

    taken = Collection(label="box", n_planned=2)
    taken.fill(bench.controller, bench.config.sequence, seed=1, on_grasp=tell)
    assert [grasp.label for grasp in taken.grasps] == ["box"]
    assert told == [(0, 1), (1, 1)]
    bench.once_in(GripperPhase.APPROACHING, bench.simulated.remove)
    with pytest.raises(NoPartFound):
        Collection(label="box", n_planned=1).fill(bench.controller, bench.config.sequence, seed=1)


def test_recorded_grasps_get_their_label_and_go_in_wherever_data_sets_do(taught, tmp_path) -> None:
    recording, named = taught.result.recording, tmp_path / "named.npz"
    n_identified = len(taught.result.records)
    notes: list[str] = []
    assert {g.label for g in read_labelled_grasps(recording, notes.append)} == {"ball", "box"}
    assert notes == [f"{recording}: {n_identified} grasps without a label are left out"]
    unnamed = tmp_path / "unnamed.npz"
    write_dataset(unnamed, [grasp for grasp in read_grasps(recording) if not grasp.label])
    with pytest.raises(CellError, match=r"tactile-cell teach LABEL --from .*unnamed\.npz -o"):
        read_labelled_grasps(unnamed, notes.append)
    assert name_recorded(recording, "thing", named) == (n_identified, 0)
    assert name_recorded(unnamed, "other", named, "second") == (n_identified, n_identified)
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
