import tracemalloc
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from benchmarks.paper.sweep_full import FULL_PRODUCT, sweep_summary
from recognition.errors import QuadricError, TrajectoryError
from recognition.quadric import quadric, sweep_roots
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.quadric import height_field_matrix
from recognition.quadric.sweep import arrow_form, distinct, points, weighted_chunks
from recognition.quadric.trajectory import PAPER_SWEEP, Axes, SweepSettings, sweep

OVAL = np.diag([1 / 7.0**2, 1 / 7.0**2, 1 / 5.85**2, -1.0])
CYLINDER = np.diag([1 / 3.0**2, 1 / 3.0**2, 0.0, -1.0])
BOX = np.diag([1 / 5.0**2, 1 / 7.95**2, 1 / 5.0**2, -1.0])
BALL = np.diag([1 / 4.75**2, 1 / 4.75**2, 1 / 4.75**2, -1.0])
DUMBBELL = np.diag([1 / 5.0**2, 1 / 5.0**2, -1 / 6.5**2, -1.0])
CAP = height_field_matrix(a=-4.0, b=-4.0, k=100.0)
TILTED = height_field_matrix(a=-4.0, b=-3.0, d=0.5, g=1.0, h=2.0, k=100.0)
ANY = np.array([[3.0, 1, -2, 4], [1, -5, 0.5, 1], [-2, 0.5, 2, -3], [4, 1, -3, 1]])
OFF_CENTRE = quadric.congruence(BOX, quadric.translation([3.0, -2.0, 1.0]))
OBJECTS = {
    "oval": OVAL,
    "cylinder": CYLINDER,
    "box": BOX,
    "ball": BALL,
    "dumbbell": DUMBBELL,
    "cap": CAP,
    "tilted": TILTED,
    "any": ANY,
    "off-centre": OFF_CENTRE,
    "positive": np.diag([1.0, 2.0, 3.0, 4.0]),
    "nothing in A": np.array([[0, 0, 0, 1.0], [0, 0, 0, 2], [0, 0, 0, 3], [1, 2, 3, 4]]),
}
SINGULAR = ("cylinder", "nothing in A")
SMALL = SweepSettings(
    scale=np.array([1.0, 1.7, 4.0]),
    translation=np.linspace(-2, 2, 5),
    angle_rad=np.linspace(0, 2 * np.pi, 9),
    translation_axes=Axes.SEPARATE,
    rotation_axes=Axes.SEPARATE,
)


def _brute(Q, grid):
    """Smallest eigenvalues of all poses, each matrix formed and solved in full."""
    shift = points(grid.translation, 2, separate=grid.translation_axes is Axes.SEPARATE)
    shift = np.column_stack([shift, np.zeros(len(shift))])
    turn = points(grid.angle_rad, 3, separate=grid.rotation_axes is Axes.SEPARATE)
    M = quadric.compose(
        translate=quadric.translation(shift)[None, :, None],
        rotate=quadric.rotation_xyz(turn)[None, None],
        scale=quadric.scaling(grid.scale)[:, None, None],
        order=grid.order,
    )
    return smallest_eigenvalue(quadric.congruence(Q, M).reshape(-1, 4, 4), grid.reading)


@pytest.mark.parametrize("reading", list(Reading))
@pytest.mark.parametrize("name", OBJECTS)
def test_the_summary_is_that_of_brute_force(name, reading):
    grid = replace(SMALL, reading=reading, scale=SMALL.scale[:2], angle_rad=SMALL.angle_rad[::2])
    expected = _brute(OBJECTS[name], grid)
    values = expected.value
    # edges in the gaps between values, where rounding cannot decide
    ordered = np.sort(values)
    gaps = np.flatnonzero(np.diff(ordered) > 1e-7 * np.abs(ordered).max())
    edges = np.unique(
        [ordered[0] - 1.0, *0.5 * (ordered[gaps] + ordered[gaps + 1])[::3], ordered[-1] + 1.0]
    )
    found = sweep_summary(OBJECTS[name], edges, grid)
    assert np.array_equal(found.counts, np.histogram(values, edges)[0])
    assert (found.below, found.above) == (0, 0)
    assert found.n_evaluations == len(values) == found.counts.sum()
    if name not in SINGULAR:
        assert found.least == pytest.approx(values.min(), rel=1e-9)
        assert found.greatest == pytest.approx(values.max(), rel=1e-9)
        assert found.n_degenerate == 0
    elif reading is not Reading.ALGEBRAIC_MINIMUM:
        assert found.n_degenerate == expected.degenerate.sum() == len(values)
    assert found.n_solved < 0.5 * len(values)


