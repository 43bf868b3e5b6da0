import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from recognition.errors import TransformError
from recognition.quadric import quadric

numbers = st.floats(-3.0, 3.0)


def _point(x, y, z):
    return np.array([x, y, z, 1.0])


def test_each_rotation_turns_right_handed():
    quarter = np.pi / 2
    assert quadric.rotation_xyz([quarter, 0, 0]) @ _point(0, 1, 0) == pytest.approx(_point(0, 0, 1))
    assert quadric.rotation_xyz([0, quarter, 0]) @ _point(0, 0, 1) == pytest.approx(_point(1, 0, 0))
    assert quadric.rotation_xyz([0, 0, quarter]) @ _point(1, 0, 0) == pytest.approx(_point(0, 1, 0))


def test_rotation_xyz_turns_about_x_first():
    both = quadric.rotation_xyz([np.pi / 2, 0.0, np.pi / 2])
    assert both @ _point(0, 1, 0) == pytest.approx(_point(0, 0, 1))
    assert both @ _point(1, 0, 0) == pytest.approx(_point(0, 1, 0))


@settings(max_examples=50)
@given(
    values=arrays(np.float64, (4, 4), elements=numbers),
    offset=arrays(np.float64, 3, elements=numbers),
    angle=arrays(np.float64, 3, elements=numbers),
    scale=st.floats(0.25, 4.0),
    point=arrays(np.float64, 3, elements=numbers),
)
def test_congruence_keeps_the_value_at_the_moved_point(values, offset, angle, scale, point):
    Q = values + values.T
    M = quadric.translation(offset) @ quadric.rotation_xyz(angle) @ quadric.scaling(scale)
    P = np.append(point, 1.0)
    moved = quadric.by_inverse(Q, np.linalg.inv(M))
    assert np.array_equal(moved, moved.T)
    assert (M @ P) @ moved @ (M @ P) == pytest.approx(P @ Q @ P, abs=1e-8)
    assert quadric.by_inverse(moved, M) == pytest.approx(Q, abs=1e-8)


def test_a_scale_of_nothing_is_refused():
    with pytest.raises(TransformError, match="scale factor is 0"):
        quadric.scaling([1.0, 0.0])
