"""Ramps that end as soon as they have told enough: in virtual time, and with model files."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.data.recording_reader import read_recording
from cell.errors import CellStopped, ConfigError, ModelError
from cell.interfaces.plugin.plugin import TactileCellPlugin
from cell.jobs.run import teach_and_identify
from cell.jobs.run_report import main_report
from cell.learning.model import load_model, save_model
from cell.learning.taught_model import TaughtModel
from cell.learning.training import EARLY_SECTION, load_early, train
from gripper.errors import ServoFault
from recognition.errors import ContactError
from recognition.ramp.ramp import learn_rest
from recognition.recognizer import UNKNOWN, Posterior
from recognition.recognizers.early_classifiers import EarlyClassifiers

STEP = GraspStep(pose=Pose(), force_n=6.0)


@dataclass
class Saying:
    """A recogniser that says the same of each grasp, and does something meanwhile."""

    share: float
    unknown: float = 0.01
    act: Callable[[], object] = lambda: None
    labels: tuple[str, ...] = ("ball", "box")
    asked: list[int] = field(default_factory=list)
    contacts: list[int | None] = field(default_factory=list)

    def posterior(self, grasp: Any) -> Posterior:
        self.asked.append(grasp.n_frames)
        self.contacts.append(grasp.contact_frame)
        self.act()
        probability = np.array([self.share, 1.0 - self.share])
        return Posterior(labels=self.labels, probability=probability, unknown=self.unknown)

    def to_arrays(self) -> Any:
        raise NotImplementedError

    @classmethod
    def from_arrays(cls, _arrays: Any) -> Any:
        raise NotImplementedError


def heads_of(taught: Any, *heads: Saying) -> EarlyClassifiers:
    """Heads that are asked at quarters of what the ball's hardest taught grasp reads."""
    rest = learn_rest(taught.grasps)
    full = max(
        float(g.counts[-5:].mean(axis=0).sum() - rest.counts.sum())
        for g in taught.grasps
        if g.label == "ball"
    )
    levels = full * np.array([0.2, 0.35, 0.5])[: len(heads)]
    return EarlyClassifiers(rest=rest, load_counts=levels, recognizers=heads)


def test_a_ramp_ends_where_it_suffices_and_tells_what_was_known_then(
    make_bench: Callable[..., Any], taught: Any, tmp_path: Path
) -> None:
    bench = make_bench(folder=tmp_path).ready()
    unsure, sure, whole = Saying(0.6), Saying(0.999), Saying(0.001)
    early = heads_of(taught, unsure, sure)
    found = bench.controller.identify(whole, [STEP], early=early)
    (record,) = found.records
    assert record.outcome.ended_early
    assert record.early.looks == 2
    assert found.label == "ball"
    assert found.posteriors == (record.early.posterior,)
    assert whole.asked == []
    assert unsure.asked[0] < sure.asked[0] == record.early.n_frames <= record.grasp.n_frames
    assert unsure.contacts == sure.contacts == [record.grasp.contact_frame]
    assert record.grasp.contact_frame is not None
    assert record.cycles[-1].setpoint_n < 5.0
    assert record.outcome.final_force_n == pytest.approx(record.cycles[-1].setpoint_n, abs=0.5)
    assert bench.controller.state is CellState.IDLE
    assert bench.grip_n == 0.0
    bench.cell.close()
    recording = read_recording(tmp_path / "recording.mcap")
    assert [event["text"] for event in recording.events if event["kind"] == "ramp"] == [
        f"ended early at {record.cycles[-1].setpoint_n:.1f} N: ball 99.9 %"
    ]
    assert [result["n_ended_early"] for result in recording.results] == [1]
    assert len(recording.grasps[0].counts) == record.grasp.n_frames


def test_nothing_but_a_sure_name_ends_a_ramp(bench: Any, taught: Any) -> None:
    bench.ready()

    def refuse() -> None:
        raise ContactError("no contact yet")

    whole = Saying(0.9, unknown=0.97)
    strange = Saying(0.999, unknown=0.05)  # enough for the end of a sequence
    early = heads_of(taught, Saying(0.999, act=refuse), strange, Saying(0.9))
    found = bench.controller.identify(whole, [STEP], early=early)
    assert found.records[0].early is None
    assert not found.records[0].outcome.ended_early
    assert found.records[0].cycles[-1].setpoint_n == 6.0
    assert len(whole.asked) == 1
    assert [len(head.asked) for head in early.recognizers] == [1, 1, 1]


def test_a_fault_while_an_ended_ramp_settles_keeps_the_grip(bench: Any, taught: Any) -> None:
    bench.ready()
    head = Saying(0.999, act=lambda: bench.simulated.inject("servo2.overload"))
    with pytest.raises(ServoFault):
        bench.controller.identify(Saying(0.5), [STEP], early=heads_of(taught, head))
    assert len(head.asked) == 1
    assert bench.controller.state is CellState.ABORTED
    assert bench.controller.holding
    assert bench.grip_n > 0.5


def test_a_stop_comes_before_the_end_of_the_ramp(bench: Any, taught: Any) -> None:
    bench.ready()
    head = Saying(0.999, act=bench.controller.cancel)
    with pytest.raises(CellStopped, match="the grip is kept"):
        bench.controller.identify(Saying(0.5), [STEP], early=heads_of(taught, head))
    assert bench.controller.state is CellState.HELD
    assert bench.grip_n > 0.5


