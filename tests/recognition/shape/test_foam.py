"""Foam and sensor as a formula: exact values, forces conserved, grids of all kinds."""

import numpy as np
import pytest

from recognition.errors import ContactError
from recognition.grasp import PadArray
from recognition.shape.foam import FoamModel, PadBed, closed_columns_m, neighbours
from recognition.shape.models import posed, resting_roll_rad


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
    pads = PadArray(
        pad_shape=np.array([[2, 2]]), taxel_pad=np.zeros(4), taxel_xy_m=xy_m, adc_max=255
    )
    with pytest.raises(ContactError, match="2 x 2 taxels form no grid"):
        PadBed(pads, 0, 1e-3)


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
