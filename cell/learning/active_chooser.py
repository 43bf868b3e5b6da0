"""Choice of the next grasp of an active sequence: the one with the least expected error."""

from collections.abc import Sequence
from dataclasses import dataclass

from cell.config.sequence import SequenceConfig
from cell.control.plan import GraspStep, plan_random
from recognition.recognizer import Posterior
from recognition.statistics.next_grasp import PoseMemory, best_next_grasp


@dataclass(frozen=True, slots=True)
class ActiveChooser:
    """Draws candidate steps from the ranges of a sequence and takes the best by a pose memory.

    Implements `cell.control.identification.StepChooser`.
    """

    memory: PoseMemory
    """Answers to the training grasps, by pose and force."""
    config: SequenceConfig
    """Ranges, and how many candidates are weighed."""
    seed: int

    def next_step(self, posteriors: Sequence[Posterior], planned: GraspStep, /) -> GraspStep:
        """Return the best of the planned step and further ones from the ranges.

        The grasps so far and the seed determine the candidates.
        """
        n_others, seed = self.config.candidates - 1, self.seed + len(posteriors)
        others = plan_random(self.config, n_others, seed=seed)
        steps = (planned, *others)
        return steps[
            best_next_grasp(self.memory, posteriors, [step.command.values for step in steps])
        ]
