"""Sizes of the taught grasps: what lies far from all of them is new, in units that they show."""

import numpy as np

from recognition.statistics.taught_sizes import TaughtSizes, fit_sizes

CLASSES = np.repeat([0, 1], 6)


def sizes(spread_mm: float) -> np.ndarray:
    """Return two sizes of six grasps each of objects of 10 and 30 mm."""
    off_mm = np.linspace(-2.5, 2.5, 6) * spread_mm
    return (np.repeat([10.0, 30.0], 6) + np.tile(off_mm, 2))[:, None] + np.array([0.0, 2.0])


def novelty(found: TaughtSizes, sizes_mm: list[list[float]], slack_mm: float = 0.0) -> np.ndarray:
    """Return the squared distances to the first object."""
    objects = np.zeros((len(sizes_mm), 1, 1), dtype=np.int64)
    return found.distances(np.array(sizes_mm)[:, None], np.array([slack_mm]), objects)[:, 0, 0]


def test_a_size_between_the_taught_ones_is_new_and_theirs_is_not():
    found = fit_sizes(sizes(0.2), CLASSES)
    taught, between, of_the_other = novelty(found, [[10.1, 12.1], [20.0, 22.0], [30.0, 32.0]])
    assert taught < 0.5
    assert of_the_other > between > 400.0
    assert novelty(found, [[20.0, 22.0]], slack_mm=10.0) < 3.0


def test_both_faces_of_an_object_are_taught_sizes():
    two_faces = np.where(np.arange(12) % 2, 10.0, 16.0)[:, None] + np.array([0.0, 2.0])
    found = fit_sizes(two_faces, np.zeros(12, dtype=np.int64))
    thin, middle, thick = novelty(found, [[10.0, 12.0], [13.0, 15.0], [16.0, 18.0]])
    assert thin == thick == 0.0
    assert middle > 50.0


def test_grasps_that_vary_more_widen_the_unit():
    tight, wide = fit_sizes(sizes(0.2), CLASSES), fit_sizes(sizes(2.0), CLASSES)
    assert np.all(wide.unit_mm > 2.0 * tight.unit_mm)


def test_few_grasps_keep_the_unit_near_the_expected_one():
    same = np.full((40, 2), 10.0)
    few = fit_sizes(same[:3], np.zeros(3, dtype=np.int64))
    many = fit_sizes(same, np.zeros(40, dtype=np.int64))
    assert np.all(few.unit_mm > 0.7 * np.array([0.5, 0.2]))
    assert np.all(many.unit_mm < 0.5 * few.unit_mm)


def test_the_only_grasp_on_another_side_hides_no_other_object():
    of_two = np.array([10.0, 10.1, 15.9, 6.0, 6.1, 6.2])[:, None] + np.array([0.0, 2.0])
    found = fit_sizes(of_two, np.repeat([0, 1], 3))
    on_a_side, on_the_other, other_object = novelty(found, [[10.05, 12.05], [15.9, 17.9], [8, 10]])
    assert max(on_a_side, on_the_other) < 0.5
    assert other_object > 50.0


def test_a_lonely_one_of_many_grasps_teaches_no_size():
    many = np.append(np.linspace(9.5, 10.5, 59), 14.0)[:, None] + np.array([0.0, 2.0])
    (at_the_lonely,) = novelty(fit_sizes(many, np.zeros(60, dtype=np.int64)), [many[-1].tolist()])
    assert at_the_lonely > 6.0


def test_sizes_come_back_from_their_arrays():
    found = fit_sizes(sizes(0.2), CLASSES)
    again = TaughtSizes.from_arrays(found.to_arrays("s_"), "s_")
    assert np.array_equal(again.mm, found.mm)
    assert np.array_equal(again.unit_mm, found.unit_mm)
