"""Shape and size of objects that were never taught: of one grasp, of several, and the foam."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recognition.errors import ContactError
from recognition.grasp import Grasp, PadArray
from recognition.shape.answer import UNCLEAR, ShapeAnswer, fuse_shapes, joint_answer, shape_of
from recognition.shape.fit import ShapeFit, misfit_of
from recognition.shape.foam import FoamModel, PadBed, closed_columns_m, neighbours
from recognition.shape.models import SHAPE_MODELS, posed, resting_roll_rad
from tests.recognition.conftest import OBJECTS, make_grasp
from tests.values import make_pads

N_OWN = {kind: model.n_own for kind, model in SHAPE_MODELS.items()}
ZERO_SD = 0.2
"""Standard deviation of the zero of the opening, shared by all grasps, in mm."""
NOISE_MM = 0.1
BAD_CHI2 = 40.0


def fit_of(kind: str, normal: Any, truth: Any, mean: Any, sd: Any, *, chi2: float) -> ShapeFit:
    """Fit a linear problem whose data alone say ``truth``."""
    theta = np.linalg.solve(normal + np.diag(sd**-2), normal @ truth + mean / sd**2)
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
    n, half_mm = N_OWN[kind] + 2, 0.5 * thickness_mm
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


def width_mm(fused: ShapeAnswer) -> float:
    return 1e3 * (fused.high_m - fused.low_m)


def test_one_grasp_comes_back_as_it_is() -> None:
    one = answer("sphere", 9.0)
    assert fuse_shapes([one]) is one
    assert one.n_grasps == 1


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
    fused = fuse_shapes(
        [
            joint_answer([fit if k == "sphere" else linear_fit(k, 9.0, chi2=900.0) for k in N_OWN])
            for fit in fits
        ],
        placing_m=1e-9,
        dependence=0.0,
    )
    assert 1e3 * fused.size_m == pytest.approx(2.0 * np.exp(mean), rel=1e-6)
    assert 1e3 * fused.high_m == pytest.approx(2.0 * np.exp(mean + 1.645 * sd), rel=1e-6)


def test_noise_averages_out_and_the_zero_of_the_opening_does_not() -> None:
    one = answer("sphere", 9.0)
    many = fuse_shapes([one] * 100, dependence=0.0)
    assert width_mm(one) > 2 * 1.645 * np.hypot(ZERO_SD, NOISE_MM) * 0.98
    assert width_mm(many) == pytest.approx(2 * 1.645 * ZERO_SD, rel=0.05)
    assert many.n_grasps == 100
    assert width_mm(many) < width_mm(fuse_shapes([one] * 100)) < 1.02 * width_mm(one)


def test_the_order_does_not_matter() -> None:
    answers = [answer("flat", 10.0), answer("flat", 15.9), answer("flat", 10.1)]
    assert fuse_shapes(answers) == fuse_shapes(answers[::-1])


def test_a_bar_shows_two_thicknesses() -> None:
    fused = fuse_shapes([answer("flat", t) for t in (15.9, 10.0, 15.8, 16.0)])
    assert [1e3 * t.size_m for t in fused.thicknesses] == pytest.approx([10.0, 15.9], abs=0.15)
    assert [t.n_grasps for t in fused.thicknesses] == [1, 3]
    assert fused.size_m == fused.thicknesses[1].size_m
    assert fused.dimensions_m["height"] == fused.size_m
    assert str(fused).startswith("flat, 10.0 mm (9.")
    assert " and 15.9 mm (15." in str(fused)
    plain = fused.as_dict()
    assert [t["n_grasps"] for t in plain["thicknesses"]] == [1, 3]
    assert plain["size_mm"] == pytest.approx(15.9, abs=0.15)


def test_of_equally_often_met_thicknesses_the_thinner_is_the_size() -> None:
    fused = fuse_shapes([answer("oval", t) for t in (12.0, 9.0)])
    assert 1e3 * fused.size_m == pytest.approx(9.0, abs=0.15)


def test_the_thickness_of_a_round_object_is_one() -> None:
    fused = fuse_shapes([answer("cylinder", t, others=400.0) for t in (9.6, 10.0)])
    assert (fused.kind, len(fused.thicknesses)) == ("cylinder", 1)
    assert 9.6e-3 < fused.size_m < 10.0e-3


def test_a_small_difference_is_no_second_thickness() -> None:
    assert len(fuse_shapes([answer("flat", t) for t in (9.9, 10.1, 10.0)]).thicknesses) == 1


def test_what_round_kinds_cannot_be_speaks_for_a_bar() -> None:
    unsure: Sequence[ShapeAnswer] = [
        joint_answer(
            [linear_fit(k, t, chi2=30.0 if k in {"flat", "cylinder"} else 90.0) for k in N_OWN]
        )
        for t in (10.0, 15.9)
    ]
    assert all(one.probability["cylinder"] > 0.3 and one.kind == UNCLEAR for one in unsure)
    assert fuse_shapes(unsure).kind == "flat"


def test_grasps_that_agree_are_surer_of_the_kind_but_not_as_if_nothing_were_shared() -> None:
    one = answer("sphere", 9.0, others=2.0)
    free, tied = fuse_shapes([one] * 3, dependence=0.0), fuse_shapes([one] * 3)
    assert one.probability["sphere"] < tied.probability["sphere"] < free.probability["sphere"]
    assert sum(tied.probability.values()) == pytest.approx(1.0)


def test_what_no_kind_explains_stays_unclear() -> None:
    strange, usual = (joint_answer([linear_fit("sphere", 9.0, chi2=x)]) for x in (150.0, 30.0))
    assert (strange.kind, usual.kind) == (UNCLEAR, "sphere")
    assert str(strange).startswith("unclear, ")
    fused = fuse_shapes([strange, strange, usual])
    assert (fused.kind, fused.likeliest) == (UNCLEAR, "sphere")
    assert fuse_shapes([strange, usual, usual]).kind == "sphere"


def test_what_cannot_be_fused_is_refused() -> None:
    with pytest.raises(ValueError, match="grasp at least once"):
        fuse_shapes([])
    fused = fuse_shapes([answer("sphere", 9.0)] * 2)
    with pytest.raises(ValueError, match="cannot be fused again"):
        fuse_shapes([fused, fused])


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


# -- Shape and size of objects that were never taught, and the foam from one gauge -----------------


FOAM = FoamModel()
LINEAR = ((0.0, 4.0), (0.0, 1.0))
"""Law of a linear sensor, as of `FoamModel.nodes`."""
SIZES_MM = {"sphere": 9.0, "oval": 10.0, "cylinder": 7.0, "flat": 8.0, "dumbbell": 9.0}
OWN = {
    "sphere": [],
    "oval": [np.log(1.6)],
    "cylinder": [np.log(2.5)],
    "flat": [np.log(1.4), np.log(0.8)],
    "dumbbell": [np.log(1.4), 0.0],
}


class Body:
    """One of the fitted kinds as a drawing."""

    roll_step_rad = 0.0

    def __init__(self, kind: str, size_mm: float) -> None:
        self.model, self.half_m, self.own = SHAPE_MODELS[kind], 0.5e-3 * size_mm, OWN[kind]

    def heights(self, x_m, y_m, roll_rad):
        lag_m, share = self.model.surface(
            np.full((1, 1, 1), self.half_m),
            np.array(self.own, dtype=float).reshape(1, -1, 1, 1),
            np.asarray(x_m)[None],
            np.asarray(y_m)[None],
            1e-5,
        )
        reach_m = np.where(share[0] > 0.5, self.half_m - lag_m[0], -np.inf)
        return reach_m, reach_m


def pressed(
    pads: PadArray,
    body: Body,
    *,
    seed: int,
    foam: FoamModel = FOAM,
    noise: float = 0.01,
    offset_m: float = 0.0,
    mirrored: bool = False,
) -> Grasp:
    """One grasp of a body: an approach without touch, then a ramp to some force."""
    rng = np.random.default_rng(seed)
    at_m, turn = rng.uniform(-1.5e-3, 1.5e-3, 2), rng.uniform(0, np.pi)
    bed = PadBed(pads, 0, foam.spread_m, cell_m=0.3e-3)
    dx_m, dy_m = np.broadcast_arrays(bed.x_m - at_m[0], bed.y_m - at_m[1])
    c, s = np.cos(turn), np.sin(turn)
    reach_m, _ = body.heights(c * dx_m + s * dy_m, c * dy_m - s * dx_m, 0.0)
    depths_m = np.linspace(0.0, 2.4e-3, 60)
    lag_m = reach_m.max() - reach_m
    forces_n = bed.taxel_force_n(
        foam.modulus_pa * foam.relative_pressure(depths_m[:, None, None] - lag_m)
    )
    end_n = rng.uniform(4.0, 7.0)
    ramp_n = np.concatenate([np.zeros(30), np.linspace(0.3, end_n, 50), np.full(15, end_n)])
    depth_m = np.interp(ramp_n, forces_n.sum(axis=1), depths_m)
    share = foam.response(np.stack([np.interp(depth_m, depths_m, f) for f in forces_n.T], axis=1))
    rows, columns = pads.pad_shape[0]
    other = share.reshape(-1, rows, columns)[:, :, ::-1].reshape(len(share), -1)
    share = np.hstack([share, other if mirrored else share])
    counts = pads.adc_max * (share + 0.05 + noise * rng.standard_normal(share.shape))
    aperture_m = 2 * body.half_m - 2 * depth_m + offset_m
    aperture_m[:30] += np.linspace(8e-3, 0.2e-3, 30)
    return Grasp(
        pads=pads,
        counts=np.rint(np.clip(counts, 0, pads.adc_max)),
        t_s=0.02 * np.arange(len(ramp_n)),
        aperture_m=aperture_m,
        force_n=ramp_n,
    )


@pytest.mark.parametrize("kind", sorted(SIZES_MM))
def test_an_untaught_object_is_named_and_measured(pads: PadArray, kind: str) -> None:
    size_mm = SIZES_MM[kind]
    for seed in range(3):
        answer = shape_of(pressed(pads, Body(kind, size_mm), seed=seed))
        assert answer.kind == kind, answer
        assert 1e3 * answer.low_m < size_mm < 1e3 * answer.high_m
        assert 1e3 * answer.size_m == pytest.approx(size_mm, abs=0.3)
        assert answer.misfit < 2.0
        assert sum(answer.probability.values()) == pytest.approx(1.0)


def test_a_rod_is_measured_along_the_whole_pad() -> None:
    rod = Body("cylinder", 8.0)
    rod.own = [np.log(5.0)]
    answer = shape_of(pressed(PadArray.grid(16, 4, 3.44e-3), rod, seed=0))
    assert answer.kind == "cylinder"
    assert 1e3 * answer.low_m < 8.0 < 1e3 * answer.high_m


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "flat"])
def test_a_linear_sensor_is_read_under_its_own_law(pads: PadArray, kind: str) -> None:
    linear = FoamModel(nodes=LINEAR)
    grasp = pressed(pads, Body(kind, SIZES_MM[kind]), seed=3, foam=linear, noise=0.004)
    answer, wrong = shape_of(grasp, foam=linear), shape_of(grasp)
    assert answer.kind == kind
    assert 1e3 * answer.size_m == pytest.approx(SIZES_MM[kind], abs=0.3)
    assert answer.misfit < 2.0
    # Another foam explains what the wrong law says, but leaves more open.
    assert wrong.high_m - wrong.low_m > answer.high_m - answer.low_m


def test_a_length_is_found_too_and_the_text_says_the_same_as_the_plain_data(pads: PadArray) -> None:
    answer = shape_of(pressed(pads, Body("cylinder", 7.0), seed=4))
    assert 1e3 * answer.dimensions_m["length"] == pytest.approx(17.5, abs=1.0)
    plain = answer.as_dict()
    low, high = plain["interval_mm"]
    assert str(answer) == f"cylinder, {plain['size_mm']:.1f} mm ({low:.1f} to {high:.1f})"


@pytest.mark.slow
def test_the_interval_holds_the_size_as_often_as_it_says(pads: PadArray) -> None:
    rng, held = np.random.default_rng(3), 0
    for seed in range(24):
        size_mm = float(rng.uniform(6.0, 14.0))
        offset_m = float(rng.normal(0.0, 0.2e-3))
        answer = shape_of(pressed(pads, Body("sphere", size_mm), seed=seed, offset_m=offset_m))
        held += answer.low_m <= 1e-3 * size_mm <= answer.high_m
    # 90 % of 24: fewer than 18 come by chance once in a thousand times
    assert held >= 18


@pytest.mark.slow
def test_without_opening_the_interval_is_wider(pads: PadArray) -> None:
    grasp = pressed(pads, Body("sphere", 9.0), seed=1, noise=0.04)
    blind = replace(grasp, aperture_m=np.full(grasp.n_frames, np.nan))
    seen, unseen = shape_of(grasp), shape_of(blind)
    assert unseen.low_m < 9e-3 < unseen.high_m
    assert unseen.high_m - unseen.low_m > 1.3 * (seen.high_m - seen.low_m)


def test_a_second_pad_that_counts_from_the_other_side(pads: PadArray) -> None:
    plain = pressed(pads, Body("oval", 10.0), seed=5)
    turned = pressed(pads, Body("oval", 10.0), seed=5, mirrored=True)
    assert shape_of(turned).size_m == pytest.approx(shape_of(plain).size_m, rel=0.02)
    assert shape_of(turned).kind == "oval"


def test_an_untouched_pad_tells_nothing(pads: PadArray) -> None:
    grasp = pressed(pads, Body("sphere", 9.0), seed=0)
    counts = grasp.counts.copy()
    counts[:, pads.taxels_of(1)] = counts[:1, pads.taxels_of(1)]
    with pytest.raises(ContactError, match="not both pads"):
        shape_of(replace(grasp, counts=counts))


@pytest.mark.parametrize(
    ("shapes", "why"),
    [
        (((10, 6), (8, 6)), "do not face each other"),
        (((7, 1), (7, 1)), "7 x 1 taxels form no grid"),
        (((1, 1),) * 14, "1 x 1 taxels form no grid"),
    ],
)
def test_pads_that_show_no_shape_are_refused(shapes, why) -> None:
    with pytest.raises(ContactError, match=why):
        shape_of(make_grasp(OBJECTS[0], np.random.default_rng(0), pads=make_pads(shapes=shapes)))


# -- How badly a model misses pressed pads, and what that does to a fit ----------------------------


def test_untouched_taxels_do_not_hide_that_no_shape_fits() -> None:
    squared = np.r_[np.full(30, 9.0), np.zeros(300)]
    tells = np.arange(330) < 30
    assert misfit_of(squared, tells, 0.0) == pytest.approx(9.0)
    assert misfit_of(squared, tells, 10.0) == pytest.approx(270.0 / 20.0)
    # Nor are taxels forgotten that read nothing where the shape would press them.
    assert misfit_of(squared[::-1], tells, 0.0) == pytest.approx(270.0 / 330.0)


def plain_fit(kind: str, chi2: float) -> tuple[ShapeFit, np.ndarray]:
    """Return a fit of a linear problem, and what its data alone say."""
    n = SHAPE_MODELS[kind].n_own + 2
    half = np.random.default_rng(3).normal(size=(3 * n, n))
    normal, truth, mean, sd = 40.0 * half.T @ half, np.full(n, 0.8), np.zeros(n), np.full(n, 0.5)
    return fit_of(kind, normal, truth, mean, sd, chi2=chi2), truth


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e6])
def test_larger_variances_move_a_fit_towards_what_is_known_beforehand(scale: float) -> None:
    fit, truth = plain_fit("oval", 30.0)
    normal, precision = fit.normal / scale, np.diag(fit.prior_sd**-2)
    moved = fit.at_scale(scale)
    assert moved.theta == pytest.approx(np.linalg.solve(normal + precision, normal @ truth))
    away = moved.theta - truth
    assert moved.chi2 == pytest.approx(30.0 + away @ fit.normal @ away)
    assert moved.at_scale(scale).theta == pytest.approx(moved.theta)


# -- The surfaces that are fitted: heights, lengths, and what they are called ----------------------


OTHERS = OWN | {"oval": [np.log(1.5)], "dumbbell": [np.log(1.3), 0.0]}


def surface(kind: str, u_m: float, v_m: float) -> tuple[float, float]:
    lag_m, share = SHAPE_MODELS[kind].surface(
        np.full((1, 1, 1), 4e-3),
        np.array(OTHERS[kind], dtype=float).reshape(1, -1, 1, 1),
        np.full((1, 1, 1), u_m),
        np.full((1, 1, 1), v_m),
        1e-4,
    )
    return float(lag_m[0, 0, 0]), float(share[0, 0, 0])


@pytest.mark.parametrize("kind", ["sphere", "oval", "cylinder"])
def test_round_shapes_fall_away_as_their_circle_does(kind: str) -> None:
    lag_m, share = surface(kind, 0.0, 2e-3)
    assert lag_m == pytest.approx(4e-3 - np.sqrt(4e-3**2 - 2e-3**2))
    assert share == 1.0
    assert surface(kind, 0.0, 4.2e-3)[1] == 0.0


def test_along_them_they_differ() -> None:
    assert surface("sphere", 2e-3, 0.0)[0] == pytest.approx(4e-3 - np.sqrt(12e-6))
    assert surface("oval", 3e-3, 0.0)[0] == pytest.approx(4e-3 * (1 - np.sqrt(0.75)))
    assert surface("cylinder", 9e-3, 0.0) == (0.0, 1.0)
    assert surface("cylinder", 10.1e-3, 0.0)[1] == 0.0
    assert surface("flat", 6.9e-3, 3.9e-3) == (0.0, 1.0)
    assert surface("flat", 6.9e-3, 4.1e-3)[1] == 0.0
    assert surface("dumbbell", 1e-3, 0.0)[1] == 0.0
    assert surface("dumbbell", 4e-3, 0.0) == (0.0, 1.0)
    # An end covers a part of its cell.
    assert surface("cylinder", 10e-3, 0.0)[1] == pytest.approx(0.5)


def test_dimensions_have_the_names_of_drawings() -> None:
    sizes = {
        kind: SHAPE_MODELS[kind].dimensions_m(4e-3, np.array(OTHERS[kind])) for kind in SHAPE_MODELS
    }
    assert sizes["sphere"] == {"diameter": 8e-3}
    assert sizes["cylinder"]["length"] == pytest.approx(20e-3)
    assert sizes["flat"]["length"] == pytest.approx(14e-3)
    assert sizes["flat"]["width"] == pytest.approx(8e-3)
    assert sizes["dumbbell"]["waist_length"] == pytest.approx(0.5 * sizes["dumbbell"]["length"])


# -- Foam and sensor as a formula: exact values, forces conserved, grids of all kinds --------------


def test_columns_follow_the_law() -> None:
    foam = FoamModel(thickness_m=2e-3, densification=0.5, limit_strain=0.9)
    got = foam.relative_pressure(np.array([-1e-3, 0.0, 1e-3, 1.8e-3]))
    assert got == pytest.approx([0.0, 0.0, 0.5 * 1.5, 0.9 * (1 + 0.5 * 81)])


def test_beyond_the_limit_it_goes_on_straight() -> None:
    foam = FoamModel(thickness_m=1.0, limit_strain=0.5)
    at = foam.relative_pressure(np.array([0.499, 0.5, 0.501, 0.7]))
    assert at[2] - at[1] == pytest.approx(at[1] - at[0], rel=0.02)
    assert at[3] - at[1] == pytest.approx(200 * (at[2] - at[1]), rel=1e-6)


def test_the_response_is_equation_11() -> None:
    foam = FoamModel(gain=1.2)
    assert FoamModel().response(np.array([0.0, 1.0])) == pytest.approx([0.0, 1 - np.exp(-0.449)])
    assert foam.response(np.array([2.0])) == pytest.approx([1 - np.exp(-0.449 * 1.2 * 2.0)])


def test_another_law_has_lines_between_its_nodes_up_to_its_full_scale() -> None:
    foam = FoamModel(gain=0.5, nodes=((0.0, 1.0, 4.0), (0.0, 0.4, 1.0)))
    force_n = np.array([0.0, 1.0, 4.0, 8.0, 50.0])
    assert foam.response(force_n) == pytest.approx([0.0, 0.2, 0.6, 1.0, 1.0])


def test_no_force_is_lost_also_at_the_rim(pads: PadArray) -> None:
    bed = PadBed(pads, 1, 1.5e-3)
    assert bed.taxels[0] == 60
    pressure = np.zeros((len(bed.x_m), bed.y_m.shape[1]))
    for cell in ((0, 0), (30, 3), (-1, -1)):
        pressure[cell] = 1e5
    force_n = bed.taxel_force_n(pressure)
    assert (force_n.shape, force_n.sum()) == ((60,), pytest.approx(3e5 * bed.cell_area_m2))


def test_a_crop_reads_what_the_whole_reads(pads: PadArray) -> None:
    bed = PadBed(pads, 0, 1.5e-3)
    part = bed.cropped(np.zeros(2), 4e-3)
    inside = np.hypot(bed.x_m, bed.y_m) < 3e-3
    near = np.hypot(part.x_m, part.y_m) < 3e-3
    assert near.size < inside.size
    assert part.taxel_force_n(near * 1e5) == pytest.approx(bed.taxel_force_n(inside * 1e5))


def test_scattered_taxels_are_refused() -> None:
    xy_m = np.array([[0, 0], [0, 1], [1, 0], [1, 1.5]]) * 3e-3
    shape, pad = np.array([[2, 2]]), np.zeros(4)
    with pytest.raises(ContactError, match="2 x 2 taxels form no grid"):
        PadBed(PadArray(pad_shape=shape, taxel_pad=pad, taxel_xy_m=xy_m, adc_max=255), 0, 1e-3)


class Ramp:
    """A surface that rises along its own x and rests on two sides."""

    roll_step_rad = np.pi

    def heights(self, x_m, y_m, roll_rad):
        return x_m + roll_rad, 2.0 * y_m


def test_a_pose_moves_and_turns() -> None:
    near, far = posed(
        Ramp(),
        np.array([3.0]),
        np.array([5.0]),
        at_m=(1.0, 1.0),
        rotation_rad=np.pi / 2,
        roll_rad=0.0,
    )
    assert near == pytest.approx([4.0])
    assert far == pytest.approx([-4.0])


def test_a_roll_settles_on_a_side() -> None:
    assert resting_roll_rad(Ramp(), 3.0) == pytest.approx(np.pi)
    assert resting_roll_rad(Ramp(), 1.0) == 0.0


# -- Columns that push each other in: between separate columns and an elastic body -----------------


POINTS_M = 0.5e-3 * (np.arange(31) - 15.0)
PUSHES = (neighbours(POINTS_M, 1.2e-3), neighbours(POINTS_M, 1.2e-3))
RADIUS_M = 5e-3


def ball_m(depth_m: float) -> np.ndarray:
    return depth_m - (POINTS_M[:, None] ** 2 + POINTS_M[None] ** 2) / (2.0 * RADIUS_M)


def test_without_sideways_columns_are_separate() -> None:
    wanted_m = ball_m(1e-3)
    closed_m = closed_columns_m(wanted_m, 1.0, 0.0, PUSHES, steps=5)
    np.testing.assert_allclose(closed_m, np.maximum(wanted_m, 0.0), atol=1e-12)


@pytest.mark.parametrize("sideways", [0.4, 0.7])
def test_the_surface_fits_where_it_touches_and_nothing_overlaps(sideways: float) -> None:
    wanted_m = ball_m(1e-3)
    closed_m = closed_columns_m(wanted_m, 1.0, sideways, PUSHES, steps=60)
    along, across = PUSHES
    given_m = (1.0 - sideways) * closed_m + sideways * along @ closed_m @ across
    touching = closed_m > 0.0
    np.testing.assert_allclose(given_m[touching], wanted_m[touching], atol=2e-6)
    assert np.all(given_m[~touching] >= wanted_m[~touching] - 2e-6)


def test_the_contact_is_smaller_and_the_rim_of_a_flat_face_carries_more() -> None:
    """As on an elastic body, and unlike separate columns."""
    separate = closed_columns_m(ball_m(1e-3), 1.0, 0.0, PUSHES, steps=0)
    pushed = closed_columns_m(ball_m(1e-3), 1.0, 0.7, PUSHES, steps=30)
    assert (pushed > 0.0).sum() < 0.9 * (separate > 0.0).sum()
    inside = (np.abs(POINTS_M) < 3e-3)[:, None] & (np.abs(POINTS_M) < 3e-3)[None]
    face = closed_columns_m(np.where(inside, 0.5e-3, -1.0), 1.0, 0.7, PUSHES, steps=30)
    assert face[15, 10] > 1.3 * face[15, 15]
