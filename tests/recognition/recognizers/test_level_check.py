import dataclasses

import numpy as np
import pytest

from recognition.errors import ContactError, QuadricError
from recognition.quadric.level import MeanFrames, frames_at, level_of
from recognition.recognizer import UNKNOWN
from recognition.recognizers.level_check import LevelCheckRecognizer, LevelCheckTrainer
from tests.recognition.conftest import grasp_of, part
from tests.values import make_pads

PAPER_FINGER = ((16, 4), (16, 4), (16, 2), (16, 2), (6, 2))


def _pads(shapes, adc_max=255):
    return make_pads(shapes=shapes, adc_max=adc_max, pitch_m=3.5e-3)


PAPER, INNER = _pads(PAPER_FINGER * 2), _pads(((16, 4), (16, 4)))
PINCH = _pads(((13, 6), (13, 6)), 4095)
LAYOUTS = {"paper": PAPER, "two inner pads": INNER, "pinch": PINCH}


def _grasp(pads, peak, rng, *, label="", touched=None, noise=0.01, force=True, width_m=0.006):
    """A force ramp: a cap of the given peak, as a part of full scale, on the touched pads."""
    touched = (0, pads.n_pads // 2) if touched is None else touched
    n_quiet, n_ramp, n_hold = 8, 20, 10
    load = np.concatenate([np.zeros(n_quiet), np.linspace(0.05, 1, n_ramp), np.ones(n_hold)])
    shift = rng.uniform(-0.002, 0.002, 2)
    cap = np.maximum(1 - np.sum(((pads.taxel_xy_m - shift) / width_m) ** 2, axis=1), 0)
    cap = np.where(np.isin(pads.taxel_pad, touched), peak * cap, 0.0)
    counts = load[:, None] * cap + np.abs(rng.normal(scale=noise, size=(len(load), pads.n_taxels)))
    return grasp_of(pads, counts * pads.adc_max, 8.0 * load if force else np.nan, label)


def _taught(pads, rng, **options):
    peaks = {"low": 0.2, "middle": 0.4, "high": 0.8}
    return [
        _grasp(pads, peak, rng, label=label, **options)
        for label, peak in peaks.items()
        for _ in range(5)
    ]


def grip_level(grasp, force_n=None):
    return level_of(grasp, force_n)[0]


@pytest.fixture
def rng():
    return np.random.default_rng(10)


@pytest.fixture(params=LAYOUTS)
def pads(request):
    return LAYOUTS[request.param]


@pytest.mark.parametrize("force", [True, False])
def test_objects_that_press_differently_are_named_on_every_layout(pads, force, rng):
    taught = LevelCheckTrainer().fit(_taught(pads, rng, force=force))
    assert taught.labels == ("high", "low", "middle")
    for label, peak in (("low", 0.2), ("middle", 0.4), ("high", 0.8)):
        grasp = _grasp(pads, peak, rng, force=force)
        posterior = taught.posterior(grasp)
        assert (posterior.best, posterior.name) == (label, label)
        assert posterior.probability.max() > 0.9
        assert taught.check(grasp) == label


def test_a_level_outside_every_band_is_unknown(pads, rng):
    taught = LevelCheckTrainer().fit(_taught(pads, rng))
    between = _grasp(pads, 0.28, rng)
    assert taught.posterior(between).name == UNKNOWN
    assert taught.check(between) == UNKNOWN


def test_objects_with_one_level_share_the_probability_and_close_the_window(rng):
    grasps = [_grasp(PINCH, 0.5, rng, label=label) for label in "ab" for _ in range(8)]
    taught = LevelCheckTrainer().fit(grasps)
    assert taught.levels.window[0] < 0.0
    middle = grasps[int(np.argsort([taught.measure(grasp)[0] for grasp in grasps])[8])]
    posterior = taught.posterior(middle)
    assert posterior.unknown < 0.5
    assert posterior.probability.min() > 0.1
    assert taught.check(middle) == UNKNOWN


def test_no_contact_and_contact_without_a_surface_are_unknown_and_uniform(rng):
    taught = LevelCheckTrainer().fit(_taught(PAPER, rng))
    nothing = _grasp(PAPER, 0.0, rng)
    tip_only = _grasp(PAPER, 0.5, rng, touched=(4,))  # a pad of 6 x 2: two rows are no surface
    for grasp in (tip_only, part(nothing, slice(1))):
        posterior = taught.posterior(grasp)
        assert (posterior.unknown, posterior.probability) == (1.0, pytest.approx([1 / 3] * 3))
        assert taught.check(grasp) == UNKNOWN
    assert taught.posterior(nothing).name == UNKNOWN
    with pytest.raises(QuadricError, match=r"no pad carries a surface: .*pad 4"):
        MeanFrames.of(tip_only).level()


def test_other_pads_are_refused(rng):
    with pytest.raises(ValueError, match="with full scale 255, taught were"):
        LevelCheckTrainer().fit(_taught(PINCH, rng)).posterior(_grasp(INNER, 0.4, rng))
    with pytest.raises(ValueError, match="different pads"):
        LevelCheckTrainer().fit([*_taught(PINCH, rng), *_taught(INNER, rng)])


def test_an_object_without_any_surface_stays_without_a_level(rng):
    grasps = _taught(PAPER, rng)
    spoilt = [_grasp(PAPER, 0.5, rng, touched=(4,), label="tip") for _ in range(3)]
    taught = LevelCheckTrainer().fit([*grasps, *spoilt])
    assert np.isnan(taught.low).tolist() == [label == "tip" for label in taught.labels]
    posterior = taught.posterior(_grasp(PAPER, 0.8, rng))
    assert posterior.best == "high"
    assert posterior.probability[posterior.labels.index("tip")] < 0.01
    again = LevelCheckRecognizer.from_arrays(taught.to_arrays())
    assert np.array_equal(again.low, taught.low, equal_nan=True)
    with pytest.raises(ValueError, match="no object of 1 has a level"):
        LevelCheckTrainer().fit(spoilt)


def test_it_never_uses_the_opening_and_refuses_what_does_not_teach(rng):
    assert not LevelCheckTrainer(use_aperture=True).uses_aperture
    for grasps, says in (([], "no grasps"), ([_grasp(PINCH, 0.5, rng)], "no label")):
        with pytest.raises(ValueError, match=says):
            LevelCheckTrainer().fit(grasps)


# --- the level of one grasp -----------------------------------------------------------------


def test_the_level_is_a_quarter_over_the_fitted_peak_in_counts_of_255(pads, rng):
    grasp = _grasp(pads, 0.5, rng, noise=0.0, width_m=0.012)
    assert grip_level(grasp) == pytest.approx(0.25 / (0.5 * 255), rel=0.1)


def test_frames_near_the_full_force_or_load(rng):
    assert frames_at(_grasp(PINCH, 0.5, rng)).tolist() == list(range(25, 38))
    assert set(frames_at(_grasp(PINCH, 0.5, rng, force=False))) >= set(range(28, 37))


def test_a_fixed_force_that_was_not_reached_is_refused():
    grasp = _grasp(PINCH, 0.5, np.random.default_rng(21))
    assert grip_level(grasp, 4.0) == pytest.approx(2 * grip_level(grasp), rel=0.2)
    with pytest.raises(ContactError, match=r"within 2 N of 20 N; the ramp reached 8 N"):
        MeanFrames.of(grasp, 20.0)


def test_levels_are_taken_at_the_force_that_every_taught_grasp_reached(rng):
    taught = _taught(PINCH, rng)
    weak = dataclasses.replace(taught[0], force_n=0.5 * taught[0].force_n)
    assert LevelCheckTrainer().fit([*taught, weak]).force_n == pytest.approx(4.0)
    unknown_force = [
        dataclasses.replace(grasp, force_n=np.full(grasp.n_frames, np.nan)) for grasp in taught
    ]
    assert LevelCheckTrainer().fit(unknown_force).force_n is None


def _held(pads, peak, rng, noise, n_frames):
    """A step of force: quiet frames, then as many under load, noise either way."""
    load = np.concatenate([np.zeros(12), np.ones(n_frames)])
    cap = np.maximum(1 - np.sum((pads.taxel_xy_m / 0.006) ** 2, axis=1), 0) * peak
    values = load[:, None] * cap + 0.2 + rng.normal(scale=noise, size=(len(load), pads.n_taxels))
    return grasp_of(pads, values * pads.adc_max, 8.0 * load)


def test_the_patch_does_not_grow_with_the_number_of_frames_averaged():
    few, many = (_held(INNER, 0.5, np.random.default_rng(3), 0.01, n) for n in (2, 40))
    assert abs(np.log(grip_level(few) / grip_level(many))) < 0.05


def test_noise_of_the_whole_pad_does_not_hide_the_first_touch_in_the_baseline():
    quiet = grip_level(_grasp(PAPER, 0.6, np.random.default_rng(4), noise=0.0))
    loud = [grip_level(_grasp(PAPER, 0.6, np.random.default_rng(4), noise=0.04)) for _ in range(3)]
    assert np.mean(loud) == pytest.approx(quiet, rel=0.06)


def test_more_noise_than_taught_is_seen_and_widens_bands_and_probabilities(rng):
    taught = LevelCheckTrainer().fit(_taught(PAPER, rng))
    calm, loud = (_grasp(PAPER, 0.3, np.random.default_rng(7), noise=n) for n in (0.005, 0.1))
    assert taught.measure(calm)[1] == 0.0
    assert 0.005 < taught.measure(loud)[1] < 0.5
    deaf = dataclasses.replace(taught, noise_per_count=0.0)
    assert taught.posterior(calm).probability == pytest.approx(deaf.posterior(calm).probability)
    assert taught.posterior(loud).unknown < deaf.posterior(loud).unknown
    wary = dataclasses.replace(taught, noise_per_count=0.04)
    assert wary.posterior(loud).probability.max() < deaf.posterior(loud).probability.max() - 0.05
    hopeless = dataclasses.replace(taught, noise_per_count=1e3)
    assert hopeless.check(loud) == UNKNOWN
    assert hopeless.posterior(loud).unknown == 1.0
