"""The table of feature groups: nothing forgotten, and vectors of the groups that a view uses."""

import importlib
import inspect
import pkgutil
from dataclasses import replace

import numpy as np
import pytest

import recognition.features
from recognition.features.footprint import pad_grid
from recognition.features.groups import (
    FEATURE_GROUPS,
    FeatureView,
    GraspDescription,
    check_table,
    features_of,
)
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest


@pytest.fixture(scope="module")
def described(train, pads):
    rest = learn_rest(train)
    return load_levels(train, rest), [pad_grid(pads, pad) for pad in rest.gripping]


def feature_functions():
    """Return the names of the public functions of the package that make features."""
    modules = [
        importlib.import_module(f"recognition.features.{found.name}")
        for found in pkgutil.iter_modules(recognition.features.__path__)
    ]
    return {
        name
        for module in modules
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if name.endswith("_features") and function.__module__ == module.__name__
    }


def test_every_feature_function_has_an_entry():
    used = {name for group in FEATURE_GROUPS for name in group.features.__code__.co_names}
    assert feature_functions() - used == set()
    assert len(feature_functions()) == len(FEATURE_GROUPS)


def test_each_group_has_a_row_of_finite_features_for_each_grasp(train, described):
    for group in FEATURE_GROUPS:
        values = group.features(GraspDescription(*described))
        assert values.shape[0] == len(train), group.name
        assert values.shape[1] > 0, group.name
        assert np.all(np.isfinite(values)), group.name


@pytest.mark.parametrize("opening", [True, False])
@pytest.mark.parametrize("view", FeatureView)
def test_a_vector_holds_the_groups_of_its_view_in_the_order_of_the_table(view, opening, described):
    expected = [
        group.features(GraspDescription(*described))
        for group in FEATURE_GROUPS
        if view in group.views and group.opening in (None, opening)
    ]
    found = features_of(*described, view, opening=opening)
    assert np.array_equal(found, np.concatenate(expected, axis=1))


def test_one_pad_has_no_other_to_compare_with(factory):
    pads = factory.pads(shapes=((10, 6),))
    grasps = factory.many(2, seed=0, pads=pads, gripping=(0,))
    levels, grids = load_levels(grasps, learn_rest(grasps)), [pad_grid(pads, 0)]
    found = features_of(levels, grids, FeatureView.SHRINKAGE_LDA, opening=True)
    described = GraspDescription(levels, grids)
    alone = [
        group.features(described).shape[1]
        for group in FEATURE_GROUPS
        if FeatureView.SHRINKAGE_LDA in group.views and group.name != "pads"
    ]
    assert found.shape == (len(grasps), sum(alone))


def test_what_is_forgotten_in_the_table_is_an_error():
    first, *others = FEATURE_GROUPS
    with pytest.raises(ValueError, match="twice"):
        check_table([*FEATURE_GROUPS, first])
    with pytest.raises(ValueError, match=r"\['patch'\] are used by no view"):
        check_table([replace(first, views=frozenset()), *others])
    no_view = [
        replace(group, views=group.views - {FeatureView.EXTRA_TREES}) for group in FEATURE_GROUPS
    ]
    with pytest.raises(ValueError, match="extra_trees"):
        check_table(no_view)


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (2, 1), (2, 2), (6, 2)])
@pytest.mark.parametrize("view", FeatureView)
def test_pads_of_one_or_two_rows_have_every_feature(factory, shape, view):
    pads = factory.pads(shapes=(shape, shape))
    grasps = factory.many(3, seed=1, pads=pads, things=factory.things[:2])
    rest = learn_rest(grasps)
    levels, grids = load_levels(grasps, rest), [pad_grid(pads, pad) for pad in rest.gripping]
    for opening in (True, False):
        assert np.all(np.isfinite(features_of(levels, grids, view, opening=opening)))
