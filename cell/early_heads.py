"""What lets a cell decide already during a ramp: taught, kept in a model file, taken from one."""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from cell.config import CellConfig
from cell.config_sequence import SequenceConfig
from cell.errors import ModelError
from cell.model import LoadedModel
from cell.model_rehearsal import rehearse
from recognition.early import EarlyHeads, EarlyTrainer
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer

SECTION = "early"
"""Name of the section of a model file."""


def teach_heads(
    grasps: Sequence[Grasp], name: str, whole: Recognizer, *, use_aperture: bool
) -> EarlyHeads:
    """Teach with ramps cut short the kind of recogniser that was taught with the whole ones."""
    base = make_trainer(name, use_aperture=use_aperture)
    return EarlyTrainer(base=base).fit_heads(grasps, whole)


def wanted_heads(
    grasps: Sequence[Grasp], whole: Recognizer, config: CellConfig
) -> EarlyHeads | None:
    """Teach with ramps cut short, where the config decides during ramps; else return None."""
    if not config.sequence.decide_early:
        return None
    wanted = config.recognition
    return teach_heads(grasps, wanted.recognizer, whole, use_aperture=wanted.use_aperture)


def heads_sections(heads: EarlyHeads | None) -> dict[str, Mapping[str, NDArray[Any]]]:
    """Return what a model file keeps of them; nothing where there are none."""
    return {} if heads is None else {SECTION: heads.to_arrays()}


def loaded_heads(model: LoadedModel, sequence: SequenceConfig) -> EarlyHeads | None:
    """Return what a model file holds, where the sequence decides during its ramps.

    Raises
    ------
    ModelError
        If it is wanted and the file has none, or what it has does not fit.
    """
    if not sequence.decide_early:
        return None
    kind = type(model.recognizer)

    def build(arrays: Mapping[str, NDArray[Any]]) -> EarlyHeads:
        heads = EarlyHeads.from_arrays(arrays, kind)
        heads.rest.check(model.pads)
        for head in heads.recognizers:
            if head.labels != model.recognizer.labels:
                raise ValueError(f"ramps cut short name {head.labels}")
            rehearse(head, model.pads)
        return heads

    heads = model.section(SECTION, build)
    if heads is None:
        raise ModelError(
            f"{model.path} was not taught with ramps cut short, which sequence.decide_early needs: "
            "train it with `tactile-cell train --early`, or set decide_early to false"
        )
    return heads
