"""Forward model of two opposing foam pads: from height maps and depths to counts.

The foam is a bed of columns side by side. At the strain e a column has the pressure
E e (1 + d (e / (1 - e))^2), beyond a largest strain along the tangent. On its way through
the sheet the pressure spreads as a Gaussian, mirrored at the rims of the pad, so that no force is
lost. With F newtons a taxel reads the share 1 - exp(-0.449 gain F) of the full scale:
equation (11) of the paper under constant current, inverted. A sensor with another law has nodes of
force and reading, with straight lines between them; a linear one has two.

Columns may push their neighbours in. This is between separate columns and an elastic body. A
surface point yields under its own column and under the pressure around it. With ``sideways`` = m
its displacement is (1 - m) q + m G q: q is the closing of each column, and G a Gaussian mean over
the surroundings. At m = 0 columns are separate. In wave numbers the compliance
(1 - m) + m exp(-k^2 s^2 / 2) decreases like that of an elastic layer. Under a rigid surface the
displacement is given; elsewhere q is 0. The solver uses projected steps with momentum (Nesterov's),
from the solution for separate columns or from a given one.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from recognition.errors import ContactError
from recognition.grasp import PadArray

Array = NDArray[np.floating[Any]]
"""Of single or of double precision; results have that of the arguments."""

DECAY_PER_N = 0.449
"""Decay of a taxel's resistance over its force in 1/N, equation (11) of the paper."""
CELL_M = 0.5e-3
"""Longest side in m of a cell of the pressure grid."""


def neighbours(points_m: Array, width_m: float) -> Array:
    """Return the weights (n, n) of the push between evenly spaced points along one axis.

    Parameters
    ----------
    points_m : (n,)
        Their positions in m.
    width_m
        Standard deviation of the Gaussian in m.
    """
    step_m = float(abs(points_m[1] - points_m[0])) if len(points_m) > 1 else width_m
    away = (points_m[:, None] - points_m[None, :]) / width_m
    weights: Array = np.exp(-0.5 * away * away) * (step_m / (np.sqrt(2.0 * np.pi) * width_m))
    return weights


def closed_columns_m(
    wanted_m: Array,
    covered: Array | float,
    sideways: Array | float,
    pushes: tuple[Array, Array],
    *,
    steps: int,
    start_m: Array | None = None,
) -> Array:
    """Return the closing of columns under a rigid surface.

    Parameters
    ----------
    wanted_m : (..., n_x, n_y)
        Depth of the surface below the untouched foam in m; negative for a gap.
    covered
        Share of each cell that it covers, broadcast against ``wanted_m``.
    sideways
        m of the module docstring, from 0 to below 1, broadcast against ``wanted_m``.
    pushes : (n_x, n_x), (n_y, n_y)
        `neighbours` along both axes.
    steps
        Number of steps; 0 returns the start.
    start_m : (..., n_x, n_y)
        Start of the closing in m.

    Returns
    -------
    closed_m : (..., n_x, n_y)
        Closing of the columns in m, not negative; its effect is multiplied by ``covered``.
    """
    along, across = pushes
    closed = np.maximum(wanted_m, 0.0) if start_m is None else start_m
    ahead = closed
    momentum = 1.0
    for _ in range(steps):
        load = covered * ahead
        pushed = along @ (load.reshape(-1, load.shape[-1]) @ across).reshape(load.shape)
        new = np.maximum(wanted_m + sideways * (ahead - pushed), 0.0)
        next_momentum = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        ahead = np.maximum(new + ((momentum - 1.0) / next_momentum) * (new - closed), 0.0)
        closed, momentum = new, next_momentum
    return closed


