"""Ramps that end as soon as they have told enough: in virtual time, and with model files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.control.keeping import Keep
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.data.recording_reader import read_recording
from cell.errors import CellError, CellStopped, ModelError
from cell.jobs.collection import Collection
from cell.jobs.identify import identify
from cell.jobs.teach import teach
from cell.learning.model import LoadedModel, load_model, save_model
from cell.learning.taught_model import TaughtModel
from cell.learning.training import EARLY_SECTION, load_early, train
from cell.plugin.plugin import TactileCellPlugin
from gripper.errors import ServoFault
from recognition.errors import ContactError
from recognition.ramp.ramp import learn_rest
from recognition.ramp.running_load import load_so_far
from recognition.recognizer import UNKNOWN
from recognition.recognizers.early_classifiers import EarlyClassifiers
from tests.cell.conftest import REAL, UNSURE, Scripted, small_config
from tests.values import raising

STEP = GraspStep(pose=Pose(), force_n=6.0)
LIKELY = (0.999, 0.01)


def heads_of(taught: Any, *heads: Scripted) -> EarlyClassifiers:
    """Heads that are asked at quarters of what the ball's hardest taught grasp reads."""
    rest = learn_rest(taught.grasps)
    full = max(
        float(g.counts[-5:].mean(axis=0).sum() - rest.counts.sum())
        for g in taught.grasps
        if g.label == "ball"
    )
    levels = full * np.array([0.2, 0.35, 0.5, 0.55])[: len(heads)]
    return EarlyClassifiers(rest=rest, load_counts=levels, recognizers=heads)


def test_a_ramp_ends_where_it_suffices_and_tells_what_was_known_then(
    make_bench, taught, tmp_path
) -> None:
    bench = make_bench(folder=tmp_path).ready()
    unsure, sure, whole = Scripted(UNSURE), Scripted(LIKELY), Scripted((0.001, 0.01))
    early = heads_of(taught, unsure, sure)
    found = bench.controller.identify(whole, [STEP], early=early)
    (record,) = found.records
    assert record.outcome.ended_early
    assert found.label == "ball"
    assert found.posteriors == (record.early,)
    assert whole.grasps == []
    (first,), (last,) = unsure.grasps, sure.grasps
    assert first.n_frames < last.n_frames <= record.grasp.n_frames
    assert first.contact_frame == last.contact_frame == record.grasp.contact_frame
    assert record.grasp.contact_frame is not None
    assert record.cycles[-1].setpoint_n < 5.0
    assert record.outcome.final_force_n == pytest.approx(record.cycles[-1].setpoint_n, abs=0.5)
    assert bench.controller.life.state is CellState.IDLE
    assert bench.grip_n == 0.0
    bench.cell.close()
    recording = read_recording(tmp_path / "recording.mcap")
    assert [event["text"] for event in recording.events if event["kind"] == "ramp"] == [
        f"ended early at {record.cycles[-1].setpoint_n:.1f} N"
    ]
    assert [result["n_ended_early"] for result in recording.results] == [1]
    assert len(recording.grasps[0].counts) == record.grasp.n_frames


def test_nothing_but_a_sure_name_ends_a_ramp(bench, taught) -> None:
    bench.ready()

    whole = Scripted((0.9, 0.97))
    strange = Scripted((0.999, 0.05))  # enough for the end of a sequence
    drawn = Scripted(LIKELY, drawn_m=(9.5e-3,))  # the size of a whole ramp is compared with it
    blind = Scripted(LIKELY, look=raising(ContactError("no contact yet")))
    early = heads_of(taught, blind, strange, drawn, Scripted((0.9, 0.01)))
    found = bench.controller.identify(whole, [STEP], early=early)
    assert found.records[0].early is None
    assert not found.records[0].outcome.ended_early
    assert found.records[0].cycles[-1].setpoint_n == 6.0
    assert len(whole.grasps) == 1
    assert [len(head.grasps) for head in early.recognizers] == [1, 1, 1, 1]


def test_a_look_that_fails_is_a_complaint_and_the_ramp_goes_on(bench, taught) -> None:
    bench.ready()

    broken = Scripted(LIKELY, look=raising(CellError("a broken model")))
    early = heads_of(taught, broken, Scripted((0.9, 0.01)))
    found = bench.controller.identify(Scripted(LIKELY), [STEP], early=early)
    assert (found.label, found.records[0].early) == ("ball", None)
    assert found.complaints == ("early checks of the ramp of grasp 1: a broken model",)
    assert [len(head.grasps) for head in early.recognizers] == [1, 1]
    assert bench.controller.life.fault is None


def test_a_fault_while_an_ended_ramp_settles_keeps_the_grip(bench, taught) -> None:
    bench.ready()
    head = Scripted(LIKELY, look=lambda: bench.simulated.inject("servo2.overload"))
    with pytest.raises(ServoFault):
        bench.controller.identify(Scripted((0.5, 0.01)), [STEP], early=heads_of(taught, head))
    assert len(head.grasps) == 1
    assert bench.controller.life.state is CellState.ABORTED
    assert bench.controller.life.holding
    assert bench.grip_n > 0.5


