"""Limit of UNKNOWN: how many taught and new objects are called UNKNOWN, by `recognition.caution`.

Objects are dealt out into six groups; each in turn is left out of teaching and is new then. Of each
object the first 60 per cent in time teach, the others are grasped: as they are, and as on the next
day under a gain of 0.7 and with the opening 4 mm off.
"""

from collections import defaultdict
from dataclasses import replace

from benchmarks._measure import line, repeats
from benchmarks.recognition._grasps import recorded, simulated
from recognition.drift.drift import Drift
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.recognizer import UNKNOWN
from recognition.recognizers.force_ramp.recognizer import ForceRampTrainer

CAUTIONS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the likelihood of a new object."""
_DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)
_GROUPS = 6


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(5, repeats(20, effort, least=10))
    train, test = chronological_split(grasps, 0.6)
    days = {
        "minutes later": test,
        "next day, drifted": tuple(a_day_later(_DRIFT.apply(grasp)) for grasp in test),
    }
    labels = sorted({grasp.label for grasp in grasps})
    groups = [set(labels[i::_GROUPS]) for i in range(min(_GROUPS, len(labels)))]
    answers: dict[tuple[str, float], list[tuple[bool, str, str]]] = defaultdict(list)
    for out in groups[: repeats(len(groups), effort)]:
        taught = ForceRampTrainer().fit([grasp for grasp in train if grasp.label not in out])
        for day, tested in days.items():
            for grasp in tested:
                evidence = taught.evidence(grasp)
                for caution in CAUTIONS:
                    name = replace(taught, caution=caution).answer(grasp, evidence).name
                    answers[day, caution].append((grasp.label in out, grasp.label, name))
    line("compared", f"{len(labels)} objects, {len(test)} grasps tested for each group left out")
    missed = {}
    for (day, caution), given in answers.items():
        known = [(truth, answer) for new, truth, answer in given if not new]
        new = [answer for new, _, answer in given if new]
        unknown = sum(answer == UNKNOWN for _, answer in known)
        wrong = sum(answer not in (truth, UNKNOWN) for truth, answer in known)
        missed[day, caution] = sum(answer != UNKNOWN for answer in new) / len(new)
        line(
            f"  {day}, {caution:g}",
            f"taught: {100 * unknown / len(known):.1f} % UNKNOWN, "
            f"{100 * wrong / len(known):.1f} % named wrongly; "
            f"new: {100 - 100 * missed[day, caution]:.1f} % UNKNOWN",
        )
    least, most = (max(missed["minutes later", c], 1e-3) for c in (CAUTIONS[-1], CAUTIONS[0]))
    line("  ratio", f"{most / least:.1f} times as many new objects named at the least caution")


if __name__ == "__main__":
    main()
