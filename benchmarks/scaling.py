"""How naming and teaching grow with the number of taught objects: 5, 36, 500.

Times are CPU times of one process, so that a busy machine changes them little.
"""

import statistics
import time

import numpy as np

from benchmarks._measure import line, quantile, repeats
from benchmarks._posed_grasps import draw_placing, posed_grasp
from recognition.grasp import Grasp
from recognition.recognizers import DEFAULT_TRAINER, make_trainer

_OBJECTS = (5, 36, 500)
_TAUGHT = 5


def made_shape(number: int) -> tuple[str, str]:
    """Return name and text of a made-up object: spheres, cylinders, boxes, ovals of all sizes."""
    rng = np.random.default_rng(number)
    a, b, c = rng.uniform(5.0, 14.0, 3)
    texts = (
        f"sphere:diameter={a:.2f}mm",
        f"cylinder:diameter={a:.2f}mm,length={b + 8:.2f}mm",
        f"box:length={a + 4:.2f}mm,width={b:.2f}mm,height={c:.2f}mm",
        f"ellipsoid:length={a + b / 2:.2f}mm,diameter={a:.2f}mm",
    )
    return f"object {number:03d}", texts[number % len(texts)]


def grasps_of(n_objects: int, n_each: int, seed: int) -> list[Grasp]:
    """Return n grasps of each object at random poses and forces."""
    rng = np.random.default_rng(seed)
    return [
        posed_grasp(*made_shape(number), draw_placing(rng), seed + 1000 * number + i)
        for number in range(n_objects)
        for i in range(n_each)
    ]


def main(effort: float = 1.0) -> None:
    line("compared", f"{DEFAULT_TRAINER} taught {_TAUGHT} grasps of each made-up object")
    medians = []
    for n_objects in sorted({repeats(n, effort, least=2 + i) for i, n in enumerate(_OBJECTS)}):
        train = grasps_of(n_objects, _TAUGHT, 0)
        test = grasps_of(n_objects, 1, 500_000)[: repeats(200, effort, least=3)]
        start_s = time.process_time()
        recognizer = make_trainer(DEFAULT_TRAINER).fit(train)
        taught_s = time.process_time() - start_s
        recognizer.posterior(test[0])
        cpu_ms, right = [], 0
        for grasp in test:
            start_s = time.process_time()
            found = recognizer.posterior(grasp).best
            cpu_ms.append(1e3 * (time.process_time() - start_s))
            right += found == grasp.label
        medians.append(statistics.median(cpu_ms))
        line(
            f"  {n_objects} objects",
            f"{medians[-1]:.2f} ms a grasp (p99 {quantile(cpu_ms, 0.99):.2f}), taught in "
            f"{taught_s:.2f} s, {right} of {len(test)} right",
        )
    line("  ratio", f"the most objects take {medians[-1] / medians[0]:.2f} x the time of the least")


if __name__ == "__main__":
    main()
