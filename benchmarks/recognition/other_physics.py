"""Drawings, and shape and size, on pads that follow another contact physics than the simulator's.

Grasps come from elastic pads (`benchmarks.recognition._elastic_contact`), which spread load
sideways: a thin layer, a thick one, a half-space, and a layer that creeps under a sensor that
bends. What names them was taught from drawings alone, which know nothing of such pads; one column
of figures has a gauge of ten grasps. Shape and size are told of objects never taught.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._elastic_grasps import MATERIALS, LayoutName, Material, Sensed
from benchmarks.recognition._elastic_trials import config_of, gauge_grasps, knowledge, trials
from benchmarks.recognition._posed_grasps import Sensing, draw_placing, posed_grasp
from benchmarks.recognition.shape_size import OBJECTS as SIZED
from cell.config.model import CellConfig
from cell.jobs.teach_from_drawing import teach_drawing
from cell.learning.pad_knowledge import PadKnowledge
from cell.learning.shapes import reader_under
from cell.simulation import drawn_shape
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Recognizer
from recognition.recognizers import make_trainer
from recognition.shape.answer import UNCLEAR, ShapeAnswer

TAUGHT = {
    "oval": "ellipsoid:length=14mm,diameter=11.7mm",
    "cylinder": "cylinder:diameter=6mm,length=20mm",
    "box": "box:length=15.9mm,width=10mm,height=10mm",
    "ball": "sphere:diameter=9.5mm",
    "dumbbell": "dumbbell:length=13mm,diameter=10mm",
}
NEVER_TAUGHT = {
    "ball 14": "sphere:diameter=14mm",
    "ball 6": "sphere:diameter=6mm",
    "cylinder 11": "cylinder:diameter=11mm,length=20mm",
    "box 6": "box:length=14mm,width=6mm,height=6mm",
    "oval 8": "ellipsoid:length=16mm,diameter=8mm",
}
_T = TypeVar("_T")
COLUMNS = "columns"
"""The simulator's own foam, for comparison."""
QUIET = 0.05
"""Noise of the linear sensor as a factor of the paper's: 0.4 % of the full scale."""
_LAYOUTS: tuple[tuple[LayoutName, float, str], ...] = (
    ("paper", 1.0, "408 taxels, paper's noise"),
    ("pinch", QUIET, "2 x 13 x 6 taxels of 3.4 mm, linear, 0.4 % noise"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """How the cell is when it is asked."""

    sensed: Sensed
    """What the sensors add."""
    use_aperture: bool = True
    """Whether the recogniser may use the opening."""


CASES = {
    "opening known": Case(sensed=Sensed()),
    "opening 0.2 mm sd": Case(sensed=Sensed(aperture_sd_m=0.2e-3)),
    "touch alone": Case(sensed=Sensed(), use_aperture=False),
    "0.2 mm, no noise": Case(sensed=Sensed(noise=0.0, aperture_sd_m=0.2e-3)),
    "0.2 mm, twice the noise": Case(sensed=Sensed(noise=2.0, aperture_sd_m=0.2e-3)),
    "gain 0.7, opening +0.5 mm": Case(
        sensed=Sensed(gain=0.7, aperture_offset_m=0.5e-3, aperture_sd_m=0.2e-3)
    ),
}


def taught(
    config: CellConfig, objects: Mapping[str, str], n: int, known: PadKnowledge
) -> dict[bool, Recognizer]:
    """Teach from drawings, with the opening (True) and without (False)."""
    grasps = [
        grasp
        for number, (label, text) in enumerate(objects.items())
        for grasp in teach_drawing(
            config, label, drawn_shape(text), n, known=known, seed=500 + number
        )
    ]
    return {use: make_trainer("force_ramp", use_aperture=use).fit(grasps) for use in (True, False)}


@dataclass(slots=True)
class Names:
    """How often the likeliest name was right, a taught object unknown, another one refused."""

    right: int = 0
    unknown: int = 0
    n: int = 0
    refused: int = 0
    n_other: int = 0

    def add(self, recognizer: Recognizer, known: Sequence[Grasp], other: Sequence[Grasp]) -> None:
        """Count grasps of taught objects and of others."""
        for grasp in known:
            posterior = recognizer.posterior(grasp)
            self.right += posterior.best == grasp.label
            self.unknown += posterior.name == UNKNOWN
        self.n += len(known)
        for grasp in other:
            self.refused += recognizer.posterior(grasp).name == UNKNOWN
        self.n_other += len(other)

    def __str__(self) -> str:
        return (
            f"likeliest name right {100 * self.right / self.n:.0f} %, taught but UNKNOWN "
            f"{100 * self.unknown / self.n:.0f} % of {self.n}, never taught and UNKNOWN "
            f"{100 * self.refused / self.n_other:.0f} % of {self.n_other}"
        )


def names(
    materials: Mapping[str, Material], layout: LayoutName, noise: float, effort: float
) -> None:
    """Print how well drawings name objects."""
    n_test, n_draw = repeats(8, effort), repeats(60, effort, least=6)
    n_gauge = repeats(10, effort, least=3)
    objects = _some(TAUGHT, effort)
    config = config_of(layout, noise)
    blind = taught(config, objects, n_draw, knowledge(config, []))
    totals = {gauged: {case: Names() for case in CASES} for gauged in (False, True)}
    for name, material in materials.items():
        tests = trials(objects, n_test, material, layout, 1)
        others = trials(_some(NEVER_TAUGHT, effort), n_test, material, layout, 2)
        gauge = gauge_grasps(material, layout, n_gauge, Sensed(noise=noise, aperture_sd_m=0.1e-3))
        gauged = taught(config, objects, n_draw, knowledge(config, gauge))
        here = {False: Names(), True: Names()}
        for case_name, case in CASES.items():
            sensed = replace(case.sensed, noise=noise * case.sensed.noise)
            known = [t.grasp(sensed) for t in tests]
            other = [t.grasp(sensed) for t in others]
            for with_gauge, recognizers in ((False, blind), (True, gauged)):
                recognizer = recognizers[case.use_aperture]
                totals[with_gauge][case_name].add(recognizer, known, other)
                if case_name == "opening 0.2 mm sd":
                    here[with_gauge].add(recognizer, known, other)
        for with_gauge, found in here.items():
            line(f"  {name}", f"{_gauge(with_gauge)}, opening 0.2 mm sd: {found}")
    for with_gauge, cases in totals.items():
        for case_name, total in cases.items():
            line(f"  {case_name}", f"{_gauge(with_gauge)}: {total}")


@dataclass(slots=True)
class Sizes:
    """How answers of shape and size compare with what was gripped."""

    answers: list[ShapeAnswer]
    true_mm: list[float]
    kinds: list[str]

    def add(self, label: str, answer: ShapeAnswer | None) -> None:
        """Count one answer."""
        if answer is not None:
            kind, size_mm, _ = SIZED[label]
            self.answers.append(answer)
            self.true_mm.append(size_mm)
            self.kinds.append(kind)

    def extend(self, other: "Sizes") -> None:
        """Count all answers of another one."""
        self.answers += other.answers
        self.true_mm += other.true_mm
        self.kinds += other.kinds

    @property
    def held(self) -> float:
        """Share of the intervals that hold the size."""
        inside = [
            1e3 * a.low_m <= mm <= 1e3 * a.high_m
            for a, mm in zip(self.answers, self.true_mm, strict=True)
        ]
        return float(np.mean(inside))

    def __str__(self) -> str:
        told = [(a.kind, k) for a, k in zip(self.answers, self.kinds, strict=True)]
        n_told = sum(kind != UNCLEAR for kind, _ in told)
        right = sum(kind == true for kind, true in told)
        away = np.array([1e3 * a.size_m for a in self.answers]) - np.array(self.true_mm)
        width = [1e3 * (a.high_m - a.low_m) for a in self.answers]
        misfit = float(np.median([a.misfit for a in self.answers]))
        return (
            f"interval held {100 * self.held:.0f} % of {len(told)}, {np.median(width):.2f} mm wide "
            f"(p90 {np.quantile(width, 0.9):.2f}), mean error {np.abs(away).mean():.2f} mm (bias "
            f"{away.mean():+.2f}), type right {right}, wrong {n_told - right}, unclear "
            f"{len(told) - n_told}, misfit {misfit:.1f}"
        )


def sizes(
    materials: Mapping[str, Material], layout: LayoutName, noise: float, effort: float
) -> list[float]:
    """Print how well shape and size of objects never taught are told; return times in s."""
    n_test, n_gauge = repeats(1, effort), repeats(10, effort, least=3)
    config = config_of(layout, noise)
    objects = {label: text for label, (_, _, text) in _some(SIZED, effort).items()}
    sensed = Sensed(noise=noise, aperture_sd_m=0.2e-3)
    taken_s: list[float] = []
    for gauged in (False, True):
        total = Sizes([], [], [])
        for name, material in materials.items():
            gauge = gauge_grasps(material, layout, n_gauge, sensed) if gauged else []
            grasps = [t.grasp(sensed) for t in trials(objects, n_test, material, layout, 3)]
            found = _told(grasps, knowledge(config, gauge), taken_s)
            line(f"  {name}", f"{_gauge(gauged)}: {found}")
            total.extend(found)
        line("  all of these", f"{_gauge(gauged)}: {total}")
    if layout == "paper":
        grasps = own_foam(objects, n_test, noise)
        line(f"  {COLUMNS}", f"no gauge: {_told(grasps, knowledge(config, []), taken_s)}")
    return taken_s


def own_foam(objects: Mapping[str, str], n: int, noise: float) -> list[Grasp]:
    """Return grasps on the simulator's foam, for comparison."""
    sensing = Sensing(noise=noise, aperture_sd_m=0.2e-3)
    return [
        posed_grasp(label, shape, draw_placing(np.random.default_rng(own)), own, sensing)
        for number, (label, shape) in enumerate(objects.items())
        for own in range(300_000 + 1000 * number, 300_000 + 1000 * number + n)
    ]


def _told(grasps: Sequence[Grasp], known: PadKnowledge, taken_s: list[float]) -> Sizes:
    found = Sizes([], [], [])
    for grasp in grasps:
        start_s = time.process_time()
        answer = reader_under(known)(grasp)
        taken_s.append(time.process_time() - start_s)
        found.add(grasp.label, answer)
    return found


def _some(objects: Mapping[str, _T], effort: float) -> dict[str, _T]:
    return dict(list(objects.items())[: repeats(len(objects), effort, least=2)])


def _gauge(gauged: bool) -> str:
    return "gauge" if gauged else "no gauge"


def main(effort: float = 1.0) -> None:
    materials = dict(list(MATERIALS.items())[: repeats(len(MATERIALS), effort)])
    layouts = _LAYOUTS[: repeats(len(_LAYOUTS), effort)]
    line(
        "compared",
        f"{len(materials)} elastic pads; {len(_some(TAUGHT, effort))} objects taught with "
        f"{repeats(60, effort, least=6)} virtual grasps of each drawing, {repeats(8, effort)} "
        f"grasps of each and of {len(_some(NEVER_TAUGHT, effort))} others; shape and size of "
        f"{len(_some(SIZED, effort))} objects, {repeats(1, effort)} grasps each; a gauge has "
        f"{repeats(10, effort, least=3)} grasps",
    )
    taken_s: list[float] = []
    for layout, noise, what in layouts:
        line("names", what)
        names(materials, layout, noise, effort)
        line("shape and size", f"{what}, opening 0.2 mm sd")
        taken_s += sizes(materials, layout, noise, effort)
    line(
        "  ratio",
        f"an answer of shape and size takes {1e3 * float(np.median(taken_s)):.0f} ms of CPU (p90 "
        f"{1e3 * float(np.quantile(taken_s, 0.9)):.0f})",
    )


if __name__ == "__main__":
    main()
