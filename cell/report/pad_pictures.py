"""Pressure on the pads as inline SVG, coloured by the page's light or dark theme.

A picture holds one path for each of `N_SHADES` shades (CSS classes ``s1`` to ``s12``), so that all
408 taxels of a grasp take a few kilobytes.
"""

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from cell.report.data import ExampleGrasp, PressureLevel
from tactile.layout import TaxelLayout

N_SHADES = 12
"""Shades from the first above nothing to full scale."""

UNTOUCHED_SHARE = 0.10
"""Part of full scale that no taxel of an untouched pad exceeds: noise stays below 8 %."""

_FILL = 0.92
"""Side of a drawn taxel as a share of the pitch: a thin gap separates the taxels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PadPicture:
    """One pad at one force: name, peak in counts, and the picture as inline SVG."""

    name: str
    peak: float
    touched: bool
    svg: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelPictures:
    """All pads at one force: the gripping ones, the others, and names of the untouched."""

    caption: str
    gripping: tuple[PadPicture, ...]
    others: tuple[PadPicture, ...]
    untouched: tuple[str, ...]


def full_shade(example: ExampleGrasp) -> float:
    """Return the counts that the darkest shade stands for: the largest of all levels."""
    return max([1.0, *(float(level.counts.max()) for level in example.levels)])


def level_pictures(example: ExampleGrasp, level: PressureLevel) -> LevelPictures:
    """Draw all pads of a grasp at one force; all levels of a grasp share one scale."""
    layout, full = example.layout, full_shade(example)
    pictures = [_picture(layout, index, level.counts, full) for index in range(layout.n_pads)]
    small = [one for index, one in enumerate(pictures) if index not in layout.gripping_pads]
    return LevelPictures(
        caption=level.caption,
        gripping=tuple(pictures[index] for index in layout.gripping_pads),
        others=tuple(picture for picture in small if picture.touched),
        untouched=tuple(picture.name for picture in small if not picture.touched),
    )


def _picture(
    layout: TaxelLayout, index: int, counts: NDArray[np.float64], full: float
) -> PadPicture:
    taxels = layout.taxels_of(index)
    values = counts[taxels]
    peak = float(values.max())
    label = f"pressure map, peak {peak:.0f} counts"
    return PadPicture(
        name=layout.pads[index].name,
        peak=peak,
        touched=peak > UNTOUCHED_SHARE * layout.adc_max,
        svg=pad_svg(layout.taxel_xy_m[taxels] * 1e3, values, full, label),
    )


def _pitch_mm(places_mm: NDArray[np.float64]) -> float:
    steps = np.diff(np.unique(np.round(places_mm, 3)))
    return float(steps.min()) if len(steps) else 0.0


def pad_svg(
    xy_mm: NDArray[np.float64], values: NDArray[np.float64], full: float, label: str
) -> str:
    """Return one pad as SVG.

    Parameters
    ----------
    xy_mm : (n, 2) float64
        Places of the taxels in mm.
    values : (n,) float64
        Their values; 0 and less is the lightest shade.
    full
        Value of the darkest shade.
    label
        The picture in words.
    """
    pitch_x, pitch_y = _pitch_mm(xy_mm[:, 0]), _pitch_mm(xy_mm[:, 1])
    pitch_x, pitch_y = pitch_x or pitch_y or 1.0, pitch_y or pitch_x or 1.0
    left, top = xy_mm.min(axis=0) - 0.5 * np.array([pitch_x, pitch_y])
    width, height = np.ptp(xy_mm, axis=0) + np.array([pitch_x, pitch_y])
    shades = np.clip(np.ceil(values / full * N_SHADES), 0, N_SHADES).astype(int)
    w, h = round(_FILL * pitch_x, 2), round(_FILL * pitch_y, 2)
    box = f"h{w:g}v{h:g}h-{w:g}z"
    paths = []
    for shade in np.unique(shades):
        corners = xy_mm[shades == shade] - 0.5 * np.array([w, h]) - np.array([left, top])
        d = "".join(f"M{x:.4g} {y:.4g}{box}" for x, y in corners.round(2))
        paths.append(f'<path class="s{shade}" d="{d}"/>')
    return (
        f'<svg class="pad" viewBox="0 0 {width:.4g} {height:.4g}" role="img" '
        f'aria-label="{escape(label)}">{"".join(paths)}</svg>'
    )