@pytest.fixture(scope="module")
def early_model(taught: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The taught model, with heads for ramps that end early."""
    path = tmp_path_factory.mktemp("early") / "model.npz"
    whole = load_model(taught.result.model)
    trained = train(taught.grasps, whole.trainer_name, early=True)
    save_model(
        path,
        whole.recognizer,
        trainer_name=whole.trainer_name,
        pads=whole.pads,
        sections=trained.sections,
    )
    return path


def test_objects_are_named_in_less_time_and_none_wrongly(
    make_bench: Callable[..., Any],
    make_config: Callable[..., Any],
    taught: Any,
    early_model: Path,
    tmp_path: Path,
) -> None:
    results = {}
    for decide_early in (False, True):
        config = make_config(sequence__decide_early=decide_early)
        bench = make_bench(config)
        bench.controller.start()
        results[decide_early] = teach_and_identify(
            bench.cell,
            config,
            labels=["ball", "box"],
            n_teach=99,
            n_trials=4,
            folder=tmp_path,
            progress=lambda *_step: None,
            model=TaughtModel.load(config, early_model),
        )
    whole, early = results[False], results[True]
    for trial in (*whole.trials, *early.trials):
        assert trial.found.label in (trial.truth, UNKNOWN)
    assert whole.n_ended_early == 0 < early.n_ended_early
    assert early.grasp_s < whole.grasp_s
    data = early.as_json()
    assert data["ramps_ended_early"] == early.n_ended_early
    assert data["grasp_seconds"] == early.grasp_s
    page = main_report(early, config, bench.cell, tmp_path / "report.html").read_text()
    n_grasps = sum(len(trial.found.records) for trial in early.trials)
    assert f"{early.n_ended_early} of {n_grasps} ended early" in page
    assert "ended early at" in page


def test_a_model_keeps_what_it_was_taught_with_ramps_cut_short(
    make_config: Callable[..., Any], taught: Any, early_model: Path
) -> None:
    wanted, unwanted = (
        make_config(sequence__decide_early=value).sequence for value in (True, False)
    )
    model = load_model(early_model)
    assert load_early(model, unwanted) is None
    heads = load_early(model, wanted)
    assert heads is not None
    assert len(heads.recognizers) == 2
    assert {head.labels for head in heads.recognizers} == {("ball", "box")}
    # A ramp to a small force never reaches half of the usual load.
    assert np.mean([bool(heads.look_frames(grasp)) for grasp in taught.grasps]) > 0.5
    plain = load_model(taught.result.model)
    assert load_early(plain, unwanted) is None
    with pytest.raises(ModelError, match=r"not taught with ramps cut short.*train --early"):
        load_early(plain, wanted)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("load_counts", lambda array: array[::-1]),
        ("1.labels", lambda _array: np.array(["ball", "egg"])),
        ("rest.adc_max", lambda array: array + 1),
        ("1.feature_version", lambda _array: None),
    ],
)
def test_heads_that_do_not_fit_their_model_are_refused(
    make_config: Callable[..., Any], early_model: Path, tmp_path: Path, name: str, change: Any
) -> None:
    model = load_model(early_model)
    arrays = dict(model.sections[EARLY_SECTION])
    changed = change(arrays.pop(name))
    arrays |= {} if changed is None else {name: changed}
    path = tmp_path / "m.npz"
    save_model(
        path,
        model.recognizer,
        trainer_name=model.trainer_name,
        pads=model.pads,
        sections={EARLY_SECTION: arrays},
    )
    sequence = make_config(sequence__decide_early=True).sequence
    with pytest.raises(ModelError, match="does not suit this program"):
        load_early(load_model(path), sequence)


def test_a_host_is_refused_before_the_cell_is_touched(
    make_config: Callable[..., Any], taught: Any
) -> None:
    config = make_config(sequence__decide_early=True)
    with pytest.raises(ModelError, match="decide_early needs"):
        TactileCellPlugin(config, model=taught.result.model)


def test_a_loop_in_the_same_process_cannot_wait_for_answers(
    make_config: Callable[..., Any],
) -> None:
    ports = {
        "gripper__port": "/dev/ttyUSB0",
        "tactile__interface": "socketcan",
        "tactile__channel": "can0",
        "positioner__kind": "operator",
        "loop__own_process": False,
    }
    make_config(**ports)
    with pytest.raises((ConfigError, ValueError), match=r"decide_early .* loop\.own_process"):
        make_config(**ports, sequence__decide_early=True)


def test_what_a_plugin_was_taught_decides_early_and_is_saved(
    make_config: Callable[..., Any], tmp_path: Path
) -> None:
    config = make_config(sequence__decide_early=True, sequence__max_grasps=1)
    with TactileCellPlugin(config) as plugin:
        plugin.result(plugin.start({"task": "teach", "label": "box", "grasps": 6}), 60.0)
        answer = plugin.result(plugin.start({"task": "identify", "present": "box"}), 60.0)
        assert (answer.label, answer.n_grasps) == ("box", 1)
        plugin.save(tmp_path / "m.npz")
    heads = load_early(load_model(tmp_path / "m.npz"), config.sequence)
    assert heads is not None
    assert len(heads.recognizers) > 0
