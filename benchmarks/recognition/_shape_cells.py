"""Shape and size fused over the grasps of many cells, each with its own foam and wrong opening.

Grasps are virtual ones (`cell.learning.virtual_grasps`). Modulus, gain and spread of a cell's foam
and the zero of its opening are drawn once for all of its grasps, with the standard deviations
that the fit assumes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._measure import line
from benchmarks.recognition._answers import shape_figures
from cell.config.model import CellConfig
from cell.jobs.teach_from_drawing import teach_drawing
from cell.learning.pad_knowledge import PadKnowledge, usual_foam
from cell.simulation import drawn_shape
from recognition.shape.answer import ShapeAnswer, shape_of
from recognition.shape.fusion import fuse_shapes

GRASPS = (1, 2, 3, 5)
"""Numbers of grasps that are fused."""
BAR = ("flat", (10.0, 15.9), "box:length=20mm,width=15.9mm,height=10mm")
"""An object that shows two thicknesses: kind, thicknesses in mm, shape."""
_OPENING_SD_M = 0.2e-3
_NO_SPREAD = ("modulus_sd", "gain_sd", "spread_sd", "densification_sd", "thickness_sd")
_EXACT = dict.fromkeys((*_NO_SPREAD, "aperture_sd_m"), 0.0) | {"other_foams": 1.0}


@dataclass(frozen=True, slots=True)
class CellSequence:
    """Answers of the grasps of one object on one cell, and the true shape."""

    kind: str
    sizes_mm: tuple[float, ...]
    answers: tuple[ShapeAnswer, ...]


def sequences(
    objects: Sequence[tuple[str, tuple[float, ...], str]],
    n_cells: int,
    n_grasps: int = max(GRASPS),
    *,
    seed: int = 61,
) -> list[CellSequence]:
    """Grasp each object (kind, thicknesses in mm, shape) on ``n_cells`` cells, each its own."""
    rng = np.random.default_rng(seed)
    config = CellConfig()
    usual = usual_foam(config)
    found = []
    for kind, sizes_mm, text in objects:
        for _ in range(n_cells):
            modulus, gain, spread = np.exp(rng.normal(0.0, [0.1, 0.1, 0.05])).tolist()
            foam = replace(
                usual,
                modulus_pa=usual.modulus_pa * modulus,
                gain=usual.gain * gain,
                spread_m=usual.spread_m * spread,
            )
            zero_m = float(rng.normal(0.0, _OPENING_SD_M))
            grasps = teach_drawing(
                config,
                "",
                drawn_shape(text),
                n_grasps,
                known=PadKnowledge(foam=foam, **_EXACT),
                seed=int(rng.integers(2**31)),
            )
            answers = [
                shape_of(replace(grasp, aperture_m=grasp.aperture_m + zero_m), foam=usual)
                for grasp in grasps
            ]
            found.append(CellSequence(kind, sizes_mm, tuple(answers)))
    return found


def fused(objects: Mapping[str, tuple[str, float, str]], n_cells: int) -> None:
    """Print the shares of right kinds and intervals after some grasps."""
    plain = sequences([(kind, (mm,), text) for kind, mm, text in objects.values()], n_cells)
    bars = sequences([BAR], 4 * n_cells)
    line(
        "fused over grasps",
        f"{len(plain)} cells, each with foam and zero of the opening of its own, "
        f"{len(objects)} objects",
    )
    for n in GRASPS:
        told = [(one.kind, one.sizes_mm[0], fuse_shapes(one.answers[:n])) for one in plain]
        several = sum(len(answer.thicknesses) > 1 for _, _, answer in told)
        line(
            f"  {n} grasps" if n > 1 else "  1 grasp",
            f"{shape_figures(told)}, a second thickness by mistake {several}",
        )
    for n in GRASPS[1:]:
        line(f"  bar 10 x 15.9, {n} grasps", _bar_row(bars, n))


def _bar_row(told: Sequence[CellSequence], n: int) -> str:
    both = shown = held = total = 0
    for one in told:
        met = {min(one.sizes_mm, key=lambda s: abs(s - 1e3 * a.size_m)) for a in one.answers[:n]}
        answer = fuse_shapes(one.answers[:n])
        both += len(met) > 1
        shown += len(met) == len(answer.thicknesses) > 1
        held += sum(any(t.low_m <= 1e-3 * s <= t.high_m for t in answer.thicknesses) for s in met)
        total += len(met)
    return (
        f"both sides met in {both} of {len(told)} sequences and told in {shown}; interval held "
        f"{held} of {total} thicknesses"
    )
