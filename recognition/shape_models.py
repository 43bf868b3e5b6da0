"""Kinds of shape that can be fitted to pressed pads, and what is thought of them beforehand.

Every kind is symmetric about the plane between the pads and 2 h thick along the closing axis. A
model tells, over a grid in the plane of the pads, how far its surface lies below its highest point
and which share of each cell it covers. In its own frame u runs along the object, v across it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Surface = tuple[Array, Array]
"""Depth below the highest point in m; share from 0 to 1 of the cell that is covered."""

_BESIDE_M = 1.0
_LOG_HALF_MM = (float(np.log(7.0)), 0.9)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeModel:
    """One kind of shape.

    Attributes
    ----------
    kind
        What it is called in an answer.
    mean, sd
        Prior, normal: of the logarithm of h in mm, then of the shape's own parameters.
    turns
        Whether a turn about the closing axis changes what the pads see.
    surface
        From h in m (B, 1, 1), own parameters (B, n, 1, 1), u and v in m (B, n_x, n_y) and the
        length of a cell in m to the surface.
    dimensions_m
        From h in m and own parameters (n,) to dimensions in m by their names; those of
        `simulator.shape_text` where there are such.
    starts
        From h, half length and half width of the pressed patch in m to own parameters from which
        a fit may start.
    """

    kind: str
    mean: tuple[float, ...]
    sd: tuple[float, ...]
    turns: bool
    surface: Callable[[Array, Array, Array, Array, float], Surface]
    dimensions_m: Callable[[float, Array], dict[str, float]]
    starts: Callable[[float, float, float], tuple[tuple[float, ...], ...]]

    @property
    def n_own(self) -> int:
        """Number of parameters: log h and the shape's own."""
        return len(self.mean)


def _covered(half_m: Array, at_m: Array, cell_m: float) -> Array:
    """Return the share of cells, at a distance from the middle, that lie within a half length."""
    share: Array = np.clip((half_m - np.abs(at_m)) / cell_m + 0.5, 0.0, 1.0)
    return share


def _cap(h_m: Array, squared: Array) -> Surface:
    lag_m = h_m * (1.0 - np.sqrt(np.maximum(1.0 - squared, 0.0)))
    inside = squared < 1.0
    return np.where(inside, lag_m, _BESIDE_M), inside.astype(squared.dtype)


def _sphere(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    del own, cell_m
    return _cap(h_m, (u_m * u_m + v_m * v_m) / (h_m * h_m))


def _oval(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    del cell_m
    half_m = h_m * np.exp(own[:, 0])
    return _cap(h_m, (u_m / half_m) ** 2 + (v_m / h_m) ** 2)


def _cylinder(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    lag_m, inside = _cap(h_m, (v_m / h_m) ** 2)
    return lag_m, inside * _covered(h_m * np.exp(own[:, 0]), u_m, cell_m)


def _flat(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    del h_m
    long_m, wide_m = 5e-3 * np.exp(own[:, 0]), 5e-3 * np.exp(own[:, 1])
    share = _covered(long_m, u_m, cell_m) * _covered(wide_m, v_m, cell_m)
    return np.zeros_like(u_m), share


def _dumbbell(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    lag_m, inside = _cap(h_m, (v_m / h_m) ** 2)
    half_m = h_m * np.exp(own[:, 0])
    waist_m = half_m / (1.0 + np.exp(-own[:, 1]))
    share = _covered(half_m, u_m, cell_m) - _covered(waist_m, u_m, cell_m)
    return lag_m, inside * np.maximum(share, 0.0)


def _size(kind: str) -> Callable[[float, Array], dict[str, float]]:
    def dimensions_m(h_m: float, own: Array) -> dict[str, float]:
        if kind == "sphere":
            return {"diameter": 2.0 * h_m}
        if kind == "flat":
            long_m, wide_m = (float(x) for x in np.sort(1e-2 * np.exp(own))[::-1])
            return {"height": 2.0 * h_m, "length": long_m, "width": wide_m}
        sizes = {"diameter": 2.0 * h_m, "length": 2.0 * h_m * float(np.exp(own[0]))}
        if kind == "dumbbell":
            sizes["waist_length"] = sizes["length"] / (1.0 + float(np.exp(-own[1])))
        return sizes

    return dimensions_m


def _starts(kind: str) -> Callable[[float, float, float], tuple[tuple[float, ...], ...]]:
    def starts(h_m: float, long_m: float, wide_m: float) -> tuple[tuple[float, ...], ...]:
        ratio, long, wide = (float(np.log(x)) for x in (long_m / h_m, long_m / 5e-3, wide_m / 5e-3))
        if kind == "sphere":
            return ((),)
        if kind == "oval":
            return ((0.15,), (0.5,), (0.9,))
        if kind == "flat":
            return ((long, wide), (long - 0.15, wide - 0.3), (long + 0.15, wide))
        lengths = (ratio - 0.2, ratio, ratio + 0.2)
        return tuple((x,) if kind == "cylinder" else (x, 0.0) for x in lengths)

    return starts


def _model(
    kind: str,
    surface: Callable[[Array, Array, Array, Array, float], Surface],
    own: tuple[tuple[float, float], ...] = (),
) -> ShapeModel:
    priors = (_LOG_HALF_MM, *own)
    return ShapeModel(
        kind=kind,
        mean=tuple(mean for mean, _ in priors),
        sd=tuple(sd for _, sd in priors),
        turns=bool(own),
        surface=surface,
        dimensions_m=_size(kind),
        starts=_starts(kind),
    )


SHAPE_MODELS: Mapping[str, ShapeModel] = MappingProxyType(
    {
        model.kind: model
        for model in (
            _model("sphere", _sphere),
            # length over diameter: from a little more than a ball on
            _model("oval", _oval, ((0.5, 0.35),)),
            _model("cylinder", _cylinder, ((0.9, 0.6),)),
            # length and width over 10 mm
            _model("flat", _flat, ((0.3, 0.5), (0.0, 0.5))),
            # length over diameter; share of the waist in the length, as a logit
            _model("dumbbell", _dumbbell, ((0.3, 0.3), (0.0, 0.6))),
        )
    }
)
"""The kinds that are compared, by name."""
