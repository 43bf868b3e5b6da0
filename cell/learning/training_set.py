"""Training set: the grasps that trained a model, in the data set beside it."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.errors import ModelError
from cell.learning.model import Arrays, LoadedModel
from cell.recording.dataset import read_dataset
from recognition.grasp import Grasp


def training_section(grasps: Sequence[Grasp], file: Path) -> Arrays:
    """Return what a model file has of its training set: name and checksum of the data set."""
    return {
        "file": np.array(file.name),
        "sha256": np.array(_checksum(grasps)),
        "grasps": np.array(len(grasps)),
    }


def saved_training_set(model: LoadedModel) -> tuple[Grasp, ...]:
    """Return the training set that was saved with a model, if it is still beside it.

    Raises DatasetError if it cannot be read.
    """
    name = str(model.training_set.get("file", ""))
    path = model.path.parent / name
    return read_dataset(path) if Path(name).name == name and os.path.isfile(path) else ()


def check_training_set(model: LoadedModel, grasps: Sequence[Grasp]) -> None:
    """Raise ModelError for grasps that cannot have trained a model.

    Further grasps after those of the model are accepted: the data set is written first, and the
    program may have ended before the model was written.
    """
    if not grasps:
        return
    labels = {grasp.label for grasp in grasps}
    section = model.training_set
    checksum, count = section.get("sha256"), str(section.get("grasps", len(grasps)))
    n_trained = int(count) if count.isdecimal() and len(count) < 10 else len(grasps)
    if (
        not labels.issuperset(model.labels)
        or not grasps[0].pads.same_as(model.pads)
        or (checksum is not None and str(checksum) != _checksum(grasps[:n_trained]))
    ):
        raise ModelError(
            f"{model.path} ({', '.join(model.labels)}) was trained with another training set than "
            f"these {len(grasps)} grasps of {', '.join(sorted(labels))}: name its own"
        )


def _checksum(grasps: Sequence[Grasp]) -> str:
    """Return the SHA-256 of labels, times and frames, which a data set keeps exactly."""
    digest = hashlib.sha256()
    for grasp in grasps:
        digest.update(f"{grasp.label}|{grasp.start_ms}|{grasp.counts.shape}|".encode())
        digest.update(np.asarray(grasp.counts, dtype="<u2").tobytes())
    return digest.hexdigest()
