"""Layouts from the config and from recorded pads."""

from typing import Any

import numpy as np
import pytest

from cell.config.tactile import (
    PadConfig,
    PadsConfig,
    TactileConfig,
    layout_from_config,
    layout_from_pads,
)
from cell.control.records import pad_array
from cell.errors import ConfigError
from recognition.grasp import PadArray
from tactile.layout import paper_layout, pinch_layout
from tests.cell.conftest import plain_pads


def pad(finger: Any, face: Any = "inner", rows: int = 4, columns: int = 3) -> PadConfig:
    return PadConfig(
        finger=finger, face=face, rows=rows, columns=columns, pitch_x_mm=2.0, pitch_y_mm=3.0
    )


def spelled(*pads: PadConfig, adc_max: int = 1023) -> TactileConfig:
    return TactileConfig(layout=PadsConfig(name="own", pads=pads, adc_max=adc_max))


def test_own_pads_become_a_layout() -> None:
    layout = layout_from_config(spelled(pad(0), pad(0, "tip", 2, 2), pad(1, rows=5)))
    assert layout.name == "own"
    assert layout.n_taxels == 12 + 4 + 15
    assert layout.pad_shape.tolist() == [[4, 3], [2, 2], [5, 3]]
    assert layout.gripping_pads == (0, 2)
    assert (layout.adc_max, layout.sample_bits) == (1023, 16)
    steps_m = np.diff(layout.taxel_xy_m[:4], axis=0)
    np.testing.assert_allclose(np.abs(steps_m[0]), [0.0, 3e-3], atol=1e-12)
    assert layout_from_config(spelled(pad(0), pad(1), adc_max=255)).sample_bits == 8


@pytest.mark.parametrize(
    "pads", [(pad(0), pad(0)), (pad(0), pad(0, "tip")), (pad(0, "tip"), pad(1))]
)
def test_pads_that_make_no_gripper_are_a_config_error(pads: tuple[PadConfig, ...]) -> None:
    with pytest.raises(ConfigError, match=r"tactile\.layout: layout own"):
        layout_from_config(spelled(*pads))


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout()])
def test_recorded_pads_give_a_layout_that_carries_their_frames(layout: Any) -> None:
    made = layout_from_pads(pad_array(layout))
    assert made.n_taxels == layout.n_taxels
    assert made.pad_shape.tolist() == layout.pad_shape.tolist()
    assert (made.adc_max, made.sample_bits) == (layout.adc_max, layout.sample_bits)
    assert made.gripping_pads == layout.gripping_pads
    pitches_m = [(one.pitch_x_m, one.pitch_y_m) for one in layout.pads]
    np.testing.assert_allclose([(one.pitch_x_m, one.pitch_y_m) for one in made.pads], pitches_m)


def recorded(*shapes: tuple[int, int]) -> PadArray:
    return plain_pads(*shapes, pitch_m=2.5e-3, adc_max=100)


@pytest.mark.parametrize("n_pads", [1, 3, 5])
def test_an_odd_number_of_recorded_pads_is_refused(n_pads: int) -> None:
    with pytest.raises(ConfigError, match=f"have {n_pads} pads; two fingers need an even number"):
        layout_from_pads(recorded(*[(3, 2)] * n_pads))


def test_more_pads_than_a_finger_has_faces_and_single_taxels_are_carried() -> None:
    layout = layout_from_pads(recorded(*[(1, 1)] * 16))
    assert layout.n_pads == 16
    assert layout.gripping_pads == (0, 8)
    assert layout.pads[0].pitch_x_m == 1e-3
