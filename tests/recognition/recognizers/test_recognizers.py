"""All recognizers that are taught: right answers, strange grasps, odd input, back from arrays."""

import dataclasses

import numpy as np
import pytest

from recognition.drift.drift import Drift, DriftGrid, DriftPrior
from recognition.evaluation.splits import a_day_later
from recognition.features import pad_grid
from recognition.grasp import Grasp
from recognition.ramp.ramp import load_levels
from recognition.recognizer import DEPENDENCE, UNKNOWN
from recognition.recognizers import DEFAULT_TRAINER, make_trainer, trainer_names
from recognition.recognizers.force_ramp.view import _Teaching, describe, even_in_time
from tests.marks import LONG
from tests.recognition.conftest import OBJECTS, accuracy, make_grasps, part
from tests.values import make_pads


@pytest.fixture(scope="module")
def taught(teach):
    return teach("force_ramp")


def test_the_default_trainer_alone_uses_the_opening_and_an_unknown_one_is_refused():
    uses = {name: make_trainer(name).uses_aperture for name in trainer_names()}
    assert uses == {DEFAULT_TRAINER: True, "level_check": False}
    with pytest.raises(ValueError, match="force_ramp"):
        make_trainer("oracle")


def test_fresh_grasps_are_named_and_known(taught, fresh):
    assert taught.labels == ("bar", "block", "disc", "egg", "pin")
    assert accuracy(taught, fresh) >= 0.96
    assert np.mean([taught.posterior(g).unknown > 0.5 for g in fresh]) <= 0.3


@pytest.mark.slow
def test_touch_alone_names_most_and_does_not_look_at_the_opening(teach, fresh):
    blind = teach("force_ramp", use_aperture=False)
    assert accuracy(blind, fresh) >= 0.8
    moved = dataclasses.replace(fresh[0], aperture_m=fresh[0].aperture_m * 2 + 0.03)
    assert np.array_equal(blind.posterior(moved).probability, blind.posterior(fresh[0]).probability)


@pytest.mark.slow
def test_8_bit_pads_among_others_with_one_sided_noise():
    pads = make_pads(shapes=((12, 4), (12, 4), (6, 2), (12, 4)), adc_max=255)
    options = {"pads": pads, "gripping": (0, 3), "noise_counts": 20.0, "n_ramp": 60}
    recognizer = make_trainer("force_ramp").fit(make_grasps(8, seed=5, **options))
    assert accuracy(recognizer, make_grasps(4, seed=6, **options)) >= 0.95


@pytest.mark.slow
def test_a_hand_of_five_fingers_of_which_an_object_presses_two():
    pads = make_pads(shapes=((4, 3),) * 5)
    bar, block, *_ = OBJECTS
    held = ((bar, "thumb", (0, 1)), (bar, "palm", (0, 3)), (block, "thumb", (1, 3)))

    def grasps(n: int, seed: int) -> list[Grasp]:
        return [
            dataclasses.replace(grasp, label=f"{grasp.label} {how}")
            for made, how, gripping in held
            for grasp in make_grasps(n, seed=seed, pads=pads, objects=[made], gripping=gripping)
        ]

    assert accuracy(make_trainer("force_ramp").fit(grasps(8, seed=5)), grasps(4, seed=6)) == 1.0


def test_a_grasp_without_contact_is_unknown(taught, fresh):
    empty = dataclasses.replace(fresh[0], counts=np.zeros_like(fresh[0].counts))
    answer = taught.posterior(empty)
    assert (answer.name, answer.name_probability, answer.unknown) == (UNKNOWN, 1.0, 1.0)
    assert np.ptp(answer.probability) == 0.0


@pytest.mark.parametrize(
    "frames", [slice(0, 1), slice(-1, None), slice(-2, None), slice(0, 3), slice(0, 12)]
)
def test_short_grasps_get_an_answer(taught, fresh, frames):
    for grasp in fresh[::5]:
        assert taught.posterior(part(grasp, frames)).probability.sum() == pytest.approx(1.0)


def test_odd_frames_get_an_answer(taught, fresh):
    grasp = fresh[0]
    full = np.full_like(grasp.counts, grasp.pads.adc_max)
    dead = grasp.counts.copy()
    dead[:, 25:32] = 0
    one_pad = grasp.counts.copy()
    one_pad[:, 60:] = 0
    one_taxel = np.zeros_like(grasp.counts)
    one_taxel[5:, [0, 60]] = grasp.pads.adc_max
    blind = dataclasses.replace(grasp, aperture_m=np.full_like(grasp.aperture_m, np.nan))
    still = dataclasses.replace(grasp, t_s=np.zeros_like(grasp.t_s))
    falling = grasp.counts[::-1].copy()
    odd = [
        dataclasses.replace(grasp, counts=counts)
        for counts in (full, dead, one_pad, one_taxel, falling)
    ]
    for one in (blind, still, *odd):
        assert taught.posterior(one).probability.sum() == pytest.approx(1.0)


