"""Taught on one simulated cell, used on another of the same layout.

The other cell has another foam and less sensitive, misaligned pads. Its opening is 1.8 mm off, and
each finger has its own gain and foam. Grasps use servos, buses and force loop. Both cells measure
their own zero once, with empty fingers; "untold" leaves that out. The gauge takes the first three
grasps of one object on the other cell, once for each object. Objects never taught are grasped
there, too.

Further cells are drawn at random: foam, gains and tilt of the pads, mounts of the servos. Each
measures its own zero once. The first cell is taught ten times for them: their intervals are those
of a bootstrap of the teachings, which differ more than the grasps.
"""

import math
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._grasps import asked, cell_grasps, figures, followed
from cell.errors import CellError
from cell.runtime.goals import GaugeGoal
from gripper.errors import GripperError
from recognition.evaluation.splits import a_day_later
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer, ForceRampTrainer
from simulator.servo.mechanics import ServoMount
from simulator.settings import SimulatedServoSettings
from simulator.world.pads import Foam, PadPair, SensorLaw
from tactile.errors import TactileError

TAUGHT = {
    "oval": "ellipsoid:length=14mm,diameter=11.7mm",
    "cylinder 6": "cylinder:diameter=6mm,length=20mm",
    "box": "box:length=15.9mm,width=10mm,height=10mm",
    "ball 9.5": "sphere:diameter=9.5mm",
    "dumbbell": "dumbbell:length=13mm,diameter=10mm",
    "cylinder 11": "cylinder:diameter=11mm,length=20mm",
    "ball 13": "sphere:diameter=13mm",
    "bar": "box:length=18mm,width=7mm,height=7mm",
}
NEVER_TAUGHT = {
    "ball 7": "sphere:diameter=7mm",
    "cylinder 8": "cylinder:diameter=8mm,length=16mm",
    "oval 8": "ellipsoid:length=16mm,diameter=8mm",
    "cube": "box:length=12mm,width=12mm,height=12mm",
}


def servos(*zeros_raw: int) -> tuple[SimulatedServoSettings, ...]:
    """Return servos whose mounts have these zeros in counts; 10 are 0.9 mm of half opening."""
    return tuple(
        SimulatedServoSettings(servo_id=number, mount=ServoMount(zero_raw=zero_raw))
        for number, zero_raw in enumerate(zeros_raw, start=1)
    )


TILT_RAD = math.radians(1.0), math.radians(-0.5)
SHIFT_M = 0.8e-3, -0.5e-3
OTHER = {
    "foam": Foam(modulus_pa=190e3, exponent=1.3, spread_m=1.3e-3),
    "law": SensorLaw(gain=0.85),
    "pads": PadPair(shift_m=SHIFT_M, tilt_rad=TILT_RAD, gains=(1.1, 0.9), stiffness=(1.1, 0.95)),
    "servos": servos(2058, 2058),
}
"""Settings of the other cell."""
DRAWN = range(100, 120)
"""Seeds of cells drawn at random, which chose nothing."""
TEACHINGS = range(80, 89)
"""Seeds of further teachings of the same objects."""


def main(effort: float = 1.0) -> None:
    n = repeats(20, effort, least=4)
    taught_objects = dict(list(TAUGHT.items())[: repeats(len(TAUGHT), effort, least=2)])
    new_objects = dict(list(NEVER_TAUGHT.items())[: repeats(len(NEVER_TAUGHT), effort)])
    taught = ForceRampTrainer().fit(cell_grasps(taught_objects, n, seed=51))
    same = cell_grasps(taught_objects, n, seed=52)
    elsewhere = cell_grasps(taught_objects | new_objects, n, seed=53, **OTHER)
    zeroed, later = ([a_day_later(grasp) for grasp in grasps] for grasps in (elsewhere, same))
    untold, bare = ([replace(grasp, zero=None) for grasp in grasps] for grasps in (zeroed, later))
    test, new = ([g for g in untold if (g.label in TAUGHT) is known] for known in (True, False))
    line("compared", f"{len(taught_objects)} objects, {n} grasps each; {len(new)} grasps of others")
    for what, grasps in (
        ("same cell", same),
        ("same cell, a day later", later),
        ("same cell, a day later, untold", bare),
        ("other cell, untold", untold),
        ("other cell, zeroed by itself", zeroed),
    ):
        line(f"  {what}", figures(asked(taught, grasps)))
    line("  other cell, untold, four fused", figures(asked(taught, untold, 4)))
    answers, day = followed(taught, test)
    line("  followed", figures(answers + asked(day, new)))
    every, groups = [], []
    for label in taught_objects:
        gauge = [grasp for grasp in untold if grasp.label == label][: GaugeGoal(label=label).grasps]
        others = [grasp for grasp in untold if not any(grasp is gauged for gauged in gauge)]
        answers = asked(taught.gauge(label, gauge), others)
        every += answers
        groups += [grasp.start_ms for grasp in others]
        line(f"  gauged by {label}", figures(answers))
    line("  gauged, all together", figures(every, groups))
    drawn_cells(taught, taught_objects, new_objects, n, effort)


