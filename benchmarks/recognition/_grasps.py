"""Grasps that recognition is measured on: recorded ones where they are at hand, else simulated."""

import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks.recognition._made_grasps import made_grasp
from cell.data.dataset import read_dataset
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from simulator.world.shapes import PAPER_OBJECTS


def recorded() -> list[Grasp] | None:
    """Return the recorded grasps of the folder in TACTILE_CELL_DATA; None without that."""
    return _read("pinch36.npz")


def recorded_later() -> list[Grasp] | None:
    """Return grasps of three of these objects on another day; None where they are not at hand."""
    return _read("pinch_november.npz")


def _read(name: str) -> list[Grasp] | None:
    folder = os.environ.get("TACTILE_CELL_DATA")
    path = None if folder is None else Path(folder) / name
    return None if path is None or not path.exists() else list(read_dataset(path))


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