@pytest.mark.parametrize("order", ["TRS", "TSR", "RTS", "RST", "STR", "SRT"])
def test_every_order_of_the_product_has_its_histogram(order):
    grid = replace(SMALL, order=order, angle_rad=np.array([0.0, 0.7, 2.0]))
    values = _brute(OFF_CENTRE, grid).value
    edges = np.geomspace(values.min() * 0.99, values.max() * 1.01, 12)
    found = sweep_summary(OFF_CENTRE, edges, grid)
    assert np.array_equal(found.counts, np.histogram(values, edges)[0])
    assert sweep(OFF_CENTRE[None], grid).value[0] == pytest.approx(values, rel=1e-9)


def test_the_full_product_counts_every_pose_and_holds_the_known_extremes():
    found = sweep_summary(OVAL, [1e-3, 1e-2, 2e-2])
    assert found.n_evaluations == 256_021_343
    assert found.below + found.counts.sum() + found.above == 256_021_343
    # two equal curvatures: one eigenvalue is the curvature over s^2 whatever the pose
    assert found.greatest == pytest.approx(1 / 49, rel=1e-12)
    assert found.least == pytest.approx(1 / 49 / 16, rel=1e-12)
    assert found.n_solved < 2e-2 * found.n_evaluations
    assert found.n_fallback == 0


def test_the_three_loops_and_their_summary_agree():
    value = sweep(BOX[None], PAPER_SWEEP).value[0]
    edges = np.geomspace(value.min() * 0.999, value.max() * 1.001, 30)
    assert np.array_equal(
        sweep_summary(BOX, edges, PAPER_SWEEP).counts, np.histogram(value, edges)[0]
    )


def test_the_last_bin_holds_its_upper_edge_and_others_do_not():
    still = replace(SMALL, scale=np.ones(1), translation=np.zeros(1))
    value = sweep_summary(BALL, [1e-9, 1.0], still).least
    found = sweep_summary(BALL, [value / 2, value], still)
    assert found.counts.tolist() == [729]
    found = sweep_summary(BALL, [value / 2, value, 2 * value], still)
    assert found.counts.tolist() == [0, 729]
    found = sweep_summary(BALL, [2 * value, 3 * value], still)
    assert (found.below, found.above) == (729, 0)


def _peak_bytes(grid):
    tracemalloc.start()
    sweep_summary(TILTED, [1e-4, 1e-2], grid)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_grid():
    few = replace(FULL_PRODUCT, scale=np.ones(1), translation=np.linspace(-2, 2, 11))
    many = replace(few, scale=np.linspace(1, 4, 11))
    finer = replace(few, angle_rad=np.linspace(0, 2 * np.pi, 35))
    at_first = _peak_bytes(few)
    assert _peak_bytes(many) < 1.05 * at_first
    assert _peak_bytes(finer) < 120e6
    assert finer.n_evaluations > 8 * few.n_evaluations


@settings(derandomize=True, max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 100_000),
    kind=st.sampled_from(["any", "double", "nearly double", "centred", "singular", "graded"]),
    reading=st.sampled_from(list(Reading)),
)
def test_any_matrix_has_the_eigenvalues_of_the_full_solver(seed, kind, reading):
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    values = rng.normal(size=3)
    if "double" in kind:
        values[1] = values[0] * (1.0 + (1e-13 if kind == "nearly double" else 0.0))
    if kind == "graded":
        values *= [1e-3, 1.0, 1e2]
    Q = np.zeros((4, 4))
    Q[:3, :3] = basis @ np.diag(values) @ basis.T
    Q[:3, 3] = Q[3, :3] = 0.0 if kind == "centred" else rng.normal(size=3)
    Q[3, 3] = rng.normal()
    if kind == "singular":
        Q[:, :] = np.outer(basis[0][[0, 1, 2, 0]], basis[0][[0, 1, 2, 0]]) * values[0]
    Q = 0.5 * (Q + Q.T)
    grid = replace(SMALL, angle_rad=rng.uniform(0, 6, 2), reading=reading)
    expected = _brute(Q, grid).value
    size = np.abs(Q).max() * 50
    tolerance = 1e-13 * size * (size if reading is Reading.COVARIANCE else 1.0)
    assert sweep(Q[None], grid).value[0] == pytest.approx(expected, abs=tolerance, rel=1e-10)


def test_a_graded_matrix_keeps_all_digits():
    # eigenvalues of order 1e-3 and 1e2: a full solver loses five digits here
    grid = replace(SMALL, angle_rad=np.array([0.4]), scale=np.array([1.3]))
    found = sweep(TILTED[None], grid).value[0]
    R = quadric.rotation_xyz([0.4, 0.4, 0.4])
    for index, (x, y) in enumerate(points(grid.translation, 2, separate=True)):
        with mpmath.workdps(50):
            M = mpmath.matrix(R.tolist())
            M[:3, :3] = M[:3, :3] * mpmath.mpf(1.3)
            M[0, 3], M[1, 3] = x, y
            inverse = M**-1
            moved = inverse.T * mpmath.matrix(TILTED.tolist()) * inverse
            values = mpmath.eigsy(0.5 * (moved + moved.T), eigvals_only=True)
            expected = min(abs(value) for value in values)
            assert abs(float(found[index] / expected) - 1.0) < 5e-13


