"""Taxels that answer more or less strongly than their neighbours are found and evened out."""

import dataclasses

import numpy as np
import pytest

from recognition.features.footprint import pad_grid
from recognition.features.taxel_gain import TaxelGains, learn_taxel_gains
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest


@pytest.fixture(scope="module")
def learnt_from(pads, factory):
    grasps = factory.many(20, seed=3, pads=pads)
    rest = learn_rest(grasps)
    return load_levels(grasps, rest), [pad_grid(pads, p) for p in rest.gripping]


def with_gains(levels, gains):
    maps = tuple(m * gain for m, gain in zip(levels.maps, gains, strict=True))
    return dataclasses.replace(levels, maps=maps)


def test_gains_of_single_taxels_are_found(learnt_from):
    levels, grids = learnt_from
    rng = np.random.default_rng(0)
    true = [np.exp(rng.normal(0.0, 0.2, m.shape[-1])) for m in levels.maps]
    before = learn_taxel_gains(levels, grids)
    found = learn_taxel_gains(with_gains(levels, true), grids)
    for was, now, gain in zip(before.pads, found.pads, true, strict=True):
        seen = now != 1.0
        assert seen.sum() >= 10
        added = np.log(now / was)[seen]
        assert np.corrcoef(added, np.log(gain)[seen])[0, 1] > 0.7


def test_even_pads_are_left_nearly_as_they_are(learnt_from):
    levels, grids = learnt_from
    for gain in learn_taxel_gains(levels, grids).pads:
        assert np.abs(np.log(gain)).max() < 0.35


def test_undone_gains_are_gone(learnt_from):
    levels, _ = learnt_from
    gains = TaxelGains(pads=tuple(np.linspace(0.5, 2.0, m.shape[-1]) for m in levels.maps))
    undone = gains.undo(with_gains(levels, gains.pads))
    for a, b in zip(undone.maps, levels.maps, strict=True):
        assert a == pytest.approx(b)


def test_few_grasps_teach_no_gains(learnt_from):
    levels, grids = learnt_from
    gains = learn_taxel_gains(levels.take(np.arange(3)), grids)
    assert all(np.all(gain == 1.0) for gain in gains.pads)


def test_gains_come_back_from_their_arrays(learnt_from):
    levels, grids = learnt_from
    gains = learn_taxel_gains(levels, grids)
    again = TaxelGains.from_arrays(gains.to_arrays(), 2)
    assert all(np.array_equal(a, b) for a, b in zip(again.pads, gains.pads, strict=True))
    with pytest.raises(KeyError):
        TaxelGains.from_arrays(gains.to_arrays(), 3)
