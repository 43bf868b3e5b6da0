"""Grasps that recognition is measured on: recorded ones where they are at hand, else simulated."""

import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks.recognition._made_grasps import made_grasp
from cell.data.dataset import read_dataset
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from simulator.world.shapes import PAPER_OBJECTS

_RECORDED = "pinch36.npz"


def recorded() -> list[Grasp] | None:
    """Return the recorded grasps of the folder in TACTILE_CELL_DATA; None without that."""
    folder = os.environ.get("TACTILE_CELL_DATA")
    return None if folder is None else list(read_dataset(Path(folder) / _RECORDED))


def simulated(n_objects: int, n_grasps: int) -> list[Grasp]:
    """Return simulated grasps of the paper's objects in random poses."""
    labels = sorted(PAPER_OBJECTS)[:n_objects]
    return [
        made_grasp(label, 1000 * k + i) for k, label in enumerate(labels) for i in range(n_grasps)
    ]


def share_right(recognizer: Recognizer, grasps: Sequence[Grasp]) -> float:
    """Return the share of grasps whose likeliest label is right."""
    right = [recognizer.posterior(grasp).best == grasp.label for grasp in grasps]
    return sum(right) / len(right)
