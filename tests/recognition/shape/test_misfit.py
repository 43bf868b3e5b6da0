"""How badly a model misses pressed pads, and what that does to a fit."""

from dataclasses import replace

import numpy as np
import pytest

from recognition.shape.answer import UNCLEAR, joint_answer
from recognition.shape.fit import ShapeFit, misfit_of, n_determined
from recognition.shape.models import SHAPE_MODELS
from tests.recognition.shape.test_fusion import fit_of


def test_untouched_taxels_do_not_hide_that_no_shape_fits() -> None:
    squared = np.r_[np.full(30, 9.0), np.zeros(300)]
    tells = np.arange(330) < 30
    assert misfit_of(squared, tells, 0.0) == pytest.approx(9.0)
    assert misfit_of(squared, tells, 10.0) == pytest.approx(270.0 / 20.0)
    # Nor are taxels forgotten that read nothing where the shape would press them.
    assert misfit_of(squared[::-1], tells, 0.0) == pytest.approx(270.0 / 330.0)


def test_what_the_prior_knows_better_is_not_determined_by_the_data() -> None:
    normal = np.diag([1e6, 1e-6, 4.0])
    assert n_determined(normal, np.array([1.0, 1.0, 0.5])) == pytest.approx(1.5, abs=1e-3)


def linear_fit(kind: str, chi2: float) -> tuple[ShapeFit, np.ndarray]:
    """Return a fit of a linear problem, and what its data alone say."""
    n = SHAPE_MODELS[kind].n_own + 2
    half = np.random.default_rng(3).normal(size=(3 * n, n))
    normal, truth, mean, sd = 40.0 * half.T @ half, np.full(n, 0.8), np.zeros(n), np.full(n, 0.5)
    return fit_of(kind, normal, truth, mean, sd, chi2=chi2), truth


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e6])
def test_larger_variances_move_a_fit_towards_what_is_known_beforehand(scale: float) -> None:
    fit, truth = linear_fit("oval", 30.0)
    normal, precision = fit.normal / scale, np.diag(fit.prior_sd**-2)
    moved = fit.at_scale(scale)
    assert moved.theta == pytest.approx(np.linalg.solve(normal + precision, normal @ truth))
    away = moved.theta - truth
    assert moved.chi2 == pytest.approx(30.0 + away @ fit.normal @ away)
    assert moved.at_scale(scale).theta == pytest.approx(moved.theta)


def test_no_kind_is_told_on_pads_that_a_known_shape_did_not_fit() -> None:
    oval, _ = linear_fit("oval", 30.0)
    sphere, _ = linear_fit("sphere", 60.0)
    plain = joint_answer([oval, replace(sphere, misfit=2.0)])
    doubted = joint_answer([oval, replace(sphere, misfit=2.0)], least_misfit=9.0)
    assert plain.kind == "oval"
    assert doubted.kind == UNCLEAR
    assert doubted.misfit == 9.0
    assert doubted.probability["oval"] < plain.probability["oval"]
    assert np.log(doubted.high_m / doubted.low_m) > 1.8 * np.log(plain.high_m / plain.low_m)
