import math

import numpy as np
import pytest

from simulator.errors import SimulatorSettingsError
from simulator.world.recorded import RecordedWorld
from tactile.layout import pinch_layout
from tests.simulator.world.test_world import HandMovedFingers

LAYOUT = pinch_layout()


def grasp(n: int) -> np.ndarray:
    counts = np.arange(n)[:, np.newaxis] + np.arange(LAYOUT.n_taxels)
    return counts.astype(np.uint16)


def test_each_scan_takes_the_next_frame_and_the_fingers_go_along() -> None:
    fingers = HandMovedFingers()
    world = RecordedWorld(LAYOUT, fingers)
    assert not world.scan().any()
    assert world.remaining == 0
    counts = grasp(3)
    world.load(counts, [0.03, math.nan, 0.02])
    assert world.remaining == 3
    assert fingers.driven_m == [0.03]
    for i in range(3):
        assert np.array_equal(world.scan(), counts[i])
        assert world.remaining == 2 - i
    assert fingers.driven_m == [0.03, 0.03, 0.02]
    assert np.array_equal(world.scan(), counts[2])
    assert world.contact_force_n() == (0.0, 0.0)


def test_a_frame_that_was_handed_out_is_nobody_elses() -> None:
    world = RecordedWorld(LAYOUT, HandMovedFingers())
    world.load(grasp(2), [0.03, 0.03])
    world.scan()[:] = 7
    assert world.scan()[0] == 1


@pytest.mark.parametrize(
    ("counts", "aperture_m", "message"),
    [
        (np.zeros((0, 156), np.uint16), [], "shape"),
        (np.zeros((2, 408), np.uint16), [0.0, 0.0], "shape"),
        (np.zeros((2, 156), np.uint16), [0.0], "aperture_m"),
        (np.zeros((2, 156)), [0.0, 0.0], "integers"),
        (np.full((2, 156), 4096), [0.0, 0.0], "0 to 4095"),
        (np.full((2, 156), -1), [0.0, 0.0], "0 to 4095"),
    ],
)
def test_grasps_that_do_not_fit_are_refused(counts, aperture_m, message) -> None:
    world = RecordedWorld(LAYOUT, HandMovedFingers())
    with pytest.raises(SimulatorSettingsError, match=message):
        world.load(counts, aperture_m)
    assert world.remaining == 0
