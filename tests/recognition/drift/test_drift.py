"""Drift of gain and opening: said, applied, undone, allowed for, and found by a gauge object."""

import dataclasses

import numpy as np
import pytest

from recognition.drift.drift import (
    CERTAIN,
    NO_DRIFT,
    Drift,
    drift_grid,
    estimate_drift,
    parse_drift,
    undo_gains,
)
from recognition.features.aperture import aperture_features, undo_offsets
from recognition.features.footprint import pad_grid
from recognition.features.virtual import can_change_sides, change_sides, turn
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest
from recognition.recognizers import make_trainer

DRIFT = Drift(gain=0.7, aperture_offset_m=-4e-3)


@pytest.fixture(scope="module")
def taught(train):
    return make_trainer("force_ramp").fit(train)


def accuracy(recognizer, grasps):
    return np.mean([recognizer.posterior(g).best == g.label for g in grasps])


def same_arrays(a, b):
    return all(
        np.allclose(x, y, equal_nan=True)
        for f in dataclasses.fields(a)
        for x, y in zip(
            np.atleast_1d(getattr(a, f.name)), np.atleast_1d(getattr(b, f.name)), strict=True
        )
    )


def test_a_drift_is_read_from_its_text():
    assert parse_drift("gain=0.7, aperture_mm=-4") == DRIFT
    assert parse_drift("aperture_mm=2") == Drift(aperture_offset_m=2e-3)


@pytest.mark.parametrize("text", ["", "gain", "gain=x", "gain=1,gain=2", "speed=3", "gain=nan"])
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match=r"gain=0\.7,aperture_mm=-4"):
        parse_drift(text)


@pytest.mark.parametrize("values", [{"gain": 0.0}, {"gain": 9.0}, {"aperture_offset_m": 0.2}])
def test_values_out_of_range_are_refused(values):
    with pytest.raises(ValueError, match="must be"):
        Drift(**values)


def test_applied_it_scales_clips_and_moves_and_undone_it_is_gone(fresh):
    grasp = fresh[0]
    drifted = DRIFT.apply(grasp)
    assert np.array_equal(drifted.counts, np.rint(grasp.counts * 0.7))
    assert drifted.aperture_m == pytest.approx(grasp.aperture_m - 4e-3)
    back = DRIFT.undo(drifted)
    assert np.abs(back.counts.astype(int) - grasp.counts).max() <= 1
    assert back.aperture_m == pytest.approx(grasp.aperture_m)
    loud = Drift(gain=5.0).apply(grasp)
    assert loud.counts.max() == grasp.pads.adc_max


def test_the_grid_holds_all_probability_most_of_it_at_its_centre():
    for grid in (drift_grid(), drift_grid(DRIFT, share=0.1), drift_grid(share=1.0), CERTAIN):
        assert np.exp(grid.log_prior).sum() == pytest.approx(1.0)
        assert np.exp(grid.gain_only.log_prior).sum() == pytest.approx(1.0)
    grid = drift_grid(DRIFT)
    gain, offset = np.unravel_index(np.argmax(grid.log_prior), grid.log_prior.shape)
    assert grid.gains[gain] == pytest.approx(0.7)
    assert grid.offsets_mm[offset] == pytest.approx(-4.0)
    assert np.exp(grid.log_prior.max()) > 0.99
    assert drift_grid(log_gain_sd=0.1).gains[-1] < drift_grid().gains[-1]


def test_levels_with_the_gain_undone_are_those_of_the_taught_sensor(train, fresh):
    rest = learn_rest(train)
    plain = load_levels(fresh[:3], rest)
    drifted = load_levels(
        [dataclasses.replace(DRIFT, aperture_offset_m=0.0).apply(g) for g in fresh[:3]], rest
    )
    undone = undo_gains(drifted, [1.0, 0.7])
    assert len(undone) == 6
    for a, b in zip(undone.take(np.array([1, 3, 5])).maps, plain.maps, strict=True):
        assert a == pytest.approx(b, abs=2e-3)
    assert same_arrays(undone.take(np.array([0, 2, 4])), drifted)