def test_a_part_kept_after_an_ended_ramp_is_held_with_the_force_of_a_carry(bench, taught) -> None:
    bench.ready()
    found = bench.controller.identify(
        Scripted((0.5, 0.01)), [STEP], early=heads_of(taught, Scripted(LIKELY)), keep=Keep.ALWAYS
    )
    (record,) = found.records
    carry_n = bench.config.sequence.carry_force_n
    assert record.outcome.final_force_n < 0.8 * carry_n
    assert found.kept
    check = bench.controller.kept.verify()
    assert (check.same, check.force_n) == (True, pytest.approx(carry_n, rel=0.1))
    assert bench.grip_n == pytest.approx(carry_n, rel=0.2)


def test_a_stop_comes_before_the_end_of_the_ramp(bench, taught) -> None:
    bench.ready()
    head = Scripted(LIKELY, look=bench.controller.life.cancel)
    with pytest.raises(CellStopped, match="the grip is kept"):
        bench.controller.identify(Scripted((0.5, 0.01)), [STEP], early=heads_of(taught, head))
    assert bench.controller.life.state is CellState.HELD
    assert bench.grip_n > 0.5


def test_objects_are_named_in_less_time_and_none_wrongly(make_bench, taught) -> None:
    bench = make_bench(taught.config).ready()
    model = TaughtModel.load(taught.config, taught.result.model)
    grasp_s: dict[bool, list[float]] = {True: [], False: []}
    for whole, times_s in grasp_s.items():
        ended = 0
        for number, label in enumerate(["ball", "box"] * 4):
            found = identify(
                bench.controller, model, presented=label, seed=20 + number, whole_ramps=whole
            )
            assert found.label in (label, UNKNOWN)
            times_s += [record.duration_s for record in found.records]
            ended += sum(record.early is not None for record in found.records)
        assert ended == 0 if whole else ended >= 3
    assert np.mean(grasp_s[False]) < np.mean(grasp_s[True])
    more = Collection(label="ball", n_planned=1)
    teach(bench.controller, model, more, seed=30, on_grasp=lambda _: None)
    assert all(one.cycles[-1].setpoint_n == one.step.force_n for one in more.records)


def test_a_model_keeps_what_it_was_taught_with_ramps_cut_short(taught) -> None:
    heads = load_early(load_model(taught.result.model))
    assert len(heads.recognizers) == 2
    assert {head.labels for head in heads.recognizers} == {("ball", "box")}
    # A ramp to a small force never reaches half of the usual load.
    loads = [load_so_far(grasp, heads.rest).max() for grasp in taught.grasps]
    assert np.mean(np.array(loads) >= heads.load_counts[0]) > 0.5


def test_by_touch_alone_ramps_are_whole_and_nothing_is_said(make_bench, taught) -> None:
    for name, use_aperture in (("level_check", True), ("force_ramp", False)):
        trained = train(taught.grasps, name, use_aperture=use_aperture, early=True)
        assert trained.early is None
    bench = make_bench(taught.config).ready()
    touch = taught.config.recognition.model_copy(update={"use_aperture": False})
    model = TaughtModel(
        taught.config.model_copy(update={"recognition": touch}), training_set=taught.grasps
    )
    model.train()
    found = identify(bench.controller, model, presented="box", seed=0)
    assert all(record.early is None for record in found.records)
    assert found.remark == ""


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("load_counts", lambda array: array[::-1]),
        ("1.labels", lambda _array: np.array(["ball", "egg"])),
        ("rest.adc_max", lambda array: array + 1),
        ("1.feature_version", lambda _array: None),
    ],
)
def test_heads_that_do_not_fit_their_model_are_refused(taught, tmp_path, name, change) -> None:
    model = load_model(taught.result.model)
    arrays = dict(model.sections[EARLY_SECTION])
    changed = change(arrays.pop(name))
    arrays |= {} if changed is None else {name: changed}
    resaved(model, tmp_path / "m.npz", {EARLY_SECTION: arrays})
    with pytest.raises(ModelError, match="does not fit tactile-cell"):
        TaughtModel.load(taught.config, tmp_path / "m.npz")


def test_a_model_taught_without_ramps_cut_short_says_once_that_its_ramps_are_whole(
    make_bench, taught, tmp_path
) -> None:
    bench = make_bench(taught.config).ready()
    path = resaved(load_model(taught.result.model), tmp_path / "m.npz", {})
    model = TaughtModel.load(taught.config, path)
    found = [identify(bench.controller, model, presented="box", seed=seed) for seed in range(2)]
    assert all(record.early is None for one in found for record in one.records)
    assert [one.remark.partition(":")[0] for one in found] == [
        "the model has no early classifiers, so no ramp ends early",
        "",
    ]


def resaved(model: LoadedModel, path: Path, sections: Any) -> Path:
    save_model(
        path, model.recognizer, trainer_name=model.trainer_name, pads=model.pads, sections=sections
    )
    return path


def test_ramps_are_whole_where_the_loop_would_wait_for_answers() -> None:
    assert small_config().decides_early
    assert not small_config(**REAL, loop__own_process=False).decides_early
    assert small_config(**REAL, loop__own_process=True).decides_early


def test_what_a_plugin_was_taught_decides_early_and_is_saved(tmp_path) -> None:
    config = small_config(sequence__max_grasps=1)
    with TactileCellPlugin(config) as plugin:
        plugin.result(plugin.start({"task": "teach", "label": "box", "grasps": 6}), 60.0)
        answer = plugin.result(plugin.start({"task": "identify", "present": "box"}), 60.0)
        assert (answer.label, answer.n_grasps) == ("box", 1)
        plugin.save(tmp_path / "m.npz")
    heads = load_early(load_model(tmp_path / "m.npz"))
    assert len(heads.recognizers) > 0
