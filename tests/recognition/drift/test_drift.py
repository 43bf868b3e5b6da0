"""The grid of drifts: its prior, and what grasps of taught and of new objects show."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recognition.drift.drift import Drift, DriftGrid, DriftPrior, drift_text, learn_spread
from recognition.drift.self_zero import (
    ZeroMeasurement,
    drawn_zero,
    foam_odds,
    measure_zero,
    prior_since,
    since,
)
from recognition.evaluation.splits import a_day_later
from recognition.features import aperture_features
from recognition.grasp import DRAWING_SOURCE, ZERO_COLUMNS, Grasp, PadArray, SelfZero
from recognition.ramp.ramp import learn_rest, load_levels
from recognition.recognizers import make_trainer
from tests.cell.archive.fleet import SIZES_MM, ramp
from tests.recognition.conftest import accuracy


@pytest.mark.parametrize(
    "values", [{"gains": (0.0,)}, {"gains": (1.0, 9.0)}, {"gains": ()}, {"aperture_offset_m": 0.2}]
)
def test_drifts_out_of_range_are_refused(values):
    with pytest.raises(ValueError, match="must be"):
        Drift(**values)


def evidence(grid, log_gain, offset_mm, sd=(0.1, 0.5)):
    """Return a Gaussian log likelihood over the hypotheses."""
    gain = -0.5 * ((grid.log_gains - log_gain) / sd[0]) ** 2
    return gain[:, None] - 0.5 * ((grid.offsets_mm - offset_mm) / sd[1]) ** 2


def test_without_grasps_half_the_weight_is_on_no_drift():
    grid = DriftGrid()
    assert (grid.weight.sum(), grid.unchanged) == (pytest.approx(1.0), pytest.approx(0.5, abs=0.02))
    assert np.exp(grid.log_weight(0.99)).max() == pytest.approx(0.99, abs=0.01)
    assert grid.drift.gain == pytest.approx(1.0)
    assert not grid.likely


def test_a_narrow_prior_has_few_hypotheses_about_its_mean():
    prior = DriftPrior(
        log_gain=-0.2, log_gain_sd=0.05, offset_mm=-4.3, offset_sd_mm=0.3, unchanged=0.0
    )
    grid = DriftGrid(prior=prior)
    assert grid.weight.size < DriftGrid().weight.size / 3
    assert grid.drift.aperture_offset_m == pytest.approx(-4.3e-3, abs=1e-4)
    assert grid.drift.gain == pytest.approx(np.exp(-0.2), rel=0.02)
    assert grid.offset_sd_m == pytest.approx(0.3e-3, rel=0.2)
    assert grid.unchanged < 1e-6


def test_a_learnt_spread_reports_only_a_drift_beyond_it():
    grid = DriftGrid(prior=DriftPrior(log_gain_sd=0.05, offset_sd_mm=0.5, unchanged=0.0))
    assert not grid.with_unnamed(evidence(grid, 0.0, 0.1), 0).likely
    for _ in range(20):
        grid = grid.with_unnamed(evidence(grid, 0.0, 1.0), 0)
    assert grid.likely


def test_a_gauge_counts_less_than_its_grasps_by_how_objects_are_placed():
    grid = DriftGrid()
    likelihood = evidence(grid, np.log(0.7), -4.0, (0.02, 0.2))
    sharp, blurred = grid.with_gauge(likelihood, 0.1, 0), grid.with_gauge(likelihood, 2.0, 0)
    assert sharp.drift.aperture_offset_m == pytest.approx(-4e-3, abs=0.3e-3)
    assert blurred.offset_sd_m > 2.0 * sharp.offset_sd_m
    assert blurred.with_gauge(likelihood, 2.0, 0).offset_sd_m < blurred.offset_sd_m


def test_unnamed_grasps_show_a_drift_together_and_are_forgotten_in_time():
    grid = repeated = DriftGrid()
    for _ in range(100):  # the same pose again and again, off as usual
        repeated = repeated.with_unnamed(evidence(grid, 0.1, 1.0, (0.1, 1.0)), 0)
    assert not repeated.likely
    for _ in range(20):
        grid = grid.with_unnamed(evidence(grid, np.log(0.7), -4.0, (0.1, 1.0)), 0)
    assert grid.likely
    assert grid.drift.aperture_offset_m == pytest.approx(-4e-3, abs=0.5e-3)
    for _ in range(80):
        grid = grid.with_unnamed(evidence(grid, 0.0, 0.0, (0.1, 1.0)), 0)
    assert abs(grid.drift.aperture_offset_m) < 1e-3
    assert grid.without_unnamed().weight == pytest.approx(DriftGrid().weight)


def test_it_comes_back_from_arrays_without_what_was_followed():
    grid = DriftGrid().with_gauge(evidence(DriftGrid(), -0.3, 2.0), 0.5, 0)
    again = DriftGrid.from_arrays(grid.with_unnamed(evidence(grid, 0.3, -2.0), 0).to_arrays())
    assert np.array_equal(again.weight, grid.weight)
    assert again.values == grid.values
    with pytest.raises(ValueError, match="shape"):
        DriftGrid.from_arrays({**grid.to_arrays(), "gauged": np.zeros((3, 4))})


# -- The spread between days is learnt from what all objects of a day have in common ---------------


def days(log_gain_sd: float, offset_sd_mm: float, n_days: int) -> tuple[list[Grasp], list[str]]:
    rng = np.random.default_rng(7)
    grasps, groups = [], []
    for day in range(n_days):
        gain = float(np.exp(log_gain_sd * rng.standard_normal()))
        offset_m = 1e-3 * offset_sd_mm * rng.standard_normal()
        drift = Drift(gains=(gain, gain), aperture_offset_m=offset_m)
        grasps += [drift.apply(ramp(label, rng)) for label in SIZES_MM for _ in range(4)]
        groups += [str(day)] * (4 * len(SIZES_MM))
    return grasps, groups


def test_the_spread_that_was_made_is_found() -> None:
    grasps, groups = days(0.15, 1.5, 30)
    prior = learn_spread(grasps, groups)
    assert prior.log_gain_sd == pytest.approx(0.15, rel=0.35)
    assert (prior.offset_sd_mm, prior.unchanged) == (pytest.approx(1.5, rel=0.35), 0.0)


def test_few_days_leave_most_to_the_usual_spread_and_one_day_shows_none() -> None:
    grasps, groups = days(0.0, 0.0, 2)
    assert 1.0 < learn_spread(grasps, groups).offset_sd_mm < DriftPrior().offset_sd_mm
    assert learn_spread(grasps, ["0"] * len(grasps)) is None
    others = [f"{group} {grasp.label}" for group, grasp in zip(groups, grasps, strict=True)]
    apart = [g if g.endswith("ball") else "0" for g in others]
    assert learn_spread(grasps[:12], apart[:12]) is None  # no object on two days


# -- Drift of gain and opening: read, applied, undone, and found by a gauge object -----------------


DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)


@pytest.fixture(scope="module")
def taught(teach):
    return teach("force_ramp")


def test_applied_it_scales_clips_and_moves_and_undone_it_is_gone(fresh):
    grasp = dataclasses.replace(fresh[0], zero=drawn_zero())
    drifted = DRIFT.apply(grasp)
    assert drifted.zero is None
    assert np.array_equal(drifted.counts, np.rint(grasp.counts * 0.7))
    assert drifted.aperture_m == pytest.approx(grasp.aperture_m - 4e-3)
    back = DRIFT.undo(drifted)
    assert np.abs(back.counts.astype(int) - grasp.counts).max() <= 1
    assert back.aperture_m == pytest.approx(grasp.aperture_m)
    assert Drift(gains=(5.0,)).apply(grasp).counts.max() == grasp.pads.adc_max


def test_each_pad_has_a_gain_of_its_own(fresh):
    grasp, drift = fresh[0], Drift(gains=(0.5, 1.5))
    drifted = drift.apply(grasp)
    for pad, gain in enumerate(drift.gains):
        mine = grasp.pads.taxels_of(pad)
        wanted = np.clip(np.rint(grasp.counts[:, mine] * gain), 0, grasp.pads.adc_max)
        assert np.array_equal(drifted.counts[:, mine], wanted)
    assert drift.gain == pytest.approx(np.sqrt(0.75))
    assert drift_text(drift) == "gain 0.50 to 1.50, opening +0.0 mm"
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
def test_a_drift_that_was_not_gauged_costs_little(taught, fresh):
    drifted = [Drift(gains=(0.7,), aperture_offset_m=-1.5e-3).apply(g) for g in fresh]
    assert accuracy(taught, fresh) >= 0.96
    assert accuracy(taught, drifted) >= 0.84


@pytest.mark.slow
def test_a_gauge_object_shows_the_drift_and_the_rest_is_as_before(taught, fresh):
    gauge = [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3]
    corrected = taught.gauge("egg", gauge)
    blind = dataclasses.replace(gauge[0], aperture_m=np.full(gauge[0].n_frames, np.nan))
    assert taught.gauge("egg", [blind, *gauge]).grid.drift == corrected.grid.drift
    grid = corrected.grid
    assert grid.drift.gain == pytest.approx(0.7, rel=0.25)
    assert grid.drift.aperture_offset_m == pytest.approx(-4e-3, abs=2.0 * grid.offset_sd_m)
    both = corrected.gauge("pin", [DRIFT.apply(g) for g in fresh if g.label == "pin"][:3])
    assert both.grid.offset_sd_m < grid.offset_sd_m
    drifted = [a_day_later(DRIFT.apply(g)) for g in fresh]
    assert accuracy(both, drifted) >= 0.96
    assert accuracy(both, drifted) >= accuracy(taught, drifted)
    again = type(taught).from_arrays(both.to_arrays())
    assert np.array_equal(
        again.posterior(drifted[0]).probability, both.posterior(drifted[0]).probability
    )
    assert both.without_gauges().grid.drift == taught.grid.drift


@pytest.mark.slow
def test_grasps_that_nobody_named_show_the_drift(taught, fresh):
    drifted = [a_day_later(DRIFT.apply(g)) for g in fresh]
    followed = taught
    for grasp in drifted[::2]:
        followed = followed.follow(grasp)
    assert followed.grid.likely
    assert followed.grid.n_followed == len(drifted[::2])
    assert followed.grid.drift.aperture_offset_m == pytest.approx(-4e-3, abs=1e-3)
    assert accuracy(followed, drifted[1::2]) >= 0.96
    saved = followed.with_grid(followed.grid.with_unnamed_as_gauge())
    assert type(taught).from_arrays(saved.to_arrays()).grid.drift == followed.grid.drift
    assert type(taught).from_arrays(followed.to_arrays()).grid.drift == taught.grid.drift
    assert not followed.grid.without_unnamed().likely


def test_grasps_without_a_drift_show_none(taught, fresh):
    followed = taught
    for grasp in fresh[:20]:
        followed = followed.follow(a_day_later(grasp))
    assert not followed.grid.likely
    assert followed.grid.unchanged > 0.5


def test_touch_alone_is_gauged_too(teach, fresh):
    touch = teach("force_ramp", use_aperture=False)
    grid = touch.gauge("egg", [DRIFT.apply(g) for g in fresh if g.label == "egg"][:3]).grid
    assert grid.drift.gain == pytest.approx(0.7, rel=0.3)
    assert grid.drift.aperture_offset_m == pytest.approx(0.0, abs=1e-6)


def test_what_cannot_gauge_says_why(taught, fresh):
    with pytest.raises(ValueError, match="bar, block"):
        taught.gauge("ghost", fresh)
    with pytest.raises(ValueError, match="touched both pads"):
        taught.gauge("egg", [])
    with pytest.raises(ValueError, match="touched both pads"):
        taught.gauge("egg", [dataclasses.replace(fresh[0], counts=np.zeros_like(fresh[0].counts))])


# -- Self-zero from made-up frames -----------------------------------------------------------------


PADS = PadArray.grid(12, 5, 3.4e-3)
XY_MM = PADS.taxel_xy_m[PADS.taxels_of(0)] * 1e3
STEP_M = 0.09e-3


def pressed(
    *,
    zero_mm: float = 0.0,
    ratio: float = 1.0,
    gain: float = 1.0,
    per_mm: float = 300.0,
    tilt: tuple[float, float] = (0.0, 0.0),
    bump_mm: float | None = None,
    dead: tuple[int, ...] = (),
    seed: int = 0,
) -> Grasp:
    """Return frames of two pads that press on each other."""
    rng = np.random.default_rng(seed)
    way_mm = np.r_[np.linspace(10.0, 1.5, 20), np.linspace(0.0, -0.6, 50) + 0.05]
    reach_mm = XY_MM @ np.array(tilt)
    if bump_mm is not None:
        reach_mm = np.where(np.hypot(*XY_MM.T) < bump_mm, 0.0, -9.0)
    depth_mm = np.maximum(reach_mm - way_mm[:, None], 0.0)
    depth_mm[:20] = 0.0
    load = gain * per_mm * depth_mm
    counts = 60.0 + np.hstack([load * math.sqrt(ratio), load / math.sqrt(ratio)])
    counts[:, list(dead)] = 60.0
    counts += rng.normal(0.0, 6.0, counts.shape)
    return Grasp(
        pads=PADS,
        counts=np.clip(np.rint(counts), 0, 4095).astype(np.uint16),
        t_s=0.02 * np.arange(len(way_mm)),
        aperture_m=np.round((way_mm + zero_mm) / (1e3 * STEP_M)) * STEP_M,
        force_n=np.r_[np.zeros(20), np.linspace(1.0, 12.0, 50)],
    )


def measured(**changes: Any) -> ZeroMeasurement:
    return measure_zero(pressed(**changes), (0, 1), step_m=STEP_M)


@pytest.mark.parametrize(
    "hand",
    [
        {},
        {"zero_mm": 1.9, "ratio": 1.2},
        {"zero_mm": -3.4, "ratio": 0.8, "tilt": (0.03, 0.0)},
        {"zero_mm": 0.4, "tilt": (-0.02, 0.03), "per_mm": 500.0},
    ],
)
def test_zero_ratio_and_stiffness_are_found_whatever_the_tilt(hand: dict[str, Any]) -> None:
    measurement = measured(**hand)
    zero = measurement.zero
    assert zero.opening_m * 1e3 == pytest.approx(hand.get("zero_mm", 0.0), abs=0.08)
    assert math.exp(zero.log_gain_ratio) == pytest.approx(hand.get("ratio", 1.0), rel=0.03)
    per_mm = hand.get("per_mm", 300.0) * len(XY_MM)
    assert abs(zero.log_stiffness - math.log(per_mm)) < 3.0 * zero.log_stiffness_sd
    assert measurement.tilt_rad == pytest.approx(hand.get("tilt", (0.0, 0.0)), abs=0.006)
    assert measurement.pads_met
    assert measurement.dead == ()


@pytest.mark.parametrize("stands_mm", [-0.04, 0.0, 0.03])
def test_a_finger_that_moves_alone_shows_the_stiffness_by_its_steps(stands_mm: float) -> None:
    """A press of one or two steps, then one finger moves; the other one's reading is off."""
    step_mm, pressing = 0.18, slice(0, 45)
    grasp = pressed(per_mm=500.0)
    way_mm = np.linspace(0.0, -0.35, 60)
    one_mm = 0.5 * step_mm
    read_mm = np.r_[
        np.round(grasp.aperture_m[pressing] * 1e3 / step_mm) * step_mm,
        np.round((way_mm - stands_mm) / one_mm) * one_mm + stands_mm,
    ]
    load = np.full((1, 120), 500.0) * -way_mm[:, None]
    whole = replace(
        grasp,
        counts=np.vstack([grasp.counts[pressing], np.rint(60.0 + load).astype(np.uint16)]),
        t_s=0.02 * np.arange(len(read_mm)),
        aperture_m=1e-3 * read_mm,
        force_n=np.r_[grasp.force_n[pressing], np.full(len(way_mm), 9.0)],
    )
    alone = np.repeat([-1, 0], [45, 60])
    by_steps, by_both = (
        measure_zero(whole, (0, 1), step_m=1e-3 * step_mm, alone=frames).zero
        for frames in (alone, None)
    )
    true = math.log(500.0 * len(XY_MM))
    off, off_by_both = (abs(zero.log_stiffness - true) for zero in (by_steps, by_both))
    assert off < 2.0 * by_steps.log_stiffness_sd
    assert off < 0.7 * off_by_both
    assert by_steps.log_stiffness_sd < 0.9 * by_both.log_stiffness_sd


