"""Comparators: features of patches and curves of known form, and the command on a data set."""

import numpy as np
import pytest
from sklearn.base import clone

from benchmarks.recognition import comparators
from cell.recording.dataset import write_dataset
from recognition.features.footprint import PadGrid
from tests.recognition.conftest import make_grasps, make_pads


def grid(rows=41, columns=31, pitch=0.5):
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    xy = np.column_stack([x.ravel() - (rows - 1) / 2, y.ravel() - (columns - 1) / 2]) * pitch
    return PadGrid(xy_mm=xy, pitch_mm=np.array([pitch, pitch]), shape=(rows, columns))


def ellipse(a, b, angle=0.0, centre=(0.0, 0.0)):
    dx, dy = (grid().xy_mm - np.array(centre)).T
    u = np.cos(angle) * dx + np.sin(angle) * dy
    v = np.cos(angle) * dy - np.sin(angle) * dx
    return np.clip(1.0 - (u / a) ** 2 - (v / b) ** 2, 0.0, None)


@pytest.mark.parametrize(
    ("features", "told"),
    [
        (comparators.radius_vector, slice(None)),
        (comparators.contour, slice(0, 8)),
        # A straight section has neither a slope of its curvature nor a cubic term.
        (comparators.sections, [0, 1, 7, 8, 9]),
    ],
)
def test_a_moved_and_turned_patch_has_nearly_the_same_features(features, told):
    first, moved, other = (
        features(patch, grid(), 0.3)[told]
        for patch in (
            ellipse(6.0, 4.0),
            ellipse(6.0, 4.0, 0.8, (1.0, -1.0)),
            ellipse(4.5, 3.9, 0.8, (1.0, -1.0)),
        )
    )
    assert np.linalg.norm(moved - first) < 0.35 * np.linalg.norm(other - first)


@pytest.mark.parametrize(
    "features", [one.of_patch for one in comparators.METHODS.values() if one.of_patch]
)
def test_an_empty_patch_has_finite_features(features):
    assert np.all(np.isfinite(features(np.zeros(20), grid(5, 4, 3.0), 0.3)))


@pytest.mark.parametrize("shift", [0.0, 1.0, -2.5])
def test_a_parabola_has_one_invariant_at_all_its_points(shift):
    # y = (x + shift)^2 / 4 has p = 2: the invariant is p^(-2/3).
    x = np.array([-1.0, 0.0, 2.0]) + shift
    stretch = 1.0 + (x / 2) ** 2
    found = comparators.curve_invariants(0.5 / stretch**1.5, -0.375 * x / stretch**3)
    assert found[:3] == pytest.approx(np.full(3, 2.0 ** (-2 / 3)))
    assert found[3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("t", [(0.2, 0.7), (0.3, 1.0, 1.4)])
def test_an_ellipse_has_its_two_invariants_from_any_points(t):
    a, b = 5.0, 3.0
    rho = np.hypot(a * np.sin(t), b * np.cos(t))
    slope = (a**2 - b**2) * np.sin(t) * np.cos(t) / rho
    m, conic = comparators.curve_invariants(a * b / rho**3, -3 * a * b * slope / rho**5)[-2:]
    assert m == pytest.approx((a * b) ** (-2 / 3))
    assert conic == pytest.approx((a**2 + b**2) / (a * b) ** (4 / 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", comparators.METHODS)
def test_a_comparator_is_an_estimator_that_names_grasps(name):
    method = clone(comparators.METHODS[name])
    method.set_params(grid={key: values[:1] for key, values in method.grid.items()})
    method.set_params(outlines=method.outlines[:1])
    if "n_estimators" in method.classifier.get_params():
        method.set_params(classifier__n_estimators=20)
    train, test = (make_grasps(n, seed=n, pads=make_pads()) for n in (6, 5))
    method.fit(train[::-1], [grasp.label for grasp in train[::-1]])
    assert np.mean(method.predict(test) == [grasp.label for grasp in test]) > 0.4
    held = [indices for _, indices in method.search_.cv]
    assert sorted(np.concatenate(held).tolist()) == list(range(len(train)))
    # In the order of time five objects have a grasp each: a block has two grasps of each.
    assert [np.unique(one // 10).tolist() for one in held] == [[0], [1], [2]]


@pytest.mark.long
def test_the_command_compares_all_methods_on_a_file(tmp_path, capsys):
    write_dataset(tmp_path / "x.npz", make_grasps(5, seed=1, pads=make_pads()))
    comparators.main(0.01, str(tmp_path / "x.npz"))
    first, *rows = capsys.readouterr().out.splitlines()
    assert "5 objects, 15 grasps teach, 10 test" in first
    assert len(rows) == 15  # the last four are drifts, alone and followed
    assert all(" of 10" in row for row in rows)
