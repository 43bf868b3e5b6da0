"""Drift of gain and opening: read, applied, undone, and found by a gauge object."""

import dataclasses

import numpy as np
import pytest

from recognition.drift.drift import Drift, drift_text, drift_values, parse_drift
from recognition.drift.self_zero import drawn_zero
from recognition.evaluation.splits import a_day_later
from recognition.features.aperture import aperture_features
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest
from recognition.recognizers import make_trainer
from tests.recognition.conftest import accuracy

DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)


@pytest.fixture(scope="module")
def taught(train):
    return make_trainer("force_ramp").fit(train)


def test_a_drift_is_read_from_its_text():
    assert parse_drift("gain=0.7, aperture_mm=-4") == DRIFT
    assert parse_drift("aperture_mm=2") == Drift(aperture_offset_m=2e-3)
    assert parse_drift("gain=0.7/0.9") == Drift(gains=(0.7, 0.9))


@pytest.mark.parametrize(
    "text", ["", "gain", "gain=x", "gain=1,gain=2", "speed=3", "gain=nan", "aperture_mm=1/2"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match=r"gain=0\.7,aperture_mm=-4"):
        parse_drift(text)


@pytest.mark.parametrize(
    "values", [{"gains": (0.0,)}, {"gains": (1.0, 9.0)}, {"gains": ()}, {"aperture_offset_m": 0.2}]
)
def test_values_out_of_range_are_refused(values):
    with pytest.raises(ValueError, match="must be"):
        Drift(**values)


def test_applied_it_scales_clips_and_moves_and_undone_it_is_gone(fresh):
    grasp = dataclasses.replace(fresh[0], zero=drawn_zero())
    drifted = DRIFT.apply(grasp)
    assert drifted.zero is None
    assert np.array_equal(drifted.counts, np.rint(grasp.counts * 0.7))
    assert drifted.aperture_m == pytest.approx(grasp.aperture_m - 4e-3)
    back = DRIFT.undo(drifted)
    assert np.abs(back.counts.astype(int) - grasp.counts).max() <= 1
    assert back.aperture_m == pytest.approx(grasp.aperture_m)
    loud = Drift(gains=(5.0,)).apply(grasp)
    assert loud.counts.max() == grasp.pads.adc_max


def test_each_pad_has_a_gain_of_its_own(fresh):
    grasp, drift = fresh[0], Drift(gains=(0.5, 1.5))
    drifted = drift.apply(grasp)
    for pad, gain in enumerate(drift.gains):
        mine = grasp.pads.taxels_of(pad)
        wanted = np.clip(np.rint(grasp.counts[:, mine] * gain), 0, grasp.pads.adc_max)
        assert np.array_equal(drifted.counts[:, mine], wanted)
    assert drift.gain == pytest.approx(np.sqrt(0.75))
    assert drift_text(drift) == "gain 0.50 to 1.50, opening +0.0 mm"
    assert drift_values(DRIFT) == {"gain": pytest.approx(0.7), "gains": [0.7], "aperture_mm": -4.0}
    with pytest.raises(ValueError, match="3 gains do not fit the 2 pads"):
        Drift(gains=(1.0, 1.0, 1.0)).apply(grasp)


def test_levels_with_a_drift_undone_are_those_of_the_taught_sensor(train, fresh):
    rest, drift = learn_rest(train), Drift(gains=(0.7, 0.9), aperture_offset_m=-4e-3)
    plain = load_levels(fresh[:3], rest)
    drifted = load_levels([drift.apply(g) for g in fresh[:3]], rest)
    undone = drifted.without_drift(np.log([0.7, 0.9]), -4.0)
    for a, b in zip(undone.maps, plain.maps, strict=True):
        assert a == pytest.approx(b, abs=2e-3)
    assert undone.timed_load == pytest.approx(plain.timed_load, abs=0.05)
    assert aperture_features(undone) == pytest.approx(aperture_features(plain), abs=0.02)


@pytest.mark.slow
def test_a_drift_that_was_not_gauged_costs_little(taught, train, fresh):
    drifted = [Drift(gains=(0.7,), aperture_offset_m=-1.5e-3).apply(g) for g in fresh]
    assert accuracy(taught, fresh) >= 0.96
    plain = accuracy(make_trainer("shrinkage_lda").fit(train), drifted)
    assert accuracy(taught, drifted) >= max(0.84, plain)


@pytest.mark.slow
def test_a_gauge_object_shows_the_drift_and_the_rest_is_as_before(taught, fresh):
    gauge = [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3]
    corrected = taught.gauge("egg", gauge)
    found = corrected.grid
    assert found.drift.gain == pytest.approx(0.7, rel=0.25)
    assert found.drift.aperture_offset_m == pytest.approx(-4e-3, abs=2.0 * found.offset_sd_m)
    both = corrected.gauge("pin", [DRIFT.apply(g) for g in fresh if g.label == "pin"][:3])
    assert both.grid.offset_sd_m < found.offset_sd_m
    drifted = [a_day_later(DRIFT.apply(g)) for g in fresh]
    assert accuracy(both, drifted) >= 0.96
    assert accuracy(both, drifted) >= accuracy(taught, drifted)
    again = type(taught).from_arrays(both.to_arrays())
    assert np.array_equal(
        again.posterior(drifted[0]).probability, both.posterior(drifted[0]).probability
    )
    assert both.without_gauges().grid.drift == taught.grid.drift


def test_grasps_that_nobody_named_show_the_drift(taught, fresh):
    drifted = [a_day_later(DRIFT.apply(g)) for g in fresh]
    followed = taught
    for grasp in drifted[::2]:
        followed = followed.follow(grasp)
    assert followed.grid.likely
    assert followed.grid.n_followed == len(drifted[::2])
    assert followed.grid.drift.aperture_offset_m == pytest.approx(-4e-3, abs=1e-3)
    assert accuracy(followed, drifted[1::2]) >= 0.96
    kept = followed.with_grid(followed.grid.with_unnamed_kept())
    again = type(taught).from_arrays(kept.to_arrays())
    assert again.grid.drift == followed.grid.drift
    assert type(taught).from_arrays(followed.to_arrays()).grid.drift == taught.grid.drift
    assert not followed.grid.without_unnamed().likely


def test_grasps_without_a_drift_show_none(taught, fresh):
    followed = taught
    for grasp in fresh[:20]:
        followed = followed.follow(a_day_later(grasp))
    assert not followed.grid.likely
    assert followed.grid.unchanged > 0.5


def test_touch_alone_is_gauged_too(train, fresh):
    touch = make_trainer("force_ramp", use_aperture=False).fit(train)
    found = touch.gauge("egg", [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3]).grid
    assert found.drift.gain == pytest.approx(0.7, rel=0.3)
    assert found.drift.aperture_offset_m == pytest.approx(0.0, abs=1e-6)


def test_what_cannot_gauge_says_why(taught, fresh):
    with pytest.raises(ValueError, match="bar, block"):
        taught.gauge("ghost", fresh)
    with pytest.raises(ValueError, match="touched both pads"):
        taught.gauge("egg", [])
    missed = dataclasses.replace(fresh[0], counts=np.zeros_like(fresh[0].counts))
    with pytest.raises(ValueError, match="touched both pads"):
        taught.gauge("egg", [missed])


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
