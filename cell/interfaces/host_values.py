"""The values that hosts read, in one table: source of methods and registers.

Each interface adds only the encoding of its protocol. HTTP sends the snapshot itself as JSON.
"""

from math import atan2, cos, hypot, sin
from typing import Any, NamedTuple

from cell.control.plan import Pose

N_TEXT = 16
"""Registers of a text, two characters each."""


class Value(NamedTuple):
    """One value of a `Snapshot`."""

    kind: type
    """``int``, ``float``, ``bool`` or ``str``."""
    text: str
    """Meaning, with unit."""
    source: str
    """Path of its attributes."""
    method: str = ""
    """Method of XML-RPC that returns it; methods of a job or a part take its number."""
    register: int = 0
    """Input register of Modbus, for a text the first of `N_TEXT`; 0: no register, or the Modbus
    interface writes it separately."""
    unit: float = 1.0
    """Unit of the register."""

    def of(self, shown: Any) -> Any:
        """Return the value; None if it does not exist or is not measured at the moment."""
        for name in self.source.split("."):
            if shown is None:
                return None
            shown = getattr(shown, name)
        if self.kind is not str:
            return shown
        return ", ".join(shown) if isinstance(shown, tuple) else shown or ""


# fmt: off
VALUES = (
    Value(int, "State of the cell: number of PackTags", "status.state_number", "state", 3),
    Value(bool, "Whether an acknowledged fault waits for reset",
          "status.needs_reset", "needs_reset"),
    Value(str, "Clients that keep the cell on hold; empty: none", "held_by", "held_by"),
    Value(int, "State of the grip, 0 to 7", "status.grasp_number", "grip_state", 4),
    Value(bool, "Whether a part may be in the grip", "status.holding", "holding"),
    Value(float, "Grip force in N", "status.live.force_n", "force", 13, 0.01),
    Value(float, "Age in s of the newest valid force",
          "status.live.force_age_s", "force_age", 23, 1e-3),
    Value(float, "Opening between the fingers in mm",
          "status.live.opening_mm", "opening", 14, 0.01),
    Value(float, "Temperature of the warmest servo in degrees Celsius",
          "status.live.temperature_c", "", 22),
    Value(int, "Number of the newest job; 0: none", "job.number", "", 8),
    Value(int, "State of the job: 1 accepted, 2 running, 4 done, 5 held on request, 6 aborted",
          "job.outcome_number", "job_state", 9),
    Value(int, "Fault number of a failed job; else 0", "job.fault_number", "job_fault"),
    Value(str, "Label found; before the end the likeliest label so far", "job.part.label", "label"),
    Value(int, "Id of the label, from 1; 0: not known yet, or UNKNOWN",
          "job.part.label_id", "label_id"),
    Value(float, "Probability of the label, 0 to 1; 0 before the end",
          "job.part.probability", "probability"),
    Value(int, "Grasps of the job so far", "job.part.n_grasps", "", 12),
    Value(int, "Job of the last identification, until the next one begins; 0: no answer",
          "status.last_answer.job", "last_answer", 24),
    Value(int, "Last identification: id of the label, from 1; 0: UNKNOWN",
          "status.last_answer.label_id", "", 10),
    Value(float, "Last identification: probability of the label, 0 to 1",
          "status.last_answer.probability", "", 11, 1e-4),
    Value(float, "Last identification: size in mm; 0: not measured",
          "status.last_answer.size_mm", "", 15, 0.01),
    Value(int, "Number of the newest part of an identification or sort; 0: none since the start",
          "part.number", "part", 96),
    Value(str, "Label of the part", "part.label", "part_label", 104),
    Value(int, "Id of the label of the part, from 1; 0: UNKNOWN",
          "part.label_id", "part_label_id", 97),
    Value(float, "Probability of the label of the part, 0 to 1",
          "part.probability", "part_probability", 98, 1e-4),
    Value(float, "Size of the part in mm; 0: not measured",
          "part.size_mm", "part_size", 99, 0.01),
    Value(str, "Place where a sort released the part; empty: not sorted",
          "part.place", "part_place", 120),
    Value(int, "Number of that place, from 1, rejects last; 0: not sorted",
          "part.place_id", "part_place_id", 100),
    Value(int, "Grasps of the identification of the part", "part.n_grasps", "", 101),
    Value(int, "Number of the pose that the cell waits for; 0: none", "pose_seq", "pose_seq", 16),
    Value(float, "Age in s of the newest frame of the taxels",
          "status.live.frame_age_s", "frame_age", 21, 1e-3),
    Value(str, "Reason why the recording has stopped; empty: no problem, or no recording",
          "status.recording_fault", "recording_fault"),
    Value(int, "Number of the latched fault; 0: none", "status.fault_number", "fault_number"),
    Value(str, "Text of the latched fault; empty: none", "status.fault", "fault_text"),
)
# fmt: on
"""All values."""


def ur_pose(pose: Pose | None) -> dict[str, float]:
    """Return a pose for URScript, in the grip frame: m, and a rotation vector in rad.

    The object first rolls about its long axis (x), then turns about the approach axis (z).
    """
    if pose is None:
        pose = Pose()
    turn, roll = pose.rotation_rad / 2, pose.roll_rad / 2
    # Product of the two unit quaternions.
    axis = (cos(turn) * sin(roll), sin(turn) * sin(roll), sin(turn) * cos(roll))
    length = hypot(*axis)
    angle_rad = 2 * atan2(length, cos(turn) * cos(roll))
    scale = angle_rad / length if length else 0.0
    rotation = dict(zip(("rx", "ry", "rz"), (scale * part for part in axis), strict=True))
    return {"x": pose.x_m, "y": pose.y_m, "z": 0.0} | rotation
