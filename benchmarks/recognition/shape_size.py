"""Shape and size of objects that were never taught: error, coverage of the interval, kind.

The cell grasps balls, cylinders, boxes, ovals and a dumbbell through its buses in virtual time;
its opening is then wrong by 0.2 mm (standard deviation) in each grasp. Prints the figures of each
object and of all together, and the time for an answer.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks._measure import line, quantile, repeats, share, timed
from benchmarks.recognition._cell_grasps import cell_grasps
from recognition.grasp import by_label
from recognition.shape.answer import UNCLEAR, ShapeAnswer, shape_of

OBJECTS = {
    "ball 6": ("sphere", 6.0, "sphere:diameter=6mm"),
    "ball 8": ("sphere", 8.0, "sphere:diameter=8mm"),
    "ball 10": ("sphere", 10.0, "sphere:diameter=10mm"),
    "ball 13": ("sphere", 13.0, "sphere:diameter=13mm"),
    "ball 16": ("sphere", 16.0, "sphere:diameter=16mm"),
    "cylinder 4": ("cylinder", 4.0, "cylinder:diameter=4mm,length=20mm"),
    "cylinder 6": ("cylinder", 6.0, "cylinder:diameter=6mm,length=24mm"),
    "cylinder 8": ("cylinder", 8.0, "cylinder:diameter=8mm,length=16mm"),
    "cylinder 11": ("cylinder", 11.0, "cylinder:diameter=11mm,length=20mm"),
    "cylinder 14": ("cylinder", 14.0, "cylinder:diameter=14mm,length=25mm"),
    "box 6": ("flat", 6.0, "box:length=14mm,width=6mm,height=6mm"),
    "box 10": ("flat", 10.0, "box:length=12mm,width=10mm,height=10mm"),
    "box 14": ("flat", 14.0, "box:length=20mm,width=14mm,height=14mm"),
    "oval 11.7": ("oval", 11.7, "ellipsoid:length=14mm,diameter=11.7mm"),
    "oval 8": ("oval", 8.0, "ellipsoid:length=16mm,diameter=8mm"),
    "dumbbell 10": ("dumbbell", 10.0, "dumbbell:length=13mm,diameter=10mm"),
}
"""Label -> kind, thickness in mm, shape."""
_APERTURE_SD_M = 0.2e-3

Told = tuple[str, float, ShapeAnswer]
"""True kind and thickness in mm of what was grasped, and the answer."""


def shape_figures(told: Sequence[Told]) -> str:
    """Return how right kinds are and how often intervals hold.

    Of several thicknesses in an answer one has to hold.
    """
    n = len(told)
    right = sum(answer.kind == kind for kind, _, answer in told)
    unclear = sum(answer.kind == UNCLEAR for _, _, answer in told)
    held = sum(
        any(t.low_m <= 1e-3 * size_mm <= t.high_m for t in answer.thicknesses)
        for _, size_mm, answer in told
    )
    wide_mm = np.median([1e3 * (answer.high_m - answer.low_m) for _, _, answer in told])
    away_mm = np.array([1e3 * answer.size_m - size_mm for _, size_mm, answer in told])
    return (
        f"kind right {share(right, n)} of {n}, wrong {n - right - unclear}, unclear {unclear}; "
        f"90 % interval {wide_mm:.2f} mm wide, held {share(held, n)}, mean error "
        f"{np.abs(away_mm).mean():.2f} mm (bias {np.mean(away_mm):+.2f})"
    )


def main(effort: float = 1.0) -> None:
    labels = list(OBJECTS)[:: max(1, round(0.5 / max(effort, 0.05)))]
    n_grasps = repeats(6, effort)
    line("compared", f"{len(labels)} objects never taught, {n_grasps} grasps of the cell each")
    grasps = cell_grasps({label: OBJECTS[label][2] for label in labels}, n_grasps, seed=41)
    rng = np.random.default_rng(8)
    wrong = (replace(g, aperture_m=g.aperture_m + rng.normal(0.0, _APERTURE_SD_M)) for g in grasps)
    cpus_s: list[float] = []
    told: list[Told] = []
    for label, members in by_label(list(wrong)).items():
        kind, size_mm, _ = OBJECTS[label]
        start = len(told)
        for grasp in members:
            answer, took = timed(partial(shape_of, grasp))
            told.append((kind, size_mm, answer))
            cpus_s.append(took.cpu_s)
        line(f"  {label}", f"{kind}, true {size_mm:5.1f} mm; {shape_figures(told[start:])}")
    line("  all", shape_figures(told))
    middle_ms, late_ms = (1e3 * quantile(cpus_s, part) for part in (0.5, 0.9))
    line("  time", f"an answer takes {middle_ms:.1f} ms of CPU (p90 {late_ms:.1f})")
