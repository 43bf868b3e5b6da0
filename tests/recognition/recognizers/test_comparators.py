"""What comparators alone have: the opening of the trees, and scikit-learn, which taught them.

What they share with the other recognisers is in `test_recognizers`.
"""

import dataclasses
import warnings

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.neural_network import MLPClassifier

from recognition.recognizers import make_trainer
from recognition.recognizers.comparators.classifiers import Forest, Network


def test_opening_alone_moves_trees_that_may_use_it(train, fresh):
    other = {g.label: g for g in fresh}
    moved = [
        (g, dataclasses.replace(g, aperture_m=other["egg"].aperture_m))
        for g in fresh
        if g.label != "egg" and g.n_frames == other["egg"].n_frames
    ]
    assert moved
    for use, changes in ((True, True), (False, False)):
        trees = make_trainer("extra_trees", use_aperture=use).fit(train)
        pairs = [[trees.posterior(g).probability for g in pair] for pair in moved]
        assert any(not np.array_equal(*pair) for pair in pairs) is changes


@pytest.mark.parametrize("n_classes", [2, 4])
def test_numpy_gives_the_probabilities_of_scikit_learn(n_classes):
    rng = np.random.default_rng(1)
    classes = np.arange(120) % n_classes
    rows = rng.normal(size=(120, 6)) + classes[:, None]
    fresh = rng.normal(size=(50, 6)) + 1.0
    network = MLPClassifier((32,), solver="lbfgs", alpha=0.1, max_iter=200, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it stops early on purpose
        network.fit(rows, classes)
    ours = Network.fit(rows, classes, n_classes)
    assert np.exp(ours.scores(fresh)) == pytest.approx(network.predict_proba(fresh), abs=1e-9)
    trees = ExtraTreesClassifier(200, random_state=0).fit(rows, classes)
    forest = Forest.fit(rows, classes, n_classes)
    assert forest.probability(fresh) == pytest.approx(trees.predict_proba(fresh), abs=1e-6)


def test_trees_that_run_in_circles_are_refused():
    rng = np.random.default_rng(2)
    forest = Forest.fit(rng.normal(size=(20, 3)), np.arange(20) % 2, 2)
    arrays = forest.to_arrays()
    looped = arrays["left"].copy()
    looped[int(np.flatnonzero(looped != np.arange(len(looped)))[-1])] = 0
    with pytest.raises(ValueError, match="downwards"):
        Forest.from_arrays(arrays | {"left": looped})
