"""Frames -> load above rest, touch and levels."""

import dataclasses

import numpy as np
import pytest

from recognition.features import aperture_features, describe_footprint, growth_features, pad_grid
from recognition.ramp.ramp import (
    LOAD_FRACTIONS,
    Rest,
    find_ramp,
    held_part,
    learn_rest,
    load_levels,
)
from tests.recognition.conftest import OBJECTS, make_grasp, make_grasps, part
from tests.values import make_pads


@pytest.fixture
def rest(train) -> Rest:
    return learn_rest(train)


def test_the_pads_that_rise_are_the_gripping_ones():
    pads = make_pads(shapes=((4, 4), (10, 6), (6, 2), (10, 6)), adc_max=255)
    rest = learn_rest(make_grasps(3, seed=3, pads=pads, gripping=(1, 3), noise_counts=16.0))
    assert rest.gripping == (1, 3)
    assert rest.noise_counts == pytest.approx([4.5, 4.5], abs=1.5)


def test_each_finger_that_is_pressed_grips_and_two_of_them_are_a_touch():
    pads = make_pads(shapes=((4, 3),) * 5)
    bar, block = OBJECTS[:2]
    taught = make_grasps(3, seed=3, pads=pads, objects=[bar], gripping=(0, 1), noise_counts=8.0)
    taught += make_grasps(3, seed=4, pads=pads, objects=[block], gripping=(0, 3), noise_counts=8.0)
    taught += make_grasps(3, seed=5, pads=pads, objects=[block], gripping=(1, 3), noise_counts=8.0)
    rest = learn_rest(taught)
    assert rest.gripping == (0, 1, 3)
    for grasp in taught:
        ramp = find_ramp(grasp, rest)
        assert ramp.touched
        assert np.count_nonzero(ramp.touch == grasp.n_frames) == 1
        assert abs(ramp.start - 8) <= 4
    alone = make_grasp(bar, np.random.default_rng(6), pads=pads, gripping=(1,))
    assert not find_ramp(alone, rest).touched


def test_a_rest_above_all_frames_cuts_nothing_off():
    pads = make_pads(shapes=((4, 3),) * 3)
    rest = learn_rest(make_grasps(3, seed=3, pads=pads, gripping=(0, 1, 2)))
    rest.counts[pads.taxels_of(2)] += 20_000.0
    loaded = part(make_grasp(OBJECTS[0], np.random.default_rng(6), pads=pads), np.arange(-5, 0))
    ramp = find_ramp(loaded, rest)
    assert ramp.touched
    assert ramp.load.sum(axis=1).max() < 0.0
    assert held_part(loaded, rest)[0] is loaded


def test_touch_is_the_first_frame_of_the_lasting_contact(pads, train):
    ramp = find_ramp(train[0], learn_rest(train))
    assert ramp.touched
    assert ramp.start == pytest.approx(9, abs=2)
    counts = train[0].counts.copy()
    counts[4, :10] = 400
    brushed = dataclasses.replace(train[0], counts=counts)
    assert find_ramp(brushed, learn_rest(train)).start == pytest.approx(9, abs=2)


def test_noise_alone_is_not_touched():
    grasps = make_grasps(3, seed=4, pads=make_pads(adc_max=255), noise_counts=20.0)
    rest = learn_rest(grasps)
    # Of a slow sensor most of the first frames are loaded.
    slow = learn_rest([part(g, slice(5, None, 3)) for g in grasps])
    assert slow.noise_counts == pytest.approx(rest.noise_counts, rel=0.15)
    rng = np.random.default_rng(0)
    noise = np.clip(np.abs(rng.normal(0, 10, grasps[0].counts.shape)), 1, 20).astype(np.uint16)
    assert not find_ramp(dataclasses.replace(grasps[0], counts=noise), rest).touched


def test_a_grasp_that_begins_loaded_is_taken_against_the_taught_rest(train):
    rest, whole = learn_rest(train), train[0]
    ramp = find_ramp(part(whole, slice(20, None)), rest)
    assert ramp.start == 0
    assert ramp.load[-1] == pytest.approx(find_ramp(whole, rest).load[-1], rel=1e-6)


def test_levels_are_fractions_of_the_full_load(train):
    levels = load_levels(train, learn_rest(train))
    assert len(levels) == len(train)
    total = sum(m.sum(axis=2) for m in levels.maps)
    assert total / total[:, -1:] == pytest.approx(
        np.broadcast_to(LOAD_FRACTIONS, total.shape), rel=0.15
    )
    assert np.all(np.diff(levels.level_time_s, axis=1) >= 0)
    assert levels.noise == pytest.approx(0.0)


def test_a_ramp_of_a_cell_has_the_same_levels_at_any_rate(train):
    """A cell stops at the contact, and its command begins there: rates change the time alone."""
    rest, whole = learn_rest(train), train[0]
    before = 12  # the command begins when the ramp has pressed for four frames: a heavy touch
    command_n = np.r_[np.zeros(before), np.linspace(0.5, 6.0, whole.n_frames - before)]
    at_once = dataclasses.replace(whole, force_n=command_n, source="cell one")
    frames = np.r_[0:before, np.repeat(np.arange(before, whole.n_frames), 4)]
    fast, slowly = (load_levels([g], rest) for g in (at_once, part(at_once, frames)))
    assert fast.touch_aperture_mm == pytest.approx(1e3 * whole.aperture_m[before])
    assert slowly.touch_aperture_mm == pytest.approx(fast.touch_aperture_mm)
    grids = [pad_grid(whole.pads, pad) for pad in rest.gripping]
    of_growth, of_opening = [], []
    for levels in (fast, slowly):
        prints = [
            describe_footprint(maps, levels.noise[..., pad], grid)
            for pad, (maps, grid) in enumerate(zip(levels.maps, grids, strict=True))
        ]
        of_growth.append(growth_features(levels, prints))
        of_opening.append(aperture_features(levels))
    for one, other in (of_growth, of_opening):
        assert other == pytest.approx(one, abs=0.1)
    # The command of another hand may begin before it touches.
    elsewhere = load_levels([dataclasses.replace(at_once, source="")], rest)
    assert elsewhere.touch_aperture_mm[0, 0] > fast.touch_aperture_mm[0, 0]


