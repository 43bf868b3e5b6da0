"""The comparators: they name plain grasps, come back from arrays, and say when they cannot tell."""

import builtins
import dataclasses
import warnings

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.neural_network import MLPClassifier

from recognition.errors import MissingExtraError
from recognition.recognizers import COMPARATORS, make_trainer
from recognition.recognizers.comparators.classifiers import Forest, Network

WITH_SKLEARN = ("radius_vector", "contour_network", "extra_trees")
LEAST = {
    "radius_vector": 0.6,
    "contour_network": 0.4,
    "contact_invariants": 0.8,
    "extra_trees": 0.95,
    "raw_neighbours": 0.8,
}


@pytest.fixture(scope="module", params=sorted(COMPARATORS))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def taught(name, train):
    return make_trainer(name).fit(train)


def test_they_are_made_by_name_beside_the_others(name):
    assert make_trainer(name).name == name
    assert make_trainer(name).uses_aperture == (name == "extra_trees")
    assert not make_trainer(name, use_aperture=False).uses_aperture


def test_fresh_grasps_are_named_better_than_by_chance(name, taught, fresh):
    right = np.mean([taught.posterior(g).best == g.label for g in fresh])
    assert right >= LEAST[name]


def test_most_familiar_grasps_are_known(taught, fresh):
    assert np.mean([taught.posterior(g).unknown > 0.5 for g in fresh]) <= 0.3


def test_they_come_back_from_plain_arrays(taught, fresh):
    arrays = taught.to_arrays()
    assert all(np.asarray(a).dtype.kind in "biufU" for a in arrays.values())
    back = type(taught).from_arrays(arrays)
    for grasp in fresh[:5]:
        before, after = taught.posterior(grasp), back.posterior(grasp)
        assert np.array_equal(before.probability, after.probability)
        assert before.unknown == after.unknown


def test_arrays_that_lack_something_or_do_not_fit_are_refused(taught):
    arrays = taught.to_arrays()
    for missing in arrays:
        with pytest.raises(ValueError, match=missing.removeprefix("classifier_")):
            type(taught).from_arrays({k: a for k, a in arrays.items() if k != missing})
    with pytest.raises(ValueError, match="labels"):
        type(taught).from_arrays(arrays | {"labels": arrays["labels"][:-1]})
    with pytest.raises(ValueError, match="version 0"):
        type(taught).from_arrays(arrays | {"feature_version": np.array(0)})


def test_odd_grasps_tell_nothing_and_break_nothing(taught, fresh):
    grasp = fresh[0]
    empty = dataclasses.replace(grasp, counts=np.zeros_like(grasp.counts))
    assert taught.posterior(empty).unknown == 1.0
    assert np.ptp(taught.posterior(empty).probability) == 0.0
    full = np.full_like(grasp.counts, grasp.pads.adc_max)
    one_taxel = np.zeros_like(grasp.counts)
    one_taxel[5:, [0, 60]] = grasp.pads.adc_max
    for counts in (full, one_taxel, grasp.counts[::-1].copy()):
        answer = taught.posterior(dataclasses.replace(grasp, counts=counts))
        assert answer.probability.sum() == pytest.approx(1.0)
    single = dataclasses.replace(
        grasp,
        counts=grasp.counts[-1:],
        t_s=grasp.t_s[-1:],
        aperture_m=grasp.aperture_m[-1:],
        force_n=grasp.force_n[-1:],
    )
    assert 0.0 <= taught.posterior(single).unknown <= 1.0
    blind = dataclasses.replace(grasp, aperture_m=np.full_like(grasp.aperture_m, np.nan))
    assert taught.posterior(blind).probability.max() <= 1.0


def test_too_little_to_learn_from_is_said(name, train):
    one = [g for g in train if g.label == "bar"]
    with pytest.raises(ValueError, match="two objects"):
        make_trainer(name).fit(one)
    never = [
        dataclasses.replace(g, counts=np.zeros_like(g.counts)) if g.label == "pin" else g
        for g in train
    ]
    with pytest.raises(ValueError, match="pin"):
        make_trainer(name).fit(never)
    with pytest.raises(ValueError, match="taught"):
        make_trainer(name).fit(train).posterior(
            dataclasses.replace(train[0], pads=dataclasses.replace(train[0].pads, adc_max=65535))
        )


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


@pytest.mark.parametrize("name", WITH_SKLEARN)
def test_without_scikit_learn_the_extra_is_named(name, train, monkeypatch):
    real = builtins.__import__

    def none_of_it(module, *args, **kwargs):
        if module.startswith("sklearn"):
            raise ImportError(module)
        return real(module, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", none_of_it)
    with pytest.raises(MissingExtraError, match=r"tactile-cell\[comparators\]"):
        make_trainer(name).fit(train)


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
