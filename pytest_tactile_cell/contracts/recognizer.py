"""Contract of a recognizer, on grasps of a simulated cell."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.plugins import RECOGNIZERS
from pytest_tactile_cell.virtual import grasps_of
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer

LABELS = ("ball", "box", "cylinder")


@pytest.fixture(scope="module")
def grasps() -> list[Grasp]:
    """Return four grasps of each of three objects.

    The slow ramp gives enough frames to a recognizer that reads frames one by one.
    """
    keys = {
        "self_zero": "never",
        "tactile.tare_frames": 25,
        "gripper.aperture_open_mm": 18.0,
        "sequence.force_n": [2.0, 3.0],
        "sequence.ramp.rate_n_s": 5.0,
        "sequence.ramp.hold_s": 0.2,
    }
    config = changed_config(CellConfig(), keys)
    with closing(build_cell(config)) as cell:
        cell.controller.start()
        return list(grasps_of(cell.controller, config.sequence, LABELS, 4, seed=1))


@pytest.fixture(scope="module")
def taught(plugin_name: str, grasps: list[Grasp]) -> Recognizer:
    """Return the recognizer trained on these grasps."""
    recognizer: Recognizer = RECOGNIZERS[plugin_name](use_aperture=True).fit(grasps)
    return recognizer


def test_its_trainer_has_its_name(plugin_name: str) -> None:
    assert RECOGNIZERS[plugin_name](use_aperture=True).name == plugin_name
    assert not RECOGNIZERS[plugin_name](use_aperture=False).uses_aperture


@pytest.mark.slow
def test_it_answers_for_the_objects_that_were_taught(
    taught: Recognizer, grasps: list[Grasp]
) -> None:
    assert taught.labels == LABELS
    right = [taught.posterior(grasp).best == grasp.label for grasp in grasps]
    assert np.mean(right) > 0.5


def test_a_file_keeps_it(plugin_name: str, taught: Recognizer, grasps: list[Grasp]) -> None:
    module = RECOGNIZERS.entry(plugin_name).module
    assert type(taught).__module__ == module
    again = type(taught).from_arrays(taught.to_arrays())
    for grasp in [*grasps[::4], replace(grasps[0], aperture_m=np.array(np.nan))]:
        first, second = taught.posterior(grasp), again.posterior(grasp)
        assert np.allclose(first.probability, second.probability)
        assert first.unknown == pytest.approx(second.unknown)


def test_no_grasps_are_refused(plugin_name: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        RECOGNIZERS[plugin_name](use_aperture=True).fit([])