def test_a_part_between_the_pads_and_dead_taxels_are_found() -> None:
    assert not measured(bump_mm=6.0).pads_met
    assert measured(dead=(7, 70)).dead == (7, 70)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"force_n": np.zeros(70)}, "frames of the ramp"),
        ({"aperture_m": np.full(70, 1e-3)}, "frames of open fingers"),
        ({"counts": np.full((70, 120), 60)}, "shows no load"),
        ({"counts": np.repeat([[10], [90]], [20, 50], axis=0) + np.zeros(120, int)}, "grew by 0%"),
    ],
)
def test_what_shows_no_zero_is_refused(change: dict[str, Any], says: str) -> None:
    grasp = pressed()
    values = {name: getattr(grasp, name) for name in ("pads", "counts", "t_s", "aperture_m")}
    with pytest.raises(ValueError, match=says):
        measure_zero(Grasp(**(values | {"force_n": grasp.force_n} | change)), (0, 1), step_m=STEP_M)


def test_what_has_changed_is_undone_and_the_rest_is_known_so_well() -> None:
    taught, today = (
        measured(**hand).zero for hand in ({}, {"zero_mm": 1.9, "ratio": 1.2, "gain": 0.8})
    )
    drift, prior = since(taught, today, (0, 1), 2), prior_since(taught, today)
    assert drift.aperture_offset_m * 1e3 == pytest.approx(1.9, abs=0.15)
    assert drift.gains[0] / drift.gains[1] == pytest.approx(1.2, rel=0.04)
    assert math.log(drift.gain) == pytest.approx(math.log(0.8), abs=2.0 * prior.log_gain_sd)
    assert prior.offset_sd_mm < 0.3
    assert prior.log_gain_sd < 0.15
    assert since(taught, taught, (0, 1), 2) == Drift(gains=(1.0, 1.0))


