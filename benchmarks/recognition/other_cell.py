"""Taught on one simulated cell, used on another of the same layout, and with ramps of other rates.

The other cell has another foam and less sensitive, misaligned pads. Its opening is 1.8 mm off, and
each finger has its own gain and foam. Grasps use servos, buses and force loop. Both cells measure
their own zero once, with empty fingers; "untold" leaves that out. The gauge takes the first three
grasps of one object on the other cell, once for each object. Objects never taught are grasped
there, too.

Further cells are drawn at random: foam, gains and tilt of the pads, mounts of the servos. Each
measures its own zero once.

The cell that taught also names grasps of slower and faster ramps. Another one is taught with slow
ramps and names fast ones.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks._measure import line, repeats, some
from benchmarks.recognition._answers import asked, figures, followed, gauged
from benchmarks.recognition._cell_grasps import cell_grasps
from recognition.evaluation.splits import a_day_later
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp.recognizer import ForceRampTrainer
from simulator.servo.mechanics import ServoMount
from simulator.settings import SimulatedServoSettings
from simulator.world.foam import Foam
from simulator.world.press import PadPair
from simulator.world.taxels import SensorLaw

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
OTHER = {
    "foam": Foam(modulus_pa=190e3, densification=0.8, spread_m=1.8e-3),
    "law": SensorLaw(gain=0.85),
    "pads": PadPair(
        shift_m=(0.8e-3, -0.5e-3),
        tilt_rad=(math.radians(1.0), math.radians(-0.5)),
        gains=(1.1, 0.9),
        stiffness=(1.1, 0.95),
    ),
    "servos": tuple(
        SimulatedServoSettings(servo_id=number, mount=ServoMount(zero_raw=2058))
        for number in (1, 2)
    ),
}
"""Settings of the other cell; 10 counts of a servo are 0.9 mm of half opening."""
N_DRAWN = 20
"""Cells drawn at random."""
_ZEROED = {"self_zero": "always"}
RATES_N_S = {5.0: 0.3, 20.0: 0.1, 40.0: 0.05}
"""Rates of the ramps in N/s, and how long each is held in s."""


def main(effort: float = 1.0) -> None:
    n = repeats(20, effort, least=4)
    taught_objects, new_objects = some(TAUGHT, effort), some(NEVER_TAUGHT, effort, least=1)
    train = cell_grasps(taught_objects, n, seed=51, changes=_ZEROED)
    same = cell_grasps(taught_objects, n, seed=52, changes=_ZEROED)
    there = cell_grasps(taught_objects | new_objects, n, seed=53, changes=_ZEROED, **OTHER)
    zeroed = [a_day_later(grasp) for grasp in there]
    untold = [replace(grasp, zero=None) for grasp in zeroed]
    test, new = ([g for g in untold if (g.label in TAUGHT) is known] for known in (True, False))
    taught = ForceRampTrainer().fit(train)
    line("compared", f"{len(taught_objects)} objects, {n} grasps each; {len(new)} grasps of others")
    line("  same cell", figures(asked(taught, same)))
    later = [a_day_later(grasp) for grasp in same]
    line("  same cell, a day later", figures(asked(taught, later)))
    bare = [replace(grasp, zero=None) for grasp in later]
    line("  same cell, a day later, untold", figures(asked(taught, bare)))
    line("  other cell, untold", figures(asked(taught, untold)))
    line("  other cell, zeroed by itself", figures(asked(taught, zeroed)))
    answers, day = followed(taught, test, 0)
    line("  followed", figures(answers + asked(day, new)))
    every = []
    for label in taught_objects:
        answers = gauged(taught, untold, [label])
        every += [one for one in answers if one.taught]
        line(f"  gauged by {label}", figures(answers))
    line("  gauged, all together", figures(every, times=len(taught_objects)))
    drawn = []
    for seed in range(repeats(N_DRAWN, effort)):
        objects, other = taught_objects | new_objects, drawn_cell(seed)
        found = cell_grasps(objects, max(n // 4, 2), seed=200 + seed, changes=_ZEROED, **other)
        answers = asked(taught, [a_day_later(grasp) for grasp in found])
        foam = other["foam"]
        what = f"{foam.modulus_pa * 1e-3:.0f} kPa, {foam.densification:.2f}"
        line(f"  drawn cell, {what}, {foam.spread_m * 1e3:.1f} mm", figures(answers))
        drawn += answers
    line("  drawn cells, all together", figures(drawn))
    rates(taught_objects, n)


def drawn_cell(seed: int) -> dict[str, Any]:
    """Return the settings of a cell that differs in foam, gains, tilt and mounts, by chance."""
    rng = np.random.default_rng(seed)
    mounts = rng.integers(-15, 16, 2).tolist()
    return {
        "foam": Foam(
            modulus_pa=float(np.exp(rng.uniform(np.log(180e3), np.log(360e3)))),
            densification=rng.uniform(0.55, 0.85),
            spread_m=rng.uniform(1.1e-3, 1.9e-3),
        ),
        "pads": PadPair(
            tilt_rad=tuple(np.radians(rng.uniform(-1.0, 1.0, 2)).tolist()),
            gains=tuple(np.exp(rng.uniform(np.log(0.8), np.log(1.25), 2)).tolist()),
        ),
        "servos": tuple(
            SimulatedServoSettings(servo_id=number, mount=ServoMount(zero_raw=2048 + mount))
            for number, mount in enumerate(mounts, start=1)
        ),
    }


def rates(objects: Mapping[str, str], n_grasps: int) -> None:
    """Print how grasps of each rate of the ramp are named after teaching with each."""

    def grasps(rate_n_s: float, seed: int) -> list[Grasp]:
        ramp = {"rate_n_s": rate_n_s, "hold_s": RATES_N_S[rate_n_s]}
        changes = _ZEROED | {f"sequence.ramp.{key}": value for key, value in ramp.items()}
        return cell_grasps(objects, n_grasps, seed=seed, changes=changes)

    tested = {rate_n_s: grasps(rate_n_s, 52) for rate_n_s in RATES_N_S}
    for taught_n_s in RATES_N_S:
        recognizer = ForceRampTrainer().fit(grasps(taught_n_s, 51))
        for used_n_s, used in tested.items():
            what = f"  taught {taught_n_s:g}, used {used_n_s:g} N/s"
            line(what, figures(asked(recognizer, used)))
