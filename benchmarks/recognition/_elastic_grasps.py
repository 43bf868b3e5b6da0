"""Grasps between elastic pads, by `_elastic_contact`: nothing of the simulated cell.

A rigid object is pressed by two equal pads with a force that grows evenly and is then held. Only
outlines of objects, positions of taxels and the converter's noise are those that the rest of the
project uses: they are geometry and sensor, not contact.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.recognition._elastic_contact import ElasticGrid, ElasticPad
from cell.control.records import pad_array
from recognition.grasp import Grasp, GraspCommand
from recognition.shape.models import posed, resting_roll_rad
from simulator.world.shape_files import parse_shape
from simulator.world.taxels import NoiseModel
from tactile.layout import paper_layout, pinch_layout

Array = NDArray[np.float64]
LayoutName = str
"""The named layout of the pads."""

FRAME_S = 0.02
_REST_S = 0.3
_RATE_N_S = 5.0
_HOLD_S = 0.4
_APPROACH_M = 1.2e-3
_CELL_M = 0.45e-3
_FIRST_DEPTH_M = 0.06e-3
_DEEPER = 1.3
_DEEPEST_M = 4e-3
_MARGIN_M = 10e-3
_LAYOUTS = {"paper": paper_layout(), "pinch": pinch_layout()}
PADS = {name: pad_array(layout) for name, layout in _LAYOUTS.items()}
FULL_SCALE_N = {"paper": None, "pinch": 4.0}
"""Force in N on one taxel that reads the full scale; None: equation (11) of the paper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """A pad, how it creeps, and how its sensor bends."""

    pad: ElasticPad
    """The elastic pad."""
    creep: float = 0.0
    """Share by which an indentation still grows under a force that stays."""
    relaxation: float = 0.0
    """Share of the force that is lost in the hold."""
    lag: float = 0.0
    """Share of the reading that follows the force only slowly."""
    slow_s: float = 0.5
    """Time constant in s of all three."""
    bend: float = 1.0
    """Exponent of the reading over what the law of the sensor says; 1: as the law says."""


