"""Grasps of the paper's objects from the simulator's physics alone: no servos, no buses, no time.

A rigid object is pressed by both gripping pads with equal force at each step of a ramp; the taxels'
forces go through equation (11), the noise and the converter. The other pads touch nothing and are
left out.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.optimize.elementwise import find_root

from recognition.grasp import Grasp, PadArray
from simulator.world.foam import Foam
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose, posed_heights, resting_pose
from simulator.world.taxels import NoiseModel, PressureGrid, ideal_counts
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

_STEP_N, _PERIOD_S, _HOLD_FRAMES = 0.1, 0.02, 15
"""Growth of the force in a frame, which is 5 N/s at 50 frames a second."""
_KNOTS = 12
"""Forces at which the contact is solved."""
_APERTURE_SD_M = 0.2e-3

_LAYOUT = paper_layout()
_FOAM = Foam()
_GRIDS = tuple(PressureGrid(_LAYOUT.pads[pad], _FOAM) for pad in _LAYOUT.gripping_pads)
_TAXELS = np.concatenate(
    [np.arange(_LAYOUT.n_taxels)[_LAYOUT.taxels_of(pad)] for pad in _LAYOUT.gripping_pads]
)
_PADS = PadArray(
    pad_shape=np.array([_LAYOUT.pad_shape[pad] for pad in _LAYOUT.gripping_pads]),
    taxel_pad=np.repeat([0, 1], len(_TAXELS) // 2),
    taxel_xy_m=np.asarray(_LAYOUT.taxel_xy_m)[_TAXELS],
    adc_max=_LAYOUT.adc_max,
)
"""The inner pads of both fingers, 16 x 4 taxels of 8 bit each."""


class Touch(NamedTuple):
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
    turn, roll = rng.uniform(0.0, math.tau), rng.uniform(0.0, math.tau)
    pose = ObjectPose(x_m=x_m, y_m=y_m, rotation_rad=turn, roll_rad=roll)
    return resting_pose(PAPER_OBJECTS[label], pose)


def press(label: str, pose: ObjectPose, full_n: float) -> Touch:
    """Press one of the paper's objects with 0 to ``full_n`` N."""
    force_n = np.linspace(0.0, full_n, _KNOTS)
    taxels, aperture_m = [], 0.0
    for side, grid in enumerate(_GRIDS):
        x_m, y_m = np.broadcast_arrays(grid.x_m, grid.y_m)
        heights_m = posed_heights(PAPER_OBJECTS[label], pose, x_m, y_m)[side]
        lag_m = heights_m.max() - heights_m
        depth_m = _depths_m(lag_m[lag_m < _FOAM.thickness_m], force_n, grid.cell_area_m2)
        pressures_pa = (_FOAM.pressure_pa(one_m - lag_m) for one_m in depth_m)
        shares = grid.shares((slice(None), slice(None)))
        taxels.append(np.array([grid.taxel_force_n(one, shares) for one in pressures_pa]))
        aperture_m = aperture_m + heights_m.max() - depth_m
    return Touch(label, force_n, np.concatenate(taxels, axis=1), aperture_m)


def _depths_m(
    lag_m: NDArray[np.float64], force_n: NDArray[np.float64], cell_area_m2: float
) -> NDArray[np.float64]:
    """Return how deep the highest point is for each force, (K,)."""

    def excess_n(depth_m: NDArray[np.float64], wanted_n: NDArray[np.float64]) -> NDArray[Any]:
        return _FOAM.pressure_pa(depth_m[:, None] - lag_m).sum(axis=1) * cell_area_m2 - wanted_n

    return np.asarray(find_root(excess_n, (0.0, _FOAM.thickness_m), args=(force_n,)).x)


def record(
    touch: Touch, rng: np.random.Generator, noise_share: float, *, start_ms: int = 0
) -> Grasp:
    """Return the grasp that the converter makes of a touch: rest, ramp of 5 N/s, hold.

    The noise is the paper's, with ``noise_share`` of full scale as its largest value.
    """
    full_n = float(touch.force_n[-1])
    ramp_n = np.arange(_STEP_N, full_n, _STEP_N)
    force_n = np.concatenate([np.zeros(REST_FRAMES), ramp_n, np.full(_HOLD_FRAMES, full_n)])
    taxel_n = make_interp_spline(touch.force_n, touch.taxel_n, k=1)(force_n)
    counts = ideal_counts(taxel_n, _PADS.adc_max)
    model = NoiseModel(kind="clipped_normal", level=noise_share / PAPER_NOISE)
    counts += model.sample(rng, counts.size, _PADS.adc_max).reshape(counts.shape)
    aperture_m = np.interp(force_n, touch.force_n, touch.aperture_m)
    return Grasp(
        pads=_PADS,
        counts=np.rint(np.clip(counts, 0.0, _PADS.adc_max)).astype(np.uint16),
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