# --- what is not verified is left to the full solver -----------------------------------------


def _arrow(Q, grid):
    form = arrow_form(Q)
    u = np.column_stack([*np.random.default_rng(3).normal(size=(2, 200)), np.zeros(200)])
    return form.arrow(form.features(u), grid.scale)


@pytest.mark.parametrize("reading", [Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM])
def test_too_few_steps_are_noticed_and_made_good(monkeypatch, reading):
    arrow = _arrow(ANY, SMALL)
    right = sweep_roots.smallest_of_arrow(arrow, reading)
    assert right.n_fallback == 0
    monkeypatch.setattr(sweep_roots, "_STEPS", 1)
    hurried = sweep_roots.smallest_of_arrow(arrow, reading)
    assert hurried.n_fallback > 0.9 * arrow.corner.size
    assert hurried.smallest.value == pytest.approx(right.smallest.value, rel=1e-11)


@pytest.mark.parametrize("reading", [Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM])
def test_another_eigenvalue_is_not_taken_for_the_smallest(monkeypatch, reading):
    arrow = _arrow(ANY, SMALL)
    right = sweep_roots.smallest_of_arrow(arrow, reading).smallest.value
    every = np.linalg.eigvalsh(arrow.matrices(np.ones(arrow.corner.shape, dtype=bool)))
    for column in range(4):
        wrong = every[:, column].reshape(arrow.corner.shape)
        monkeypatch.setattr(
            sweep_roots,
            "_laguerre",
            lambda arrow, *_, w=wrong: (
                w.copy() if arrow.corner.shape == w.shape else np.full(arrow.corner.shape, np.nan)
            ),
        )
        found = sweep_roots.smallest_of_arrow(arrow, reading).smallest.value
        assert found == pytest.approx(right, rel=1e-11)


def test_what_cannot_be_told_by_newton_is_left_to_the_solver():
    # a pole that does not couple and an eigenvalue beside it: a double root of the polynomial
    Q = np.diag([0.5, 1.0, 3.0, 0.5])
    grid = replace(SMALL, translation=np.array([0.0, 1e-9]), scale=np.ones(1))
    assert sweep(Q[None], grid).value[0] == pytest.approx(_brute(Q, grid).value, rel=1e-12)


# --- the grid --------------------------------------------------------------------------------


@pytest.mark.parametrize("separate", [True, False])
@pytest.mark.parametrize("rotated", [True, False])
def test_chunks_hold_every_pose_once(separate, rotated):
    angle = np.linspace(0, 2 * np.pi, 9)
    shift = points(np.linspace(-2, 2, 5), 2, separate=True)
    chunks = list(weighted_chunks(shift, angle, rotated=rotated, separate=separate))
    u = np.concatenate([chunk[0] for chunk in chunks])
    weight = np.concatenate([chunk[1] for chunk in chunks])
    assert weight.sum() == 25 * 9 ** (3 if separate else 1)
    R = quadric.rotation_xyz(points(angle, 3, separate=separate))[:, :3, :3]
    plane = np.column_stack([shift, np.zeros(25)])
    every = np.einsum("rij,ti->rtj", R if rotated else np.repeat(np.eye(3)[None], len(R), 0), plane)
    direction = np.array([0.3, -0.8, 0.5])
    for power in (1, 2, 3):
        expected = np.sum((every.reshape(-1, 3) @ direction) ** power)
        assert np.sum(weight * (u @ direction) ** power) == pytest.approx(expected, abs=1e-8)


def test_distinct_columns_gather_their_weights():
    columns = np.array([[1.0, 2.0, 1.0 + 1e-15, 1.0], [5.0, 5.0, 5.0, -5.0]])
    first, weight = distinct(columns, np.array([1, 2, 4, 8]))
    found = {tuple(np.round(columns[:, i], 6)): int(w) for i, w in zip(first, weight, strict=True)}
    assert found == {(1.0, 5.0): 5, (2.0, 5.0): 2, (1.0, -5.0): 8}
    first, weight = distinct(np.zeros((0, 7)))
    assert (first.tolist(), weight.tolist()) == ([0], [7])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: sweep_summary(np.eye(5), [0, 1]), TrajectoryError, r"shape \(5, 5\)"),
        (lambda: sweep_summary(np.full((4, 4), np.nan), [0, 1]), QuadricError, "not finite"),
        (lambda: sweep_summary(BALL, [1.0]), TrajectoryError, "at least two ascending"),
        (lambda: sweep_summary(BALL, [1.0, 1.0]), TrajectoryError, "at least two ascending"),
    ],
)
def test_refusals_name_the_cause(call, error, message):
    with pytest.raises(error, match=message):
        call()
