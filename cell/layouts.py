"""Taxel layouts from the config, and from the pads of recorded grasps."""

from typing import get_args

import numpy as np

from cell.config_tactile import PadsConfig, TactileConfig
from cell.errors import ConfigError
from recognition.grasp import PadArray
from tactile.errors import LayoutError
from tactile.layout import Face, Pad, TaxelLayout
from tactile.layouts import paper_layout, pinch_layout


def layout_from_config(config: TactileConfig) -> TaxelLayout:
    """Return the layout that a config names or spells out.

    Raises
    ------
    ConfigError
        If pads of one's own do not make a layout (one inner pad for each finger).
    """
    if config.layout == "paper":
        return paper_layout()
    if config.layout == "pinch":
        return pinch_layout()
    spelled: PadsConfig = config.layout
    try:
        return TaxelLayout(
            name=spelled.name,
            pads=tuple(
                Pad(
                    name=f"finger{pad.finger}.{pad.face}.{number}",
                    finger=pad.finger,
                    face=pad.face,
                    rows=pad.rows,
                    columns=pad.columns,
                    pitch_x_m=pad.pitch_x_mm * 1e-3,
                    pitch_y_m=pad.pitch_y_mm * 1e-3,
                )
                for number, pad in enumerate(spelled.pads)
            ),
            sample_bits=8 if spelled.adc_max <= 255 else 16,
            adc_max=spelled.adc_max,
        )
    except LayoutError as error:
        raise ConfigError(f"tactile.layout: {error}") from error


def layout_from_pads(pads: PadArray) -> TaxelLayout:
    """Return a layout that carries recorded frames of these pads.

    Half of the pads are taken for each finger, in order; the first of each half grips.

    Raises
    ------
    ConfigError
        If there are not two equal halves.
    """
    if pads.n_pads < 2 or pads.n_pads % 2:
        raise ConfigError(
            f"the recorded grasps have {pads.n_pads} pads; two fingers need an even number"
        )
    half = pads.n_pads // 2
    faces = get_args(Face)
    made = []
    for index, (rows, columns) in enumerate(pads.pad_shape.tolist()):
        finger, place = divmod(index, half)
        xy_m = pads.taxel_xy_m[pads.taxels_of(index)]
        made.append(
            Pad(
                name=f"finger{finger}.pad{place}",
                finger=finger,
                face=faces[min(place, len(faces) - 1)],
                rows=rows,
                columns=columns,
                pitch_x_m=_pitch_m(xy_m[::columns, 0]),
                pitch_y_m=_pitch_m(xy_m[:columns, 1]),
            )
        )
    return TaxelLayout(
        name="recorded",
        pads=tuple(made),
        sample_bits=8 if pads.adc_max <= 255 else 16,
        adc_max=pads.adc_max,
    )


def _pitch_m(coordinates_m: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the mean distance of neighbours in m; 1 mm where there is but one taxel."""
    if len(coordinates_m) < 2:
        return 1e-3
    return max(float(np.abs(np.diff(coordinates_m)).mean()), 1e-4)
