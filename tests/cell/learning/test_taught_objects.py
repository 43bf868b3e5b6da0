"""What a taught model shows of its objects, and how one is forgotten."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from cell.errors import CellError, RequestRefused
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import ToldApart, told_apart
from cell.plugin.tasks import ModelFile
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from tests.cell.conftest import plain_grasp


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
