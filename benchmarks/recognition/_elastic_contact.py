"""A rigid surface pressed into an elastic pad: another contact physics than the simulator's.

The pad is an elastic half-space, or an elastic layer that is bonded to a rigid ground; its surface
is free of friction. Pressure and displacement are linked by an influence function on a regular
grid; the contact is solved by conjugate gradients over the cells that carry load (Polonsky and
Keer 1999), the influence evaluated by fast Fourier transforms. A sensor below the surface feels
the normal stress there.

It shares no code with `simulator.world.foam` or `recognition.shape.foam`, which are beds of
separate columns.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

Array = NDArray[np.float64]

_MAX_STEPS = 60
_TOLERANCE = 2e-3
_DEEP = 16.0
"""Beyond this product of wave number and thickness a layer is a half-space."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ElasticPad:
    """A pad."""

    modulus_pa: float
    """Young's modulus in Pa."""
    poisson: float = 0.3
    """Poisson's ratio, below 0.5."""
    thickness_m: float | None = None
    """Thickness of the layer in m; None: a half-space."""
    sensor_m: float = 1.5e-3
    """Depth of the sensor in m below the surface of a half-space; that of a layer lies on its
    ground."""


def bonded_layer(alpha: Array, poisson: float) -> tuple[Array, Array]:
    """Return compliance and stress on the ground of a bonded layer in plane strain.

    The stress function (A + B s) cosh s + (C + D s) sinh s with s = k z is free of shear at the
    surface and of displacement on the ground, both along and normal to it.

    Parameters
    ----------
    alpha
        Wave number times thickness, positive.
    poisson
        Poisson's ratio.

    Returns
    -------
    compliance
        Displacement of the surface over that of a half-space under the same pressure: 1 at large
        ``alpha``.
    stress
        Normal stress on the ground over the pressure on the surface: 1 at small ``alpha``.
    """
    s = np.minimum(alpha, _DEEP)
    sh, ch = np.sinh(s), np.cosh(s)
    rest = 1.0 - poisson
    # Factors of A, B, D in (1 - nu) phi'' + nu phi and (1 - nu) phi''' + (nu - 2) phi'.
    along = (
        rest * ch + poisson * ch,
        rest * (sh + s * ch) + poisson * (s * ch - sh),
        rest * (2.0 * ch + s * sh) + poisson * s * sh,
    )
    normal = (
        rest * sh + (poisson - 2.0) * sh,
        rest * (2.0 * ch + s * sh) + (poisson - 2.0) * s * sh,
        rest * (3.0 * sh + s * ch) + (poisson - 2.0) * (sh + s * ch),
    )
    determinant = along[1] * normal[2] - along[2] * normal[1]
    b = (-along[0] * normal[2] + along[2] * normal[0]) / determinant
    d = (-along[1] * normal[0] + along[0] * normal[1]) / determinant
    stress = ch + b * (s * ch - sh) + d * s * sh
    return np.abs(b), np.where(alpha < _DEEP, stress, 0.0)


def _patch_displacement(x: Array, y: Array, a: float, b: float) -> Array:
    """Return Love's integral of 1 / r over a rectangle of 2 a by 2 b, seen from (x, y)."""

    def corner(u: Array, v: Array) -> Array:
        r = np.hypot(u, v)
        return u * np.log(v + r) + v * np.log(u + r)

    return corner(x + a, y + b) - corner(x - a, y + b) - corner(x + a, y - b) + corner(x - a, y - b)


class ElasticGrid:
    """A regular grid of ``shape`` cells on a pad, and what pressure on it does.

    Parameters
    ----------
    shape
        Cells along x and y.
    margin_m
        How far around the grid the stress is wanted, in m.
    """

    def __init__(
        self, pad: ElasticPad, shape: tuple[int, int], cell_m: float, margin_m: float = 0.0
    ) -> None:
        self.shape, self.cell_m = shape, cell_m
        self.margin = int(np.ceil(margin_m / cell_m))
        self._full = tuple(next_fast_len(max(2 * n, n + 2 * self.margin), real=True) for n in shape)
        n_x, n_y = self._full
        k_x = 2.0 * np.pi * np.fft.fftfreq(n_x, cell_m)
        k_y = 2.0 * np.pi * np.fft.rfftfreq(n_y, cell_m)
        wave = np.hypot(k_x[:, None], k_y[None, :])
        wave[0, 0] = 1e-3 * k_y[1]
        stiffness_pa = pad.modulus_pa / (1.0 - pad.poisson**2)
        if pad.thickness_m is None:
            x = cell_m * np.fft.fftfreq(n_x, 1.0 / n_x)[:, None]
            y = cell_m * np.fft.fftfreq(n_y, 1.0 / n_y)[None, :]
            kernel = _patch_displacement(x, y, 0.5 * cell_m, 0.5 * cell_m)
            self._influence = rfft2(kernel) / (np.pi * stiffness_pa)
            depth = wave * pad.sensor_m
            self._transfer = (1.0 + depth) * np.exp(-depth)
        else:
            compliance, stress = bonded_layer(wave * pad.thickness_m, pad.poisson)
            self._influence = (2.0 / stiffness_pa) * compliance / wave
            self._transfer = stress

    def displacement_m(self, pressure_pa: Array) -> Array:
        """Return the displacement of the surface in m under pressures in Pa on the cells."""
        n_x, n_y = self.shape
        whole: Array = irfft2(rfft2(pressure_pa, self._full) * self._influence, self._full)
        return whole[:n_x, :n_y]

    def stress_pa(self, pressure_pa: Array) -> Array:
        """Return the normal stress in Pa at the sensor, the margin added on all four sides."""
        whole = irfft2(rfft2(pressure_pa, self._full) * self._transfer, self._full)
        m = self.margin
        shifted: Array = np.roll(whole, (m, m), (0, 1))
        return shifted[: self.shape[0] + 2 * m, : self.shape[1] + 2 * m]

    def press(self, indentation_m: Array, start_pa: Array | None = None) -> Array:
        """Solve a contact.

        Parameters
        ----------
        indentation_m
            How far the rigid surface reaches below the untouched pad at each cell in m; negative
            where there is a gap, -inf where there is no surface.
        start_pa
            Pressure in Pa to start from.

        Returns
        -------
        pressure_pa
            Pressure in Pa on the cells, 0 where there is no contact.
        """
        wanted_m = np.maximum(indentation_m, -1.0)
        size_m = float(wanted_m.max())
        if size_m <= 0.0:
            return np.zeros(self.shape)
        stiffness = 1.0 / float(self.displacement_m(np.ones(self.shape)).max())
        pressure = np.maximum(wanted_m, 0.0) * stiffness if start_pa is None else start_pa.copy()
        direction = np.zeros(self.shape)
        before, going = 1.0, 0.0
        for _ in range(_MAX_STEPS):
            gap = self.displacement_m(pressure) - wanted_m
            carried = pressure > 0.0
            worst = float(np.abs(np.where(carried, gap, np.minimum(gap, 0.0))).max())
            if worst < _TOLERANCE * size_m:
                break
            square = float((gap[carried] ** 2).sum())
            direction = np.where(carried, gap + going * (square / before) * direction, 0.0)
            moved = self.displacement_m(direction)
            slope = float((moved * direction)[carried].sum())
            if slope <= 0.0:
                break
            step = float((gap * direction)[carried].sum()) / slope
            pressure = np.maximum(pressure - step * direction, 0.0)
            overlap = (pressure == 0.0) & (gap < 0.0)
            pressure[overlap] -= step * gap[overlap]
            before, going = square, 0.0 if overlap.any() else 1.0
        return pressure
