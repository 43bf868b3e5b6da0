"""Grasps that recognition is measured on: recorded ones where they are at hand, else simulated."""

import os
from pathlib import Path

import numpy as np

from benchmarks.recognition._posed_grasps import draw_placing, posed_grasp
from cell.data.dataset import read_dataset
from recognition.grasp import Grasp
from simulator.world.shapes import PAPER_OBJECTS

PAPER = {name: name for name in PAPER_OBJECTS}
"""The paper's objects as label and shape."""
LEFT_OUT = ("recorded grasps", "left out: TACTILE_CELL_DATA names no folder with pinch36.npz")


def recorded(name: str = "pinch36.npz") -> list[Grasp] | None:
    """Return recorded grasps of the folder in TACTILE_CELL_DATA; None where they are not at hand.

    ``pinch_november.npz`` are grasps of three of the 36 objects on another day.
    """
    folder = os.environ.get("TACTILE_CELL_DATA")
    path = None if folder is None else Path(folder) / name
    return None if path is None or not path.exists() else list(read_dataset(path))


def simulated(n_objects: int, n_grasps: int) -> list[Grasp]:
    """Return simulated grasps of the paper's objects in random poses."""
    rng = np.random.default_rng(0)
    return [
        posed_grasp(label, label, draw_placing(rng), 1000 * k + i)
        for k, label in enumerate(list(PAPER)[:n_objects])
        for i in range(n_grasps)
    ]
