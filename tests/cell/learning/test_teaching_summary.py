"""The teaching summary: what a teaching does not show is named."""

from dataclasses import replace

import numpy as np
import pytest

from cell.learning.teaching_summary import summarise_teaching
from recognition.evaluation.splits import a_day_later
from recognition.grasp import Grasp, PadArray

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
    assert str(summary) == (
        "taught in series of at most 22 s; the opening of one object spreads by 0.8 mm"
    )
    (note,) = summary.notes
    assert "one series" in note
    assert "calibrate --gauge" in note


def test_further_series_of_some_objects_alone_are_warned_of() -> None:
    first = [grasp(label, i) for label in ("ball", "box") for i in range(3)]
    again = [a_day_later(g) for g in first]
    (note,) = summarise_teaching([*first, *again[:3]]).notes
    assert note.startswith("taught in several series: ball; in one: the 1 others")
    assert summarise_teaching([*first, *again]).notes == ()


def test_an_unknown_opening_is_left_out_and_a_grasp_without_label_refused() -> None:
    unknown = replace(grasp("ball", 0), aperture_m=np.full(2, np.nan))
    assert summarise_teaching([unknown]).opening_sd_mm is None
    with pytest.raises(ValueError, match="no label"):
        summarise_teaching([replace(unknown, label="")])
