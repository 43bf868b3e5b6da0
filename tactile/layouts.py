"""The layouts that exist: the paper's two fingers of 204 taxels, and two plain opposing pads."""

from typing import Literal

from tactile.layout import Face, Pad, TaxelLayout, Vector

FINGER_LENGTH_M = 0.055
FINGER_WIDTH_M = 0.020
FINGER_THICKNESS_M = 0.012
"""The paper, section 2: a finger of 55 x 20 x 12 mm."""

LayoutName = Literal["paper", "pinch"]


def _finger_pads(finger: int) -> tuple[Pad, ...]:
    length, width, thickness = FINGER_LENGTH_M, FINGER_WIDTH_M, FINGER_THICKNESS_M
    mid_z = -0.5 * thickness
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    minus_y, minus_z = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
    # face, rows, columns, extent along the pad's x and y in m, centre, x axis, y axis
    faces: tuple[tuple[Face, int, int, float, float, Vector, Vector, Vector], ...] = (
        ("inner", 16, 4, length, width, (0.0, 0.0, 0.0), x, y),
        ("outer", 16, 4, length, width, (0.0, 0.0, -thickness), x, minus_y),
        ("side_a", 16, 2, length, thickness, (0.0, 0.5 * width, mid_z), x, minus_z),
        ("side_b", 16, 2, length, thickness, (0.0, -0.5 * width, mid_z), x, z),
        ("tip", 6, 2, width, thickness, (0.5 * length, 0.0, mid_z), y, z),
    )
    return tuple(
        Pad(
            name=f"finger{finger}.{face}",
            finger=finger,
            face=face,
            rows=rows,
            columns=columns,
            pitch_x_m=extent_x_m / rows,
            pitch_y_m=extent_y_m / columns,
            centre_m=centre_m,
            x_axis=x_axis,
            y_axis=y_axis,
        )
        for face, rows, columns, extent_x_m, extent_y_m, centre_m, x_axis, y_axis in faces
    )


def paper_layout() -> TaxelLayout:
    """Return the paper's sensor: 2 x 204 taxels of 8 bit.

    Per finger two 16 x 4 fields, two 16 x 2 fields and one 6 x 2 field (section 2); the pitch
    follows from the finger's size: 3.44 mm along and 5 mm across the inner face.
    """
    return TaxelLayout(name="paper", pads=_finger_pads(0) + _finger_pads(1))


def pinch_layout() -> TaxelLayout:
    """Return two opposing pads of 13 x 6 taxels at 3.4 mm pitch, 12 bit in 16 bit samples."""
    pads = tuple(
        Pad(
            name=f"finger{finger}.inner",
            finger=finger,
            face="inner",
            rows=13,
            columns=6,
            pitch_x_m=3.4e-3,
            pitch_y_m=3.4e-3,
        )
        for finger in (0, 1)
    )
    return TaxelLayout(name="pinch", pads=pads, sample_bits=16, adc_max=4095)
