"""Drawings, and shape and size, on pads that follow another contact physics than the simulator's.

Grasps come from elastic pads (`benchmarks.recognition._elastic_contact`), which spread load
sideways: a thin layer, a thick one, a half-space, and a layer that creeps under a sensor that
bends. What names them was taught from drawings alone, which know nothing of such pads; one column
of figures has a gauge of ten grasps. Shape and size are told of objects never taught.
"""

import time
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._elastic_grasps import (
    FULL_SCALE_N,
    MATERIALS,
    PADS,
    LayoutName,
    Material,
    Sensed,
    Trial,
    elastic_grasp,
    pressed,
)
from benchmarks.recognition._posed_grasps import draw_placing
from benchmarks.recognition.shape_size import OBJECTS as SIZED
from cell.config.model import CellConfig
from cell.config.tactile import LinearCalibrationConfig
from cell.jobs.teach_from_drawing import teach_drawing
from cell.learning.pad_knowledge import PadKnowledge, calibrate_on_gauge, usual_foam
from cell.learning.shapes import reader_under
from cell.simulation import drawn_shape
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Recognizer
from recognition.recognizers import make_trainer
from recognition.shape.answer import UNCLEAR, ShapeAnswer

_T = TypeVar("_T")
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
GAUGE = {"gauge": "sphere:diameter=9.5mm"}
"""The object that calibrates."""
_LAYOUTS: tuple[tuple[LayoutName, float, str], ...] = (
    ("paper", 1.0, "408 taxels, paper's noise"),
    ("pinch", 0.05, "2 x 13 x 6 taxels of 3.4 mm, linear, 0.4 % noise"),
)
"""Layouts with their noise, as a factor of the paper's."""
CASES = {"opening too": (1.0, True), "touch alone": (1.0, False), "twice the noise": (2.0, True)}
"""How names are asked for: a factor on the noise, and whether the opening is used."""


def trials(
    objects: Mapping[str, str], n: int, material: Material, layout: LayoutName, number: int
) -> dict[int, Trial]:
    """Press each object ``n`` times at random placings with 2 to 8 N; trials by their seed."""
    return {
        seed: pressed(label, shape, draw_placing(np.random.default_rng(seed)), material, layout)
        for start, (label, shape) in enumerate(objects.items(), 100 * number)
        for seed in range(1000 * start, 1000 * start + n)
    }


def sensed(trials: Mapping[int, Trial], sensor: Sensed) -> list[Grasp]:
    """Return the grasps of trials under a sensor."""
    return [elastic_grasp(trial, sensor, seed) for seed, trial in trials.items()]


def config_of(layout: LayoutName, noise: float) -> CellConfig:
    """Return the built-in config with a sensor: its law is known, its pads are not."""
    config = CellConfig()
    simulator = config.simulator.model_copy(update={"noise_level": noise})
    tactile = config.tactile
    full_n = FULL_SCALE_N[layout]
    if full_n is not None:
        law = LinearCalibrationConfig(
            kind="linear", force_per_count_n=full_n / PADS[layout].adc_max
        )
        tactile = tactile.model_copy(update={"layout": layout, "calibration": law})
    return config.model_copy(update={"simulator": simulator, "tactile": tactile})


def knowledge(
    config: CellConfig, material: Material, layout: LayoutName, sensor: Sensed, effort: float
) -> dict[str, PadKnowledge]:
    """Return what is usual of the pads, and what a gauge of ten grasps shows of them."""
    gauge = sensed(trials(GAUGE, repeats(10, effort, least=3), material, layout, 7), sensor)
    foam = usual_foam(config)
    return {
        "no gauge": PadKnowledge(foam=foam),
        "gauge": calibrate_on_gauge(gauge, drawn_shape(GAUGE["gauge"]), PADS[layout], foam),
    }


def taught(config: CellConfig, known: PadKnowledge, effort: float) -> dict[bool, Recognizer]:
    """Teach from drawings, with the opening (True) and without (False)."""
    grasps = [
        grasp
        for number, (label, text) in enumerate(_some(TAUGHT, effort).items())
        for grasp in teach_drawing(
            config,
            label,
            drawn_shape(text),
            repeats(60, effort, least=6),
            known=known,
            seed=500 + number,
        )
    ]
    return {use: make_trainer("force_ramp", use_aperture=use).fit(grasps) for use in (True, False)}


def named(recognizer: Recognizer, grasps: Sequence[Grasp]) -> list[tuple[str, str, str]]:
    """Return what each grasp was of, its likeliest label, and the name that it gets."""
    posteriors = [recognizer.posterior(grasp) for grasp in grasps]
    return [(g.label, p.best, p.name) for g, p in zip(grasps, posteriors, strict=True)]


def name_figures(answers: Sequence[tuple[str, str, str]]) -> str:
    """Return how often the likeliest name was right, and what was called UNKNOWN."""
    known = [answer for answer in answers if answer[0] in TAUGHT]
    other = [name == UNKNOWN for label, _, name in answers if label not in TAUGHT]
    right = np.mean([label == best for label, best, _ in known])
    unknown = np.mean([name == UNKNOWN for _, _, name in known])
    return (
        f"likeliest name right {100 * right:.0f} %, taught but UNKNOWN {100 * unknown:.0f} % of "
        f"{len(known)}, never taught and UNKNOWN {100 * np.mean(other):.0f} % of {len(other)}"
    )


