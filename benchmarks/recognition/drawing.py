"""Taught from drawings alone, tested on the cell's own grasps; other foam, with and without gauge.

The cell grasps five objects through its buses in virtual time, after a self-zero. What names them
was taught either with virtual grasps of their drawings, or with the cell's own grasps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from benchmarks._measure import line, repeats
from benchmarks.recognition._answers import asked, figures
from benchmarks.recognition._cell_grasps import cell_grasps, configured, with_aperture_noise
from benchmarks.recognition._grasps import PAPER
from cell.config.tactile import layout_from_config
from cell.control.records import pad_array
from cell.jobs.teach_from_drawing import teach_drawing
from cell.learning.pad_knowledge import PadKnowledge, calibrate_on_gauge
from cell.simulation import drawn_shape
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp.recognizer import ForceRampTrainer
from simulator.world.foam import Foam

OTHER_FOAM = Foam(modulus_pa=240e3, densification=0.8, spread_m=1.2e-3)
"""Stiffer by 60 %, other densification, sharper."""
_GAUGE = "ball"
_ZEROED = {"self_zero": "always"}


def drawn(objects: Mapping[str, str], n_grasps: int, known: PadKnowledge | None) -> list[Grasp]:
    """Return virtual grasps of all drawings."""
    config = configured(objects, 1)
    return [
        grasp
        for number, (label, text) in enumerate(objects.items())
        for grasp in teach_drawing(
            config, label, drawn_shape(text), n_grasps, known=known, seed=500 + number
        )
    ]


def score(title: str, train: Sequence[Grasp], test: Sequence[Grasp]) -> None:
    """Train on one, test on the other, print the shares of right names."""
    noisy = with_aperture_noise(test, 0.2e-3, 7)
    for use_aperture, cases in (
        (True, {"with aperture": test, "aperture 0.2 mm sd": noisy}),
        (False, {"tactile only": test}),
    ):
        recognizer = ForceRampTrainer(use_aperture=use_aperture).fit(train)
        for what, grasps in cases.items():
            line(f"  {what}", f"{title}: {figures(asked(recognizer, grasps))}")


def main(effort: float = 1.0) -> None:
    n_objects = repeats(len(PAPER), effort, least=2)
    objects = dict(list(PAPER.items())[-n_objects:])
    n_test, n_draw = repeats(20, effort), repeats(60, effort, least=6)
    line(
        "compared",
        f"{n_objects} objects, {n_draw} virtual grasps of each drawing, tested on {n_test} grasps "
        "of the cell each",
    )
    test = cell_grasps(objects, n_test, seed=31, changes=_ZEROED)
    train = drawn(objects, n_draw, None)
    score("from drawings", train, test)
    score("from drawings, no self-zero", train, [replace(g, zero=None) for g in test])
    own = cell_grasps(objects, repeats(20, effort, least=3), seed=32, changes=_ZEROED)
    score("from the cell's grasps", own, test)
    other = cell_grasps(objects, n_test, seed=33, changes=_ZEROED, foam=OTHER_FOAM)
    score("from drawings, other foam", train, other)
    n_gauge = repeats(10, effort, least=3)
    gauge = cell_grasps({_GAUGE: _GAUGE}, n_gauge, seed=34, changes=_ZEROED, foam=OTHER_FOAM)
    pads = pad_array(layout_from_config(configured(objects, 1).tactile))
    known = calibrate_on_gauge(gauge, drawn_shape(_GAUGE), pads)
    line("gauge", f"{_GAUGE}: {known}")
    score("from drawings, other foam, gauge", drawn(objects, n_draw, known), other)
