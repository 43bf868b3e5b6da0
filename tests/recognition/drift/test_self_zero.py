"""Self-zero from made-up frames: what is found, what has changed between two, what is no zero."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recognition.drift.drift import Drift
from recognition.drift.self_zero import (
    ZeroMeasurement,
    anchored,
    drawn_zero,
    foam_change,
    foam_odds,
    measure_zero,
    prior_since,
    since,
)
from recognition.evaluation.splits import a_day_later
from recognition.grasp import DRAWING_SOURCE, ZERO_COLUMNS, Grasp, PadArray, SelfZero
from recognition.recognizers import make_trainer

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
) -> tuple[Grasp, np.ndarray]:
    """Return frames of two pads that press on each other, and the force by their law at each."""
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
    aperture_mm = np.round((way_mm + zero_mm) / (1e3 * STEP_M)) * 1e3 * STEP_M
    grasp = Grasp(
        pads=PADS,
        counts=np.clip(np.rint(counts), 0, 4095).astype(np.uint16),
        t_s=0.02 * np.arange(len(way_mm)),
        aperture_m=1e-3 * aperture_mm,
        force_n=np.r_[np.zeros(20), np.linspace(1.0, 12.0, 50)],
    )
    return grasp, 0.1 + per_mm * depth_mm.sum(axis=1) / 2e4


def measured(**changes: Any) -> ZeroMeasurement:
    grasp, pads_n = pressed(**changes)
    return measure_zero(grasp, pads_n, (0, 1), step_m=STEP_M)


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
    found = measured(**hand)
    zero = found.zero
    assert zero.opening_m * 1e3 == pytest.approx(hand.get("zero_mm", 0.0), abs=0.08)
    assert math.exp(zero.log_gain_ratio) == pytest.approx(hand.get("ratio", 1.0), rel=0.03)
    per_mm = hand.get("per_mm", 300.0) * len(XY_MM)
    assert abs(zero.log_stiffness - math.log(per_mm)) < 3.0 * zero.log_stiffness_sd
    assert found.tilt_rad == pytest.approx(hand.get("tilt", (0.0, 0.0)), abs=0.006)
    assert found.pads_met
    assert found.dead == ()


@pytest.mark.parametrize("stands_mm", [-0.04, 0.0, 0.03])
def test_a_finger_that_moves_alone_shows_the_stiffness_by_its_steps(stands_mm: float) -> None:
    """A press of one or two steps, then one finger moves; the other one's reading is off."""
    step_mm, pressing = 0.18, slice(0, 45)
    grasp, pads_n = pressed(per_mm=500.0)
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
    pads_n = np.r_[pads_n[pressing], load.sum(axis=1) / 2e4]
    alone = np.repeat([-1, 0], [45, 60])
    by_steps, by_both = (
        measure_zero(whole, pads_n, (0, 1), step_m=1e-3 * step_mm, alone=frames).zero
        for frames in (alone, None)
    )
    true = math.log(500.0 * len(XY_MM))
    off, off_by_both = (abs(zero.log_stiffness - true) for zero in (by_steps, by_both))
    assert off < 2.0 * by_steps.log_stiffness_sd
    assert off < 0.7 * off_by_both
    assert by_steps.log_stiffness_sd < 0.9 * by_both.log_stiffness_sd


def test_a_part_between_the_pads_has_another_footprint() -> None:
    assert not measured(bump_mm=6.0).pads_met


def test_dead_taxels_are_named() -> None:
    assert measured(dead=(7, 70)).dead == (7, 70)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"force_n": np.zeros(70)}, "frames of the ramp"),
        ({"aperture_m": np.full(70, 1e-3)}, "frames of open fingers"),
        ({"counts": np.full((70, 120), 60)}, "shows no load"),
    ],
)
def test_what_shows_no_zero_is_refused(change: dict[str, Any], says: str) -> None:
    grasp, pads_n = pressed()
    values = {name: getattr(grasp, name) for name in ("pads", "counts", "t_s", "aperture_m")}
    with pytest.raises(ValueError, match=says):
        measure_zero(
            Grasp(**(values | {"force_n": grasp.force_n} | change)), pads_n, (0, 1), step_m=STEP_M
        )


