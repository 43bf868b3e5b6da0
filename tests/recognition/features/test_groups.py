"""The table of feature groups: nothing forgotten, and vectors of the groups that a view uses."""

import importlib
import inspect
import pkgutil

import numpy as np
import pytest

import recognition.features
from recognition.features.aperture import aperture_features
from recognition.features.footprint import describe_footprint, pad_grid
from recognition.features.groups import FEATURE_GROUPS, FeatureView, features_of
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
    used |= {group.features.__name__ for group in FEATURE_GROUPS}
    assert feature_functions() - used == {"touch_features", "aperture_features"}


def test_each_group_has_a_name_and_a_recogniser_and_each_recogniser_a_group():
    assert len({group.name for group in FEATURE_GROUPS}) == len(FEATURE_GROUPS)
    assert all(group.views for group in FEATURE_GROUPS)
    assert {view for group in FEATURE_GROUPS for view in group.views} == set(FeatureView)


@pytest.fixture(scope="module")
def footprints(described):
    levels, grids = described
    return [
        describe_footprint(maps, levels.noise[..., pad], grid)
        for pad, (maps, grid) in enumerate(zip(levels.maps, grids, strict=True))
    ]


def test_each_group_has_a_row_of_finite_features_for_each_grasp(train, described, footprints):
    for group in FEATURE_GROUPS:
        values = group.features(described[0], footprints)
        assert values.shape[0] == len(train), group.name
        assert values.shape[1] > 0, group.name
        assert np.all(np.isfinite(values)), group.name


@pytest.mark.parametrize("opening", [True, False])
@pytest.mark.parametrize("view", FeatureView)
def test_a_vector_holds_the_groups_of_its_view_and_then_the_opening(
    view, opening, described, footprints
):
    expected = [
        group.features(described[0], footprints)
        for group in FEATURE_GROUPS
        if view in group.views and (group.name != "harmonics" or not opening)
    ]
    expected += [aperture_features(described[0])] * opening
    found = features_of(*described, view, opening=opening)
    assert np.array_equal(found, np.concatenate(expected, axis=1))


def test_one_pad_has_no_other_to_compare_with(factory):
    pads = factory.pads(shapes=((10, 6),))
    grasps = factory.many(2, seed=0, pads=pads, gripping=(0,))
    levels, grids = load_levels(grasps, learn_rest(grasps)), [pad_grid(pads, 0)]
    alone = [describe_footprint(levels.maps[0], levels.noise[..., 0], grids[0])]
    widths = {g.name: g.features(levels, alone).shape[1] for g in FEATURE_GROUPS}
    assert [name for name, width in widths.items() if not width] == ["pads"]
    found = features_of(levels, grids, FeatureView.FORCE_RAMP, opening=False)
    assert found.shape == (len(grasps), sum(widths.values()))


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (2, 1), (2, 2), (6, 2)])
@pytest.mark.parametrize("view", FeatureView)
def test_pads_of_one_or_two_rows_have_every_feature(factory, shape, view):
    pads = factory.pads(shapes=(shape, shape))
    grasps = factory.many(3, seed=1, pads=pads, things=factory.things[:2])
    rest = learn_rest(grasps)
    levels, grids = load_levels(grasps, rest), [pad_grid(pads, pad) for pad in rest.gripping]
    for opening in (True, False):
        assert np.all(np.isfinite(features_of(levels, grids, view, opening=opening)))
