"""Limit of UNKNOWN: how many taught and new objects are called so, by caution and taught grasps.

Objects are dealt out into six groups; each in turn is left out of teaching and is new then. Of each
object the first 60 per cent in time teach, the others are grasped: as they are, and as on the next
day under a gain of 0.7 and with the opening 4 mm off.

Then a few objects are taught alone with a few grasps each: grasps of the simulated cell, and of the
recorded ones the first 60 per cent in time alone, of which 60 per cent teach.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks._measure import line, repeats, some
from benchmarks.recognition._answers import JudgedAnswer, figures
from benchmarks.recognition._cell_grasps import cell_grasps
from benchmarks.recognition._grasps import PAPER, recorded, simulated
from benchmarks.recognition.drift import DRIFT
from benchmarks.recognition.sequences import ended
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.grasp import Grasp, by_label
from recognition.recognizers.force_ramp.recognizer import ForceRampTrainer
from recognition.statistics.fusion import StopRule

CAUTIONS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the likelihood of a new object."""
_GROUPS = 6
TAUGHT = (3, 5, 8, 12)
"""Grasps of each object where a few objects are taught alone."""
SIMULATED = {name: name for name in sorted(PAPER)} | {
    "small ball": "sphere:diameter=8mm",
    "large ball": "sphere:diameter=13mm",
    "rod": "cylinder:diameter=7.5mm,length=20mm",
    "thick rod": "cylinder:diameter=11mm,length=18mm",
    "block": "box:length=12mm,width=12mm,height=7mm",
}
"""Objects of the simulated cell; some differ by a millimetre."""
_MAX_GRASPS = StopRule().max_grasps


def show_few(
    name_of_data: str, train: Sequence[Grasp], test: Sequence[Grasp], n_objects: int, n_taught: int
) -> None:
    """Print the answers where random groups are taught alone; as many other objects are new."""
    taught, tested = by_label(train), by_label(test)
    labels = np.random.default_rng(0).permutation(sorted(taught)).tolist()
    single: list[JudgedAnswer] = []
    several: list[JudgedAnswer] = []
    for start in range(0, len(labels) - n_objects + 1, n_objects):
        group = (labels[start:] + labels[:start])[: 2 * n_objects]
        recognizer = ForceRampTrainer().fit(
            [grasp for label in group[:n_objects] for grasp in taught[label][:n_taught]]
        )
        for label in group:
            posteriors = [recognizer.posterior(grasp) for grasp in tested[label]]
            single += [JudgedAnswer.of(label, one) for one in posteriors]
            for begin in range(0, len(posteriors), _MAX_GRASPS):
                row = posteriors[begin : begin + _MAX_GRASPS]
                name = ended(row, StopRule(max_grasps=len(row)))[0].label
                several.append(JudgedAnswer(label, label in recognizer.labels, name, name))
    line(f"  {name_of_data}, {n_objects} objects, {n_taught} grasps", figures(single))
    line("    in sequences", figures(several))


def show_teachings(grasps: Sequence[Grasp] | None, effort: float) -> None:
    """Print what few taught grasps of few objects give."""
    counts = TAUGHT[: repeats(len(TAUGHT), effort)]
    objects = some(SIMULATED, effort, least=4)
    n_tested = repeats(15, effort, least=2)
    made = by_label(cell_grasps(objects, counts[-1] + n_tested, seed=11))
    train, test = (
        [grasp for members in made.values() for grasp in members[part]]
        for part in (slice(counts[-1]), slice(counts[-1], None))
    )
    for n_objects in (3, 5)[: 1 + (len(objects) >= 10)]:
        for n_taught in counts:
            show_few("simulated", train, test, n_objects, n_taught)
    if grasps is not None:
        train, test = map(list, chronological_split(chronological_split(grasps, 0.6)[0], 0.6))
        for n_objects in (4, 8):
            for n_taught in counts[:-1]:
                show_few("recorded", train, test, n_objects, n_taught)


def main(effort: float = 1.0) -> None:
    real = recorded()
    grasps = real or simulated(5, repeats(20, effort, least=10))
    train, test = chronological_split(grasps, 0.6)
    days = {
        "minutes later": test,
        "next day, drifted": tuple(a_day_later(DRIFT.apply(grasp)) for grasp in test),
    }
    labels = sorted({grasp.label for grasp in grasps})
    groups = [set(labels[i::_GROUPS]) for i in range(min(_GROUPS, len(labels)))]
    answers: dict[tuple[str, float], list[JudgedAnswer]] = defaultdict(list)
    for out in groups[: repeats(len(groups), effort)]:
        taught = ForceRampTrainer().fit([grasp for grasp in train if grasp.label not in out])
        for day, tested in days.items():
            for grasp in tested:
                evidence = taught.evidence(grasp)
                for caution in CAUTIONS:
                    posterior = replace(taught, caution=caution).answer(grasp, evidence)
                    answers[day, caution].append(JudgedAnswer.of(grasp.label, posterior))
    line("compared", f"{len(labels)} objects, {len(test)} grasps tested for each group left out")
    for (day, caution), given in answers.items():
        line(f"  {day}, {caution:g}", figures(given))
    show_teachings(real, effort)
