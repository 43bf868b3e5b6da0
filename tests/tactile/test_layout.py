"""Layouts: sizes, positions, hash, refusals."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tactile.errors import LayoutError
from tactile.layout import Pad, TaxelLayout, paper_layout, pinch_layout

PAPER = paper_layout()
INNER = [
    Pad(name=f"f{i}", finger=i, face="inner", rows=2, columns=3, pitch_x_m=0.002, pitch_y_m=0.003)
    for i in (0, 1)
]
POSITION_M = np.concatenate(
    [pad.centre_m + pad.taxel_xy_m() @ [pad.x_axis, pad.y_axis] for pad in PAPER.pads]
)


def test_paper_layout_has_204_taxels_a_finger_in_the_order_of_the_paper() -> None:
    finger = [[16, 4], [16, 4], [16, 2], [16, 2], [6, 2]]
    assert (PAPER.pad_shape.tolist(), PAPER.n_taxels) == (finger + finger, 408)
    assert PAPER.sample_bits == 8
    assert [pad.face for pad in PAPER.pads[:5]] == ["inner", "outer", "side_a", "side_b", "tip"]
    assert PAPER.gripping_pads == (0, 5)
    assert [pad.finger for pad in PAPER.pads] == [0] * 5 + [1] * 5
    assert PAPER.taxels_of(5) == slice(204, 268)
    np.testing.assert_array_equal(np.bincount(PAPER.taxel_pad)[:5], [64, 64, 32, 32, 12])


def test_paper_pitch_and_extent() -> None:
    inner = PAPER.pads[0]
    assert (inner.pitch_x_m, inner.pitch_y_m) == (pytest.approx(3.4375e-3), pytest.approx(5e-3))
    assert np.all(np.abs(POSITION_M[:, :2]) <= np.array([0.0275, 0.010]) + 1e-12)
    assert np.all((POSITION_M[:, 2] <= 0) & (POSITION_M[:, 2] >= -0.012))


def test_normals_point_out_of_the_finger() -> None:
    centre = np.array([0.0, 0.0, -0.006])
    normal = np.array([pad.normal for pad in PAPER.pads])[PAPER.taxel_pad]
    assert np.all(np.einsum("ij,ij->i", POSITION_M - centre, normal) > 0)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    np.testing.assert_array_equal(normal[0], [0, 0, 1])


def test_inner_pads_of_both_fingers_face_each_other_taxel_by_taxel() -> None:
    first, second = (PAPER.taxels_of(pad) for pad in PAPER.gripping_pads)
    np.testing.assert_array_equal(POSITION_M[first], POSITION_M[second])


def test_pinch_layout_is_row_by_row_and_centred() -> None:
    layout = pinch_layout()
    assert (layout.n_taxels, layout.sample_bits, layout.adc_max) == (156, 16, 4095)
    np.testing.assert_allclose(
        layout.taxel_xy_m[:7] * 1e3,
        [[-20.4, y] for y in (-8.5, -5.1, -1.7, 1.7, 5.1, 8.5)] + [[-17.0, -8.5]],
        atol=1e-9,
    )


def test_arrays_cannot_be_written_and_a_pad_that_is_not_there_is_named() -> None:
    for array in (PAPER.taxel_xy_m, PAPER.taxel_pad):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(IndexError, match="pad 10"):
        PAPER.taxels_of(10)


def test_hash_covers_what_gives_the_samples_their_meaning() -> None:
    layout = paper_layout()
    assert layout.layout_hash == paper_layout().layout_hash
    pads = layout.pads
    other = [
        replace(layout, pads=(pads[5:] + pads[:5])),
        replace(layout, pads=(replace(pads[0], pitch_x_m=3.4e-3), *pads[1:])),
        replace(layout, adc_max=254),
        replace(layout, adc_max=4095),
    ]
    assert len({layout.layout_hash, *(changed.layout_hash for changed in other)}) == 5
    assert replace(layout, name="renamed").layout_hash == layout.layout_hash
    assert len(layout.layout_hash) == 16
    assert int(layout.layout_hash, 16) > 0


SMALL = TaxelLayout(name="small", pads=tuple(INNER))


@pytest.mark.parametrize(
    ("whole", "change", "says"),
    [
        (INNER[0], {"finger": 2}, "finger is 2"),
        (INNER[0], {"face": "back"}, "back"),
        (INNER[0], {"rows": 0}, "0 x 3"),
        (INNER[0], {"columns": 256}, "2 x 256"),
        (INNER[0], {"pitch_x_m": 0.0}, "pitch"),
        (INNER[0], {"pitch_y_m": float("nan")}, "pitch"),
        (INNER[0], {"centre_m": (0.0, float("inf"), 0.0)}, "finite"),
        (INNER[0], {"y_axis": (0.0, 2.0, 0.0)}, "orthonormal"),
        (INNER[0], {"y_axis": (1.0, 0.0, 0.0)}, "orthonormal"),
        (SMALL, {"adc_max": 65536}, "65536"),
        (SMALL, {"adc_max": 0}, "adc_max is 0"),
        (SMALL, {"pads": (INNER[0],)}, "1 and 0"),
        (SMALL, {"pads": (INNER[0], replace(INNER[0], name="b"), INNER[1])}, "2 and 1"),
        (SMALL, {"pads": (INNER[0], replace(INNER[1], name="f0"))}, "repeat"),
    ],
)
def test_impossible_pads_and_layouts_are_refused(whole: Any, change: dict, says: str) -> None:
    with pytest.raises(LayoutError, match=says):
        replace(whole, **change)
