"""The page that puts the paper beside ours: its physics, its rules, and that it is written."""

import numpy as np
import pytest

from benchmarks.paper.grasps import PAPER_NOISE, REST_FRAMES, press, record
from benchmarks.paper.reproduction import (
    LABELS,
    Section,
    classify,
    html,
    levels_of,
    name_by_threshold,
    one_frame,
)
from recognition.quadric.thresholds import find_thresholds
from simulator.world.shapes import ObjectPose


@pytest.mark.parametrize("label", LABELS)
def test_both_pads_carry_the_grip_force_at_every_step(label):
    touch = press(label, ObjectPose(x_m=1e-3, y_m=-1e-3, rotation_rad=0.4), 6.0)
    both = touch.taxel_n.reshape(len(touch.force_n), 2, -1).sum(axis=2)
    assert both == pytest.approx(np.stack([touch.force_n] * 2, axis=1), rel=2e-3, abs=1e-9)
    assert np.all(np.diff(touch.aperture_m) < 0)


def test_a_record_rests_ramps_and_holds_within_its_noise():
    touch = press("ball", ObjectPose(), 5.0)
    assert touch.aperture_m[0] == pytest.approx(9.5e-3, abs=2e-5)
    silent, noisy = (record(touch, np.random.default_rng(0), n) for n in (0.0, PAPER_NOISE))
    assert not silent.counts[:REST_FRAMES].any()
    assert np.max(np.diff(silent.force_n)) <= 0.1 + 1e-9
    assert np.array_equal(silent.counts[-1], silent.counts[-15])
    added = noisy.counts.astype(float) - silent.counts
    assert added.min() >= 1
    assert added.max() <= 20.5


def test_levels_follow_the_force_and_are_missing_without_contact():
    grasp = record(press("ball", ObjectPose(), 6.0), np.random.default_rng(0), 0.0)
    (_, at_full, _, at_common), signed = levels_of(grasp).T
    # more force, a higher peak, a smaller eigenvalue
    assert 1e-3 < at_full < at_common < 1e-2
    assert np.all(signed < -10)
    assert np.isnan(levels_of(one_frame(grasp, 0.0))).all()


def test_a_value_belongs_to_the_object_between_whose_thresholds_it_falls():
    levels = find_thresholds([[5.0, 6.0], [1.0, 2.0], [9.0, 10.0]])
    values = np.array([0.0, 3.4, 3.6, 7.4, 7.6, 99.0, np.nan])
    assert name_by_threshold(levels, values).tolist() == [1, 1, 0, 0, 2, 2, -1]


def test_outcomes_count_names_and_windows():
    taught = np.array([[i, i + 0.2] for i in range(1, 6)], dtype=float)
    tested = np.array([[i + 0.1, i + 0.9] for i in range(1, 6)], dtype=float)
    tested[4, 1] = np.nan
    found = classify([taught], [tested])
    assert found.counts[:, -1].tolist() == [0, 0, 0, 0, 1]
    assert found.trials == (5, 10)
    assert found.windows_right == 5


def test_the_page_has_each_part_and_needs_no_network():
    parts = [Section("A < B", [("x", "y"), ("1", "2")]), Section("C", svg="<svg></svg>")]
    page = html(parts)
    assert "<h2>A &lt; B</h2><table><tr><td>x</td><td>y</td></tr>" in page
    assert "<svg></svg>" in page
    assert "<script" not in page
    assert "http" not in page
