"""Choice of the next grasp of an active sequence: the one with the least expected error."""

from collections.abc import Sequence

from cell.config.sequence import SequenceConfig
from cell.control.plan import GraspStep, plan_random
from recognition.recognizer import Posterior
from recognition.statistics.next_grasp import PoseMemory, best_next_grasp


class ActiveChooser:
    """Draws candidate steps from the ranges of a sequence and takes the best by a pose memory.

    Implements `cell.control.identification.StepChooser`.

    Parameters
    ----------
    memory
        Answers to the training grasps, by pose and force.
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
        """Return the best of the planned step and further ones from the ranges.

        The grasps so far and the seed determine the candidates.
        """
        others = plan_random(
            self._config, self._config.candidates - 1, seed=self._seed + len(posteriors)
        )
        steps = (planned, *others)
        return steps[
            best_next_grasp(self._memory, posteriors, [step.command.values for step in steps])
        ]
