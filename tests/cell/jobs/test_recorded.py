"""Jobs over recorded grasps: evaluate, replay, identify."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.data.files import json_bytes
from cell.errors import CellError, ConfigError, ModelError, PositionerError
from cell.jobs.common import silent
from cell.jobs.evaluate import evaluate_recognizers
from cell.jobs.identify import drawn_object, identify_recorded
from cell.jobs.replay import replay_grasps
from cell.learning.model import load_model
from cell.learning.taught_model import TaughtModel
from cell.plugin.goals import IdentifyGoal
from cell.plugin.plugin import TactileCellPlugin
from tests.cell.conftest import plain_grasp, small_config

SPLIT = "chronological:0.6"


def play(grasps: Any, **changes: Any) -> Any:
    options = {"split": SPLIT, "limit": None, "recognizer": "force_ramp", "progress": silent}
    return replay_grasps(grasps, **options | changes)


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


@pytest.mark.slow
def test_replayed_grasps_come_back_bit_for_bit_and_are_named(taught: Any, tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    result = play(
        taught.grasps, capture=tmp_path / "bus.pcap", progress=lambda *step: told.append(step)
    )
    assert result.frames_equal
    assert result.difference is None
    assert (result.n_grasps, result.n_train) == (4, 6)
    assert result.frames_received == result.frames_sent > 4 * 25
    assert result.aperture_error_mm < 0.3
    assert result.accuracy == 1.0
    assert told[-1] == ("replay", 4, 4)
    assert (tmp_path / "bus.pcap").stat().st_size > 59 * 16 * result.frames_sent
    assert json.loads(json_bytes(result))["frames_equal"] is True


def test_grasps_without_labels_are_replayed_and_not_named(taught: Any) -> None:
    nameless = [replace(grasp, label="") for grasp in taught.grasps[:2]]
    result = play(nameless, limit=1)
    assert result.frames_equal
    assert (result.accuracy, result.interval, result.n_train) == (None, None, 0)


@pytest.mark.parametrize("n", [1, 4])
def test_what_is_too_short_to_teach_is_compared_all_the_same(taught: Any, n: int) -> None:
    result = play(taught.grasps[:n])
    assert result.frames_equal
    assert (result.n_grasps, result.accuracy, result.n_train) == (n, None, 0)
    assert "ball" in str(result.unnamed)


def test_other_pads_wide_openings_and_unknown_ones_are_replayed() -> None:
    wide = plain_grasp("", aperture_m=np.linspace(0.12, 0.02, 12))
    partly = plain_grasp("", aperture_m=np.where(np.arange(12) < 4, np.nan, 0.03))
    still = plain_grasp("", t_s=np.zeros(12), aperture_m=np.full(12, np.nan))
    result = play([wide, partly, still])
    assert result.frames_equal
    assert result.frames_received == 36
    assert result.aperture_error_mm < 1.0


def test_what_cannot_be_replayed_says_why(taught: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="have 3 pads"):
        play([plain_grasp("", ((2, 2),) * 3)])
    with pytest.raises(CellError, match="not understood"):
        play(taught.grasps, split="?")
    with pytest.raises(CellError, match=r"bus\.pcap"):
        play([plain_grasp("")], capture=tmp_path / "none" / "bus.pcap")


# -- identify -------------------------------------------------------------------------------------


def test_recorded_grasps_are_answered_one_by_one(taught: Any) -> None:
    model = load_model(taught.result.model)
    grasps = [taught.grasps[0], replace(taught.grasps[9], label="")]
    answers = identify_recorded(model, grasps)
    assert [posterior.name for posterior, *_ in answers] == ["ball", "box"]
    assert answers[0][0].name_probability > 0.5
    assert answers[1][1:] == (None, None)


def test_grasps_on_other_pads_are_refused(taught: Any) -> None:
    with pytest.raises(ModelError, match=r"taught on 408 taxels in 10 pads, these .* 24 in 2"):
        identify_recorded(load_model(taught.result.model), [plain_grasp("a")])


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


def test_a_model_of_other_pads_is_refused_before_the_cell_is_built(taught: Any) -> None:
    with pytest.raises(ModelError, match="teach on these pads"):
        TaughtModel(small_config(tactile__layout="pinch"), load_model(taught.result.model))


def test_an_unknown_object_has_the_probability_of_being_unknown(taught: Any) -> None:
    grasp = taught.grasps[0]
    untouched = replace(grasp, counts=np.repeat(grasp.counts[:1], grasp.n_frames, 0))
    ((answer, *_),) = identify_recorded(load_model(taught.result.model), [untouched])
    assert (answer.name, answer.name_probability, answer.unknown) == ("UNKNOWN", 1.0, 1.0)


def test_pads_that_differ_in_full_scale_or_place_are_told_apart(taught: Any) -> None:
    grasp = taught.grasps[0]
    pads = grasp.pads
    finer = replace(pads, adc_max=4095)
    moved = replace(pads, taxel_xy_m=1.1 * pads.taxel_xy_m)
    for other, text in ((finer, "a full scale of 4095 instead of 255"), (moved, "at other places")):
        with pytest.raises(ModelError, match=text):
            identify_recorded(load_model(taught.result.model), [replace(grasp, pads=other)])
