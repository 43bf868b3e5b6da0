"""Grasps of the whole simulated cell in virtual time: through servos, buses and force loop."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.jobs.collection import grasps_of
from cell.simulation import simulator_settings
from recognition.grasp import Grasp


def configured(objects: Mapping[str, str], seed: int, **changes: Any) -> CellConfig:
    """Return the built-in config with these objects (label -> shape), and changes by key."""
    entries = [{"label": label, "shape": text} for label, text in objects.items()]
    return changed_config(CellConfig(), {"simulator.objects": entries, "seed": seed} | changes)


def cell_grasps(
    objects: Mapping[str, str],
    n_grasps: int,
    *,
    seed: int,
    changes: Mapping[str, Any] | None = None,
    **differs: Any,
) -> list[Grasp]:
    """Have a cell grasp each object ``n_grasps`` times.

    ``changes`` of its config come by key. Fields of the simulator's settings in which it differs
    from its config may be given.
    """
    config = configured(objects, seed, **{"self_zero": "never", **(changes or {})})

    def settings(config: CellConfig, **others):
        return replace(simulator_settings(config, **others), **differs)

    with patch("cell.simulation.simulator_settings", settings):
        cell = build_cell(config)
    try:
        cell.controller.start()
        labels = list(objects)
        return grasps_of(cell.controller, config.sequence, labels, n_grasps, seed=1000 * seed)
    finally:
        cell.close()


def with_aperture_noise(grasps: Sequence[Grasp], sd_m: float, seed: int) -> list[Grasp]:
    """Shift the opening of each grasp as a whole by chance."""
    rng = np.random.default_rng(seed)
    return [replace(g, aperture_m=g.aperture_m + rng.normal(0.0, sd_m)) for g in grasps]