@dataclass(frozen=True, slots=True, kw_only=True)
class FoamModel:
    """Foam of the pads and the sensor below it."""

    thickness_m: float = 3e-3
    """Thickness of the sheet in m."""
    modulus_pa: float = 150e3
    """Young's modulus at small strain in Pa."""
    densification: float = 0.5
    """d: at a strain of one half the secant modulus is 1 + d times the modulus."""
    limit_strain: float = 0.9
    """Strain from which the law continues along its tangent."""
    spread_m: float = 1.5e-3
    """Standard deviation of the spread of the pressure in m."""
    gain: float = 1.0
    """Factor on the force on a taxel before the law."""
    nodes: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Forces on a taxel in N from 0 on, and its readings as shares of the full scale; None:
    equation (11)."""
    sideways: float = 0.0
    """Share, from 0 to below 1, of a point's displacement by the pressure around it."""
    sideways_m: float = 1.2e-3
    """Standard deviation in m of the weights with which it does."""

    def relative_pressure(
        self, indentation_m: NDArray[np.floating[Any]], stiffening: ArrayLike = 1.0
    ) -> NDArray[np.floating[Any]]:
        """Return pressure over modulus of columns, elementwise; 0 without indentation.

        ``stiffening`` is a factor on the densification, broadcast against ``indentation_m``.
        """
        densification = self.densification * np.asarray(stiffening)
        strain = np.maximum(indentation_m, 0.0) / self.thickness_m
        bent = np.minimum(strain, self.limit_strain)
        closing = bent / (1.0 - bent)
        pressure: NDArray[np.floating[Any]] = bent * (1.0 + densification * (closing * closing))
        if strain.size and float(strain.max()) > self.limit_strain:
            edge = self.limit_strain / (1.0 - self.limit_strain)
            slope = 1.0 + densification * edge**2 * (1.0 + 2.0 / (1.0 - self.limit_strain))
            pressure += slope * (strain - bent)
        return pressure

    def response(self, force_n: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reading of taxels under ``force_n`` N as a share of the full scale."""
        taxel_n = self.gain * force_n
        if self.nodes is not None:
            return np.interp(taxel_n, *self.nodes)
        return -np.expm1(-DECAY_PER_N * taxel_n)


class PadBed:
    """One pad: a fine grid over it, and the transfer of pressure from the grid to the taxels.

    Raises ContactError if the taxels are not on a regular grid of at least 2 x 2: their pressure
    shows no shape.

    Parameters
    ----------
    pads, pad
        The pad; its taxels are on a regular grid, row-major.
    spread_m
        See `FoamModel`.
    cell_m
        Longest side of a cell of the grid in m.
    """

    __slots__ = ("across", "along", "cell_area_m2", "taxels", "x_m", "y_m")

    def __init__(
        self, pads: PadArray, pad: int, spread_m: float, *, cell_m: float = CELL_M
    ) -> None:
        rows, columns = (int(n) for n in pads.pad_shape[pad])
        self.taxels = pads.taxels_of(pad)
        """Indices of the pad's taxels."""
        xy_m = pads.taxel_xy_m[self.taxels].reshape(rows, columns, 2)
        x_m, y_m = xy_m[:, 0, 0], xy_m[0, :, 1]
        regular = (
            rows > 1
            and columns > 1
            and np.allclose(xy_m[..., 0], x_m[:, None], atol=1e-5)
            and np.allclose(xy_m[..., 1], y_m, atol=1e-5)
            and all(np.allclose(np.diff(line), line[1] - line[0], atol=1e-5) for line in (x_m, y_m))
            and x_m[1] != x_m[0]
            and y_m[1] != y_m[0]
        )
        if not regular:
            raise ContactError(
                f"pad {pad}: its {rows} x {columns} taxels form no grid of 2 x 2 or more"
            )
        x, self.along = _shares(tuple(x_m.tolist()), spread_m, cell_m)
        y, self.across = _shares(tuple(y_m.tolist()), spread_m, cell_m)
        """(rows, n_x) and (columns, n_y) float64: share of a cell's force that reaches each
        row and each column of taxels."""
        self.x_m, self.y_m = x[:, None], y[None, :]
        """(n_x, 1) and (1, n_y) float64: centres of the cells in the pad's plane in m."""
        self.cell_area_m2 = float(abs((x[1] - x[0]) * (y[1] - y[0])))
        """Area of a cell in m²."""

    def same_points_as(self, other: "PadBed") -> bool:
        """Return whether both have cells at the same points of their pads' planes."""
        return np.array_equal(self.x_m, other.x_m) and np.array_equal(self.y_m, other.y_m)

    def cropped(self, centre_xy_m: NDArray[np.float64], half_m: ArrayLike) -> "PadBed":
        """Return the same pad with the cells within ``half_m`` m of a point, in x and in y.

        ``half_m`` is one length, or one for x and one for y.
        """
        part = object.__new__(PadBed)
        half_x_m, half_y_m = np.broadcast_to(np.asarray(half_m, dtype=np.float64), 2)
        in_x = np.abs(self.x_m[:, 0] - centre_xy_m[0]) <= half_x_m
        in_y = np.abs(self.y_m[0] - centre_xy_m[1]) <= half_y_m
        part.x_m, part.y_m = self.x_m[in_x], self.y_m[:, in_y]
        part.along, part.across = self.along[:, in_x], self.across[:, in_y]
        part.cell_area_m2, part.taxels = self.cell_area_m2, self.taxels
        return part

    def taxel_force_n(self, pressure_pa: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return forces (..., rows * columns) in N for pressures (..., n_x, n_y) in Pa."""
        force_n = self.along @ (pressure_pa @ self.across.T) * self.cell_area_m2
        return force_n.reshape(*force_n.shape[:-2], -1)


@lru_cache(maxsize=256)
def _shares(
    places_m: tuple[float, ...], spread_m: float, cell_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cell centres (n,) in m and the share (n_taxels, n) of each cell for each taxel."""
    centres_m = np.array(places_m)
    pitch_m = float(abs(centres_m[1] - centres_m[0]))
    low_m = float(centres_m.min()) - 0.5 * pitch_m
    high_m = float(centres_m.max()) + 0.5 * pitch_m
    n = len(centres_m) * max(2, int(np.ceil(pitch_m / cell_m)))
    edges_m = np.linspace(low_m, high_m, n + 1)
    cells_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    share = np.zeros((len(centres_m), n))
    for image_m in (cells_m, 2.0 * low_m - cells_m, 2.0 * high_m - cells_m):
        for sign in (1.0, -1.0):
            edge_m = centres_m[:, None] + 0.5 * sign * pitch_m
            share += 0.5 * sign * erf((edge_m - image_m) / (np.sqrt(2.0) * spread_m))
    share /= share.sum(axis=0)
    cells_m.setflags(write=False)
    share.setflags(write=False)
    return cells_m, share
