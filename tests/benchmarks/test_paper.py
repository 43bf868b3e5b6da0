"""The paper's claims beside ours: the levels of a grasp, and the names by thresholds."""

import numpy as np

from benchmarks.paper.grasps import press, record
from benchmarks.paper.reproduction import classify, levels_of, name_by_threshold, one_frame
from recognition.quadric.thresholds import find_thresholds
from simulator.world.shapes import ObjectPose


def test_levels_follow_the_force_and_are_missing_without_contact():
    grasp = record(press("ball", ObjectPose(), 6.0), np.random.default_rng(0), 0.0)
    _, at_common, at_full = levels_of(grasp)
    # more force, a higher peak, a smaller eigenvalue
    assert 1e-3 < at_full < at_common < 1e-2
    assert np.isnan(levels_of(one_frame(grasp, 0.0))).all()


def test_a_value_belongs_to_the_object_between_whose_thresholds_it_falls():
    levels = find_thresholds([[5.0, 6.0], [1.0, 2.0], [9.0, 10.0]])
    values = np.array([0.0, 3.4, 3.6, 7.4, 7.6, 99.0, np.nan])
    assert name_by_threshold(levels, values).tolist() == [1, 1, 0, 0, 2, 2, -1]


def test_outcomes_count_names_and_missing_surfaces():
    taught = np.array([[i, i + 0.2] for i in range(1, 6)], dtype=float)
    tested = np.array([[i + 0.1, i + 0.9] for i in range(1, 6)], dtype=float)
    tested[4, 1] = np.nan
    counts = classify([taught], [tested]).counts
    assert counts[:, -1].tolist() == [0, 0, 0, 0, 1]
    assert (np.trace(counts), counts.sum()) == (5, 10)
