"""The next grasp of an active sequence: the one that is expected to tell most."""

import math
from collections.abc import Sequence

from cell.collect import GraspRecord
from cell.config_sequence import SequenceConfig
from cell.errors import CellError
from cell.sequence import GraspStep, plan_random
from recognition.next_pose import PoseMemory, remember
from recognition.recognizer import Posterior, Trainer


def step_settings(step: GraspStep) -> tuple[float, ...]:
    """Return the numbers by which a memory knows pose and force.

    Pads and most parts look alike after half a turn, so turns count twice: cosine and sine of the
    doubled angle.
    """
    pose = step.pose
    return (
        1e3 * pose.x_m,
        1e3 * pose.y_m,
        math.cos(2.0 * pose.rotation_rad),
        math.sin(2.0 * pose.rotation_rad),
        math.cos(2.0 * pose.roll_rad),
        math.sin(2.0 * pose.roll_rad),
        step.force_n,
    )


def remember_records(trainer: Trainer, records: Sequence[GraspRecord]) -> PoseMemory:
    """Build the memory from the grasps that taught. Raises ValueError where they do not suffice."""
    return remember(
        trainer,
        [record.grasp for record in records],
        [step_settings(record.step) for record in records],
    )


def check_active(config: SequenceConfig, *, taught: bool) -> None:
    """Refuse an active sequence where nothing is taught: only teaching records the poses.

    Raises CellError.
    """
    if config.kind == "active" and not taught:
        raise CellError(
            "sequence.kind is active, which goes by the poses of the grasps that taught, and a "
            "model file has none: teach in the same run, or choose random, grid or list"
        )


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
        return steps[self._memory.best_of(posteriors, [step_settings(step) for step in steps])]
