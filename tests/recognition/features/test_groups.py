"""The table of feature groups: nothing forgotten, and vectors of the groups that are used."""

import importlib
import inspect
import pkgutil

import numpy as np
import pytest

import recognition.features
from recognition.features.aperture import aperture_features
from recognition.features.footprint import describe_footprint, pad_grid
from recognition.features.groups import FEATURE_GROUPS, features_of
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest


@pytest.fixture(scope="module")
def described(train):
    rest = learn_rest(train)
    return load_levels(train, rest), rest


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


def test_each_group_has_a_name_of_its_own():
    assert len({group.name for group in FEATURE_GROUPS}) == len(FEATURE_GROUPS)


@pytest.fixture(scope="module")
def footprints(described):
    levels, rest = described
    return [
        describe_footprint(maps, levels.noise[..., column], pad_grid(rest.pads, pad))
        for column, (maps, pad) in enumerate(zip(levels.maps, rest.gripping, strict=True))
    ]


def test_each_group_has_a_row_of_finite_features_for_each_grasp(train, described, footprints):
    for group in FEATURE_GROUPS:
        values = group.features(described[0], footprints)
        assert values.shape[0] == len(train), group.name
        assert values.shape[1] > 0, group.name
        assert np.all(np.isfinite(values)), group.name


@pytest.mark.parametrize("opening", [True, False])
def test_a_vector_holds_the_groups_and_then_the_opening(opening, described, footprints):
    expected = [
        group.features(described[0], footprints)
        for group in FEATURE_GROUPS
        if group.name != "harmonics" or not opening
    ]
    expected += [aperture_features(described[0])] * opening
    found = features_of(*described, opening=opening)
    assert np.array_equal(found, np.concatenate(expected, axis=1))


def test_one_pad_has_no_other_to_compare_with(factory):
    pads = factory.pads(shapes=((10, 6),))
    grasps = factory.many(2, seed=0, pads=pads, gripping=(0,))
    rest = learn_rest(grasps)
    levels = load_levels(grasps, rest)
    alone = [describe_footprint(levels.maps[0], levels.noise[..., 0], pad_grid(pads, 0))]
    widths = {g.name: g.features(levels, alone).shape[1] for g in FEATURE_GROUPS}
    assert [name for name, width in widths.items() if not width] == ["pads"]
    found = features_of(levels, rest, opening=False)
    assert found.shape == (len(grasps), sum(widths.values()))


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (2, 1), (2, 2), (6, 2)])
def test_pads_of_one_or_two_rows_have_every_feature(factory, shape):
    pads = factory.pads(shapes=(shape, shape))
    grasps = factory.many(3, seed=1, pads=pads, things=factory.things[:2])
    rest = learn_rest(grasps)
    levels = load_levels(grasps, rest)
    for opening in (True, False):
        assert np.all(np.isfinite(features_of(levels, rest, opening=opening)))
