"""Dependence of grasps: found from posteriors whose dependence is known."""

import numpy as np
import pytest

from recognition.recognizer import DEPENDENCE, Posterior
from recognition.statistics.fusion import evidence, fit_dependence, fuse, independent_share

N_CLASSES, RUN = 5, 6


def runs(shared: float, n: int, *, seed: int = 0):
    """Posteriors of Gaussian classes; a part of each error is the same for a whole run."""
    rng = np.random.default_rng(seed)
    classes = np.repeat(rng.integers(0, N_CLASSES, n), RUN)
    run = np.repeat(np.arange(n), RUN)
    common = np.repeat(rng.normal(size=(n, N_CLASSES)), RUN, axis=0)
    own = rng.normal(size=(n * RUN, N_CLASSES))
    error = np.sqrt(shared) * common + np.sqrt(1.0 - shared) * own
    x = 1.2 * np.eye(N_CLASSES)[classes] + error
    score = np.exp(1.2 * x)
    return score / score.sum(axis=1, keepdims=True), classes, run


def test_it_grows_with_what_the_grasps_share():
    found = [fit_dependence(*runs(shared, 150)) for shared in (0.0, 0.4, 0.9)]
    assert found[0] < 0.05
    assert 0.25 < found[1] < 0.6
    assert found[2] > 0.65


def test_grasps_that_say_little_leave_the_usual_value():
    probability, classes, run = runs(0.9, 1)
    assert fit_dependence(probability, classes, run) == pytest.approx(DEPENDENCE, abs=0.15)
    alone = np.arange(len(classes))
    assert fit_dependence(probability, classes, alone) == pytest.approx(DEPENDENCE, abs=1e-3)


def test_runs_end_where_the_object_changes():
    probability, classes, _ = runs(0.9, 150)
    one = np.zeros(len(classes), dtype=np.int64)
    first = np.flatnonzero(np.diff(classes, prepend=classes[0] + 1))
    assert len(first) < 150
    assert 0.5 < fit_dependence(probability, classes, one) <= 1.0


def test_fusion_goes_by_the_dependence_that_posteriors_carry():
    p = np.array([0.7, 0.2, 0.1])

    def both(dependence: float) -> Posterior:
        one = Posterior(labels=("a", "b", "c"), probability=p, unknown=0.1, dependence=dependence)
        return fuse([one, one])

    assert both(1.0).probability == pytest.approx(p, abs=0.005)
    assert both(0.0).probability[0] > both(0.5).probability[0] > both(1.0).probability[0]
    assert both(0.3).dependence == pytest.approx(0.3)
    with pytest.raises(ValueError, match="dependence"):
        both(1.2)


def test_evidence_is_even_where_a_grasp_tells_nothing():
    assert evidence(np.full((1, 4), 0.25)) == pytest.approx(np.zeros((1, 4)))
    assert independent_share(1, 0.7) == 1.0
    assert 5 * independent_share(5, 0.25) == pytest.approx(2.5)
