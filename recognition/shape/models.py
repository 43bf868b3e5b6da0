"""Kinds of shape that can be fitted to pressed pads, with their priors, and drawn objects.

Every kind is symmetric about the plane between the pads and 2 h thick along the closing axis. A
model gives two values over a grid in the plane of the pads. They are the depth of its surface below
its highest point, and its share of each cell. In its own frame u is along the object, v across it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Drawing(Protocol):
    """A drawn rigid object: two surfaces over the plane of the pads.

    x is along its own long axis, z along the closing axis.
    """

    @property
    def roll_step_rad(self) -> float:
        """Step in rad of the rolls in which it rests between the pads; 0 allows any."""

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return its reach in m towards both pads at points of its own frame, -inf outside it."""


def posed(
    drawing: Drawing,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
    *,
    at_m: tuple[float, float],
    rotation_rad: float,
    roll_rad: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the reach in m of a posed object towards both pads at points of the pads' plane.

    Parameters
    ----------
    x_m, y_m
        Points, broadcast against each other.
    at_m
        Position of the object's centre in the plane in m.
    rotation_rad, roll_rad
        Turns about the closing axis and about the object's own long axis in rad.
    """
    dx_m, dy_m = np.broadcast_arrays(x_m - at_m[0], y_m - at_m[1])
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    return drawing.heights(c * dx_m + s * dy_m, c * dy_m - s * dx_m, roll_rad)


def resting_roll_rad(drawing: Drawing, roll_rad: float) -> float:
    """Return the roll in rad to the nearest side on which the object rests."""
    step_rad = drawing.roll_step_rad
    return step_rad * round(roll_rad / step_rad) if step_rad else roll_rad


Array = NDArray[np.floating[Any]]
Surface = tuple[Array, Array]
"""Depth below the highest point in m; share from 0 to 1 of the cell that is covered."""

_OUTSIDE_M = 1.0
"""Depth in m outside an object, without pressure: much more than any foam."""
_LOG_HALF_MM = (float(np.log(7.0)), 0.9)
"""Mean and standard deviation of the prior of the logarithm of half a thickness in mm."""
_FLAT_UNIT_M = 5e-3
"""Half length and half width of a flat object are relative to this, in m."""


@dataclass(frozen=True, slots=True)
class ShapeModel:
    """One kind of shape."""

    kind: str
    """Its name in an answer."""
    surface: Callable[[Array, Array, Array, Array, float], Surface]
    """Returns the surface. Arguments: h in m (B, 1, 1), own parameters (B, n, 1, 1), u and v in m
    (B, n_x, n_y) and the length of a cell in m."""
    prior: tuple[tuple[float, float], ...] = (_LOG_HALF_MM,)
    """Mean and standard deviation of the normal prior: of the logarithm of h in mm, then of the
    shape's own parameters."""

    @property
    def n_own(self) -> int:
        """Number of parameters: log h and the shape's own."""
        return len(self.prior)

    @property
    def turns(self) -> bool:
        """Whether a turn about the closing axis changes the footprint."""
        return self.n_own > 1

    def dimensions_m(self, h_m: float, own: Array) -> dict[str, float]:
        """Return dimensions in m by their names from h in m and own parameters (n,).

        Names are those of `simulator.world.shapes` if they exist there.
        """
        if self.kind == "sphere":
            return {"diameter": 2.0 * h_m}
        if self.kind == "flat":
            long_m, wide_m = (float(x) for x in np.sort(2.0 * _FLAT_UNIT_M * np.exp(own))[::-1])
            return {"height": 2.0 * h_m, "length": long_m, "width": wide_m}
        sizes = {"diameter": 2.0 * h_m, "length": 2.0 * h_m * float(np.exp(own[0]))}
        if self.kind == "dumbbell":
            sizes["waist_length"] = sizes["length"] / (1.0 + float(np.exp(-own[1])))
        return sizes

    def starts(self, h_m: float, long_m: float, wide_m: float) -> tuple[tuple[float, ...], ...]:
        """Return own parameters for the start of a fit.

        From h, half length and half width of the pressed patch in m.
        """
        ratio, long, wide = (
            float(np.log(x)) for x in (long_m / h_m, long_m / _FLAT_UNIT_M, wide_m / _FLAT_UNIT_M)
        )
        if self.kind == "sphere":
            return ((),)
        if self.kind == "oval":
            return ((0.15,), (0.5,), (0.9,))
        if self.kind == "flat":
            return ((long, wide), (long - 0.15, wide - 0.3), (long + 0.15, wide))
        lengths = (ratio - 0.2, ratio, ratio + 0.2)
        return tuple((x,) if self.kind == "cylinder" else (x, 0.0) for x in lengths)


def _covered(half_m: Array, at_m: Array, cell_m: float) -> Array:
    """Return the covered share of cells at a distance from the middle, for a half length."""
    share: Array = np.clip((half_m - np.abs(at_m)) / cell_m + 0.5, 0.0, 1.0)
    return share


def _cap(h_m: Array, squared: Array) -> Surface:
    lag_m = h_m * (1.0 - np.sqrt(np.maximum(1.0 - squared, 0.0)))
    inside = squared < 1.0
    return np.where(inside, lag_m, _OUTSIDE_M), inside.astype(squared.dtype)


def _sphere(h_m: Array, _own: Array, u_m: Array, v_m: Array, _cell_m: float) -> Surface:
    return _cap(h_m, (u_m * u_m + v_m * v_m) / (h_m * h_m))


def _oval(h_m: Array, own: Array, u_m: Array, v_m: Array, _cell_m: float) -> Surface:
    half_m = h_m * np.exp(own[:, 0])
    return _cap(h_m, (u_m / half_m) ** 2 + (v_m / h_m) ** 2)


def _cylinder(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    lag_m, inside = _cap(h_m, (v_m / h_m) ** 2)
    return lag_m, inside * _covered(h_m * np.exp(own[:, 0]), u_m, cell_m)


def _flat(_h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    long_m, wide_m = _FLAT_UNIT_M * np.exp(own[:, 0]), _FLAT_UNIT_M * np.exp(own[:, 1])
    share = _covered(long_m, u_m, cell_m) * _covered(wide_m, v_m, cell_m)
    return np.zeros_like(u_m), share


def _dumbbell(h_m: Array, own: Array, u_m: Array, v_m: Array, cell_m: float) -> Surface:
    lag_m, inside = _cap(h_m, (v_m / h_m) ** 2)
    half_m = h_m * np.exp(own[:, 0])
    waist_m = half_m / (1.0 + np.exp(-own[:, 1]))
    share = _covered(half_m, u_m, cell_m) - _covered(waist_m, u_m, cell_m)
    return lag_m, inside * np.maximum(share, 0.0)


SHAPE_MODELS: Mapping[str, ShapeModel] = MappingProxyType(
    {
        model.kind: model
        for model in (
            ShapeModel("sphere", _sphere),
            # length over diameter: a little more than that of a ball, or larger
            ShapeModel("oval", _oval, (_LOG_HALF_MM, (0.5, 0.35))),
            ShapeModel("cylinder", _cylinder, (_LOG_HALF_MM, (0.9, 0.6))),
            # length and width over 10 mm
            ShapeModel("flat", _flat, (_LOG_HALF_MM, (0.3, 0.5), (0.0, 0.5))),
            # length over diameter; share of the waist in the length, as a logit
            ShapeModel("dumbbell", _dumbbell, (_LOG_HALF_MM, (0.3, 0.3), (0.0, 0.6))),
        )
    }
)
"""The kinds that are compared, by name."""
