"""Grasps of the whole simulated cell in virtual time: through servos, buses and force loop."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.jobs.collection import grasps_of
from cell.simulation import simulator_settings
from recognition.grasp import Grasp


def cell_grasps(
    objects: Mapping[str, str],
    n_grasps: int,
    *,
    seed: int,
    changes: Mapping[str, Any] | None = None,
    **differs: Any,
) -> list[Grasp]:
    """Have a cell with the built-in config grasp each object (label -> shape) ``n_grasps`` times.

    ``changes`` of its config come by key. Fields of the simulator's settings in which it differs
    from its config may be given.
    """
    entries = [{"label": label, "shape": text} for label, text in objects.items()]
    usual = {"simulator.objects": entries, "seed": seed, "self_zero": "never"}
    config = changed_config(CellConfig(), usual | dict(changes or {}))

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
