"""What a drawn object is to the pads: two surfaces over their plane."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Drawing(Protocol):
    """A rigid object as it is drawn; x along its own long axis, z along the closing axis."""

    @property
    def roll_step_rad(self) -> float:
        """Rolls in which it rests between the pads: multiples of this in rad; 0 allows any."""
        ...

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return its reach in m towards both pads at points of its own frame, -inf beside it."""
        ...


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
        Where the object's centre is in the plane in m.
    rotation_rad, roll_rad
        Turns about the closing axis and about the object's own long axis in rad.
    """
    dx_m, dy_m = np.broadcast_arrays(x_m - at_m[0], y_m - at_m[1])
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    return drawing.heights(c * dx_m + s * dy_m, c * dy_m - s * dx_m, roll_rad)


def resting_roll_rad(drawing: Drawing, roll_rad: float) -> float:
    """Return the roll in rad onto the nearest side that the object rests on."""
    step_rad = drawing.roll_step_rad
    return step_rad * round(roll_rad / step_rad) if step_rad else roll_rad
