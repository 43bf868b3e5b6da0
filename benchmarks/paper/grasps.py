"""Grasps of the paper's objects from the simulator's physics alone: no servos, no buses, no time.

A rigid object is pressed by both gripping pads with equal force at each step of a ramp; the taxels'
forces go through equation (11), the noise and the converter. The other pads touch nothing and are
left out.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.errors import CellError
from recognition.grasp import Grasp, PadArray
from simulator.world.foam import Foam
from simulator.world.shapes import PAPER_OBJECTS, Box, ObjectPose, posed_heights, resting_pose
from simulator.world.taxels import (
    RESISTANCE_AT_REST_MOHM,
    NoiseModel,
    PressureGrid,
    ideal_counts,
)
from tactile.layout import paper_layout

FULL_N = (4.0, 8.0)
"""Range of the force at the end of a ramp in N: "a different force"."""
COMMON_N = 4.0
"""Force in N that every ramp passes."""
OFFSET_M = 2e-3
"""Largest offset along and across the fingers in m."""
PAPER_NOISE = 0.08
"""Upper end of the paper's noise as a part of full scale: 20.4 of 255 counts."""
REST_FRAMES = 10
"""Frames before contact."""

_STEP_N = 0.1  # 5 N/s at 50 frames a second
_HOLD_FRAMES = 15
_PERIOD_S = 0.02
_KNOTS = 12
_APERTURE_SD_M = 0.2e-3

_LAYOUT = paper_layout()
_FOAM = Foam()
_GRIDS = tuple(PressureGrid(_LAYOUT.pads[pad], _FOAM) for pad in _LAYOUT.gripping_pads)


def inner_pads() -> PadArray:
    """Return the inner pads of both fingers, 16 x 4 taxels of 8 bit each."""
    taxels = [np.arange(_LAYOUT.n_taxels)[_LAYOUT.taxels_of(pad)] for pad in _LAYOUT.gripping_pads]
    return PadArray(
        pad_shape=np.array([_LAYOUT.pad_shape[pad] for pad in _LAYOUT.gripping_pads]),
        taxel_pad=np.repeat([0, 1], [len(part) for part in taxels]),
        taxel_xy_m=np.asarray(_LAYOUT.taxel_xy_m)[np.concatenate(taxels)],
        adc_max=_LAYOUT.adc_max,
    )


_PADS = inner_pads()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Touch:
    """One object in one pose, pressed with rising force."""

    label: str
    """The object."""
    force_n: NDArray[np.float64]
    """(K,) float64: grip force in N, ascending from 0."""
    taxel_n: NDArray[np.float64]
    """(K, n_taxels) float64: force on each taxel in N."""
    aperture_m: NDArray[np.float64]
    """(K,) float64: opening between the undeformed pads in m."""


def random_pose(label: str, rng: np.random.Generator) -> ObjectPose:
    """Draw a pose: any turn, any roll in which the object rests, offsets up to `OFFSET_M`."""
    x_m, y_m = rng.uniform(-OFFSET_M, OFFSET_M, 2)
    return resting_pose(
        PAPER_OBJECTS[label],
        ObjectPose(
            x_m=x_m,
            y_m=y_m,
            rotation_rad=rng.uniform(0.0, math.tau),
            roll_rad=rng.uniform(0.0, math.tau),
        ),
    )


def press(label: str, pose: ObjectPose, full_n: float) -> Touch:
    """Press one of the paper's objects with 0 to ``full_n`` N. Raises CellError if it cannot be."""
    force_n = np.linspace(0.0, full_n, _KNOTS)
    taxels, depths_m, reach_m = [], [], 0.0
    for side, grid in enumerate(_GRIDS):
        x_m, y_m = np.broadcast_arrays(grid.x_m, grid.y_m)
        heights_m = posed_heights(PAPER_OBJECTS[label], pose, x_m, y_m)[side]
        highest_m = float(heights_m.max())
        if not math.isfinite(highest_m):
            raise CellError(f"{label} lies beside the pads at {pose}; choose a smaller offset")
        lag_m = highest_m - heights_m
        touched = lag_m < _FOAM.thickness_m
        rows, columns = (_span(touched, axis) for axis in (0, 1))
        lag_m = lag_m[rows, columns]
        depth_m = _depths_m(lag_m, force_n, grid.cell_area_m2)
        shares = grid.shares((rows, columns))
        taxels.append(
            np.array(
                [grid.taxel_force_n(_FOAM.pressure_pa(d_m - lag_m), shares) for d_m in depth_m]
            )
        )
        depths_m.append(depth_m)
        reach_m += highest_m
    return Touch(
        label=label,
        force_n=force_n,
        taxel_n=np.concatenate(taxels, axis=1),
        aperture_m=reach_m - depths_m[0] - depths_m[1],
    )


def _span(touched: NDArray[np.bool_], axis: int) -> slice:
    at = np.nonzero(touched)[axis]
    return slice(int(at.min()), int(at.max()) + 1)


