"""What a teaching does not show is named, and what a taught model shows of its objects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from cell.errors import CellError, RequestRefused
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import ToldApart, summarise_teaching, told_apart
from cell.plugin.tasks import ModelFile
from recognition.drift.self_zero import drawn_zero
from recognition.evaluation.splits import a_day_later
from recognition.grasp import DRAWING_SOURCE, Grasp, PadArray
from recognition.recognizer import Posterior
from tests.cell.conftest import plain_grasp

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


@pytest.fixture
def model(taught: Any) -> TaughtModel:
    """Ball and box, five grasps each."""
    return TaughtModel.load(taught.config, taught.result.model)


def test_objects_have_their_grasps_and_the_size_of_the_newest(model) -> None:
    assert model.objects()["ball"] == (5, None)  # who asks does not wait
    assert not model.shapes_read
    model.read_shapes()
    assert model.shapes_read
    objects = model.objects()
    assert {label: n for label, (n, _) in objects.items()} == {"ball": 5, "box": 5}
    shape = objects["ball"][1]
    assert 1e3 * shape.size_m == pytest.approx(9.5, abs=1.0)
    revision = model.revision
    model.read_shapes()
    assert (model.objects()["ball"][1] is shape, model.revision) == (True, revision)  # read once


@pytest.mark.slow
def test_the_newest_grasp_is_taken_back_and_an_object_forgotten(model, tmp_path) -> None:
    path = tmp_path / "parts.model.npz"
    file, gone = ModelFile(model, path), []
    revision = model.revision
    file.forget("box", last=True, forgotten=lambda: gone.append("box"))
    assert (model.objects()["box"][0], model.labels, gone) == (4, ("ball", "box"), [])
    file.forget("box", last=False, forgotten=lambda: gone.append("box"))
    assert (model.labels, gone, model.revision) == (("ball",), ["box"], revision + 2)
    assert TaughtModel.load(model.config, path).labels == ("ball",)
    with pytest.raises(RequestRefused, match="'box' is not taught; ball"):
        model.forget("box")
    file.forget("ball", last=False, forgotten=lambda: None)
    assert model.labels == ()
    assert not path.exists()  # the next start shall not find it


@pytest.mark.slow
def test_what_leaves_too_few_grasps_changes_nothing(model) -> None:
    for _ in range(2):
        model.forget("box", last=True)
    with pytest.raises(CellError, match="'box' is unchanged"):
        model.forget("box", last=True)
    assert model.objects()["box"][0] == 3
    assert model.labels == ("ball", "box")


@dataclass
class Nearsighted:
    """A recogniser that takes every second grasp of a pin for a bolt."""

    labels: tuple[str, ...]

    def fit(self, grasps: Sequence[Grasp]) -> "Nearsighted":
        return Nearsighted(tuple(sorted({grasp.label for grasp in grasps})))

    def posterior(self, grasp: Grasp) -> Posterior:
        wrong = grasp.label == "pin" and grasp.start_ms % 2
        likely = "bolt" if wrong else grasp.label
        weights = np.array([10.0 if one == likely else 1.0 for one in self.labels])
        if "bolt" in self.labels:
            weights[self.labels.index("bolt")] += 0.5
        return Posterior(labels=self.labels, probability=weights / weights.sum(), unknown=0.0)


def test_the_nearest_object_is_that_which_grasps_look_like() -> None:
    grasps = [
        plain_grasp(label, start_ms=number)
        for label in ("nut", "pin", "bolt")
        for number in range(1, 9)
    ]
    trainer: Any = Nearsighted(())
    assert told_apart(grasps, "pin", trainer) == ToldApart(nearest="bolt", mistaken_share=0.5)
    assert told_apart(grasps, "nut", trainer) == ToldApart(nearest="bolt", mistaken_share=0.0)
    alone = [grasp for grasp in grasps if grasp.label == "pin"]
    assert told_apart(alone, "pin", trainer) == ToldApart(nearest=None, mistaken_share=None)
