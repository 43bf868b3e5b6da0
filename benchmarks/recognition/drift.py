"""What another day costs: each grasp by itself, followed through a shift, and after gauges.

Of each object the first 60 per cent of the grasps in time teach, the others are tested on the next
day under a gain of 0.7 and with the opening 4 mm off. With the folder of recorded grasps in
TACTILE_CELL_DATA, `pinch_november.npz` is a real other day of three objects. Shifts come in mixed
orders, and nobody names their grasps. A gauge takes the first three grasps of an object. New are
objects that were left out of teaching, a third of all.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._grasps import recorded, recorded_later, share_right, simulated
from recognition.drift.drift import Drift
from recognition.evaluation.metrics import wilson_interval
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.force_ramp.recognizer import ForceRamp, ForceRampTrainer

_DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)
_GAUGE_GRASPS = 3
_SHIFTS = 5
"""Orders of the grasps of a shift."""

Answer = tuple[str, Posterior]
"""What it was, and the answer."""


def alone(recognizer: ForceRamp, grasps: Sequence[Grasp]) -> list[Answer]:
    """Answer each grasp by itself."""
    return [(grasp.label, recognizer.posterior(grasp)) for grasp in grasps]


def in_a_shift(recognizer: ForceRamp, grasps: Sequence[Grasp], seed: int) -> list[Answer]:
    """Answer the grasps in a mixed order, each after those before it."""
    answers = []
    for i in np.random.default_rng(seed).permutation(len(grasps)).tolist():
        answers += alone(recognizer, [grasps[i]])
        recognizer = recognizer.follow(grasps[i])
    return answers


def gauged(recognizer: ForceRamp, grasps: Sequence[Grasp], labels: Sequence[str]) -> list[Answer]:
    """Gauge with the first grasps of each label and answer the others."""
    taken = [g for label in labels for g in [g for g in grasps if g.label == label][:_GAUGE_GRASPS]]
    for label in labels:
        recognizer = recognizer.gauge(label, [grasp for grasp in taken if grasp.label == label])
    return alone(recognizer, [g for g in grasps if not any(g is one for one in taken)])


def figures(answers: Sequence[Answer], taught: Sequence[str], *, times: int = 1) -> str:
    """Return shares of taught objects named rightly and wrongly, and of new ones called UNKNOWN.

    Each grasp was answered several ``times``: for the intervals it counts as one.
    """
    known = [(truth, one) for truth, one in answers if truth in taught]
    right = sum(one.name == truth for truth, one in known)
    wrong = sum(one.name not in (truth, UNKNOWN) for truth, one in known)
    likeliest = sum(one.best == truth for truth, one in known)
    n = len(known)
    low, high = wilson_interval(right // times, n // times)
    least, most = wilson_interval(wrong // times, n // times)
    text = (
        f"likeliest {100 * likeliest / n:.1f} %, named rightly {100 * right / n:.1f} % "
        f"({100 * low:.1f}-{100 * high:.1f}), wrongly {100 * wrong / n:.1f} % "
        f"({100 * least:.1f}-{100 * most:.1f}) of {n // times}"
    )
    new = [one.name == UNKNOWN for truth, one in answers if truth not in taught]
    return text + (f"; new UNKNOWN {100 * sum(new) / len(new):.1f} % of {len(new)}" if new else "")


def day(title: str, taught: ForceRamp, grasps: Sequence[Grasp], effort: float) -> None:
    """Print the figures of one day."""
    line(f"  {title}", f"alone: {figures(alone(taught, grasps), taught.labels)}")
    shifts = [in_a_shift(taught, grasps, seed) for seed in range(repeats(_SHIFTS, effort))]
    every = [one for shift in shifts for one in shift]
    line("    in a shift", figures(every, taught.labels, times=len(shifts)))
    labels = sorted({grasp.label for grasp in grasps} & set(taught.labels))
    for n in (1, 2):
        sets = list(combinations(labels, n))
        step = max(1, len(sets) // repeats(12, effort))
        found = [gauged(taught, grasps, some) for some in sets[::step]]
        answers = [one for of_one in found for one in of_one]
        line(f"    gauged with {n}", figures(answers, taught.labels, times=len(found)))


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(2, repeats(20, effort, least=10))
    train, test = chronological_split(grasps, 0.6)
    drifted = [a_day_later(_DRIFT.apply(grasp)) for grasp in test]
    taught = ForceRampTrainer().fit(train)
    line("compared", f"{len(taught.labels)} objects, {len(test)} grasps tested")
    line("  minutes later", figures(alone(taught, test), taught.labels))
    day("gain 0.7, -4 mm", taught, drifted, effort)
    ours = share_right(taught, drifted)
    theirs = share_right(make_trainer("shrinkage_lda").fit(train), drifted)
    times = (1.0 - theirs) / max(1.0 - ours, 0.5 / len(test))
    line("  ratio", f"shrinkage_lda errs {times:.1f} times as often, each grasp by itself")
    if len(taught.labels) >= 3:
        labels = np.random.default_rng(0).permutation(taught.labels).tolist()
        out = labels[: len(labels) // 3]
        rest = ForceRampTrainer().fit([grasp for grasp in train if grasp.label not in out])
        for title, tested in (("no drift", [*map(a_day_later, test)]), ("drift", drifted)):
            answers = in_a_shift(rest, tested, 0)
            line(f"  a third new, {title}", figures(answers, rest.labels))
    november = recorded_later()
    if november is not None:
        day("November", ForceRampTrainer().fit(grasps), november, effort)


if __name__ == "__main__":
    main()