def names(materials: Mapping[str, Material], effort: float) -> None:
    """Print how well drawings name objects, on the first layout."""
    layout, noise, what = _LAYOUTS[0]
    line("names", what)
    config, n_test = config_of(layout, noise), repeats(8, effort)
    objects = _some(TAUGHT, effort) | _some(NEVER_TAUGHT, effort)
    gauge_sensor = Sensed(noise=noise, aperture_sd_m=0.1e-3)
    total: dict[tuple[str, str], list[tuple[str, str, str]]] = {}
    for name, material in materials.items():
        tests = trials(objects, n_test, material, layout, 1)
        known = knowledge(config, material, layout, gauge_sensor, effort)
        for gauge, one in known.items():
            recognizers = taught(config, one, effort)
            for case, (factor, use_aperture) in CASES.items():
                grasps = sensed(tests, Sensed(noise=noise * factor))
                answers = named(recognizers[use_aperture], grasps)
                total.setdefault((gauge, case), []).extend(answers)
                if case == "opening too":
                    line(f"  {name}", f"{gauge}: {name_figures(answers)}")
    for (gauge, case), answers in total.items():
        line(f"  {case}", f"{gauge}: {name_figures(answers)}")


def size_figures(answers: Sequence[tuple[str, ShapeAnswer]]) -> str:
    """Return how answers of shape and size compare with what was gripped."""
    kinds, true_mm = zip(*(SIZED[label][:2] for label, _ in answers), strict=True)
    told = [answer for _, answer in answers]
    sizes = np.array([[1e3 * a.low_m, 1e3 * a.size_m, 1e3 * a.high_m] for a in told])
    low, middle, high = sizes.T
    held = (low <= np.array(true_mm)) & (np.array(true_mm) <= high)
    away = middle - np.array(true_mm)
    right = sum(a.kind == kind for a, kind in zip(told, kinds, strict=True))
    unclear = sum(a.kind == UNCLEAR for a in told)
    return (
        f"interval held {100 * held.mean():.0f} % of {len(told)}, {np.median(high - low):.2f} mm "
        f"wide, mean error {np.abs(away).mean():.2f} mm (bias {away.mean():+.2f}), kind right "
        f"{right}, wrong {len(told) - right - unclear}, unclear {unclear}"
    )


def sizes(
    materials: Mapping[str, Material], layout: LayoutName, noise: float, effort: float
) -> list[float]:
    """Print how well shape and size of objects never taught are told; return times in s."""
    config, sensor = config_of(layout, noise), Sensed(noise=noise)
    objects = {label: text for label, (_, _, text) in _some(SIZED, effort).items()}
    total: dict[str, list[tuple[str, ShapeAnswer]]] = {}
    taken_s: list[float] = []
    for name, material in materials.items():
        grasps = sensed(trials(objects, repeats(1, effort), material, layout, 3), sensor)
        for gauge, known in knowledge(config, material, layout, sensor, effort).items():
            found = []
            for grasp in grasps:
                start_s = time.process_time()
                answer = reader_under(known)(grasp)
                taken_s.append(time.process_time() - start_s)
                if answer is not None:
                    found.append((grasp.label, answer))
            line(f"  {name}", f"{gauge}: {size_figures(found)}")
            total.setdefault(gauge, []).extend(found)
    for gauge, found in total.items():
        line("  all of these", f"{gauge}: {size_figures(found)}")
    return taken_s


def _some(objects: Mapping[str, _T], effort: float) -> dict[str, _T]:
    return dict(list(objects.items())[: repeats(len(objects), effort, least=2)])


def main(effort: float = 1.0) -> None:
    materials = _some(MATERIALS, effort)
    line(
        "compared",
        f"{len(materials)} elastic pads, the opening wrong by 0.2 mm sd; "
        f"{len(_some(TAUGHT, effort))} objects taught with {repeats(60, effort, least=6)} virtual "
        f"grasps of each drawing, {repeats(8, effort)} grasps of each and of "
        f"{len(_some(NEVER_TAUGHT, effort))} others; shape and size of {len(_some(SIZED, effort))} "
        f"objects, {repeats(1, effort)} grasps each; a gauge has {repeats(10, effort, least=3)}",
    )
    names(materials, effort)
    taken_s: list[float] = []
    for layout, noise, what in _LAYOUTS[: repeats(len(_LAYOUTS), effort)]:
        line("shape and size", what)
        taken_s += sizes(materials, layout, noise, effort)
    line(
        "  ratio",
        f"an answer of shape and size takes {1e3 * float(np.median(taken_s)):.0f} ms of CPU (p90 "
        f"{1e3 * float(np.quantile(taken_s, 0.9)):.0f})",
    )


if __name__ == "__main__":
    main()