def test_counts_of_another_foam_are_compared_by_the_way_if_it_was_measured() -> None:
    taught = replace(measured().zero, log_stiffness_sd=0.05, log_gain_ratio=0.0)
    foam = replace(taught, log_stiffness=taught.log_stiffness + math.log(2.2))
    assert since(taught, foam, (0, 1), 2).gain == pytest.approx(2.2)
    assert prior_since(taught, foam).log_gain_sd == pytest.approx(0.05 * math.sqrt(2.0))
    # Objects look newer on another foam, and the caution allows for it.
    assert foam_odds(taught, taught) > 0.8
    assert foam_odds(taught, foam) == pytest.approx(0.45, abs=0.05)
    drawn = drawn_zero()
    assert since(drawn, foam, (0, 1), 2).gain == 1.0
    assert prior_since(drawn, foam).log_gain_sd == DriftPrior().log_gain_sd


@pytest.mark.parametrize("name", ["opening_m", "log_stiffness_sd"])
def test_a_self_zero_is_finite_and_in_m(name: str) -> None:
    good = measured().zero.values
    assert SelfZero.from_values(good).values == good
    place = ZERO_COLUMNS.index(name)
    for bad in (math.nan, 3.0 if name == "opening_m" else -0.1):
        with pytest.raises(ValueError, match=name):
            SelfZero.from_values([*good[:place], bad, *good[place + 1 :]])


