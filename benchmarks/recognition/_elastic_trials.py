"""Objects pressed between elastic pads at random placings, and what a cell there would know."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.recognition._elastic_grasps import (
    FULL_SCALE_N,
    PADS,
    LayoutName,
    Material,
    Pressed,
    Sensed,
    elastic_grasp,
    pressed,
)
from benchmarks.recognition._posed_grasps import draw_placing
from cell.config.model import CellConfig
from cell.config.tactile import LinearCalibrationConfig
from cell.learning.pad_knowledge import PadKnowledge, calibrate_on_gauge, usual_foam
from cell.simulation import drawn_shape
from recognition.grasp import Grasp, GraspCommand

GAUGE = "sphere:diameter=9.5mm"
"""The object that calibrates."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """One object pressed at one command, to be sensed in several ways."""

    label: str
    shape: str
    command: GraspCommand
    press: Pressed
    material: Material
    layout: LayoutName
    seed: int

    def grasp(self, sensed: Sensed) -> Grasp:
        """Return the grasp under a sensor."""
        return elastic_grasp(
            self.label,
            self.shape,
            self.command,
            material=self.material,
            seed=self.seed,
            sensed=sensed,
            layout=self.layout,
            press=self.press,
        )


def trials(
    objects: Mapping[str, str], n: int, material: Material, layout: LayoutName, seed: int
) -> list[Trial]:
    """Press each object ``n`` times at random placings with 2 to 8 N."""
    found = []
    for number, (label, shape) in enumerate(objects.items()):
        for i in range(n):
            own = 1000 * (number + 100 * seed) + i
            command = draw_placing(np.random.default_rng(own))
            press = pressed(material.pad, shape, command, layout, 1.15 * command.force_n)
            found.append(
                Trial(
                    label=label,
                    shape=shape,
                    command=command,
                    press=press,
                    material=material,
                    layout=layout,
                    seed=own,
                )
            )
    return found


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


def knowledge(config: CellConfig, gauge: Sequence[Grasp]) -> PadKnowledge:
    """Return what a gauge tells of the pads, or what is usual where there is none."""
    foam = usual_foam(config)
    if not gauge:
        return PadKnowledge(foam=foam)
    return calibrate_on_gauge(gauge, drawn_shape(GAUGE), gauge[0].pads, foam)


def gauge_grasps(material: Material, layout: LayoutName, n: int, sensed: Sensed) -> list[Grasp]:
    """Return grasps of the gauge."""
    return [t.grasp(sensed) for t in trials({"gauge": GAUGE}, n, material, layout, 7)]
