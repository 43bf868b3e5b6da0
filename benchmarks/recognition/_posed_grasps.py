"""Grasps of any shape at any pose and force, made by the simulator's foam without servos."""

import math
from dataclasses import dataclass

import numpy as np

from cell.control.records import pad_array
from recognition.grasp import Grasp, GraspCommand
from simulator.world.foam import Foam
from simulator.world.press import Press
from simulator.world.shape_files import parse_shape
from simulator.world.shapes import ObjectPose, resting_pose
from simulator.world.taxels import NoiseModel, PressureGrid, ideal_counts
from tactile.layout import paper_layout

FRAME_S = 0.02
REST_S = 0.3
_RATE_N_S = 5.0
_HOLD_S = 0.3
_APPROACH_M = 1e-3
_BISECTIONS = 30
_LAYOUT = paper_layout()
_FOAM = Foam()
_GRIDS = tuple(PressureGrid(_LAYOUT.pads[pad], _FOAM) for pad in _LAYOUT.gripping_pads)
PADS = pad_array(_LAYOUT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensing:
    """What the sensors add: noise as a factor of the paper's, errors of opening and force."""

    noise: float = 1.0
    aperture_sd_m: float = 2e-4
    aperture_known: bool = True
    force_sd: float = 0.03


def draw_placing(rng: np.random.Generator) -> GraspCommand:
    """Draw a command as a sequence of kind ``random`` does."""
    x_m, y_m = rng.uniform(-2e-3, 2e-3, 2)
    return GraspCommand(
        x_m=x_m,
        y_m=y_m,
        rotation_rad=rng.uniform(0.0, math.tau),
        roll_rad=rng.uniform(0.0, math.tau),
        force_n=rng.uniform(2.0, 8.0),
    )


def posed_grasp(
    label: str, shape: str, command: GraspCommand, seed: int, sensing: Sensing | None = None
) -> Grasp:
    """Return one grasp: 0.3 s of rest, a ramp of 5 N/s, 0.3 s of hold, 50 frames a second.

    The opening is that at which the foam has the present force. A random factor of the grasp
    changes the commanded force; a random error of the grasp changes the opening.
    """
    sensing = sensing or Sensing()
    rng = np.random.default_rng(seed)
    thing = parse_shape(shape)
    pose = ObjectPose(
        x_m=command.x_m,
        y_m=command.y_m,
        rotation_rad=command.rotation_rad,
        roll_rad=command.roll_rad,
    )
    press = Press(thing, resting_pose(thing, pose), _GRIDS, (_FOAM, _FOAM))
    n_rest, n_hold = round(REST_S / FRAME_S), round(_HOLD_S / FRAME_S)
    n_ramp = max(2, round(command.force_n / _RATE_N_S / FRAME_S))
    ramp_n = np.linspace(0.0, command.force_n, n_ramp + 1)[1:]
    force_n = np.concatenate([np.zeros(n_rest), ramp_n, np.full(n_hold, command.force_n)])
    factor = 1.0 + rng.normal(0.0, sensing.force_sd)
    touch_m = 0.5 * sum(press.reach_m)
    half_m = np.empty(len(force_n))
    half_m[:n_rest] = touch_m + _APPROACH_M * np.linspace(1.0, 0.0, n_rest, endpoint=False)
    on_taxels_n = np.zeros((len(force_n), _LAYOUT.n_taxels))
    low_m = touch_m
    for i in range(n_rest, len(force_n)):
        if i < n_rest + n_ramp:
            low_m = _half_m(press, factor * float(force_n[i]), low_m)
        half_m[i] = low_m
        for side, pad in enumerate(_LAYOUT.gripping_pads):
            on_taxels_n[i, _LAYOUT.taxels_of(pad)] = press.taxel_force_n(side, (low_m, low_m))
    model = NoiseModel(level=sensing.noise)
    counts = ideal_counts(on_taxels_n, _LAYOUT.adc_max)
    counts += model.sample(rng, counts.size, _LAYOUT.adc_max).reshape(counts.shape)
    aperture_m = 2.0 * half_m + rng.normal(0.0, sensing.aperture_sd_m)
    return Grasp(
        pads=PADS,
        counts=np.rint(np.clip(counts, 0.0, _LAYOUT.adc_max)).astype(np.uint16),
        t_s=np.arange(len(force_n)) * FRAME_S,
        aperture_m=aperture_m if sensing.aperture_known else np.full(len(force_n), np.nan),
        force_n=force_n,
        label=label,
        start_ms=seed,
        command=command,
    )


def _half_m(press: Press, goal_n: float, open_m: float) -> float:
    """Return the half opening at which the pads push with a force, closer than ``open_m``."""
    low_m, high_m = open_m - _FOAM.thickness_m, open_m
    for _ in range(_BISECTIONS):
        middle_m = 0.5 * (low_m + high_m)
        force_n, _ = press.settle((middle_m, middle_m), 0.0)
        if sum(force_n) < 2.0 * goal_n:
            high_m = middle_m
        else:
            low_m = middle_m
    return 0.5 * (low_m + high_m)