@pytest.mark.slow
def test_grasps_and_those_that_teach_may_lack_the_opening(taught, train, fresh):
    blind, blind_train = (
        [dataclasses.replace(g, aperture_m=np.full_like(g.aperture_m, np.nan)) for g in grasps]
        for grasps in (fresh, train)
    )
    assert accuracy(taught, blind) >= 0.8
    assert accuracy(make_trainer("force_ramp").fit(blind_train), fresh) >= 0.8


def test_too_few_grasps_of_an_object_are_refused(train):
    with pytest.raises(ValueError, match="at least 3"):
        make_trainer("force_ramp").fit(train[::8])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "taught"),
    [(6, ("pin",)), LONG(6, ("block", "pin")), LONG(6, ("bar", "pin")), (3, ("bar", "disc"))],
)
def test_few_grasps_of_few_objects_name_no_other_one(pads, fresh, n, taught):
    few = [g for g in make_grasps(n, seed=3, pads=pads) if g.label in taught]
    recognizer = make_trainer("force_ramp").fit(few)
    names = [(g.label, recognizer.posterior(g).name) for g in fresh]
    assert np.mean([name == label for label, name in names if label in taught]) >= 0.7
    assert np.mean([name != UNKNOWN for label, name in names if label not in taught]) <= 0.1


@pytest.mark.slow
def test_taught_again_with_a_grasp_that_missed_it_gives_the_same(taught, train, fresh):
    missed = dataclasses.replace(train[0], counts=np.zeros_like(train[0].counts))
    again = make_trainer("force_ramp").fit([missed, *train]).posterior(fresh[7])
    assert np.array_equal(again.probability, taught.posterior(fresh[7]).probability)


def test_an_object_whose_grasps_all_missed_is_named(train):
    lost = [dataclasses.replace(g, counts=np.zeros_like(g.counts)) for g in train[:2]]
    lost = [dataclasses.replace(g, label="ghost") for g in lost]
    with pytest.raises(ValueError, match="ghost"):
        make_trainer("force_ramp").fit([*train, *lost])


@pytest.mark.slow
@pytest.mark.parametrize("use_aperture", [True, False])
def test_recognizer_comes_back_from_its_arrays(teach, fresh, use_aperture):
    taught = teach("force_ramp", use_aperture=use_aperture)
    arrays = taught.to_arrays()
    assert all(np.asarray(a).dtype.kind in "biufU" for a in arrays.values())
    again = type(taught).from_arrays(arrays)
    for grasp in fresh[::4]:
        a, b = taught.posterior(grasp), again.posterior(grasp)
        assert np.array_equal(a.probability, b.probability)
        assert a.unknown == b.unknown
    with pytest.raises(ValueError, match="rest_gripping"):
        type(taught).from_arrays({k: a for k, a in arrays.items() if k != "rest_gripping"})
    with pytest.raises(ValueError, match=r"labels|cannot reshape"):
        type(taught).from_arrays(arrays | {"labels": arrays["labels"][:-1]})
    with pytest.raises(ValueError, match=r"version 0.*train again"):
        type(taught).from_arrays(arrays | {"version": np.array(0)})


@pytest.mark.slow
def test_within_an_hour_on_the_cell_that_taught_nothing_has_drifted(train, fresh):
    def taken(grasps, source):
        return [dataclasses.replace(g, source=source) for g in grasps]

    taught = make_trainer("force_ramp").fit(taken(train, "cell one"))
    taught = type(taught).from_arrays(taught.to_arrays())
    drift = Drift(aperture_offset_m=-3e-3)
    (here,), (there,) = (taken([drift.apply(fresh[0])], cell) for cell in ("cell one", "cell two"))
    soon, elsewhere = taught.posterior(here), taught.posterior(there)
    later = taught.posterior(a_day_later(here))
    assert soon.unknown > later.unknown == elsewhere.unknown
    # All grasps there have the same unknown zero: several show no more than one.
    assert soon.dependence == DEPENDENCE
    assert later.dependence == elsewhere.dependence > 0.9
    # Some objects were taught on another day: the zero may have moved since.
    own = np.array(taught.labels) == fresh[0].label
    for old in (own, ~own):
        older = dataclasses.replace(taught, taught_ms=taught.taught_ms - 2 * 86_400_000 * old)
        assert later.unknown < older.posterior(here).unknown < soon.unknown
    told = taught.with_grid(DriftGrid(prior=DriftPrior(offset_mm=-3.0, offset_sd_mm=0.2)))
    assert told.posterior(here).best == fresh[0].label
    assert told.posterior(here).unknown < 0.5


