"""Right names on another day: each grasp by itself, followed through a shift, and after gauges.

Of each object the first 60 per cent of the grasps in time teach. The others are tested as on the
next day, with gain 0.7 and the opening 4 mm off. With the folder of recorded grasps in
TACTILE_CELL_DATA, `pinch_november.npz` is a real other day of three objects. The grasps of a shift
come in random order and without their names. A gauge takes the first three grasps of an object. New
objects are those left out of teaching, a third of all. In rows of ramps that end early, each grasp
ends where a cell would end it; the drift follows only whole ramps.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._answers import asked, figures, followed, gauged
from benchmarks.recognition._grasps import recorded, simulated
from recognition.drift.drift import Drift
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.grasp import Grasp
from recognition.recognizers.early_classifiers import EarlyClassifiers, teach_early
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer, ForceRampTrainer

DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)
_SHIFTS = 5
"""Orders of the grasps of a shift."""


def teach(grasps: Sequence[Grasp]) -> tuple[ForceRampRecognizer, EarlyClassifiers]:
    """Return the recogniser of whole ramps, and those of ramps cut short."""
    whole = ForceRampTrainer().fit(grasps)
    return whole, teach_early(ForceRampTrainer(), grasps, whole.labels)


def day(
    title: str,
    taught: ForceRampRecognizer,
    early: EarlyClassifiers,
    grasps: Sequence[Grasp],
    effort: float,
) -> None:
    """Print the figures of one day."""
    line(f"  {title}", f"alone: {figures(asked(taught, grasps))}")
    line("    ended early", figures(asked(taught, grasps, early)))
    for what, heads in (("in a shift", None), ("in a shift, ended early", early)):
        seeds = range(repeats(_SHIFTS, effort))
        shifts = [followed(taught, grasps, seed, heads)[0] for seed in seeds]
        every = [one for shift in shifts for one in shift]
        line(f"    {what}", figures(every, times=len(shifts)))
    labels = sorted({grasp.label for grasp in grasps} & set(taught.labels))
    for n in (1, 2):
        sets = list(combinations(labels, n))
        step = max(1, len(sets) // repeats(12, effort))
        found = [gauged(taught, grasps, chosen) for chosen in sets[::step]]
        answers = [one for of_one in found for one in of_one]
        line(f"    gauged with {n}", figures(answers, times=len(found)))


def main(effort: float = 1.0) -> None:
    grasps = recorded() or simulated(2, repeats(20, effort, least=10))
    train, test = chronological_split(grasps, 0.6)
    drifted = [a_day_later(DRIFT.apply(grasp)) for grasp in test]
    taught, early = teach(train)
    line("compared", f"{len(taught.labels)} objects, {len(test)} grasps tested")
    line("  minutes later", figures(asked(taught, test)))
    line("    ended early", figures(asked(taught, test, early)))
    day("gain 0.7, -4 mm", taught, early, drifted, effort)
    if len(taught.labels) >= 3:
        labels = np.random.default_rng(0).permutation(taught.labels).tolist()
        out = labels[: len(labels) // 3]
        rest, heads = teach([grasp for grasp in train if grasp.label not in out])
        for title, tested in (("no drift", [*map(a_day_later, test)]), ("drift", drifted)):
            line(f"  a third new, {title}", figures(followed(rest, tested, 0)[0]))
            line("    ended early", figures(followed(rest, tested, 0, heads)[0]))
    november = recorded("pinch_november.npz")
    if november is not None:
        day("November", *teach(grasps), november, effort)