def test_what_has_changed_is_undone_and_the_rest_is_known_so_well() -> None:
    taught, today = (
        measured(**hand).zero for hand in ({}, {"zero_mm": 1.9, "ratio": 1.2, "gain": 0.8})
    )
    drift, prior = since(taught, today, (0, 1), 2), prior_since(taught, today)
    assert drift.aperture_offset_m * 1e3 == pytest.approx(1.9, abs=0.15)
    assert drift.gains[0] / drift.gains[1] == pytest.approx(1.2, rel=0.04)
    assert math.log(drift.gain) == pytest.approx(math.log(0.8), abs=2.0 * prior.log_gain_sd)
    assert prior.offset_sd_mm < 0.3
    assert prior.log_gain_sd < 0.12
    assert since(taught, taught, (0, 1), 2) == Drift(gains=(1.0, 1.0))


def test_a_gain_that_the_law_of_the_pads_hides_comes_from_the_motor_constants() -> None:
    today = measured(gain=0.8)
    assert today.zero.log_scale == pytest.approx(
        measured().zero.log_scale + math.log(0.8), abs=0.01
    )
    by_law = replace(today, zero=measured().zero)
    found = anchored(by_law, 30.0, math.log(0.8), 0.07).zero
    assert found.log_scale == pytest.approx(by_law.zero.log_scale + math.log(0.8 * 30.0))
    assert found.log_scale_sd == pytest.approx(math.hypot(by_law.zero.log_scale_sd, 0.07))
    unknown = anchored(by_law, 30.0, 0.0, math.inf).zero
    assert unknown.log_scale_sd == 100.0
    assert foam_change(found, replace(unknown, log_stiffness=9.0 + found.log_stiffness)) is None


def test_another_foam_is_told_from_another_gain_and_makes_objects_look_newer() -> None:
    taught = replace(measured().zero, log_scale_sd=0.04, log_stiffness_sd=0.05, log_gain_ratio=0.0)
    gain = replace(
        taught, log_scale=taught.log_scale - 0.5, log_stiffness=taught.log_stiffness - 0.5
    )
    foam = replace(taught, log_stiffness=taught.log_stiffness + math.log(2.2))
    for today in (taught, gain):
        assert foam_change(taught, today) is None
        assert foam_odds(taught, today) > 0.8
    assert foam_change(taught, foam) == pytest.approx(2.2)
    assert foam_odds(taught, foam) == pytest.approx(0.4, abs=0.05)
    # Counts are compared by the way: the same footprint has 2.2 times the counts.
    assert since(taught, foam, (0, 1), 2).gain == pytest.approx(2.2, rel=0.05)
    assert since(taught, gain, (0, 1), 2).gain == pytest.approx(math.exp(-0.5), rel=0.05)


@pytest.mark.parametrize("name", ["opening_m", "log_scale_sd"])
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
    gain = math.log(drift.gain)
    return SelfZero(
        opening_m=1e-3 + drift.aperture_offset_m,
        opening_sd_m=1e-4,
        log_gain_ratio=math.log(first / second),
        log_gain_ratio_sd=0.02,
        log_scale=8.0 + gain,
        log_scale_sd=0.07,
        log_stiffness=8.0 + gain,
        log_stiffness_sd=0.2,
    )


def named(taught: Any, grasps: Sequence[Grasp]) -> float:
    """Return the share of grasps that get the name of their object."""
    return float(np.mean([taught.posterior(g).name == g.label for g in grasps]))