def drawn_cells(
    taught: ForceRampRecognizer,
    taught_objects: Mapping[str, str],
    new_objects: Mapping[str, str],
    n_grasps: int,
    effort: float,
) -> None:
    """Print how cells drawn at random are named by each of several teachings."""
    seeds = DRAWN[: repeats(len(DRAWN), effort)]
    teach = partial(_teaching, taught_objects, n_grasps)
    there = partial(_drawn_grasps, taught_objects | new_objects, max(n_grasps // 4, 2))
    drawn, teachings = dict[int, list[Grasp]](), [taught]
    with ProcessPoolExecutor() as workers:
        for seed, grasps in zip(seeds, workers.map(there, seeds), strict=True):
            if isinstance(grasps, str):
                line(f"  drawn cell {seed}", f"ended with a fault: {grasps}")
            else:
                drawn[seed] = [a_day_later(grasp) for grasp in grasps]
        teachings += workers.map(teach, TEACHINGS[: repeats(len(TEACHINGS), effort)])
    answers = [
        (number, seed, answer)
        for number, recognizer in enumerate(teachings, start=1)
        for seed, grasps in drawn.items()
        for answer in asked(recognizer, grasps)
    ]
    for seed in drawn:
        here = [(number, answer) for number, cell, answer in answers if cell == seed]
        what = f"  drawn cell, {1e-3 * drawn_cell(seed)['foam'].modulus_pa:.0f} kPa"
        line(what, figures([answer for _, answer in here], [number for number, _ in here]))
    for teaching in range(1, 1 + len(teachings)):
        here = [(seed, answer) for number, seed, answer in answers if number == teaching]
        what = f"  drawn cells, teaching {teaching}"
        line(what, figures([answer for _, answer in here], [seed for seed, _ in here]))
    every, groups = [answer for *_, answer in answers], [number for number, *_ in answers]
    line("  drawn cells, all together", figures(every, groups))


def _teaching(objects: Mapping[str, str], n_grasps: int, seed: int) -> ForceRampRecognizer:
    """Return a recognizer taught on the first cell."""
    return ForceRampTrainer().fit(cell_grasps(objects, n_grasps, seed=seed))


def _drawn_grasps(objects: Mapping[str, str], n_grasps: int, seed: int) -> list[Grasp] | str:
    """Return the grasps of a drawn cell, or the error that ended them."""
    try:
        return cell_grasps(objects, n_grasps, seed=200 + seed, **drawn_cell(seed))
    except (CellError, GripperError, TactileError) as error:
        return f"{type(error).__name__}: {error}"


def drawn_cell(seed: int) -> dict[str, Any]:
    """Return the settings of a cell that differs in foam, gains, tilt and mounts, by chance."""
    rng = np.random.default_rng(seed)
    mounts = rng.integers(-15, 16, 2) + 2048
    foam = Foam(
        modulus_pa=float(np.exp(rng.uniform(np.log(180e3), np.log(360e3)))),
        exponent=rng.uniform(1.2, 1.9),
        spread_m=rng.uniform(0.8e-3, 1.35e-3),
    )
    tilt_rad = tuple(np.radians(rng.uniform(-1.0, 1.0, 2)).tolist())
    gains = tuple(np.exp(rng.uniform(np.log(0.8), np.log(1.25), 2)).tolist())
    pads = PadPair(tilt_rad=tilt_rad, gains=gains)
    return {"foam": foam, "pads": pads, "servos": servos(*mounts.tolist())}
