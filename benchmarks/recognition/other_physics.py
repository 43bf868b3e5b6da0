"""Drawings, and shape and size, on pads that follow another contact physics than the simulator's.

Grasps come from elastic pads (`benchmarks.recognition._elastic_contact`), which spread load
sideways: a thin layer, a thick one, a half-space, and a layer that creeps under a sensor that
bends. The recogniser was taught from drawings alone, with the foam of the simulator. One column of
figures has a gauge of ten grasps. Shape and size are those of objects never taught.
"""

from collections.abc import Mapping

import numpy as np

from benchmarks._measure import line, repeats, some
from benchmarks.recognition._answers import JudgedAnswer, Told, asked, figures, shape_figures
from benchmarks.recognition._elastic_grasps import (
    FULL_SCALE_N,
    MATERIALS,
    PADS,
    LayoutName,
    Material,
    PressedObject,
    Sensed,
    elastic_grasp,
    pressed_object,
)
from benchmarks.recognition._grasps import PAPER
from benchmarks.recognition._posed_grasps import draw_placing
from benchmarks.recognition.shape_size import OBJECTS as SIZED
from cell.config.model import CellConfig
from cell.config.tactile import LinearCalibrationConfig
from cell.jobs.teach_from_drawing import teach_drawing
from cell.learning.pad_knowledge import PadKnowledge, calibrate_on_gauge, usual_foam
from cell.learning.shape_reading import reader_under
from cell.simulation import drawn_shape
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer

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
) -> dict[int, PressedObject]:
    """Press each object ``n`` times at random placings with 2 to 8 N; trials by their seed."""
    return {
        seed: pressed_object(
            label, shape, draw_placing(np.random.default_rng(seed)), material, layout
        )
        for start, (label, shape) in enumerate(objects.items(), 100 * number)
        for seed in range(1000 * start, 1000 * start + n)
    }


def sensed(trials: Mapping[int, PressedObject], sensor: Sensed) -> list[Grasp]:
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
    """Return the usual foam of the pads, and the foam measured by a gauge of ten grasps."""
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
        for number, (label, text) in enumerate(some(PAPER, effort).items())
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


def names(materials: Mapping[str, Material], effort: float) -> None:
    """Print the names of objects taught from drawings, on the first layout."""
    layout, noise, what = _LAYOUTS[0]
    line("names", what)
    config, n_test = config_of(layout, noise), repeats(8, effort)
    objects = some(PAPER, effort) | some(NEVER_TAUGHT, effort)
    gauge_sensor = Sensed(noise=noise, aperture_sd_m=0.1e-3)
    total: dict[tuple[str, str], list[JudgedAnswer]] = {}
    for name, material in materials.items():
        tests = trials(objects, n_test, material, layout, 1)
        known = knowledge(config, material, layout, gauge_sensor, effort)
        for gauge, one in known.items():
            recognizers = taught(config, one, effort)
            for case, (factor, use_aperture) in CASES.items():
                grasps = sensed(tests, Sensed(noise=noise * factor))
                answers = asked(recognizers[use_aperture], grasps)
                total.setdefault((gauge, case), []).extend(answers)
                if case == "opening too":
                    line(f"  {name}", f"{gauge}: {figures(answers)}")
    for (gauge, case), answers in total.items():
        line(f"  {case}", f"{gauge}: {figures(answers)}")


def sizes(
    materials: Mapping[str, Material], layout: LayoutName, noise: float, effort: float
) -> None:
    """Print the errors of shape and size of objects never taught."""
    config, sensor = config_of(layout, noise), Sensed(noise=noise)
    objects = {label: text for label, (_, _, text) in some(SIZED, effort).items()}
    total: dict[str, list[Told]] = {}
    for name, material in materials.items():
        grasps = sensed(trials(objects, repeats(1, effort), material, layout, 3), sensor)
        for gauge, known in knowledge(config, material, layout, sensor, effort).items():
            answers = [(SIZED[grasp.label][:2], reader_under(known)(grasp)) for grasp in grasps]
            found = [(*true, answer) for true, answer in answers if answer is not None]
            line(f"  {name}", f"{gauge}: {shape_figures(found)}")
            total.setdefault(gauge, []).extend(found)
    for gauge, found in total.items():
        line("  all of these", f"{gauge}: {shape_figures(found)}")


def main(effort: float = 1.0) -> None:
    materials = some(MATERIALS, effort)
    line(
        "compared",
        f"{len(materials)} elastic pads, the opening wrong by 0.2 mm sd; "
        f"{len(some(PAPER, effort))} objects taught with {repeats(60, effort, least=6)} virtual "
        f"grasps of each drawing, {repeats(8, effort)} grasps of each and of "
        f"{len(some(NEVER_TAUGHT, effort))} others; shape and size of {len(some(SIZED, effort))} "
        f"objects, {repeats(1, effort)} grasps each; a gauge has {repeats(10, effort, least=3)}",
    )
    names(materials, effort)
    for layout, noise, what in _LAYOUTS[: repeats(len(_LAYOUTS), effort)]:
        line("shape and size", what)
        sizes(materials, layout, noise, effort)