def zero_of(drift: Drift) -> SelfZero:
    """Return the self-zero of a hand with a drift since that of no drift."""
    first, second = drift.gains
    return SelfZero(
        opening_m=1e-3 + drift.aperture_offset_m,
        opening_sd_m=1e-4,
        log_gain_ratio=math.log(first / second),
        log_gain_ratio_sd=0.02,
        log_stiffness=8.0 + math.log(drift.gain),
        log_stiffness_sd=0.2,
    )


NO_DRIFT = zero_of(Drift(gains=(1.0, 1.0)))


def named(taught: Any, grasps: Sequence[Grasp]) -> float:
    """Return the share of grasps that get the name of their object."""
    return float(np.mean([taught.posterior(g).name == g.label for g in grasps]))


@pytest.mark.slow
def test_two_self_zeros_undo_what_has_changed_for_each_grasp(train, fresh) -> None:
    drift = Drift(gains=(0.7, 0.9), aperture_offset_m=-4e-3)
    taught = make_trainer("force_ramp").fit([replace(g, zero=NO_DRIFT) for g in train])
    later = [drift.apply(a_day_later(g)) for g in fresh]
    told = [replace(g, zero=zero_of(drift)) for g in later]

    assert named(taught, told) >= named(taught, [replace(g, zero=NO_DRIFT) for g in fresh]) - 0.05
    assert named(taught, told) > named(taught, later) + 0.1
    again = type(taught).from_arrays(taught.to_arrays())
    before, after = (model.posterior(told[0]).probability for model in (taught, again))
    assert after == pytest.approx(before)
    # Following goes on within one session, and begins anew with another self-zero.
    followed = taught.follow(told[0]).follow(told[1])
    assert followed.grid.n_followed == 2
    # Without its self-zero a grasp is not corrected: what is known after one does not count.
    assert (bare := followed.grid_at(later[2])).prior == DriftPrior()
    assert bare.n_followed == 0
    assert abs(followed.grid.drift.aperture_offset_m) < 0.3e-3
    assert (
        followed.follow(replace(told[2], zero=zero_of(Drift(gains=(0.8, 0.8))))).grid.n_followed
        == 1
    )


