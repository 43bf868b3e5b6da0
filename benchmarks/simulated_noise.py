"""One grasp, three and five fused on the paper's objects, at the paper's noise and at twice that.

Grasps of random pose and force; those that are fused follow each other and are counted once, so
the intervals (Wilson, 95 %) are those of independent sequences.
"""

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks._posed_grasps import Sensing, draw_placing, posed_grasp
from recognition.fusion import fuse
from recognition.grasp import Grasp
from recognition.metrics import wilson_interval
from recognition.recognizers import DEFAULT_TRAINER, make_trainer
from recognition.splits import by_label
from simulator.shapes import PAPER_OBJECTS

_TAUGHT = 20
_TESTED = 120
_LENGTHS = (1, 3, 5)
_CASES = {
    "touch alone, the paper's noise": Sensing(aperture_known=False),
    "touch alone, twice the noise": Sensing(noise=2.0, aperture_known=False),
    "touch and opening, the paper's noise": Sensing(),
    "touch and opening, twice the noise": Sensing(noise=2.0),
}


def grasps_of(n_each: int, sensing: Sensing, seed: int) -> list[Grasp]:
    """Return n grasps of each of the paper's objects."""
    rng = np.random.default_rng(seed)
    return [
        posed_grasp(label, label, draw_placing(rng), seed + 1000 * number + i, sensing)
        for number, label in enumerate(PAPER_OBJECTS)
        for i in range(n_each)
    ]


def main(effort: float = 1.0) -> None:
    n_taught = repeats(_TAUGHT, effort, least=6)
    n_tested = repeats(_TESTED, effort, least=max(_LENGTHS))
    line("compared", f"{DEFAULT_TRAINER}, {n_taught} grasps of each of five objects teach")
    cases = list(_CASES.items())
    errors = []
    for name, sensing in cases if effort >= 0.2 else cases[:1]:
        train = grasps_of(n_taught, sensing, 0)
        test = grasps_of(n_tested, sensing, 700_000)
        recognizer = make_trainer(DEFAULT_TRAINER, use_aperture=sensing.aperture_known).fit(train)
        rows = {
            label: [recognizer.posterior(grasp) for grasp in members]
            for label, members in by_label(test).items()
        }
        for length in _LENGTHS:
            right = [
                fuse(row[start : start + length]).best == label
                for label, row in rows.items()
                for start in range(0, len(row) - length + 1, length)
            ]
            low, high = wilson_interval(sum(right), len(right))
            errors.append(1.0 - sum(right) / len(right))
            line(
                f"  {name}, {length}",
                f"{100 * sum(right) / len(right):.1f} % right ({100 * low:.1f} to "
                f"{100 * high:.1f}) of {len(right)}",
            )
    line("  ratio", f"five err {errors[2] / max(errors[0], 1e-3):.2f} times as often as one")


if __name__ == "__main__":
    main()
