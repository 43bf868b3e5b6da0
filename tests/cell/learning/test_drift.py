"""A running cell follows the drift of its sensors, says so once, and can keep it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from cell.control.identification import Identification
from cell.data.recording_reader import read_recording
from cell.errors import ConfigError, ModelError
from cell.interfaces.cli.app import app
from cell.interfaces.plugin import tasks
from cell.interfaces.plugin.goals import IdentifyGoal, TeachGoal
from cell.interfaces.plugin.plugin import TactileCellPlugin
from cell.jobs.calibrate import calibrate_model
from cell.jobs.identify import identify_recorded, objects_in_turn
from cell.learning.drift import DriftTracker, estimate_values
from cell.learning.model import load_model, save_model
from cell.learning.taught_model import TaughtModel
from cell.learning.training import Trained
from gripper.state import GraspResult
from recognition.drift.drift import NO_DRIFT, Drift
from recognition.drift.estimate import DriftEstimate, DriftMeasurement
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from recognition.statistics.fusion import Decision, DecisionKind

DRIFT = Drift(gains=(0.72, 0.72), aperture_offset_m=-3.8e-3)


@dataclass(frozen=True)
class Follower:
    """Finds a drift likely from the second object on, and no more from the fourth."""

    labels: tuple[str, ...] = ("ball", "box")
    seen: int = 0

    def posterior(self, grasp: Grasp) -> Posterior:
        unknown = 0.1 if self.drift_estimate.likely else 0.9
        return Posterior(labels=self.labels, probability=np.array([0.9, 0.1]), unknown=unknown)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        return {}

    @classmethod
    def from_arrays(cls, arrays: object) -> "Follower":
        return cls()

    def track_drift(self, grasps: Sequence[Grasp]) -> "Follower":
        return replace(self, seen=self.seen + 1)

    @property
    def drift_estimate(self) -> DriftEstimate:
        before = DriftEstimate.before((0, 1), 2, n_labels=3)
        if not 2 <= self.seen < 4:
            return before
        mean = np.array([np.log(0.72), np.log(0.72), -3.8])
        measured = {
            label: (
                DriftMeasurement(
                    label=label, probability=1.0, values=mean, covariance=before.covariance
                ),
            )
            for label in ("ball", "box", "pin")
        }
        return replace(before, mean=mean, unchanged=0.001, measured=measured)


class Plain:
    """Cannot follow."""

    labels = ("ball", "box")

    def posterior(self, grasp: Grasp) -> Posterior:
        return Posterior(labels=self.labels, probability=np.array([0.5, 0.5]), unknown=0.0)


def record(grasp: Grasp, result: GraspResult = GraspResult.FORCE_REACHED, early: bool = False):
    outcome = SimpleNamespace(
        result=result, ended_early=early, final_force_n=5.0, final_aperture_m=0.01
    )
    return SimpleNamespace(grasp=grasp, outcome=outcome, early=None)


def test_it_learns_after_each_answer_and_speaks_once(make_grasp: Callable[..., Grasp]) -> None:
    shift = DriftTracker(Follower())
    records: Any = [record(make_grasp("ball"))]
    assert shift.drift == NO_DRIFT
    assert shift.add_records(records) == ""
    assert shift.add_records(records) == (
        "the sensors have drifted since teaching: gain 0.72, opening -3.8 mm: gauge the cell"
    )
    assert shift.drift == DRIFT
    assert shift.add_records(records) == ""
    assert "as expected again" in shift.add_records(records)
    assert shift.add_records(records) == ""
    assert shift.taught == Follower()


def test_what_a_drift_is_as_plain_data() -> None:
    values = estimate_values(Follower(seen=3).drift_estimate)
    assert values["gains"] == pytest.approx([0.72, 0.72])
    assert values["gain"] == pytest.approx(0.72)
    assert values["aperture_mm"] == pytest.approx(-3.8)
    assert values["unchanged"] < 0.01
    assert values["n_objects"] == 3
    assert estimate_values(Follower().drift_estimate)["gain"] == 1.0


def test_only_whole_ramps_that_held_something_teach(make_grasp: Callable[..., Grasp]) -> None:
    shift = DriftTracker(Follower())
    grasp = make_grasp("ball")
    weak = record(grasp, GraspResult.FORCE_NOT_REACHED)
    shift.add_records([weak, record(grasp, early=True)])  # type: ignore[list-item]
    shift.add_records([])
    assert shift.recognizer == Follower()
    shift.add_records([weak, record(grasp)])  # type: ignore[list-item]
    assert shift.recognizer == Follower(seen=1)


@pytest.mark.parametrize(("taught", "follow"), [(Plain(), True), (Follower(), False)])
def test_others_are_passed_through(
    taught: Any, follow: bool, make_grasp: Callable[..., Grasp]
) -> None:
    shift = DriftTracker(taught, follow=follow)
    for _ in range(4):
        assert shift.add_records([record(make_grasp("ball"))]) == ""  # type: ignore[list-item]
    assert shift.recognizer is taught
    assert shift.drift == NO_DRIFT


def test_taught_anew_it_follows_the_same_grasps_again(make_grasp: Callable[..., Grasp]) -> None:
    shift = DriftTracker(Follower())
    for _ in range(3):
        shift.add_grasps([make_grasp("ball")])
    again = shift.continued_with(Follower(labels=("ball", "box", "pin")))
    assert again.recognizer == Follower(labels=("ball", "box", "pin"), seen=3)
    assert again.drift == DRIFT
    assert "as expected again" in again.add_grasps([make_grasp("ball")])


def test_what_was_followed_can_be_forgotten(make_grasp: Callable[..., Grasp]) -> None:
    shift = DriftTracker(Follower())
    assert [bool(shift.add_grasps([make_grasp("ball")])) for _ in range(2)] == [False, True]
    shift.reset()
    assert shift.recognizer is shift.taught
    assert shift.drift == NO_DRIFT
    assert shift.continued_with(Follower()).recognizer == Follower()
    assert [bool(shift.add_grasps([make_grasp("ball")])) for _ in range(2)] == [False, True]


def test_recorded_grasps_are_followed_in_the_order_of_time(
    make_grasp: Callable[..., Grasp],
) -> None:
    times = {"b": 30, "c": 40, "a": 20, "d": 10}
    grasps = [replace(make_grasp("ball"), source=k, start_ms=t) for k, t in times.items()]
    grasps[3] = replace(grasps[3], label="")
    grasps[1] = replace(grasps[1], label="box")
    runs = objects_in_turn(grasps)
    assert [[number for number, _ in run] for run in runs] == [[3], [2, 0], [1]]
    model: Any = SimpleNamespace(recognizer=Follower(), pads=grasps[0].pads)
    answers = identify_recorded(model, grasps, tracker=DriftTracker(model.recognizer))
    assert [answer.number for answer in answers] == [0, 1, 2, 3]
    assert [a.drift.n_objects for a in answers if a.drift] == [0, 3, 0, 0]
    assert [answer.label for answer in answers] == ["UNKNOWN", "ball", "UNKNOWN", "UNKNOWN"]
    assert answers[1].as_json()["drift"]["gain"] == pytest.approx(0.72)
    alone = identify_recorded(model, grasps)
    assert [answer.label for answer in alone] == 4 * ["UNKNOWN"]


class Grasping:
    """A controller whose grasps are given."""

    def __init__(self, grasp: Grasp) -> None:
        self.given, self.remarks = grasp, list[tuple[str, str]]()

    def present(self, label: object) -> None:
        pass

    def collect(self, label: str, steps: Sequence[object], **_options: object) -> list[Any]:
        return [record(replace(self.given, label=label)) for _ in steps]

    def identify(self, recognizer: Follower, *_: object, **__: object) -> Any:
        posterior = recognizer.posterior(self.given)
        return Identification(
            label="ball",
            probability=0.9,
            decision=Decision(kind=DecisionKind.DECIDED, label="ball", probability=0.9),
            posteriors=(posterior,),
            fused=posterior,
            records=(record(self.given),),
            drift=recognizer.drift_estimate,
        )

    def remark(self, kind: str, text: str) -> None:
        self.remarks.append((kind, text))


def test_a_session_says_the_drift_and_takes_it_off_what_is_taught_then(
    make_config: Callable[..., Any],
    make_grasp: Callable[..., Grasp],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taught_with: list[list[Grasp]] = []

    def train(grasps: list[Grasp], name: str, **_options: object) -> Trained:
        taught_with.append(list(grasps))
        return Trained(recognizer=Follower(), trainer_name=name)

    monkeypatch.setattr("cell.learning.taught_model.train", train)
    controller: Any = Grasping(make_grasp("ball"))
    model, told = TaughtModel(make_config()), list[Any]()
    file = tasks.ModelFile(model, None)
    tasks.teach(controller, model, file, TeachGoal(label="ball", grasps=1), told.append)
    assert np.array_equal(taught_with[0][0].counts, controller.given.counts)
    answers = []
    for _ in range(3):
        answers.append(
            tasks.identify(
                controller, model, IdentifyGoal(), told.append, seen=lambda *_, **__: None
            )
        )
    assert [bool(answer.remark) for answer in answers] == [False, True, False]
    assert controller.remarks == [("drift", answers[1].remark)]
    assert told[-1] == {"task": "identify", "remark": answers[1].remark}
    assert [a.drift.likely for a in answers if a.drift] == [False, False, True]
    tasks.teach(controller, model, file, TeachGoal(label="box", grasps=1), told.append)
    first, second = taught_with[1]
    assert np.array_equal(first.counts, controller.given.counts)
    assert second.aperture_m == pytest.approx(controller.given.aperture_m + 3.8e-3)
    assert model.recognizer == Follower(seen=3)


def test_a_plugin_saves_what_was_taught_or_what_it_followed(
    taught: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin = TactileCellPlugin(taught.config, model=taught.result.model)
    # One object alone shows no drift; here the estimate counts as likely from the start.
    monkeypatch.setattr("recognition.drift.estimate._UNCHANGED", 1e-9)
    monkeypatch.setattr("recognition.drift.estimate._LEAST_OBJECTS", 0)
    try:
        job = plugin.start({"task": "identify", "max_grasps": 1, "present": "ball"})
        answer = plugin.result(job, 60.0)
        plugin.save(tmp_path / "taught.npz")
        plugin.save(tmp_path / "followed.npz", followed=True)
        plugin.forget_drift()
        plugin.save(tmp_path / "forgotten.npz", followed=True)
    finally:
        plugin.close()
    assert answer.drift is not None
    names = ("taught", "followed", "forgotten")
    before, same, followed, forgotten = (
        np.unique(load_model(path).recognizer.to_arrays()["drift_gains"]).tolist()
        for path in (taught.result.model, *(tmp_path / f"{name}.npz" for name in names))
    )
    assert before == same == forgotten == [1.0]
    assert followed != before


def test_the_recording_names_the_drift_of_each_answer(taught: Any) -> None:
    results = read_recording(taught.result.recording).results
    assert [result["drift_n_objects"] for result in results] == [0, 1]
    assert all(result["drift_gain"] == 1.0 for result in results)
    assert all(result["drift_unchanged"] > 0.9 for result in results)
    assert taught.result.as_json()["drift"]["n_objects"] == 2
    assert taught.result.as_json()["remarks"] == []


def test_a_cell_that_grasps_one_object_has_nothing_to_follow(taught: Any) -> None:
    with pytest.raises(ConfigError, match="--follow"):
        CliRunner().invoke(
            app,
            ["identify", "--follow", "-m", str(taught.result.model)],
            catch_exceptions=False,
        )


def test_a_model_that_cannot_follow_is_refused(taught: Any, tmp_path: Path) -> None:
    result = taught.result
    model = tmp_path / "level.npz"
    recognizer = result.recognizers["level_check"]
    save_model(model, recognizer, trainer_name="level_check", pads=taught.grasps[0].pads)
    with pytest.raises(ModelError, match="level_check cannot follow a drift"):
        CliRunner().invoke(
            app,
            ["identify", "--follow", "-m", str(model), str(result.dataset)],
            catch_exceptions=False,
        )


def test_what_is_taught_beside_a_gauged_model_expects_the_gauged_drift(taught: Any) -> None:
    model = load_model(taught.result.model)
    drift = Drift(gains=(0.8,), aperture_offset_m=-1e-3)
    balls = [drift.apply(grasp) for grasp in taught.grasps if grasp.label == "ball"]
    corrected, _ = calibrate_model(model, "ball", balls)
    gauged = TaughtModel(
        taught.config, replace(model, recognizer=corrected), training_set=taught.grasps
    )
    expected = gauged.drift_estimate.expected
    assert expected != NO_DRIFT
    gauged.train()
    assert gauged.drift_estimate.expected == expected
