"""Taught on one simulated cell, used on another of the same layout, and with ramps of other rates.

The other cell has another foam, another sensitivity of the pads, servos that are mounted 1.8 mm
off at the opening, pads that are misaligned, and a gain and a foam of its own for each finger.
Grasps go through servos, buses and force loop. Both cells measure their own zero once, with empty
fingers; "untold" leaves that out. The gauge takes the first three grasps of one object on the other
cell, once for each object. Objects never taught are grasped there, too.

The cell that taught names grasps of slower and faster ramps as well, and one that was taught with
slow ramps names fast ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._cell_grasps import cell_grasps
from recognition.evaluation.metrics import wilson_interval
from recognition.evaluation.splits import a_day_later
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Recognizer
from recognition.recognizers import make_trainer
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
_GAUGE_GRASPS = 3
_ZEROED = {"self_zero": "always"}
RATES_N_S = {5.0: 0.3, 20.0: 0.1, 40.0: 0.05}
"""Rates of the ramps in N/s, and how long each is held in s."""


def names(recognizer: Recognizer, grasps: Sequence[Grasp]) -> list[tuple[str, str]]:
    """Return the likeliest label of each grasp, and the name that one grasp gives it."""
    posteriors = map(recognizer.posterior, grasps)
    return [(posterior.best, posterior.name) for posterior in posteriors]


def figures(answers: Sequence[tuple[str, str]], grasps: Sequence[Grasp]) -> str:
    """Return shares of grasps of taught objects as text."""
    n = len(grasps)
    likeliest = sum(best == g.label for (best, _), g in zip(answers, grasps, strict=True))
    right = sum(named == g.label for (_, named), g in zip(answers, grasps, strict=True))
    unknown = sum(named == UNKNOWN for _, named in answers)
    low, high = wilson_interval(right, n)
    return (
        f"likeliest right {100 * likeliest / n:.1f} %, named right {100 * right / n:.1f} % "
        f"({100 * low:.1f}-{100 * high:.1f}), wrong {100 * (n - right - unknown) / n:.1f} % of {n}"
    )


def main(effort: float = 1.0) -> None:
    n = repeats(20, effort, least=4)
    taught_objects = dict(list(TAUGHT.items())[: repeats(len(TAUGHT), effort, least=2)])
    new_objects = dict(list(NEVER_TAUGHT.items())[: repeats(len(NEVER_TAUGHT), effort, least=1)])
    train = cell_grasps(taught_objects, n, seed=51, changes=_ZEROED)
    same = cell_grasps(taught_objects, n, seed=52, changes=_ZEROED)
    there = cell_grasps(taught_objects | new_objects, n, seed=53, changes=_ZEROED, **OTHER)
    there = [a_day_later(grasp) for grasp in there]
    zeroed = [grasp for grasp in there if grasp.label in taught_objects]
    zeroed_new = [grasp for grasp in there if grasp.label in new_objects]
    test, new = ([replace(grasp, zero=None) for grasp in part] for part in (zeroed, zeroed_new))
    taught = ForceRampTrainer().fit(train)
    plain = make_trainer("shrinkage_lda").fit(train)
    line("compared", f"{len(taught_objects)} objects, {n} grasps each; {len(new)} grasps of others")
    line("  same cell", figures(names(taught, same), same))
    untold = names(taught, test)
    line("  other cell, untold", figures(untold, test))
    line("", _called_unknown(taught, new))
    line("  other cell, zeroed by itself", figures(names(taught, zeroed), zeroed))
    line("", _called_unknown(taught, zeroed_new))
    day = taught
    answered = []
    for number in np.random.default_rng(0).permutation(len(test)).tolist():
        answered += zip(names(day, [test[number]]), [test[number]], strict=True)
        day = day.follow(test[number])
    line("  followed", figures([one for one, _ in answered], [grasp for _, grasp in answered]))
    line("", _called_unknown(day, new))
    gauged: list[tuple[str, str]] = []
    truth: list[Grasp] = []
    for label in taught_objects:
        taken = [grasp for grasp in test if grasp.label == label][:_GAUGE_GRASPS]
        rest = [grasp for grasp in test if not any(grasp is one for one in taken)]
        with_gauge = taught.gauge(label, taken)
        answers = names(with_gauge, rest)
        gauged += answers
        truth += rest
        line(f"  gauged by {label}", figures(answers, rest))
        line("", _called_unknown(with_gauge, new))
    line("  gauged, all together", figures(gauged, truth))
    ours = sum(best != g.label for (best, _), g in zip(untold, test, strict=True))
    theirs = sum(plain.posterior(g).best != g.label for g in test)
    ratio = max(theirs, 0.5) / max(ours, 0.5)
    line("  ratio", f"shrinkage_lda errs {ratio:.1f} times as often untold")
    rates(taught_objects, n)


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
            line(what, figures(names(recognizer, used), used))


def _called_unknown(recognizer: Recognizer, new: Sequence[Grasp]) -> str:
    found = sum(named == UNKNOWN for _, named in names(recognizer, new))
    return f"{100 * found / len(new):.1f} % of the grasps of new objects called UNKNOWN"


if __name__ == "__main__":
    main()
