"""Several grasps of one object -> one shape and size: what averages out, and what does not."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recognition.shape.answer import UNCLEAR, ShapeAnswer, joint_answer
from recognition.shape.fit import ShapeFit, evidence_of
from recognition.shape.fusion import fuse_shapes
from recognition.shape.models import SHAPE_MODELS

N_OWN = {kind: model.n_own for kind, model in SHAPE_MODELS.items()}
ZERO_SD = 0.2
"""Standard deviation of the zero of the opening, shared by all grasps, in mm."""
NOISE_MM = 0.1
BAD_CHI2 = 40.0


def fit_of(kind: str, normal: Any, truth: Any, mean: Any, sd: Any, *, chi2: float) -> ShapeFit:
    """Fit a linear problem whose data alone say ``truth``."""
    precision = normal + np.diag(sd**-2)
    theta = np.linalg.solve(precision, normal @ truth + mean / sd**2)
    away = theta - truth
    return ShapeFit(
        model=SHAPE_MODELS[kind],
        theta=theta,
        normal=normal,
        gradient=normal @ away,
        prior_mean=mean,
        prior_sd=sd,
        chi2=chi2 + float(away @ normal @ away),
        misfit=(chi2 + float(away @ normal @ away)) / 30.0,
        n_shared=1,
    )


def linear_fit(
    kind: str, thickness_mm: float, *, zero_mm: float = 0.0, chi2: float = 30.0, wrong: float = 0.0
) -> ShapeFit:
    """Fit a problem that is linear but for the logarithm: one opening tells the thickness.

    The parameters are the log of the half thickness, the kind's own, one of the grasp and the zero.
    """
    n = N_OWN[kind] + 2
    half_mm = 0.5 * thickness_mm
    slope = np.zeros(n)
    slope[0], slope[-1] = 2.0 * half_mm / NOISE_MM, 1.0 / NOISE_MM
    normal = np.outer(slope, slope)
    normal[1, 1] += 25.0
    normal[-2, -2] += 100.0
    # The depth of the touch, which no other grasp shares, hangs on the thickness.
    normal[0, -2] = normal[-2, 0] = 5.0
    mean = np.zeros(n)
    sd = np.r_[0.9, np.full(n - 3, 0.4), 1.0, ZERO_SD]
    mean[0] = np.log(7.0)
    truth = np.zeros(n)
    truth[0] = np.log(half_mm) + 0.5 * (zero_mm + wrong) / half_mm
    return fit_of(kind, normal, truth, mean, sd, chi2=chi2)


def answer(
    kind: str,
    thickness_mm: float,
    *,
    zero_mm: float = 0.0,
    wrong: float = 0.0,
    others: float = BAD_CHI2,
) -> ShapeAnswer:
    """Return what a grasp says that speaks for one kind: the others fit worse by some chi2."""
    return joint_answer(
        [
            linear_fit(
                name,
                thickness_mm,
                zero_mm=zero_mm,
                wrong=wrong,
                chi2=30.0 + (0.0 if name == kind else others),
            )
            for name in SHAPE_MODELS
        ]
    )


def width_mm(found: ShapeAnswer) -> float:
    return 1e3 * (found.high_m - found.low_m)


def test_one_grasp_comes_back_as_it_is() -> None:
    one = answer("sphere", 9.0)
    assert fuse_shapes([one]) is one
    assert one.n_grasps == 1


@pytest.mark.parametrize("kind", sorted(SHAPE_MODELS))
def test_the_evidence_of_one_grasp_is_that_of_its_fit(kind: str) -> None:
    fit = linear_fit(kind, 9.0, zero_mm=0.1)
    told = evidence_of(fit, 1.3)
    precision = told.precision + np.diag(told.prior_sd**-2)
    eta = told.eta + told.prior_mean / told.prior_sd**2
    s = np.linalg.solve(precision, eta)
    kept = [0, len(fit.theta) - 1]
    assert s == pytest.approx(fit.theta[kept])
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert sd[0] == pytest.approx(fit.log_half_sd(1.3))
    log_evidence = (
        told.level
        - 0.5 * float(np.sum((told.prior_mean / told.prior_sd) ** 2))
        - float(np.log(told.prior_sd).sum())
        + 0.5 * float(eta @ s)
        - 0.5 * float(np.linalg.slogdet(precision)[1])
    )
    assert log_evidence == pytest.approx(fit.log_evidence(1.3))


def test_grasps_together_are_as_one_fit_to_all_of_them() -> None:
    fits = [linear_fit("sphere", 9.0, zero_mm=0.1, wrong=w) for w in (-0.05, 0.02, 0.11)]
    n = len(fits[0].theta)
    # By hand: log half and zero once, the grasp's own parameter once for each grasp.
    size = 2 + (n - 2) * len(fits)
    precision, eta = np.zeros((size, size)), np.zeros(size)
    prior = fits[0].prior_sd ** -2
    for i, fit in enumerate(fits):
        place = [0, *range(2 + i * (n - 2), 2 + (i + 1) * (n - 2)), 1]
        own = prior * np.r_[0.0, np.ones(n - 2), 0.0]
        full = fit.normal + np.diag(prior)
        precision[np.ix_(place, place)] += fit.normal + np.diag(own)
        eta[place] += full @ fit.theta - (prior - own) * fit.prior_mean
    precision[[0, 1], [0, 1]] += prior[[0, -1]]
    eta[[0, 1]] += prior[[0, -1]] * fits[0].prior_mean[[0, -1]]
    mean, sd = np.linalg.solve(precision, eta)[0], np.sqrt(np.linalg.inv(precision)[0, 0])
    found = fuse_shapes(
        [
            joint_answer([fit if k == "sphere" else linear_fit(k, 9.0, chi2=900.0) for k in N_OWN])
            for fit in fits
        ],
        placing_m=1e-9,
        dependence=0.0,
    )
    assert 1e3 * found.size_m == pytest.approx(2.0 * np.exp(mean), rel=1e-6)
    assert 1e3 * found.high_m == pytest.approx(2.0 * np.exp(mean + 1.645 * sd), rel=1e-6)


def test_noise_averages_out_and_the_zero_of_the_opening_does_not() -> None:
    one = answer("sphere", 9.0)
    many = fuse_shapes([one] * 100, dependence=0.0)
    assert width_mm(one) > 2 * 1.645 * np.hypot(ZERO_SD, NOISE_MM) * 0.98
    assert width_mm(many) == pytest.approx(2 * 1.645 * ZERO_SD, rel=0.05)
    assert many.n_grasps == 100
    careful = fuse_shapes([one] * 100)
    assert width_mm(many) < width_mm(careful) < 1.02 * width_mm(one)


@pytest.mark.slow
def test_the_interval_holds_as_often_as_it_says_whatever_the_grasps_share() -> None:
    rng = np.random.default_rng(4)
    for n_grasps in (1, 2, 5):
        held = 0
        for _ in range(120):
            size_mm, zero_mm = float(rng.uniform(6, 14)), float(rng.normal(0, ZERO_SD))
            wrong = rng.normal(0, NOISE_MM, n_grasps)
            found = fuse_shapes(
                [
                    joint_answer([linear_fit("sphere", size_mm, zero_mm=zero_mm, wrong=float(w))])
                    for w in wrong
                ]
            )
            held += found.low_m <= 1e-3 * size_mm <= found.high_m
        # 90 % of 120 within about four standard deviations
        assert 95 <= held <= 119, n_grasps


def test_the_order_does_not_matter() -> None:
    answers = [answer("flat", 10.0), answer("flat", 15.9), answer("flat", 10.1)]
    assert fuse_shapes(answers) == fuse_shapes(answers[::-1])


def test_a_bar_shows_two_thicknesses() -> None:
    found = fuse_shapes([answer("flat", t) for t in (15.9, 10.0, 15.8, 16.0)])
    assert [1e3 * t.size_m for t in found.thicknesses] == pytest.approx([10.0, 15.9], abs=0.15)
    assert [t.n_grasps for t in found.thicknesses] == [1, 3]
    assert found.size_m == found.thicknesses[1].size_m
    assert found.dimensions_m["height"] == found.size_m
    assert str(found).startswith("flat, 10.0 mm (9.")
    assert " and 15.9 mm (15." in str(found)
    plain = found.as_dict()
    assert [t["n_grasps"] for t in plain["thicknesses"]] == [1, 3]
    assert plain["size_mm"] == pytest.approx(15.9, abs=0.15)


def test_of_equally_often_met_thicknesses_the_thinner_is_the_size() -> None:
    found = fuse_shapes([answer("oval", t) for t in (12.0, 9.0)])
    assert 1e3 * found.size_m == pytest.approx(9.0, abs=0.15)


def test_the_thickness_of_a_round_object_is_one() -> None:
    told = [answer("cylinder", t, others=400.0) for t in (9.6, 10.0)]
    found = fuse_shapes(told)
    assert found.kind == "cylinder"
    assert len(found.thicknesses) == 1
    assert 9.6e-3 < found.size_m < 10.0e-3


def test_a_small_difference_is_no_second_thickness() -> None:
    assert len(fuse_shapes([answer("flat", t) for t in (9.9, 10.1, 10.0)]).thicknesses) == 1


def test_what_round_kinds_cannot_be_speaks_for_a_bar() -> None:
    unsure: Sequence[ShapeAnswer] = [
        joint_answer(
            [linear_fit(k, t, chi2=30.0 if k in {"flat", "cylinder"} else 90.0) for k in N_OWN]
        )
        for t in (10.0, 15.9)
    ]
    assert all(one.probability["cylinder"] > 0.3 for one in unsure)
    assert fuse_shapes(unsure).kind == "flat"


def test_grasps_that_agree_are_surer_of_the_kind_but_not_as_if_nothing_were_shared() -> None:
    one = answer("sphere", 9.0, others=2.0)
    free, tied = fuse_shapes([one] * 3, dependence=0.0), fuse_shapes([one] * 3)
    assert one.probability["sphere"] < tied.probability["sphere"] < free.probability["sphere"]
    assert sum(tied.probability.values()) == pytest.approx(1.0)


def test_what_no_kind_explains_stays_unclear() -> None:
    strange = joint_answer([linear_fit("sphere", 9.0, chi2=150.0)])
    found = fuse_shapes([strange, strange, answer_of_one()])
    assert (found.kind, found.likeliest) == (UNCLEAR, "sphere")
    assert fuse_shapes([strange, answer_of_one(), answer_of_one()]).kind == "sphere"


def answer_of_one() -> ShapeAnswer:
    return joint_answer([linear_fit("sphere", 9.0)])


def test_what_cannot_be_fused_is_refused() -> None:
    with pytest.raises(ValueError, match="grasp at least once"):
        fuse_shapes([])
    fused = fuse_shapes([answer("sphere", 9.0)] * 2)
    with pytest.raises(ValueError, match="cannot be fused again"):
        fuse_shapes([fused, fused])
    fits = [linear_fit(kind, 9.0) for kind in N_OWN]
    other = joint_answer([_trusting(fit) for fit in fits])
    with pytest.raises(ValueError, match="different uncertainty"):
        fuse_shapes([joint_answer(fits), other])


def _trusting(fit: ShapeFit) -> ShapeFit:
    return replace(fit, prior_sd=np.r_[fit.prior_sd[:-1], 0.5 * fit.prior_sd[-1]])


def test_a_foam_that_explains_all_grasps_is_that_of_the_cell() -> None:
    """Two foams tell two thicknesses; each grasp leans to the first, all together the more so."""

    def told(others: float) -> ShapeAnswer:
        fits = [
            linear_fit("sphere", 9.0, chi2=30.0),
            linear_fit("sphere", 10.0, chi2=30.0 + others),
        ]
        return joint_answer(fits, [np.log(0.5), np.log(0.5)])

    one, three = told(1.0), fuse_shapes([told(1.0)] * 3, dependence=0.0)
    assert one.probability == {"sphere": pytest.approx(1.0)}
    assert 9.2e-3 < one.size_m < 9.5e-3
    assert 9.0e-3 < three.size_m < 9.25e-3
    assert width_mm(three) < width_mm(one)
    # What is likely beforehand counts once, not once in each grasp.
    fits = [linear_fit("sphere", 9.0), linear_fit("cylinder", 9.0, chi2=29.0)]
    leaning = joint_answer(fits, [np.log(0.9), np.log(0.1)])
    apart = fuse_shapes([leaning] * 2, dependence=1.0)
    assert apart.probability["sphere"] == pytest.approx(leaning.probability["sphere"], abs=0.02)
