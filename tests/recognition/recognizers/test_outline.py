"""Outlines of patches whose form is known, and invariants of curves whose equation is known."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from recognition.features.footprint import PadGrid
from recognition.recognizers.comparators.invariants import (
    LocalGeometry as Geometry,
    conic_invariants,
    cubic_geometry,
    parabola_invariant,
    section_features,
)
from recognition.recognizers.comparators.outline import (
    angles_and_lengths,
    canonical_start,
    centroid_mm,
    outline_radii_mm,
    polygon,
    sample_mm,
)


def grid(rows=41, columns=31, pitch=0.5):
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    xy = np.column_stack([x.ravel() - (rows - 1) / 2, y.ravel() - (columns - 1) / 2]) * pitch
    return PadGrid(xy_mm=xy, pitch_mm=np.array([pitch, pitch]), shape=(rows, columns))


def ellipse(pad, a, b, angle=0.0, centre=(0.0, 0.0)):
    dx, dy = (pad.xy_mm - np.array(centre)).T
    u = np.cos(angle) * dx + np.sin(angle) * dy
    v = np.cos(angle) * dy - np.sin(angle) * dx
    return np.clip(1.0 - (u / a) ** 2 - (v / b) ** 2, 0.0, None)


def test_outline_of_an_ellipse_has_its_radii_wherever_it_lies():
    pad = grid()
    for centre in ((0.0, 0.0), (2.0, -1.0)):
        radii = outline_radii_mm(ellipse(pad, 6.0, 4.0, centre=centre), pad, 32)
        shrink = np.sqrt(0.7)
        assert radii[[0, 16]] == pytest.approx(6.0 * shrink, abs=0.15)
        assert radii[[8, 24]] == pytest.approx(4.0 * shrink, abs=0.15)


def test_a_turned_patch_has_the_same_canonical_outline():
    pad = grid()
    one, other = (
        canonical_start(outline_radii_mm(ellipse(pad, 6.0, 4.0, angle), pad, 32))
        for angle in (0.3, 1.5)
    )
    assert one == pytest.approx(other, rel=0.06)
    assert one[0] == pytest.approx(one.max(), rel=0.03)


def test_an_empty_patch_has_a_plain_outline_and_finite_features():
    pad = grid(5, 4, 3.0)
    nothing = np.zeros(20)
    assert np.array_equal(outline_radii_mm(nothing, pad, 8), np.ones(8))
    assert centroid_mm(nothing, pad) == pytest.approx([0.0, 0.0])
    assert np.all(np.isfinite(section_features(nothing, pad)))


def test_patch_falls_to_nothing_beside_the_pad():
    pad = grid(3, 3, 2.0)
    beside = np.array([[2.0, 0.0], [3.0, 0.0], [4.0, 0.0], [9.0, 0.0]])
    assert sample_mm(np.ones(9), pad, beside) == pytest.approx([1.0, 0.5, 0.0, 0.0])


def test_a_square_keeps_its_four_corners():
    angle = np.arange(64) * (2 * np.pi / 64)
    radii = 1.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    corners = polygon(radii, 4)
    assert np.sort(np.abs(corners), axis=None) == pytest.approx(np.ones(8))
    described = angles_and_lengths(corners)
    assert described[0::2] == pytest.approx(np.full(4, 0.25))
    assert described[1::2] == pytest.approx(np.full(4, 0.5))


@settings(max_examples=25, derandomize=True)
@given(st.floats(0.0, 6.0), st.floats(0.3, 4.0), st.floats(-5.0, 5.0), st.integers(0, 4))
def test_angles_and_lengths_do_not_see_a_similarity(angle, scale, shift, start):
    shape = np.array([[0.0, 0.0], [3.0, 0.2], [4.0, 2.0], [1.0, 4.0], [-1.0, 2.0]])
    c, s = np.cos(angle), np.sin(angle)
    moved = np.roll(scale * shape @ np.array([[c, s], [-s, c]]) + shift, start, axis=0)
    assert angles_and_lengths(moved) == pytest.approx(angles_and_lengths(shape), abs=1e-9)


@pytest.mark.parametrize("shift", [0.0, 1.0, -2.5])
def test_a_parabola_has_one_invariant_at_all_its_points(shift):
    # y = (x + shift)^2 / 4 has p = 2: the invariant is p^(-2/3)
    geometry = cubic_geometry(
        np.array([shift**2 / 4, shift / 2, 0.25, 0.0]), np.array([-1.0, 0.0, 2.0])
    )
    assert parabola_invariant(geometry) == pytest.approx(np.full(3, 2.0 ** (-2 / 3)))
    assert conic_invariants(geometry)[0] == pytest.approx(0.0, abs=1e-9)


def test_an_ellipse_has_its_two_invariants_from_any_points():
    a, b = 5.0, 3.0
    for t in (np.array([0.2, 0.7]), np.array([0.3, 1.0, 1.4])):
        rho = np.hypot(a * np.sin(t), b * np.cos(t))
        slope = (a**2 - b**2) * np.sin(t) * np.cos(t) / rho
        geometry = Geometry(curvature=a * b / rho**3, derivative=-3 * a * b * slope / rho**5)
        m, conic = conic_invariants(geometry)
        assert m == pytest.approx((a * b) ** (-2 / 3))
        assert conic == pytest.approx((a**2 + b**2) / (a * b) ** (4 / 3))


def test_sections_do_not_see_where_a_patch_lies_nor_how_it_is_turned():
    pad = grid()
    first = section_features(ellipse(pad, 6.0, 4.0), pad)
    moved = section_features(ellipse(pad, 6.0, 4.0, 0.8, (1.0, -1.0)), pad)
    other = section_features(ellipse(pad, 4.0, 3.9), pad)
    # what a straight section has none of (derivative at the middle, cubic term) is left out
    telling = [0, 1, 8, 9]
    assert moved[telling] == pytest.approx(first[telling], rel=0.06)
    assert np.abs(other - first)[telling].max() > 0.15
