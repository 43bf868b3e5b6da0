"""The next grasp of an active sequence: the one that is expected to tell most."""

from collections.abc import Mapping, Sequence

from cell.config_sequence import SequenceConfig
from cell.errors import CellError, ModelError
from cell.model import Arrays, LoadedModel
from cell.sequence import GraspStep, plan_random
from recognition.grasp import Grasp
from recognition.next_pose import best_of
from recognition.pose_memory import PoseMemory, remember
from recognition.recognizer import Posterior, Trainer

SECTION = "memory"
"""Section of a model file that holds a `PoseMemory`."""


def remember_grasps(trainer: Trainer, grasps: Sequence[Grasp]) -> PoseMemory:
    """Build the memory from the grasps that taught.

    Raises
    ------
    CellError
        If they do not suffice, or none says its pose.
    """
    try:
        return remember(trainer, grasps)
    except ValueError as error:
        raise CellError(
            f"{len(grasps)} taught grasps do not suffice to choose grasps by: {error}; teach more "
            "grasps of each object, or choose random, grid or list"
        ) from error


def memory_sections(memory: PoseMemory | None) -> Mapping[str, Arrays]:
    """Return the sections of a model file that hold a memory."""
    return {} if memory is None else {SECTION: memory.to_arrays()}


def memory_for(config: SequenceConfig, model: LoadedModel) -> PoseMemory | None:
    """Return what an active sequence goes by; None where the config asks for another kind.

    Raises
    ------
    ModelError
        If the sequence is to be active and the model has no poses, or its memory does not fit its
        recogniser.
    """
    if config.kind != "active":
        return None

    def build(arrays: Arrays) -> PoseMemory:
        memory = PoseMemory.from_arrays(arrays)
        if memory.labels != model.labels:
            raise ValueError(f"it remembers {', '.join(memory.labels)}")
        return memory

    memory = model.section(SECTION, build)
    if memory is None:
        raise ModelError(
            f"sequence.kind is active, which goes by the poses of the grasps that taught, and "
            f"{model.path} has none: train it with `tactile-cell train --poses`, or choose random, "
            "grid or list"
        )
    return memory


class ActiveChooser:
    """Draws candidates from the ranges of a sequence and takes the one that tells most.

    Implements `cell.identification.StepChooser`.

    Parameters
    ----------
    memory
        What the taught grasps told, and where.
    config
        Ranges, and how many candidates are weighed.
    seed
        Of the candidates.
    """

    def __init__(self, memory: PoseMemory, config: SequenceConfig, *, seed: int) -> None:
        self._memory = memory
        self._config = config
        self._seed = seed

    def next_step(self, posteriors: Sequence[Posterior], planned: GraspStep, /) -> GraspStep:
        """Return the most telling of the planned step and further ones from the ranges.

        The grasps so far and the seed determine the candidates.
        """
        others = plan_random(
            self._config, self._config.candidates - 1, seed=self._seed + len(posteriors)
        )
        steps = (planned, *others)
        return steps[best_of(self._memory, posteriors, [step.placing.values for step in steps])]