MATERIALS = {
    "thin layer": Material(
        pad=ElasticPad(modulus_pa=0.45e6, poisson=0.3, thickness_m=2e-3), bend=1.0
    ),
    "thick layer": Material(pad=ElasticPad(modulus_pa=0.6e6, poisson=0.4, thickness_m=6e-3)),
    "half-space": Material(pad=ElasticPad(modulus_pa=1.2e6, poisson=0.45, sensor_m=1.5e-3)),
    "creeping layer": Material(
        pad=ElasticPad(modulus_pa=0.5e6, poisson=0.35, thickness_m=3.5e-3),
        creep=0.15,
        relaxation=0.1,
        lag=0.1,
        bend=0.85,
    ),
}
"""Clearly different pads, from almost separate columns to a half-space, and one that creeps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensed:
    """What the sensors add."""

    noise: float = 1.0
    """Factor on the paper's noise (`simulator.world.taxels`)."""
    aperture_sd_m: float = 0.2e-3
    """Standard deviation of the error of the opening in m, drawn for each grasp."""
    force_sd: float = 0.03
    """Relative standard deviation of the force over the commanded one, of a grasp."""
    pad_gain_sd: float = 0.02
    taxel_gain_sd: float = 0.03
    """Relative standard deviations of the gains of the two pads, and of single taxels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PressedObject:
    """An object pressed into one pad deeper and deeper; K depths, the first of them 0."""

    label: str
    command: GraspCommand
    material: Material
    layout: LayoutName
    """What is pressed, how, and into what."""
    thick_m: float
    """Thickness of the object at its highest points in m."""
    depth_m: Array
    force_n: Array
    """(K,) float64: depth of the highest point in m, and force on the pad in N."""
    taxels_n: Array
    """(K, n_taxels of the pad) float64: force that reaches each taxel in N."""


@lru_cache(maxsize=256)
def _grid(pad: ElasticPad, shape: tuple[int, int]) -> ElasticGrid:
    return ElasticGrid(pad, shape, _CELL_M, _MARGIN_M)


def pressed_object(
    label: str, shape: str, command: GraspCommand, material: Material, layout: LayoutName = "paper"
) -> PressedObject:
    """Press an object into a pad until it carries the force of the command, and some to spare."""
    largest_n = 1.15 * command.force_n
    thing = parse_shape(shape)
    half_m = [np.abs(PADS[layout].taxel_xy_m[:, axis]).max() + 4e-3 for axis in (0, 1)]
    x_m, y_m = (
        _CELL_M * np.arange(-round(h / _CELL_M), round(h / _CELL_M) + 1, dtype=np.float64)
        for h in half_m
    )
    heights_m = posed(
        thing,
        x_m[:, None],
        y_m[None, :],
        at_m=(command.x_m, command.y_m),
        rotation_rad=command.rotation_rad,
        roll_rad=resting_roll_rad(thing, command.roll_rad),
    )
    lag_m = heights_m[0].max() - heights_m[0]
    near = lag_m < 0.6 * _DEEPEST_M
    rows, columns = (
        _even(np.flatnonzero(near.any(axis=axis)), near.shape[1 - axis]) for axis in (1, 0)
    )
    lag_m = lag_m[rows, columns]
    grid = _grid(material.pad, lag_m.shape)
    gripping = _LAYOUTS[layout].pads[_LAYOUTS[layout].gripping_pads[0]]
    m = grid.margin
    along = _areas(
        x_m[0] + _CELL_M * np.arange(rows.start - m, rows.stop + m),
        gripping.rows,
        gripping.pitch_x_m,
    )
    across = _areas(
        y_m[0] + _CELL_M * np.arange(columns.start - m, columns.stop + m),
        gripping.columns,
        gripping.pitch_y_m,
    )
    depths_m, forces_n = [0.0], [0.0]
    taxels_n = [np.zeros(gripping.rows * gripping.columns)]
    pressure_pa, depth_m = None, _FIRST_DEPTH_M
    while forces_n[-1] < largest_n and depth_m < _DEEPEST_M:
        pressure_pa = grid.press(depth_m - lag_m, pressure_pa)
        depths_m.append(depth_m)
        forces_n.append(float(pressure_pa.sum()) * _CELL_M**2)
        stress_pa = grid.stress_pa(pressure_pa)
        taxels_n.append((along @ stress_pa @ across.T).ravel() * _CELL_M**2)
        depth_m *= _DEEPER
    return PressedObject(
        label=label,
        command=command,
        material=material,
        layout=layout,
        thick_m=float(heights_m[0].max() + heights_m[1].max()),
        depth_m=np.array(depths_m),
        force_n=np.array(forces_n),
        taxels_n=np.maximum(np.array(taxels_n), 0.0),
    )


def elastic_grasp(trial: PressedObject, sensed: Sensed, seed: int) -> Grasp:
    """Return one grasp: 0.3 s of rest, a ramp of 5 N/s, 0.4 s of hold, 50 frames a second."""
    rng = np.random.default_rng(seed)
    command, material, layout = trial.command, trial.material, trial.layout
    factor = 1.0 + rng.normal(0.0, sensed.force_sd)
    n_rest, n_hold = round(_REST_S / FRAME_S), round(_HOLD_S / FRAME_S)
    n_ramp = max(2, round(command.force_n / _RATE_N_S / FRAME_S))
    ramp_n = np.linspace(0.0, command.force_n, n_ramp + 1)[1:]
    goal_n = np.concatenate([np.zeros(n_rest), ramp_n, np.full(n_hold, command.force_n)])
    held_s = FRAME_S * np.clip(np.arange(len(goal_n)) - (n_rest + n_ramp - 1), 0, None)
    force_n = factor * goal_n * (1.0 - material.relaxation * -np.expm1(-held_s / material.slow_s))
    # A force that relaxes is held at one opening.
    pressing_n = factor * goal_n if material.relaxation else force_n
    depth_m = np.interp(pressing_n, trial.force_n, trial.depth_m)
    depth_m += material.creep * _slowly(depth_m, material.slow_s)
    half_m = 0.5 * trial.thick_m - depth_m
    half_m[:n_rest] += 0.5 * _APPROACH_M * np.linspace(1.0, 0.0, n_rest, endpoint=False)
    pads, gripping = PADS[layout], _LAYOUTS[layout].gripping_pads
    model = NoiseModel(level=sensed.noise)
    counts = model.sample(rng, len(goal_n) * pads.n_taxels, pads.adc_max)
    counts = counts.reshape(len(goal_n), -1)
    taxels_n = np.stack(
        [np.interp(force_n, trial.force_n, one) for one in trial.taxels_n.T], axis=1
    )
    taxels_n += material.lag * (_slowly(taxels_n, material.slow_s) - taxels_n)
    for pad in gripping:
        where = pads.taxels_of(pad)
        gains = rng.lognormal(0.0, sensed.pad_gain_sd) * np.exp(
            rng.normal(0.0, sensed.taxel_gain_sd, len(where))
        )
        felt_n = gains * taxels_n
        full_n = FULL_SCALE_N[layout]
        share = -np.expm1(-0.449 * felt_n) if full_n is None else np.minimum(felt_n / full_n, 1.0)
        counts[:, where] += pads.adc_max * share**material.bend
    return Grasp(
        pads=pads,
        counts=np.rint(np.clip(counts, 0.0, pads.adc_max)).astype(np.uint16),
        t_s=np.arange(len(goal_n)) * FRAME_S,
        aperture_m=2.0 * half_m + rng.normal(0.0, sensed.aperture_sd_m),
        force_n=goal_n,
        label=trial.label,
        source="elastic pads",
        start_ms=seed,
    )


def _slowly(values: Array, slow_s: float) -> Array:
    """Return what follows values (n, ...) with a time constant."""
    share = -math.expm1(-FRAME_S / slow_s)
    out = np.zeros_like(values)
    for i in range(1, len(values)):
        out[i] = out[i - 1] + share * (values[i] - out[i - 1])
    return out


def _even(inside: NDArray[np.int64], n: int) -> slice:
    """Return a stretch around indices whose length is a multiple of 8: few grids serve all."""
    low, high = int(inside.min()), int(inside.max()) + 1
    wanted = min(n, -(-(high - low) // 8) * 8)
    low = max(0, min(low, n - wanted))
    return slice(low, low + wanted)


def _areas(centres_m: Array, n: int, pitch_m: float) -> Array:
    """Return the share (n, n_cells) of each cell that lies on each row of taxels."""
    low_m = pitch_m * (np.arange(n) - 0.5 * n)[:, None]
    begin_m, end_m = centres_m - 0.5 * _CELL_M, centres_m + 0.5 * _CELL_M
    inside_m = np.minimum(end_m, low_m + pitch_m) - np.maximum(begin_m, low_m)
    return np.clip(inside_m / _CELL_M, 0.0, 1.0)
