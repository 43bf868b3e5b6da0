"""Jobs over recorded grasps: evaluate, identify, gauge, calibrate."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.config.file import changed_config, config_text
from cell.errors import CellError, ConfigError, ModelError, PositionerError, RequestRefused
from cell.evaluation.evaluate import evaluate_recognizers
from cell.learning.model import load_model
from cell.learning.progress import silent
from cell.learning.taught_model import TaughtModel
from cell.learning.training import calibrate_model, identify_recorded
from cell.recording.dataset import read_dataset, write_dataset
from cell.runtime import tasks
from cell.runtime.goals import GaugeGoal, IdentifyGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.sort import drawn_object
from gripper.values.outcome import GraspResult
from recognition.drift.drift import Drift
from recognition.recognizers import make_trainer
from tests.cell.conftest import call, plain_grasp, small_config

SPLIT = "chronological:0.6"


# -- evaluate ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_file_to_train_on_replaces_the_split(taught: Any) -> None:
    told: list[tuple[str, int, int]] = []
    result = evaluate_recognizers(
        taught.grasps[1:9],
        train=taught.grasps,
        split=SPLIT,
        names=["force_ramp", "level_check"],
        progress=lambda *step: told.append(step),
    )
    assert (result.split, result.n_train, result.n_test) == ("separate files", 10, 8)
    force_ramp, level_check = result.recognizers.values()
    assert force_ramp.full.n == 8
    assert force_ramp.without_aperture is not force_ramp.full
    assert level_check.without_aperture is level_check.full  # it has no opening to leave out
    assert told[-1] == ("evaluate", 4, 4)


def test_what_cannot_be_evaluated_says_why(taught: Any) -> None:
    def evaluated(grasps: Any, **changes: Any) -> Any:
        options = {"split": SPLIT, "names": ["force_ramp"], "progress": silent}
        return evaluate_recognizers(grasps, **options | changes)

    with pytest.raises(CellError, match="not understood"):
        evaluated(taught.grasps, split="halves")
    with pytest.raises(CellError, match="has no label"):
        evaluated([plain_grasp("")])
    with pytest.raises(CellError, match=r"to train and .* to test; both need at least one"):
        evaluated(taught.grasps, train=())
    with pytest.raises(CellError, match="different pads"):
        evaluated(taught.grasps, train=[plain_grasp("ball")])
    with pytest.raises(CellError, match="force_ramp cannot be evaluated"):
        evaluated(taught.grasps[:3], train=taught.grasps[:2])


# -- replay ---------------------------------------------------------------------------------------


# -- identify -------------------------------------------------------------------------------------


def test_recorded_grasps_are_answered_one_by_one(taught: Any) -> None:
    model = load_model(taught.result.model)
    grasps = [taught.grasps[0], replace(taught.grasps[9], label="")]
    answers = identify_recorded(model, grasps)
    assert [posterior.name for posterior, *_ in answers] == ["ball", "box"]
    assert answers[0][0].name_probability > 0.5
    assert answers[1][1:] == (None, None)


def test_a_real_cell_is_not_told_what_it_holds(taught: Any) -> None:
    asked: list[str] = []

    def ask(text: str) -> str:
        asked.append(text)
        return "" if len(asked) == 1 else "q"

    config = small_config(positioner__kind="operator")
    with (
        TactileCellPlugin(config, ask=ask, model=taught.result.model) as plugin,
        pytest.raises(PositionerError, match="operator stopped"),
    ):
        plugin.run(IdentifyGoal(present=drawn_object(config)))
    assert "the object to identify" in asked[0]


def test_an_unknown_object_has_the_probability_of_being_unknown(taught: Any) -> None:
    grasp = taught.grasps[0]
    untouched = replace(grasp, counts=np.repeat(grasp.counts[:1], grasp.n_frames, 0))
    ((answer, *_),) = identify_recorded(load_model(taught.result.model), [untouched])
    assert (answer.name, answer.name_probability, answer.unknown) == ("UNKNOWN", 1.0, 1.0)


def test_grasps_on_other_pads_are_refused(taught: Any) -> None:
    grasp, pads = taught.grasps[0], taught.grasps[0].pads
    for other, text in (
        (replace(grasp, pads=replace(pads, adc_max=4095)), "a full scale of 4095 instead of 255"),
        (replace(grasp, pads=replace(pads, taxel_xy_m=1.1 * pads.taxel_xy_m)), "at other places"),
        (plain_grasp("a"), r"taught on 408 taxels in 10 pads, these .* 24 in 2"),
    ):
        with pytest.raises(ModelError, match=text):
            identify_recorded(load_model(taught.result.model), [other])


# -- Taking a drift off: calibrate -----------------------------------------------------------------


DRIFT = Drift(gains=(0.8,), aperture_offset_m=-1e-3)


@pytest.fixture
def drifted(taught: Any, tmp_path: Path) -> Path:
    path = tmp_path / "drifted.npz"
    write_dataset(path, [DRIFT.apply(grasp) for grasp in taught.grasps])
    return path


@pytest.mark.slow
def test_a_running_cell_is_gauged_and_expects_the_drift_from_then_on(taught, tmp_path) -> None:
    balls = [grasp for grasp in taught.grasps if grasp.label == "ball"]
    model = TaughtModel.load(taught.config, taught.result.model)
    path, told = tmp_path / "gauged.npz", list[Any]()
    goal = GaugeGoal(label="ball", grasps=len(balls))

    def gauge(drift: Drift) -> Drift:
        outcome = SimpleNamespace(result=GraspResult.FORCE_REACHED, short="")
        records = iter([SimpleNamespace(grasp=drift.apply(g), outcome=outcome) for g in balls])
        controller: Any = SimpleNamespace(
            check_plan=lambda *_: None,
            moves=SimpleNamespace(present=lambda _label: None),
            grasp=lambda *_, **__: next(records),
        )
        file: Any = tasks.ModelFile(model, path)
        return tasks.Tasks(controller, file).gauge(goal, told.append)

    found = gauge(DRIFT)
    assert found.aperture_offset_m == pytest.approx(-1e-3, abs=1e-3)
    assert [one["grasps"] for one in told] == [*range(len(balls) + 1), len(balls)]
    shown = {"gain": found.gain, "opening_mm": 1e3 * found.aperture_offset_m}
    before = {"gain": pytest.approx(1.0), "opening_mm": pytest.approx(0.0, abs=1e-9)}
    assert told[-1]["gauged"] == {"label": "ball", "before": before, "after": shown}
    assert model.drift.drift == found
    assert load_model(path).recognizer.grid.drift == found  # type: ignore[attr-defined]
    again = gauge(Drift())
    assert told[-1]["gauged"]["before"] == shown
    assert again.gain == pytest.approx(1.0, rel=0.1)
    assert again.aperture_offset_m > found.aperture_offset_m
    with pytest.raises(RequestRefused, match="'nut' was not taught: gauge with one of ball, box"):
        model.check_gauge("nut")


@pytest.mark.slow
def test_what_cannot_be_gauged_or_followed_says_why(taught, drifted, tmp_path) -> None:
    command, into = ("model", "calibrate", "-m", taught.result.model), ("-o", tmp_path / "m.npz")
    write_dataset(tmp_path / "few.npz", read_dataset(drifted)[:4])
    for arguments, error, complaint in (
        ((taught.result.dataset, "--gauge", "ghost"), CellError, "no 'ghost', but 'ball', 'box'"),
        ((tmp_path / "few.npz",), CellError, "4 grasps are too few for a drift"),
        ((), ConfigError, "--gauge"),
        (("--gauge", "cube"), CellError, "'cube' was not taught: gauge with one of ball, box"),
    ):
        with pytest.raises(error, match=complaint):
            call(*command, *arguments, *into)
    with pytest.raises(ConfigError, match="--model"):
        call("model", "calibrate", "--gauge", "ball", "-o", tmp_path / "m.npz")
    model = load_model(taught.result.model)
    with pytest.raises(CellError, match="no gauge grasp touched both pads"):
        calibrate_model(model, {"ball": []})
    plain = make_trainer("level_check").fit(taught.grasps)
    with pytest.raises(ModelError, match="cannot be gauged"):
        calibrate_model(
            replace(model, recognizer=plain, trainer_name="level_check"), {"ball": taught.grasps}
        )


@pytest.mark.slow
def test_calibrate_writes_a_model_that_expects_the_drift(taught, drifted, tmp_path) -> None:
    new = tmp_path / "gauged.npz"
    text = call(
        *("model", "calibrate", drifted, "--gauge", "ball", "-m", taught.result.model, "-o", new),
        *("--json", tmp_path / "c.json"),
    )
    assert "5 grasps of ball: gain" in text
    found = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert found["aperture_mm"] == pytest.approx(-1.0, abs=2.0 * found["aperture_sd_mm"])
    assert found["aperture_mm"] < 0.0
    recognizer = load_model(new).recognizer
    grasps = read_dataset(drifted)
    assert all(recognizer.posterior(grasp).best == grasp.label for grasp in grasps)
    named = [recognizer.posterior(grasp).name == grasp.label for grasp in grasps]
    assert sum(named) >= 7


@pytest.mark.slow
def test_calibrate_follows_grasps_that_nobody_named(taught, tmp_path) -> None:
    unnamed = tmp_path / "shift.npz"
    drift = Drift(gains=(0.7,), aperture_offset_m=-3e-3)
    grasps = [drift.apply(grasp) for grasp in taught.grasps]
    mixed = [grasp for k in range(5) for grasp in (grasps[k], grasps[k + 5])]
    write_dataset(unnamed, [replace(g, label="", start_ms=k) for k, g in enumerate(mixed)])
    new = tmp_path / "followed.npz"
    text = call(
        *("model", "calibrate", unnamed, "-m", taught.result.model, "-o", new),
        *("--json", tmp_path / "c.json"),
    )
    assert "10 grasps of a shift: gain" in text
    found = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert found["gauge"] is None
    assert found["aperture_mm"] == pytest.approx(-3.0, abs=2.0 * found["aperture_sd_mm"])
    assert found["aperture_mm"] < -2.0
    recognizer = load_model(new).recognizer
    # Ten grasps leave the zero unsure by a millimetre, and the objects differ by half of one.
    assert sum(recognizer.posterior(grasp).best == grasp.label for grasp in grasps) >= 8


@pytest.mark.slow
def test_calibrate_on_the_cell_finds_that_nothing_drifted(taught, tmp_path) -> None:
    config = tmp_path / "cell.yaml"
    changes = {"recording.directory": str(tmp_path / "out")}
    config.write_text(config_text(changed_config(taught.config, changes)))
    call(
        *(
            "model",
            "calibrate",
            "--gauge",
            "ball",
            "-m",
            taught.result.model,
            "-o",
            tmp_path / "m.npz",
        ),
        *("-n", 3, "-c", config, "--json", tmp_path / "c.json"),
    )
    found = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert found["n_grasps"] == 3
    assert abs(found["aperture_mm"]) < 2.0 * found["aperture_sd_mm"]
    assert load_model(tmp_path / "m.npz").labels == ("ball", "box")
