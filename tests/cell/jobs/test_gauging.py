"""Drift in evaluation, and taking it off: evaluate --drift --gauge, calibrate."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.config.file import changed_config, config_text
from cell.data.dataset import read_dataset, write_dataset
from cell.errors import CellError, ConfigError, ModelError, RequestRefused
from cell.jobs.calibrate import calibrate_model
from cell.jobs.common import silent
from cell.jobs.evaluate import evaluate_recognizers
from cell.learning.model import load_model
from cell.learning.taught_model import TaughtModel
from cell.plugin import tasks
from cell.plugin.goals import GaugeGoal
from gripper.values.outcome import GraspResult
from recognition.drift.drift import NO_DRIFT, Drift
from recognition.recognizers import make_trainer
from tests.cell.archive.fleet import SIZES_MM, ramp
from tests.cell.conftest import call

DRIFT = Drift(gains=(0.8,), aperture_offset_m=-1e-3)


@pytest.fixture
def drifted(taught: Any, tmp_path: Path) -> Path:
    path = tmp_path / "drifted.npz"
    write_dataset(path, [DRIFT.apply(grasp) for grasp in taught.grasps])
    return path


@pytest.mark.slow
def test_evaluate_drifts_and_gauges(tmp_path) -> None:
    rng = np.random.default_rng(5)
    grasps = [ramp(label, rng, start_ms=20_000 * n) for n in range(20) for label in SIZES_MM]
    write_dataset(tmp_path / "grasps.npz", grasps)
    text = call(
        *("evaluate", tmp_path / "grasps.npz", "--recognizer", "force_ramp", "--fuse", "1"),
        *("--drift", "gain=0.8,aperture_mm=-3", "--gauge", "ball", "--json", tmp_path / "e.json"),
    )
    data = json.loads((tmp_path / "e.json").read_text(encoding="utf-8"))
    assert "gain 0.80, opening -3.0 mm" in text
    assert "gauged with 3 grasps of ball" in text
    wanted = {"gain": pytest.approx(0.8), "gains": [0.8], "aperture_mm": pytest.approx(-3.0)}
    assert data["drift"] == wanted
    assert data["gauge"]["label"] == "ball"
    assert data["gauge"]["gain"] == pytest.approx(0.8, abs=0.05)
    assert data["gauge"]["aperture_mm"] == pytest.approx(-3.0, abs=0.2)
    figures = data["recognizers"]["force_ramp"]
    assert np.sum(figures["confusion"]) == 21
    assert figures["single_accuracy"] == 1.0


@pytest.mark.slow
def test_a_running_cell_is_gauged_and_expects_the_drift_from_then_on(taught, tmp_path) -> None:
    balls = [grasp for grasp in taught.grasps if grasp.label == "ball"]
    model = TaughtModel.load(taught.config, taught.result.model)
    path, told = tmp_path / "gauged.npz", list[Any]()
    goal = GaugeGoal(label="ball", grasps=len(balls))

    def gauge(drift: Drift) -> Drift:
        outcome = SimpleNamespace(result=GraspResult.FORCE_REACHED)
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
    assert [one["grasps"] for one in told] == [*range(1, len(balls) + 1), len(balls)]
    shown = {"gain": found.gain, "opening_mm": 1e3 * found.aperture_offset_m}
    before = {"gain": pytest.approx(1.0), "opening_mm": pytest.approx(0.0, abs=1e-9)}
    assert told[-1]["gauged"] == {"label": "ball", "before": before, "after": shown}
    assert model.drift.drift == found
    assert load_model(path).recognizer.grid.drift == found  # type: ignore[attr-defined]
    again = gauge(NO_DRIFT)
    assert told[-1]["gauged"]["before"] == shown
    assert again.gain == pytest.approx(1.0, rel=0.1)
    assert again.aperture_offset_m > found.aperture_offset_m
    with pytest.raises(RequestRefused, match="'nut' was not taught: gauge with one of ball, box"):
        model.check_gauge("nut")


def test_a_gauge_that_the_data_set_does_not_hold_is_named_with_those_it_does(
    taught, tmp_path
) -> None:
    with pytest.raises(CellError, match=r"its 10 grasps have no 'ghost', but 'ball', 'box'"):
        call(
            *("calibrate", taught.result.dataset, "--gauge", "ghost"),
            *("-m", taught.result.model, "-o", tmp_path / "m.npz"),
        )


@pytest.mark.slow
def test_what_cannot_be_gauged_says_why(taught, tmp_path) -> None:
    options = {"split": "chronological:0.6", "names": ["force_ramp"], "progress": silent}
    with pytest.raises(CellError, match="was not taught"):
        evaluate_recognizers(taught.grasps, gauge="ghost", **options)
    of_ball = [grasp for grasp in taught.grasps if grasp.label == "ball"]
    with pytest.raises(CellError, match="are used for the gauge"):
        evaluate_recognizers(of_ball, gauge="ball", **options)
    with pytest.raises(ConfigError, match="--drift"):
        call("evaluate", taught.result.dataset, "--drift", "speed=3")
    with pytest.raises(ConfigError, match="--model"):
        call("calibrate", "--gauge", "ball", "-o", tmp_path / "m.npz")
    model = load_model(taught.result.model)
    with pytest.raises(CellError, match="no gauge grasp touched both pads"):
        calibrate_model(model, {"ball": []})
    with pytest.raises(CellError, match="'cube' was not taught: gauge with one of ball, box"):
        call("calibrate", "--gauge", "cube", "-m", taught.result.model, "-o", tmp_path / "m.npz")
    plain = make_trainer("shrinkage_lda").fit(taught.grasps)
    with pytest.raises(ModelError, match="cannot be gauged"):
        calibrate_model(
            replace(model, recognizer=plain, trainer_name="shrinkage_lda"), {"ball": taught.grasps}
        )


@pytest.mark.slow
def test_calibrate_writes_a_model_that_expects_the_drift(taught, drifted, tmp_path) -> None:
    new = tmp_path / "gauged.npz"
    text = call(
        *("calibrate", drifted, "--gauge", "ball", "-m", taught.result.model, "-o", new),
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
        *("calibrate", unnamed, "-m", taught.result.model, "-o", new),
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


def test_what_cannot_be_followed_says_why(taught, drifted, tmp_path) -> None:
    few = tmp_path / "few.npz"
    write_dataset(few, read_dataset(drifted)[:4])
    with pytest.raises(CellError, match="4 grasps are too few for a drift"):
        call("calibrate", few, "-m", taught.result.model, "-o", tmp_path / "m.npz")
    with pytest.raises(ConfigError, match="--gauge"):
        call("calibrate", "-m", taught.result.model, "-o", tmp_path / "m.npz")


@pytest.mark.slow
def test_calibrate_on_the_cell_finds_that_nothing_drifted(taught, tmp_path) -> None:
    config = tmp_path / "cell.yaml"
    changes = {"recording.directory": str(tmp_path / "out")}
    config.write_text(config_text(changed_config(taught.config, changes)))
    call(
        *("calibrate", "--gauge", "ball", "-m", taught.result.model, "-o", tmp_path / "m.npz"),
        *("-n", 3, "-c", config, "--json", tmp_path / "c.json"),
    )
    found = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert found["n_grasps"] == 3
    assert abs(found["aperture_mm"]) < 2.0 * found["aperture_sd_mm"]
    assert load_model(tmp_path / "m.npz").labels == ("ball", "box")
