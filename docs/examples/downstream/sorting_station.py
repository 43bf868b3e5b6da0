"""The integrator's own program: have a part named, carry it to its bin, let it go there."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cell.config.sequence import SequenceConfig
from cell.control.controller import CellController
from cell.control.plan import Keep, Pose, plan
from cell.control.positioner import Destination
from recognition.recognizer import Recognizer

MANUAL = "manual inspection"


@dataclass
class Robot:
    """Stands for the robot that holds the gripper; remembers where it was sent."""

    reach_m: float = 0.01
    poses: list[Pose] = field(default_factory=list)
    places: list[str] = field(default_factory=list)

    def move(self, pose: Pose) -> bool:
        """Go to a pose; False refuses one that is out of reach."""
        self.poses.append(pose)
        return abs(pose.x_m) <= self.reach_m and abs(pose.y_m) <= self.reach_m

    def bring(self, destination: Destination) -> None:
        """Carry the part in the grip to a place; a False would keep it there."""
        self.places.append(destination.place)


@dataclass
class SortingStation:
    """Sorts by touch; what it does not know, or doubts, goes to a person."""

    controller: CellController
    recognizer: Recognizer
    sequence: SequenceConfig
    bins: Mapping[str, str]
    least_probability: float = 0.9

    def sort(self, seed: int = 0) -> str:
        """Name the part in front of the gripper, let it go in its bin, and return that bin.

        A fault, a cancel or a refused place ends here with an error and the part in the grip.
        """
        steps = plan(self.sequence, self.sequence.max_grasps, seed=seed)
        identification = self.controller.identify(self.recognizer, steps, keep=Keep.ALWAYS)
        sure = identification.decision.probability >= self.least_probability
        place = self.bins.get(identification.label, MANUAL) if sure else MANUAL
        self.controller.moves.carry_to(Destination(label=identification.label, place=place))
        if not self.controller.kept_part.verify().same:
            # It has turned or slipped in the grip: a person looks at it.
            place = MANUAL
            self.controller.moves.carry_to(Destination(label=identification.label, place=place))
        self.controller.put_down()
        return place
