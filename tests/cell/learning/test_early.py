"""Ramps that end as soon as the data so far suffice: in virtual time, with the taught model."""

import numpy as np
import pytest

from cell.control.early_end import EarlyDecider
from cell.control.keeping import Keep
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.data.recording_reader import read_recording
from cell.errors import CellError, CellStopped
from cell.jobs.collection import Collection
from cell.jobs.identify import identify
from cell.jobs.teach import teach
from cell.learning.taught_model import TaughtModel
from gripper.errors import ServoFault
from recognition.errors import ContactError
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import StopRule, fuse
from tests.cell.conftest import REAL, UNSURE, Scripted, plain_grasp, small_config
from tests.values import raising

STEP = GraspStep(pose=Pose(), force_n=6.0)
LIKELY = (0.999, 0.01)
UNLIKELY = (0.001, 0.01)


def posterior(share: float, unknown: float = 0.01) -> Posterior:
    probability = np.array([share, 1.0 - share])
    return Posterior(labels=("ball", "box"), probability=probability, unknown=unknown)


@pytest.mark.slow
def test_a_ramp_ends_where_it_suffices_with_the_answer_of_that_moment(make_bench, tmp_path) -> None:
    bench = make_bench(folder=tmp_path).ready()
    recogniser = Scripted(UNSURE, LIKELY, UNLIKELY)
    found = bench.controller.identify(recogniser, [STEP], early=True)
    (record,) = found.records
    assert record.outcome.ended_early
    assert found.label == "ball"
    assert found.posteriors == (record.early,)
    first, last = recogniser.grasps
    assert first.n_frames < last.n_frames <= record.grasp.n_frames
    assert first.contact_frame == last.contact_frame == record.grasp.contact_frame
    assert record.grasp.contact_frame is not None
    assert first.force_n[-1] == pytest.approx(3.0, abs=0.4)
    assert last.force_n[-1] == pytest.approx(4.5, abs=0.4)
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
    recogniser = Scripted(answer, **options)
    decider = EarlyDecider(recogniser, (), StopRule(error_rate=0.02))
    grasp = plain_grasp("")
    assert not any(decider.suffices(share, lambda: grasp) for share in np.linspace(0.0, 1.0, 50))
    assert decider.answer is None
    assert decider.error is None
    assert len(recogniser.grasps) == 2


def test_earlier_grasps_count_and_each_share_is_checked_once() -> None:
    grasp, rule = plain_grasp(""), StopRule(error_rate=0.03)
    for earlier, n_checks in (((), 2), ((posterior(0.95), posterior(0.95)), 1)):
        recogniser = Scripted((0.95, 0.01))
        decider = EarlyDecider(recogniser, earlier, rule)
        found = [decider.suffices(share, lambda: grasp) for share in (0.49, 0.5, 0.6, 0.9, 0.95)]
        assert found == [False, n_checks == 1, False, False, False]
        assert len(recogniser.grasps) == n_checks
    against = EarlyDecider(Scripted((0.95, 0.01)), (posterior(0.02),), rule)
    assert not against.suffices(0.8, lambda: grasp)


def test_the_last_grasp_is_no_reason_to_end_a_ramp() -> None:
    rule = StopRule(error_rate=0.02, max_grasps=1)
    assert not rule.suffices(posterior(0.9))
    assert rule.suffices(fuse([posterior(0.9), posterior(0.95)]))
    assert not rule.suffices(posterior(0.999, unknown=0.99))


@pytest.mark.slow
def test_a_check_that_fails_is_a_complaint_and_the_ramp_goes_on(bench) -> None:
    bench.ready()
    looks = iter([raising(CellError("a broken model")), bool, bool])

    def look() -> object:
        return next(looks)()

    recogniser = Scripted((0.9, 0.01), look=look)
    found = bench.controller.identify(recogniser, [STEP], early=True)
    (record,) = found.records
    assert (found.label, record.early, record.outcome.ended_early) == ("ball", None, False)
    assert record.cycles[-1].setpoint_n == 6.0
    assert found.complaints == ("early checks of the ramp of grasp 1: a broken model",)
    assert len(recogniser.grasps) == 3
    assert bench.controller.life.fault is None


@pytest.mark.slow
def test_a_fault_while_an_ended_ramp_settles_keeps_the_grip(bench) -> None:
    bench.ready()
    recogniser = Scripted(LIKELY, look=lambda: bench.simulated.inject("servo2.overload"))
    with pytest.raises(ServoFault):
        bench.controller.identify(recogniser, [STEP], early=True)
    assert len(recogniser.grasps) == 1
    assert bench.controller.life.state is CellState.ABORTED
    assert bench.controller.life.holding
    assert bench.grip_n > 0.5


@pytest.mark.slow
def test_a_part_kept_after_an_ended_ramp_is_held_with_the_force_of_a_carry(bench) -> None:
    bench.ready()
    step = GraspStep(pose=Pose(), force_n=5.0)
    found = bench.controller.identify(Scripted(LIKELY), [step], early=True, keep=Keep.ALWAYS)
    (record,) = found.records
    carry_n = bench.config.sequence.carry_force_n
    assert record.outcome.final_force_n < 0.8 * carry_n
    assert found.kept
    check = bench.controller.kept.verify()
    assert (check.same, check.force_n) == (True, pytest.approx(carry_n, rel=0.1))
    assert bench.grip_n == pytest.approx(carry_n, rel=0.2)


@pytest.mark.slow
def test_a_stop_comes_before_the_end_of_the_ramp(bench) -> None:
    bench.ready()
    recogniser = Scripted(LIKELY, look=bench.controller.life.cancel)
    with pytest.raises(CellStopped, match="the grip is kept"):
        bench.controller.identify(recogniser, [STEP], early=True)
    assert bench.controller.life.state is CellState.HELD
    assert bench.grip_n > 0.5


@pytest.mark.slow
def test_objects_are_named_in_less_time_and_none_wrongly(make_bench, taught) -> None:
    bench = make_bench(taught.config).ready()
    model = TaughtModel.load(taught.config, taught.result.model)
    grasp_s: dict[bool, list[float]] = {True: [], False: []}
    for whole, times_s in grasp_s.items():
        ended = 0
        for number, label in enumerate(["ball", "box"] * 2):
            found = identify(
                bench.controller, model, presented=label, seed=20 + number, whole_ramps=whole
            )
            assert found.label in (label, UNKNOWN)
            times_s += [record.duration_s for record in found.records]
            ended += sum(record.early is not None for record in found.records)
        assert ended == 0 if whole else ended >= 1
    assert np.mean(grasp_s[False]) < np.mean(grasp_s[True])
    more = Collection(label="ball", n_planned=1)
    teach(bench.controller, model, more, seed=30, on_grasp=lambda _: None)
    assert all(one.cycles[-1].setpoint_n == one.step.force_n for one in more.records)


@pytest.mark.slow
def test_by_touch_alone_and_for_other_kinds_ramps_are_whole(taught) -> None:
    for name, use_aperture in (("force_ramp", True), ("level_check", True), ("force_ramp", False)):
        recognition = {"recognizer": name, "use_aperture": use_aperture}
        config = taught.config.model_copy(
            update={"recognition": taught.config.recognition.model_copy(update=recognition)}
        )
        model = TaughtModel(config, training_set=taught.grasps)
        model.train()
        assert model.ends_early is (name == "force_ramp" and use_aperture)


def test_ramps_are_whole_where_the_loop_would_wait_for_answers() -> None:
    assert small_config().decides_early
    assert not small_config(**REAL, loop__own_process=False).decides_early
    assert small_config(**REAL, loop__own_process=True).decides_early
