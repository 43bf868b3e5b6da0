"""The teaching summary: what a teaching does not show is named."""

from dataclasses import replace

import numpy as np
import pytest

from cell.learning.teaching_summary import summarise_teaching
from recognition.drift.self_zero import drawn_zero
from recognition.evaluation.splits import a_day_later
from recognition.grasp import DRAWING_SOURCE, Grasp, PadArray

PADS = PadArray(
    pad_shape=np.array([[1, 1]]), taxel_pad=np.zeros(1), taxel_xy_m=np.zeros((1, 2)), adc_max=255
)


def grasp(label: str, number: int, smallest_mm: float = np.nan) -> Grasp:
    return Grasp(
        pads=PADS,
        counts=np.zeros((2, 1), dtype=np.uint16),
        t_s=np.array([0.0, 2.0]),
        aperture_m=1e-3 * np.array([30.0, smallest_mm]),
        force_n=np.zeros(2),
        label=label,
        start_ms=10_000 * number,
    )


def test_one_series_of_each_object_is_said_to_miss_what_another_day_brings() -> None:
    grasps = [grasp(label, i, 10.0 + i) for label in ("ball", "box") for i in range(3)]
    summary = summarise_teaching(grasps)
    assert summary.longest_series_s == 22.0
    assert summary.opening_sd_mm == pytest.approx(0.8, abs=0.05)
    note = summary.notes[-1]
    assert "in one series" in note
    assert "calibrate --gauge" in note


def test_few_grasps_few_objects_and_drawings_are_said_to_need_more() -> None:
    ball = [grasp("ball", i) for i in range(6)]
    pin = [replace(grasp("pin", i), source=DRAWING_SOURCE) for i in range(60)]
    note = summarise_teaching([*ball, *pin]).notes[0]
    assert note.startswith("teach 10 grasps of each object")
    for part in (
        "(now ball 6)",
        "4 objects (now 2)",
        "drawn objects (pin)",
        "one in six of similar untaught",
    ):
        assert part in note
    assert summarise_teaching([*ball, *pin]).few_grasps == {"ball": 6}
    enough = [grasp(label, i) for label in ("a", "b", "c", "d") for i in range(10)]
    assert len(summarise_teaching(enough).notes) == 1


def test_further_series_of_some_objects_alone_are_warned_of() -> None:
    first = [grasp(label, i) for label in ("ball", "box", "cone", "disc") for i in range(10)]
    again = [a_day_later(g) for g in first]
    (note,) = summarise_teaching([*first, *again[:10]]).notes
    assert note.startswith("taught in several series: ball; in one: the 3 others")
    assert summarise_teaching([*first, *again]).notes == ()


def test_grasps_without_a_self_zero_among_others_are_named() -> None:
    bare = [grasp(label, i) for label in ("a", "b", "c", "d") for i in range(10)]
    zeroed = [replace(g, zero=drawn_zero()) for g in bare]
    assert "self-zero" not in summarise_teaching(bare).notes[-1]
    assert "self-zero" not in summarise_teaching(zeroed).notes[-1]
    mixed = summarise_teaching([*bare[:4], *zeroed[4:]])
    assert mixed.notes[-1].startswith("4 of 40 grasps have no self-zero")


def test_an_unknown_opening_is_left_out_and_a_grasp_without_label_refused() -> None:
    unknown = replace(grasp("ball", 0), aperture_m=np.full(2, np.nan))
    assert summarise_teaching([unknown]).opening_sd_mm is None
    with pytest.raises(ValueError, match="no label"):
        summarise_teaching([replace(unknown, label="")])