def test_openings_with_the_offset_undone_are_those_of_the_taught_sensor(train, fresh):
    rest = learn_rest(train)
    plain = aperture_features(load_levels(fresh[:3], rest))
    drifted = aperture_features(load_levels([DRIFT.apply(g) for g in fresh[:3]], rest))
    undone = undo_offsets(drifted, np.array([0.0, -4.0]))
    assert undone.shape == (3, 2, plain.shape[1])
    assert undone[:, 0] == pytest.approx(drifted)
    assert undone[:, 1] == pytest.approx(plain, abs=0.02)


def test_a_drift_that_nobody_told_of_costs_little(taught, train, fresh):
    drifted = [Drift(gain=0.7, aperture_offset_m=-1.5e-3).apply(g) for g in fresh]
    assert accuracy(taught, fresh) >= 0.96
    plain = accuracy(make_trainer("shrinkage_lda").fit(train), drifted)
    assert accuracy(taught, drifted) >= max(0.84, plain)


def test_a_gauge_object_shows_the_drift_and_the_rest_is_as_before(taught, fresh):
    gauge = [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3]
    found = taught.gauge("egg", gauge)
    assert found.n_grasps == 3
    assert found.drift.gain == pytest.approx(0.7, rel=0.2)
    assert found.drift.aperture_offset_m == pytest.approx(-4e-3, abs=0.7e-3)
    drifted = [DRIFT.apply(g) for g in fresh]
    corrected = taught.with_drift(found)
    assert accuracy(corrected, drifted) >= 0.96
    assert accuracy(corrected, drifted) >= accuracy(taught, drifted)
    again = type(taught).from_arrays(corrected.to_arrays())
    assert np.array_equal(
        again.posterior(drifted[0]).probability, corrected.posterior(drifted[0]).probability
    )


def test_touch_alone_is_gauged_too(train, fresh):
    touch = make_trainer("force_ramp", use_aperture=False).fit(train)
    found = touch.gauge("egg", [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3])
    assert found.drift.gain == pytest.approx(0.7, rel=0.25)
    assert found.drift.aperture_offset_m == 0.0


def test_what_cannot_gauge_says_why(taught, fresh):
    with pytest.raises(ValueError, match="bar, block"):
        taught.gauge("ghost", fresh)
    with pytest.raises(ValueError, match="about three times"):
        taught.gauge("egg", [])
    missed = dataclasses.replace(fresh[0], counts=np.zeros_like(fresh[0].counts))
    with pytest.raises(ValueError, match="touched both pads"):
        taught.gauge("egg", [missed])
    with pytest.raises(ValueError, match="touched both pads"):
        estimate_drift(np.zeros((0, 1, 1)), CERTAIN)


def test_an_estimate_without_information_is_the_prior():
    grid = drift_grid(share=1.0)
    found = estimate_drift(np.zeros((2, *grid.log_prior.shape)), grid)
    assert found.drift.gain == pytest.approx(NO_DRIFT.gain)
    assert found.offset_sd_m == pytest.approx(3e-3, rel=0.1)


def test_virtual_grasps_are_of_the_same_surfaces(train, pads, factory):
    rest = learn_rest(train)
    levels = load_levels(train[:4], rest)
    grids = [pad_grid(pads, p) for p in rest.gripping]
    assert can_change_sides(grids)
    sides = change_sides(levels)
    assert np.array_equal(sides.maps[0], levels.maps[1])
    assert np.array_equal(sides.touch_delay_s, -levels.touch_delay_s)
    assert same_arrays(change_sides(sides), levels)
    turned = turn(levels)
    rows, columns = grids[0].shape
    before = levels.maps[0].reshape(4, -1, rows, columns)
    assert np.array_equal(turned.maps[0].reshape(before.shape), before[..., ::-1, ::-1])
    unlike = factory.pads(shapes=((10, 6), (8, 6)))
    assert not can_change_sides([pad_grid(unlike, 0), pad_grid(unlike, 1)])


def test_grasps_too_short_for_rest_and_load_teach_no_rest(train):
    short = [
        dataclasses.replace(
            grasp, **{n: getattr(grasp, n)[:5] for n in ("counts", "t_s", "aperture_m", "force_n")}
        )
        for grasp in train[:3]
    ]
    with pytest.raises(
        ValueError, match=r"5 frames in the median, at least 6 .* from rest to load"
    ):
        learn_rest(short)