@pytest.mark.slow
def test_grasps_of_several_sessions_teach_as_of_one(train, fresh) -> None:
    drift = Drift(gains=(0.8, 0.9), aperture_offset_m=2e-3)
    half = [
        replace(g, zero=NO_DRIFT) if i % 2 else replace(drift.apply(g), zero=zero_of(drift))
        for i, g in enumerate(train)
    ]
    taught = make_trainer("force_ramp").fit(half)
    assert named(taught, [replace(g, zero=NO_DRIFT) for g in fresh]) > 0.8


@pytest.mark.slow
def test_a_self_zero_ties_the_opening_of_what_was_taught_from_drawings(train, fresh) -> None:
    drawn = [replace(g, zero=drawn_zero(NO_DRIFT.opening_m), thickness_m=8e-3) for g in train]
    taught = make_trainer("force_ramp").fit(drawn)
    drift = Drift(gains=(1.0, 1.0), aperture_offset_m=-3e-3)
    later = [drift.apply(a_day_later(g)) for g in fresh]
    told = [replace(g, zero=zero_of(drift)) for g in later]

    assert named(taught, told) > named(taught, later) + 0.1
    grid = taught.grid_at(told[0])
    assert grid.offset_sd_m < 0.2e-3
    # Nothing is known of the gain that both pads have in common.
    assert (grid.prior.log_gain_sd, grid.prior.log_gain) == (pytest.approx(0.25, abs=0.01), 0.0)
    # A drawn thickness is compared as the opening reads today.
    assert taught.posterior(told[0]).drawn_m == pytest.approx((5e-3,), abs=2e-4)


@pytest.mark.slow
def test_what_was_taught_without_a_self_zero_leaves_all_without(train, fresh) -> None:
    two = [g for g in train if g.label in ("bar", "egg")][::2]
    zeroed = [replace(g, zero=NO_DRIFT) for g in two]
    newer = [replace(g, zero=drawn_zero(), source=DRAWING_SOURCE, start_ms=2**40) for g in two]
    assert make_trainer("force_ramp").fit([*zeroed, *newer]).zero == NO_DRIFT
    some = make_trainer("force_ramp").fit([*two[:1], *zeroed[1:]])
    assert some.zero is None
    assert some.grid_at(replace(fresh[0], zero=NO_DRIFT)) is some.grid
    # Gauges without a self-zero count for a shift; what was followed goes on.
    gauged = some.gauge("bar", [g for g in fresh if g.label == "bar"][:2]).follow(fresh[0])
    late = replace(fresh[0], start_ms=fresh[0].start_ms + 13 * 3_600_000)
    assert (gauged.grid.n_gauged, gauged.grid_at(fresh[1])) == (1, gauged.grid)
    assert (gauged.grid_at(late).gauged.any(), gauged.grid_at(late).n_followed) == (False, 1)
