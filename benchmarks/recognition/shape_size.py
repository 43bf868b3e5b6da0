"""Shape and size of objects that were never taught: error, coverage of the interval, type.

The cell grasps balls, cylinders, boxes, ovals and a dumbbell through its buses in virtual time;
its opening is then wrong by 0.2 mm (standard deviation) in each grasp. Then virtual grasps of an
object are fused, on cells whose foam and opening are wrong alike in all of them. With the folder of
recorded grasps in TACTILE_CELL_DATA, real objects are measured too, with the golf ball and then the
ping-pong ball as the gauge.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks._measure import line, quantile, repeats, timed
from benchmarks.recognition._answers import Told, shape_figures
from benchmarks.recognition._cell_grasps import cell_grasps, with_aperture_noise
from benchmarks.recognition._grasps import LEFT_OUT, recorded
from benchmarks.recognition._shape_cells import fused
from cell.learning.pad_knowledge import calibrate_on_gauge
from cell.simulation import drawn_shape
from recognition.errors import ContactError
from recognition.evaluation.splits import chronological_split
from recognition.grasp import Grasp, by_label
from recognition.ramp.ramp import learn_rest
from recognition.shape.answer import ShapeAnswer, shape_of
from recognition.shape.foam import FoamModel

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
REAL_MM = {"golf_ball": 42.7, "ping-pong_ball": 40.0, "tennis_ball": 67.0}
"""Diameters in mm that rules of sport prescribe."""
_N_GAUGE = 10
_KINDS = {"sphere": "sphere", "cylinder": "cylinder", "box": "flat"}


def measured(
    title: str, kind: str, size_mm: float | None, answers: Sequence[ShapeAnswer]
) -> list[Told]:
    """Print one line about an object; return its answers beside the truth."""
    told = [(kind, size_mm, answer) for answer in answers]
    true = "" if size_mm is None else f"true {size_mm:5.1f}, "
    middle_mm = np.median([1e3 * answer.size_m for answer in answers])
    line(f"  {title}", f"{kind}, {true}measured {middle_mm:5.1f} mm; {shape_figures(told)}")
    return told


def simulated(labels: Sequence[str], n_grasps: int) -> None:
    """Measure simulated objects with known foam."""
    grasps = cell_grasps({label: OBJECTS[label][2] for label in labels}, n_grasps, seed=41)
    members = by_label(with_aperture_noise(grasps, 0.2e-3, 8))
    cpus_s: list[float] = []
    told: list[Told] = []
    for label in labels:
        kind, size_mm, _ = OBJECTS[label]
        answers: list[ShapeAnswer] = []
        for grasp in members[label]:
            answer, took = timed(partial(shape_of, grasp))
            answers.append(answer)
            cpus_s.append(took.cpu_s)
        told += measured(label, kind, size_mm, answers)
    line("  all", shape_figures(told))
    middle_ms, late_ms = (1e3 * quantile(cpus_s, part) for part in (0.5, 0.9))
    line("  time", f"an answer takes {middle_ms:.1f} ms of CPU (p90 {late_ms:.1f})")


def real(grasps: Sequence[Grasp], n_grasps: int, gauge: str) -> None:
    """Measure recorded objects, calibrated on the first grasps of one of them.

    Of each object the first 60 % of its grasps in time are used.
    """
    grasps, _ = chronological_split(grasps, 0.6)
    members, rest = by_label(grasps), learn_rest(grasps)
    known = calibrate_on_gauge(
        members[gauge][:_N_GAUGE],
        drawn_shape(f"sphere:diameter={REAL_MM[gauge]}mm"),
        grasps[0].pads,
        FoamModel(modulus_pa=1e6, spread_m=1e-3),
    )
    foam, trust = known.foam, known.trust
    line(
        f"recorded, {gauge} gauge",
        f"foam {1e-6 * foam.modulus_pa:.2f} MPa at an assumed 3 mm, spread "
        f"{1e3 * foam.spread_m:.2f} mm, opening {1e3 * foam.aperture_offset_m:+.1f} mm within "
        f"{1e3 * trust.aperture_m:.1f} mm, misfit {trust.misfit:.0f}",
    )
    # With the misfit of the gauge, and as where no known shape had been tried.
    for trust in (known.trust, replace(known.trust, misfit=0.0)):
        told: list[Told] = []
        for label, found in sorted(members.items()):
            answers = []
            for grasp in found[_N_GAUGE if label == gauge else 0 :][:n_grasps]:
                with suppress(ContactError):
                    answers.append(shape_of(grasp, foam=foam, uncertainty=trust, rest=rest))
            kind = _KINDS.get(found[0].shape, "other")
            if trust.misfit and answers:
                measured(label, kind, REAL_MM.get(label), answers)
            told += [(kind, None, answer) for answer in answers]
        line(
            "  all recorded" if trust.misfit else "  without the gauge's misfit",
            shape_figures(told),
        )


def main(effort: float = 1.0) -> None:
    labels = list(OBJECTS)[:: max(1, round(0.5 / max(effort, 0.05)))]
    n_grasps = repeats(6, effort)
    line("compared", f"{len(labels)} objects never taught, {n_grasps} grasps of the cell each")
    simulated(labels, n_grasps)
    fused({label: OBJECTS[label] for label in labels}, repeats(6, effort))
    grasps = recorded()
    if grasps is None:
        line(*LEFT_OUT)
        return
    for gauge in ("golf_ball", "ping-pong_ball"):
        real(grasps, repeats(7, effort), gauge)
