"""The part of a report with shape and size of the held parts, on one scale in mm."""

from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from cell.learning.shape_reading import in_words
from recognition.recognizer import UNKNOWN
from recognition.shape.answer import ShapeAnswer

MAX_BARS = 30
"""Most bars of one object, and most listed unknown objects; all are counted."""

ShapeRow = tuple[str, str, ShapeAnswer | None]
"""True name (empty if not known), the answer, and its shape."""

_TICKS = 6
"""Most ticks of the scale."""


def shapes_view(
    rows: Sequence[ShapeRow], true_sizes: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any] | None:
    """Return a group for each object, the scale, and the unknown objects; None without shapes.

    ``true_sizes`` are texts by label, for objects of a simulated cell.
    """
    read = [(truth, label, shape) for truth, label, shape in rows if shape is not None]
    if not read:
        return None
    ends_mm = [
        1e3 * x for *_, shape in read for t in shape.thicknesses for x in (t.low_m, t.high_m)
    ]
    step_mm = _step_mm(max(ends_mm) - min(ends_mm))
    low_mm = step_mm * np.floor(min(ends_mm) / step_mm)
    high_mm = max(step_mm * np.ceil(max(ends_mm) / step_mm), low_mm + step_mm)
    groups = []
    for name, count in Counter(truth or label for truth, label, _ in rows).items():
        shapes = [shape for truth, label, shape in read if (truth or label) == name]
        groups.append(
            {
                "label": name,
                "kinds": _kinds(shapes, count),
                "shapes": shapes[:MAX_BARS],
                "text": "; ".join(filter(None, (_sizes(shapes), true_sizes.get(name)))),
            }
        )
    strangers = [(truth, in_words(shape)) for truth, label, shape in read if label == UNKNOWN]
    return {
        "groups": groups,
        "at": lambda x_m: 100.0 * (1e3 * x_m - low_mm) / (high_mm - low_mm),
        "ticks_mm": np.arange(low_mm, high_mm + 0.5 * step_mm, step_mm).tolist(),
        "strangers": strangers[:MAX_BARS],
        "n_hidden": len(strangers[MAX_BARS:]),
    }


def _kinds(shapes: Sequence[ShapeAnswer], n: int) -> str:
    """Return the number of each kind in ``n`` identifications, and of those without shape."""
    counts = Counter(shape.kind for shape in shapes).most_common()
    silent = [("without shape", n - len(shapes))] if len(shapes) < n else []
    return ", ".join(f"{kind} {count} of {n}" for kind, count in counts + silent)


def _sizes(shapes: Sequence[ShapeAnswer]) -> str:
    """Return the sizes of one answer; of several answers the medians of size and interval."""
    if len(shapes) < 2:
        return " and ".join(str(thickness) for shape in shapes for thickness in shape.thicknesses)
    size_mm = 1e3 * float(np.median([shape.size_m for shape in shapes]))
    width_mm = 1e3 * float(np.median([shape.high_m - shape.low_m for shape in shapes]))
    return f"median {size_mm:.1f} mm, intervals {width_mm:.1f} mm wide"


def _step_mm(range_mm: float) -> float:
    """Return a round tick spacing in mm."""
    steps = [0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
    return next((step for step in steps if range_mm / step <= _TICKS), 200.0)
