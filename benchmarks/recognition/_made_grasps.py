"""Grasps of 408 taxels, made by the simulator's foam and converter without servos and buses."""

import math

import numpy as np

from cell.control.records import pad_array
from recognition.grasp import Grasp
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose
from simulator.world.world import STEP_S, PhysicalWorld, WorldSettings
from tactile.layout import paper_layout

GRASP_S = 2.0
"""How long a grasp takes, from the first frame before contact to the end of the hold."""
_PERIOD_S = 0.02
_LEVELS_N = (3.0, 6.0, 10.0, 15.0)
_REST_S = 0.2
_SPEED_M_S = 0.02
_COMPLIANCE_M_N = 5e-6
_HALF_OPEN_M = 8.5e-3
_OFFSET_M = 1.5e-3
_LAYOUT = paper_layout()
_PADS = pad_array(_LAYOUT)


class _ForcedFingers:
    """Fingers that a set-point of force moves; they have neither servos nor friction."""

    def __init__(self) -> None:
        self.half_m = _HALF_OPEN_M
        self.goal_n = 0.0

    @property
    def finger_position_m(self) -> tuple[float, float]:
        return self.half_m, self.half_m

    def step(
        self,
        dt_s: float,
        contact_force_n: tuple[float, float],
        contact_stiffness_n_m: tuple[float, float],
    ) -> None:
        del contact_stiffness_n_m
        limit_m = _SPEED_M_S * dt_s
        wanted_m = _COMPLIANCE_M_N * (self.goal_n - 0.5 * sum(contact_force_n))
        self.half_m -= min(max(wanted_m, -limit_m), limit_m)


def _goal_n(t_s: float) -> float:
    if t_s < _REST_S:
        return 0.0
    level = int((t_s - _REST_S) / (GRASP_S - _REST_S) * len(_LEVELS_N))
    return _LEVELS_N[min(level, len(_LEVELS_N) - 1)]


def made_grasp(label: str, seed: int) -> Grasp:
    """Return one grasp in a random pose: a staircase of forces, 50 frames a second."""
    rng = np.random.default_rng(seed)
    fingers = _ForcedFingers()
    world = PhysicalWorld(_LAYOUT, fingers, WorldSettings(seed=seed))
    shape = PAPER_OBJECTS[label]
    roll_rad = rng.uniform(0.0, math.tau)
    if shape.roll_step_rad:
        roll_rad -= roll_rad % shape.roll_step_rad
    x_m, y_m = rng.uniform(-_OFFSET_M, _OFFSET_M, 2)
    world.place(
        label,
        ObjectPose(x_m=x_m, y_m=y_m, rotation_rad=rng.uniform(0.0, math.pi), roll_rad=roll_rad),
    )
    times_s = np.arange(round(GRASP_S / _PERIOD_S)) * _PERIOD_S
    counts, aperture_m, force_n = [], [], []
    for t_s in times_s:
        fingers.goal_n = _goal_n(t_s)
        for step in range(round(_PERIOD_S / STEP_S)):
            world.advance_to(t_s + (step + 1) * STEP_S)
        counts.append(world.scan())
        aperture_m.append(2.0 * fingers.half_m)
        force_n.append(fingers.goal_n)
    return Grasp(
        pads=_PADS,
        counts=np.array(counts),
        t_s=times_s,
        aperture_m=np.array(aperture_m),
        force_n=np.array(force_n),
        label=label,
        start_ms=seed,
    )