def test_gaps_in_the_opening_are_bridged_and_a_missing_one_stays_missing(rest, train):
    holes = train[0].aperture_m.copy()
    holes[::4] = np.nan
    bridged = load_levels([dataclasses.replace(train[0], aperture_m=holes)], rest)
    assert bridged.aperture_mm == pytest.approx(load_levels(train[:1], rest).aperture_mm, abs=0.2)
    forces_n = np.append(np.where(np.isnan(holes), np.nan, 4.0)[1:], np.nan)
    commanded = load_levels([dataclasses.replace(train[0], force_n=forces_n)], rest)
    assert not commanded.level_time_s.any()
    none = dataclasses.replace(train[0], aperture_m=np.full_like(holes, np.nan))
    assert np.all(np.isnan(load_levels([none], rest).aperture_mm))


def test_rest_refuses_what_it_cannot_learn_from(train):
    with pytest.raises(ValueError, match="no grasps"):
        learn_rest([])
    with pytest.raises(ValueError, match=r"5 frames in the median, at least 6 .* from rest"):
        learn_rest([part(grasp, slice(5)) for grasp in train[:3]])
    other = make_grasps(1, seed=0, pads=make_pads(shapes=((8, 6), (8, 6))))
    with pytest.raises(ValueError, match="different pads"):
        learn_rest([*train, *other])
    with pytest.raises(ValueError, match="teach on these pads"):
        find_ramp(other[0], learn_rest(train))


def test_a_drift_of_all_taxels_is_no_load_however_large():
    grasps = make_grasps(3, seed=4, pads=make_pads(adc_max=255), noise_counts=16.0)
    rest = learn_rest(grasps)
    whole = find_ramp(grasps[0], rest)
    lifted = dataclasses.replace(grasps[0], counts=np.minimum(grasps[0].counts + 25, 255))
    shifted = find_ramp(lifted, rest)
    assert shifted.start == whole.start
    assert shifted.load[-5:].mean() == pytest.approx(whole.load[-5:].mean(), rel=0.1)


def test_what_follows_the_release_is_left_out(train):
    rest, whole = learn_rest(train), train[0]
    n = whole.n_frames
    assert held_part(whole, rest)[0] is whole
    let_go = part(whole, np.r_[0:n, n - 1 : -1 : -1])
    held, _ = held_part(let_go, rest)
    assert n - 2 <= held.n_frames <= n + n // 4
    before, after = (load_levels([g], rest) for g in (whole, let_go))
    for one, other in zip(before.maps, after.maps, strict=True):
        assert other[0, -1] == pytest.approx(one[0, -1], abs=0.1 * one.max())
    turned = [part(g, np.r_[0:n, n - 1 : -1 : -1]) for g in train]
    assert learn_rest(turned).gripping == rest.gripping


def test_a_spike_of_one_frame_is_no_load(rest, train):
    counts = train[0].counts.copy()
    counts[25, 3] = train[0].pads.adc_max
    counts[30, 40] = counts[0, 5:60] = counts[-1, 20] = counts[1, 2] = counts[-2, 21] = train[
        0
    ].pads.adc_max
    spiky = find_ramp(dataclasses.replace(train[0], counts=counts), rest)
    clean = find_ramp(train[0], rest)
    assert spiky.start == clean.start
    assert np.abs(spiky.load - clean.load).max() < 0.2 * train[0].pads.adc_max


def test_a_taxel_that_sticks_reads_as_those_beside_it():
    pads = make_pads(shapes=((10, 6), (10, 6)), adc_max=255)
    grasps = make_grasps(3, seed=3, pads=pads, noise_counts=16.0)
    rest = learn_rest(grasps)
    clean = find_ramp(grasps[0], rest)
    top = int(np.argmax(clean.rise[0][-5:].mean(axis=0)))
    counts = grasps[0].counts.copy()
    counts[:, [0, top]] = 254 + np.arange(len(counts))[:, None] % 2
    ramp = find_ramp(dataclasses.replace(grasps[0], counts=counts), rest)
    assert ramp.start == clean.start
    assert abs(ramp.rise[0][-5:, 0].mean()) < 12
    row, column = divmod(top, 6)
    neighbours = [
        r * 6 + c
        for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        if 0 <= r < 10 and 0 <= c < 6
    ]
    assert ramp.rise[0][:, top] == pytest.approx(ramp.rise[0][:, neighbours].mean(axis=1))


def test_a_load_that_is_held_all_the_time_is_not_stuck(train):
    rest, whole = learn_rest(train), train[0]
    assert find_ramp(part(whole, np.full(20, whole.n_frames - 1)), rest).load[-1] == pytest.approx(
        (whole.counts[-1] - rest.counts).reshape(2, -1).sum(axis=1)
    )
