"""Grasps that recognition is measured on: recorded ones where they are at hand, else simulated."""

import os
from pathlib import Path

import numpy as np

from benchmarks.paper.grasps import PAPER_NOISE, random_grasp
from cell.data.dataset import read_dataset
from recognition.grasp import Grasp
from simulator.world.shapes import PAPER_OBJECTS

PAPER = tuple(PAPER_OBJECTS)
"""Labels of the paper's objects."""


def recorded() -> list[Grasp] | None:
    """Return `pinch36.npz` of the folder in TACTILE_CELL_DATA; None where it is not at hand."""
    path = Path(os.environ.get("TACTILE_CELL_DATA", "no folder"), "pinch36.npz")
    return list(read_dataset(path)) if path.exists() else None


def simulated(n_objects: int, n_grasps: int) -> list[Grasp]:
    """Return simulated grasps of the paper's objects in random poses."""
    rng = np.random.default_rng(0)
    return [
        random_grasp(label, rng, PAPER_NOISE, start_ms=1000 * k + i)
        for k, label in enumerate(PAPER[:n_objects])
        for i in range(n_grasps)
    ]
