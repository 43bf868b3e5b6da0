"""Dependence of grasps: what repeats another grasp counts less."""

import numpy as np
import pytest

from recognition.recognizer import Posterior
from recognition.statistics.fusion import evidence, fuse, independent_share


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
