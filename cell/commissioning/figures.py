"""Figures of the findings: numbers in JSON, and their drawing.

`curves` and `pads` make the numbers; `element` draws them for the record.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cell.report.figures import MUTED, colour, drawing, new_figure, pad_svg, picture
from tactile.layout import TaxelLayout

_MOST_POINTS = 600
"""Most points of a kept curve; the picture has about as many pixels."""
_DECIMALS = 6
"""Decimals of the kept numbers, in their units."""

Figure = Mapping[str, Any]


def curves(
    title: str,
    x: ArrayLike,
    series: Mapping[str, ArrayLike],
    *,
    x_label: str,
    y_label: str,
    limits: Mapping[str, float] | None = None,
) -> Figure:
    """Return a figure of curves over one axis, NaN for gaps.

    Parameters
    ----------
    x : (n,) float64
        Values of the axis.
    series
        Values (n,) of each curve by its name.
    x_label, y_label
        Names of the axes, with units.
    limits
        Horizontal lines by name, e.g. ``{"cap": 15.0}``.
    """
    every = max(1, -(-np.asarray(x).size // _MOST_POINTS))
    return {
        "kind": "curves",
        "title": title,
        "x": _kept(x, every),
        "series": {name: _kept(values, every) for name, values in series.items()},
        "x_label": x_label,
        "y_label": y_label,
        "limits": dict(limits or {}),
    }


def pads(title: str, layout: TaxelLayout, values: ArrayLike, *, unit: str) -> Figure:
    """Return a figure of one value for each taxel.

    ``values`` are (n_taxels,) float64 in the order of the layout.
    """
    shown = np.asarray(values, dtype=np.float64)
    return {
        "kind": "pads",
        "title": title,
        "unit": unit,
        "pads": [
            {
                "name": pad.name,
                "xy_mm": np.round(pad.taxel_xy_m() * 1e3, 3).tolist(),
                "values": _kept(shown[layout.taxels_of(index)], 1),
            }
            for index, pad in enumerate(layout.pads)
        ],
    }


def element(figure: Figure) -> str:
    """Return a figure as an element of a page.

    Raises MissingExtraError if matplotlib is missing.
    """
    return _pads(figure) if figure["kind"] == "pads" else _curves(figure)


def _kept(values: ArrayLike, every: int) -> list[float | None]:
    numbers = np.asarray(values, dtype=np.float64).ravel()[::every]
    return [round(v, _DECIMALS) if np.isfinite(v) else None for v in numbers.tolist()]


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array(values, dtype=np.float64)  # None becomes NaN


def _pads(figure: Figure) -> str:
    """Return the pictures of all pads, with one scale."""
    values = [_floats(pad["values"]) for pad in figure["pads"]]
    full = max([1e-9, *(float(np.nanmax(v)) for v in values if np.isfinite(v).any())])
    cells = []
    for pad, shown in zip(figure["pads"], values, strict=True):
        known = np.nan_to_num(shown)
        label = f"{pad['name']}: {known.min():.3g} to {known.max():.3g} {figure['unit']}"
        picture = pad_svg(np.array(pad["xy_mm"]), known, full, label)
        cells.append(f"<figure>{picture}<figcaption>{label}</figcaption></figure>")
    return f'<div class="pads">{"".join(cells)}</div>'


def _curves(figure: Figure) -> str:
    x = _floats(figure["x"])
    with drawing():
        drawn = new_figure(6.4, 3.2)
        axes = drawn.subplots()
        for place, (label, values) in enumerate(figure["series"].items()):
            axes.plot(x, _floats(values), color=colour(place), lw=1.4, label=label)
        for label, value in figure["limits"].items():
            axes.axhline(value, color=MUTED, lw=0.9, ls=(0, (4, 3)), label=label)
        axes.set_xlabel(figure["x_label"])
        axes.set_ylabel(figure["y_label"])
        axes.margins(x=0.01)
        if len(figure["series"]) + len(figure["limits"]) > 1:
            axes.legend(loc="best")
    return picture(drawn, figure["title"])