def _depths_m(
    lag_m: NDArray[np.float64], force_n: NDArray[np.float64], cell_area_m2: float
) -> NDArray[np.float64]:
    """Return how deep the highest point is for each force, (K,), by bisection."""
    flat = lag_m[lag_m < _FOAM.thickness_m]
    # Coarse first: pressures at 64 depths, then the force is close to linear between two of them.
    depth_m = np.linspace(0.0, _FOAM.thickness_m, 65)
    together_n = _FOAM.pressure_pa(depth_m[:, None] - flat).sum(axis=1) * cell_area_m2
    if together_n[-1] < force_n[-1]:
        raise CellError(
            f"{force_n[-1]:.1f} N press the foam flat ({together_n[-1]:.1f} N): choose less force"
        )
    place = np.clip(np.searchsorted(together_n, force_n, side="right") - 1, 0, 63)
    low, high = depth_m[place], depth_m[place + 1]
    for _ in range(12):
        middle = 0.5 * (low + high)
        found_n = _FOAM.pressure_pa(middle[:, None] - flat).sum(axis=1) * cell_area_m2
        low, high = (
            np.where(found_n < force_n, middle, low),
            np.where(found_n < force_n, high, middle),
        )
    return np.where(force_n > 0.0, 0.5 * (low + high), 0.0)


def noise_model(share: float) -> NoiseModel:
    """Return the paper's noise, scaled so that its largest value is ``share`` of full scale."""
    return NoiseModel(kind="clipped_normal", level=share / PAPER_NOISE)


def record(
    touch: Touch, rng: np.random.Generator, noise_share: float, *, start_ms: int = 0
) -> Grasp:
    """Return the grasp that the converter makes of a touch: rest, ramp of 5 N/s, hold."""
    full_n = float(touch.force_n[-1])
    ramp_n = np.arange(_STEP_N, full_n, _STEP_N)
    force_n = np.concatenate([np.zeros(REST_FRAMES), ramp_n, np.full(_HOLD_FRAMES, full_n)])
    place = np.minimum(force_n / full_n * (len(touch.force_n) - 1), len(touch.force_n) - 1 - 1e-9)
    before = place.astype(np.int64)
    part = (place - before)[:, None]
    taxel_n = (1.0 - part) * touch.taxel_n[before] + part * touch.taxel_n[before + 1]
    counts = ideal_counts(taxel_n, _PADS.adc_max)
    noise = noise_model(noise_share).sample(rng, counts.size, _PADS.adc_max)
    counts = np.rint(np.clip(counts + noise.reshape(counts.shape), 0.0, _PADS.adc_max))
    aperture_m = np.interp(force_n, touch.force_n, touch.aperture_m)
    return Grasp(
        pads=_PADS,
        counts=counts.astype(np.uint16),
        t_s=_PERIOD_S * np.arange(len(force_n), dtype=np.float64),
        aperture_m=aperture_m + rng.normal(0.0, _APERTURE_SD_M),
        force_n=force_n,
        label=touch.label,
        source="simulated physics",
        start_ms=start_ms,
    )


def random_grasp(
    label: str, rng: np.random.Generator, noise_share: float, *, start_ms: int = 0
) -> Grasp:
    """Return a grasp in a random pose to a random full force."""
    touch = press(label, random_pose(label, rng), rng.uniform(*FULL_N))
    return record(touch, rng, noise_share, start_ms=start_ms)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Indentation:
    """A flat indenter, as large as a taxel, pressed on the middle of one taxel."""

    force_n: NDArray[np.float64]
    """(K,) float64: force on the indenter in N."""
    taxel_n: NDArray[np.float64]
    """(K,) float64: what of it reaches the taxel under it in N."""
    resistance_mohm: NDArray[np.float64]
    """(K,) float64: what the converter's whole counts say of the taxel's resistance, in MOhm."""


def indent(force_n: NDArray[np.float64]) -> Indentation:
    """Press a flat indenter of one taxel's size onto a taxel, forces in N ascending from 0."""
    grid = _GRIDS[0]
    pad = grid.pad
    taxel = (pad.rows // 2) * pad.columns + pad.columns // 2
    x_m, y_m = np.asarray(_LAYOUT.taxel_xy_m)[_LAYOUT.taxels_of(_LAYOUT.gripping_pads[0])][taxel]
    tip = Box(length_m=pad.pitch_x_m, width_m=pad.pitch_y_m, height_m=1e-2)
    heights_m = posed_heights(
        tip, ObjectPose(x_m=float(x_m), y_m=float(y_m)), *np.broadcast_arrays(grid.x_m, grid.y_m)
    )[0]
    touched = np.isfinite(heights_m)
    window = (_span(touched, 0), _span(touched, 1))
    area_m2 = grid.cell_area_m2 * int(touched.sum())
    under_n = []
    for wanted_n in force_n:
        pressure_pa = np.where(touched[window], wanted_n / area_m2, 0.0)
        under_n.append(float(grid.taxel_force_n(pressure_pa, grid.shares(window))[taxel]))
    taxel_n = np.array(under_n)
    counts = np.rint(ideal_counts(taxel_n, _PADS.adc_max))
    return Indentation(
        force_n=force_n,
        taxel_n=taxel_n,
        resistance_mohm=RESISTANCE_AT_REST_MOHM * (1.0 - counts / _PADS.adc_max),
    )