@pytest.mark.slow
def test_objects_that_only_their_size_tells_apart_have_no_name_on_another_day(pads):
    _, _, disc, egg, pin = OBJECTS
    objects = (disc, dataclasses.replace(disc, label="thicker", opening_mm=23.0), egg, pin)
    taught = make_trainer("force_ramp").fit(make_grasps(10, seed=1, pads=pads, objects=objects))
    grasps = make_grasps(5, seed=2, pads=pads, objects=objects)
    drifts = [Drift(aperture_offset_m=mm * 1e-3) for mm in (-3.0, -1.0, 0.0, 1.0, 3.0)]
    later = [a_day_later(drift.apply(grasp)) for drift in drifts for grasp in grasps]
    names = [(taught.posterior(grasp).name, grasp.label) for grasp in later]
    wrong = sum(name not in (label, UNKNOWN) for name, label in names)
    alike, others = (
        np.mean([name != UNKNOWN for name, label in names if (label in ("egg", "pin")) is apart])
        for apart in (False, True)
    )
    assert wrong <= 0.05 * len(names)
    assert others > alike + 0.2
    assert all(taught.posterior(grasp).name == grasp.label for grasp in grasps)
    # A week later one of them alone is taught again: the others do not have its zero.
    for number in (1, 2):
        week_ms = 604_800_000 * (np.arange(4) == number)
        again = dataclasses.replace(taught, taught_ms=taught.taught_ms + week_ms)
        asked = [g for g in grasps if g.label != taught.labels[number]]
        drifted = [drift.apply(grasp) for drift in drifts[::4] for grasp in asked]
        today = [dataclasses.replace(grasp, start_ms=604_860_000) for grasp in drifted]
        names = [(again.posterior(grasp).name, grasp.label) for grasp in today]
        assert sum(name not in (label, UNKNOWN) for name, label in names) <= 5


@pytest.mark.slow
def test_a_size_between_two_taught_ones_is_no_taught_object(train, fresh):
    few = [g for label in ("egg", "pin") for g in [g for g in train if g.label == label][:6]]
    taught = make_trainer("force_ramp").fit(few)
    known = [g for g in fresh if g.label in taught.labels]
    assert np.mean([taught.posterior(g).name == g.label for g in known]) >= 0.7
    moved = [Drift(aperture_offset_m=8e-3).apply(g) for g in known]
    assert all(taught.posterior(g).name == UNKNOWN for g in moved)


def test_grasps_with_a_wrong_name_do_not_raise_the_limit_of_novelty(taught, train, monkeypatch):
    scored = _Teaching.held_out_scores

    def confused(teaching, held):
        rows, scores, novelty = scored(teaching, held)
        for i in range(0, len(rows), 8):
            novelty[i], scores[i] = 9.0, 0.0
            scores[i, teaching.classes[rows[i]] - 1] = 9.0
        return rows, scores, novelty

    monkeypatch.setattr(_Teaching, "held_out_scores", confused)
    again = make_trainer("force_ramp").fit(train)
    assert again.both.limit == pytest.approx(taught.both.limit, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("opening", [True, False])
def test_likely_objects_have_the_scores_that_they_have_among_all(teach, fresh, opening):
    taught = teach("force_ramp")
    view, levels = taught.both if opening else taught.touch, load_levels(fresh[:1], taught.rest)
    grids = [pad_grid(taught.rest.pads, pad) for pad in taught.rest.gripping]
    drifts = {"log_gains": taught.grid.log_gains, "offsets_mm": taught.grid.offsets_mm}
    features = describe(levels, grids, opening=opening, **drifts)
    for also in range(len(taught.labels)):
        every, few = view.model.score(features), view.model.score(features, likely=1, also=also)
        assert also in few.classes
        assert set(every.scores.argmax(axis=-1).flat) <= set(few.classes)
        assert few.scores == pytest.approx(every.scores[..., few.classes])
        assert np.all(few.novelty >= every.novelty - 1e-9)


def test_of_many_taught_grasps_as_many_of_each_object_are_kept():
    classes = np.repeat([0, 1, 2], [40, 3, 9])
    chosen = even_in_time(classes, 15)
    assert np.bincount(classes[chosen]).tolist() == [5, 3, 5]
    assert chosen[[0, 4, -1]].tolist() == [0, 39, 51]
    assert np.array_equal(even_in_time(classes, 120), np.arange(52))


@pytest.mark.slow
def test_caution_calls_more_objects_unknown(teach, fresh):
    taught = teach("force_ramp", "bar", "block", "disc", "pin")
    named = [
        sum(dataclasses.replace(taught, caution=c).posterior(g).name != UNKNOWN for g in fresh)
        for c in (0.01, 1.0, 100.0)
    ]
    assert named[0] >= named[1] > named[2]
    assert named[0] > named[2]