@pytest.mark.slow
def test_two_self_zeros_undo_what_has_changed_for_each_grasp(train, fresh) -> None:
    drift, none = Drift(gains=(0.7, 0.9), aperture_offset_m=-4e-3), Drift(gains=(1.0, 1.0))
    taught = make_trainer("force_ramp").fit([replace(g, zero=zero_of(none)) for g in train])
    later = [drift.apply(a_day_later(g)) for g in fresh]
    told = [replace(g, zero=zero_of(drift)) for g in later]

    undrifted = [replace(g, zero=zero_of(none)) for g in fresh]
    assert named(taught, told) >= named(taught, undrifted) - 0.05
    assert named(taught, told) > named(taught, later) + 0.1
    again = type(taught).from_arrays(taught.to_arrays())
    assert again.posterior(told[0]).probability == pytest.approx(
        taught.posterior(told[0]).probability
    )
    # Following goes on within one session, and begins anew with another self-zero.
    followed = taught.follow(told[0]).follow(told[1])
    assert followed.grid.n_followed == 2
    assert abs(followed.grid.drift.aperture_offset_m) < 0.3e-3
    assert (
        followed.follow(replace(told[2], zero=zero_of(Drift(gains=(0.8, 0.8))))).grid.n_followed
        == 1
    )


@pytest.mark.slow
def test_grasps_of_several_sessions_teach_as_of_one(train, fresh) -> None:
    drift, none = Drift(gains=(0.8, 0.9), aperture_offset_m=2e-3), Drift(gains=(1.0, 1.0))
    half = [
        replace(g, zero=zero_of(none)) if i % 2 else replace(drift.apply(g), zero=zero_of(drift))
        for i, g in enumerate(train)
    ]
    taught = make_trainer("force_ramp").fit(half)
    told = [replace(g, zero=zero_of(none)) for g in fresh]
    assert named(taught, told) > 0.8


@pytest.mark.slow
def test_a_self_zero_ties_the_opening_of_what_was_taught_from_drawings(train, fresh) -> None:
    nominal_m = zero_of(Drift(gains=(1.0, 1.0))).opening_m
    drawn = [replace(g, zero=drawn_zero(nominal_m), thickness_m=8e-3) for g in train]
    taught = make_trainer("force_ramp").fit(drawn)
    drift = Drift(gains=(1.0, 1.0), aperture_offset_m=-3e-3)
    later = [drift.apply(a_day_later(g)) for g in fresh]
    told = [replace(g, zero=zero_of(drift)) for g in later]

    assert named(taught, told) > named(taught, later) + 0.1
    grid = taught.grid_at(told[0])
    assert grid.offset_sd_m < 0.2e-3
    # Nothing is known of the gain that both pads have in common.
    assert grid.prior.log_gain_sd == pytest.approx(0.25, abs=0.01)
    assert grid.prior.log_gain == 0.0
    # A drawn thickness is compared as the opening reads today.
    assert taught.posterior(told[0]).drawn_m == pytest.approx((5e-3,), abs=2e-4)


@pytest.mark.slow
def test_within_the_hour_nothing_has_changed_since_one_self_zero(train, fresh) -> None:
    zero = zero_of(Drift(gains=(1.0, 1.0)))
    soon = [replace(g, start_ms=train[0].start_ms) for g in fresh]
    plain = make_trainer("force_ramp").fit(train)
    taught = make_trainer("force_ramp").fit([replace(g, zero=zero) for g in train])
    for grasp in soon[::4]:
        found, expected = taught.posterior(replace(grasp, zero=zero)), plain.posterior(grasp)
        assert found.probability == pytest.approx(expected.probability, abs=0.02)
        assert found.unknown == pytest.approx(expected.unknown, abs=0.05)


@pytest.mark.slow
def test_what_was_taught_without_a_self_zero_leaves_all_without(train, fresh) -> None:
    zeroed = [replace(g, zero=zero_of(Drift(gains=(1.0, 1.0)))) for g in train]
    measured = zeroed[0].zero
    newer = [replace(g, zero=drawn_zero(), source=DRAWING_SOURCE, start_ms=2**40) for g in train]
    assert make_trainer("force_ramp").fit([*zeroed, *newer]).zero == measured
    some = make_trainer("force_ramp").fit([*train[:1], *zeroed[1:]])
    assert some.zero is None
    assert some.grid_at(replace(fresh[0], zero=measured)) is some.grid
