"""The integrator's own program: have a part identified, and say which bin it belongs in."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cell.config.sequence import SequenceConfig
from cell.control.controller import CellController
from cell.control.plan import Pose, plan
from recognition.recognizer import Recognizer

MANUAL = "manual inspection"


@dataclass
class Robot:
    """Stands for the robot that holds the gripper; remembers where it was sent."""

    reach_m: float = 0.01
    poses: list[Pose] = field(default_factory=list)

    def move(self, pose: Pose) -> bool:
        """Go to a pose; False refuses one that is out of reach."""
        self.poses.append(pose)
        return abs(pose.x_m) <= self.reach_m and abs(pose.y_m) <= self.reach_m


@dataclass
class SortingStation:
    """Sorts by touch; what it does not know, or doubts, goes to a person."""

    controller: CellController
    recognizer: Recognizer
    sequence: SequenceConfig
    bins: Mapping[str, str]
    least_probability: float = 0.9

    def sort(self, seed: int = 0) -> str:
        """Identify the part in front of the gripper and return its bin."""
        steps = plan(self.sequence, self.sequence.max_grasps, seed=seed)
        found = self.controller.identify(self.recognizer, steps)
        if found.probability < self.least_probability:
            return MANUAL
        return self.bins.get(found.label, MANUAL)
