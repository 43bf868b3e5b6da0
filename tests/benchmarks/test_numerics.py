"""The solvers that the numerics study compares are what their names say."""

import numpy as np
import pytest

from benchmarks.paper import _solvers, numerics

GAPS = np.array([-9.0, -0.5, 1.0, 6.0])


def _batch(values, n=20, dtype=np.float64):
    rng = np.random.default_rng(1)
    axes, _ = np.linalg.qr(rng.normal(size=(n, 4, 4)))
    Q = axes @ np.diag(values) @ np.swapaxes(axes, 1, 2)
    return (0.5 * (Q + np.swapaxes(Q, 1, 2))).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", numerics.SOLVERS)
def test_every_solver_finds_its_eigenvalue_of_an_easy_matrix(name, dtype):
    found = numerics.SOLVERS[name](_batch(GAPS, dtype=dtype))
    expected = -9.0 if "largest" in name else 6.0 if "shifted" in name else -0.5
    assert found == pytest.approx(np.full(20, expected), rel=1e-9 if dtype is np.float64 else 1e-3)
    assert found.dtype == dtype


def test_the_coefficients_are_the_elementary_symmetric_functions():
    assert _solvers.characteristic_coefficients(_batch(GAPS)) == pytest.approx(
        np.tile(np.poly(GAPS), (20, 1))
    )


def test_the_reference_holds_what_doubles_cannot():
    graded = np.diag([1e-3, 1.0, 5.0, 1e2])
    axes, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))
    Q = axes @ graded @ axes.T
    reference = numerics.precise(0.5 * (Q + Q.T)[None])
    assert reference[0] == pytest.approx([1e-3, 1.0, 5.0, 1e2], rel=1e-10)
    # exact in binary: no rounding of the entries to hide behind
    exact = np.array([[2.0**20, 1, 0, 0], [1, 2.0**-20, 0, 0], [0, 0, 3, 0], [0, 0, 0, 5]])
    assert numerics.precise(exact[None])[0, 0] == pytest.approx(0.0, abs=1e-30)
    assert np.abs(np.linalg.eigvalsh(exact)).min() < 1e-9


def test_what_the_study_states():
    families = numerics.families(60)
    graded = families["graded 1e-3..1e2"]
    reference = numerics.precise(graded)
    symmetric, _ = numerics.errors_of("QR, symmetric (eigvalsh)", graded, reference)
    polynomial, _ = numerics.errors_of("characteristic polynomial", graded, reference)
    companion, _ = numerics.errors_of("companion matrix", graded, reference)
    # in double precision every direct method is far below the noise of the levels
    assert symmetric.max() < 1e-10 < polynomial.max() < 1e-4
    assert companion.max() < 1e-4
    # in single precision the polynomial is lost and the symmetric method is not
    narrowed = graded.astype(np.float32)
    reference = numerics.precise(narrowed.astype(np.float64))
    symmetric, _ = numerics.errors_of("QR, symmetric (eigvalsh)", narrowed, reference)
    polynomial, _ = numerics.errors_of("characteristic polynomial", narrowed, reference)
    assert np.mean(symmetric > 0.08) == 0.0
    assert np.mean(polynomial > 0.08) > 0.5
