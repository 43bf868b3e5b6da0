"""Pressure on the pads as inline SVG, coloured by the page's light or dark theme.

A picture has one path for each of `N_SHADES` shades (CSS classes ``s1`` to ``s12``), so all 408
taxels of a grasp take a few kilobytes.
"""

from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp
from tactile.layout import TaxelLayout

N_SHADES = 12
"""Number of shades between zero and full scale."""

UNTOUCHED_SHARE = 0.10
"""Largest reading of an untouched pad as a share of full scale: noise stays below 8 %."""

_FILL = 0.92
"""Side of a drawn taxel as a share of the pitch: a thin gap separates the taxels."""


_LEVELS, _LEVEL_FRAMES = 4, 5
"""Number of forces of the ramp with a picture, and of frames in the mean of a picture."""


def pressure_levels(grasp: Grasp) -> dict[str, NDArray[np.float64]]:
    """Return the counts (n_taxels,) at four equal steps of the force ramp, by the force as text.

    Each is the mean of the nearest frames. The force is the set-point, which each frame of a cell's
    grasp has.
    """
    levels = {}
    for wanted_n in np.linspace(0, float(grasp.force_n.max()), _LEVELS + 1)[1:]:
        # Of equally near frames take the later ones: their pressure has settled.
        near = np.lexsort((-np.arange(grasp.n_frames), np.abs(grasp.force_n - wanted_n)))
        levels[f"{wanted_n:.1f} N"] = grasp.counts[near[:_LEVEL_FRAMES]].mean(axis=0)
    return levels


def level_pictures(
    layout: TaxelLayout, caption: str, counts: NDArray[np.float64], full: float
) -> dict[str, Any]:
    """Draw all pads at one force: gripping pads, other touched pads, names of untouched pads.

    ``full`` are the counts of the darkest shade.
    """
    places = range(layout.n_pads)
    pictures = [_picture(layout, i, counts[layout.taxels_of(i)], full) for i in places]
    small = [one for index, one in enumerate(pictures) if index not in layout.gripping_pads]
    return {
        "caption": caption,
        "gripping": [pictures[index] for index in layout.gripping_pads],
        "others": [picture for picture in small if picture["touched"]],
        "untouched": [picture["name"] for picture in small if not picture["touched"]],
    }


def _picture(
    layout: TaxelLayout, index: int, values: NDArray[np.float64], full: float
) -> dict[str, Any]:
    """Return name of a pad, peak in counts, whether it is touched, and the picture."""
    peak = float(values.max())
    xy_mm = layout.taxel_xy_m[layout.taxels_of(index)] * 1e3
    return {
        "name": layout.pads[index].name,
        "peak": peak,
        "touched": peak > UNTOUCHED_SHARE * layout.adc_max,
        "svg": pad_svg(xy_mm, values, full, f"pressure map, peak {peak:.0f} counts"),
    }


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
        Their values; 0 or less has the lightest shade.
    full
        Value of the darkest shade.
    label
        Text for screen readers.
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
