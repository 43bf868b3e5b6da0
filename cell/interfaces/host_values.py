"""The values that hosts read, in one table: source of nodes, methods and registers.

Each interface adds only the encoding of its protocol. HTTP sends the snapshot itself as JSON.
"""

from math import atan2, cos, hypot, sin
from typing import Any, NamedTuple

from cell.control.plan import Pose

N_TEXT = 16
"""Registers of a text, two characters each."""


class Value(NamedTuple):
    """One value of a `Snapshot`, of the service, or of a refusal."""

    node: str
    """Node of OPC UA, its path below ``Cell``."""
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
    Value("State.Number", int, "State of the cell: number of PackTags",
          "status.state_number", "state", 3),
    Value("State.Name", str, "State of the cell: PackML name", "status.state"),
    Value("State.NeedsReset", bool, "Whether an acknowledged fault waits for reset",
          "status.needs_reset", "needs_reset"),
    Value("State.Commander", str, "Client in command", "commander"),
    Value("State.HeldBy", str, "Clients that keep the cell on hold; empty: none",
          "held_by", "held_by"),
    Value("Grip.Number", int, "State of the grip, 0 to 7", "status.grasp_number", "grip_state", 4),
    Value("Grip.Name", str, "State of the grip", "status.grasp"),
    Value("Grip.Holding", bool, "Whether a part may be in the grip", "status.holding", "holding"),
    Value("Grip.Force", float, "Grip force in N", "status.live.force_n", "force", 13, 0.01),
    Value("Grip.ForceAge", float, "Age in s of the newest valid force",
          "status.live.force_age_s", "force_age", 23, 1e-3),
    Value("Grip.Setpoint", float, "Set-point of the force in N", "status.live.setpoint_n"),
    Value("Grip.Opening", float, "Opening between the fingers in mm",
          "status.live.opening_mm", "opening", 14, 0.01),
    Value("Grip.Temperature", float, "Temperature of the warmest servo in degrees Celsius",
          "status.live.temperature_c", "", 22),
    Value("Job.Number", int, "Number of the newest job; 0: none", "job.number", "", 8),
    Value("Job.Task", str, "Task of the job", "job.task"),
    Value("Job.State", int, "State: 1 accepted, 2 running, 4 done, 5 held on request, 6 aborted",
          "job.outcome_number", "job_state", 9),
    Value("Job.FaultNumber", int, "Fault number of a failed job; else 0",
          "job.fault_number", "job_fault"),
    Value("Job.FaultText", str, "Reason of its failure; else empty", "job.error"),
    Value("Job.Label", str, "Label found; before the end the likeliest label so far",
          "job.label", "label"),
    Value("Job.LabelId", int, "Id of the label, from 1; 0: not known yet, or UNKNOWN",
          "job.label_id", "label_id"),
    Value("Job.Probability", float, "Probability of the label, 0 to 1; 0 before the end",
          "job.probability", "probability"),
    Value("Job.Shape", str, "Shape; empty: not measured", "job.shape"),
    Value("Job.Size", float, "Size in mm; 0: not measured", "job.size_mm"),
    Value("Job.Grasps", int, "Grasps so far", "job.n_grasps", "", 12),
    Value("Job.Kept", bool, "Whether the part is kept", "job.kept"),
    Value("LastAnswer.Job", int,
          "Job of the last identification, until the next one begins; 0: no answer",
          "last_answer.number", "last_answer", 24),
    Value("LastAnswer.Label", str, "Label found", "last_answer.label"),
    Value("LastAnswer.LabelId", int, "Id of the label, from 1; 0: UNKNOWN",
          "last_answer.label_id", "", 10),
    Value("LastAnswer.Probability", float, "Probability of the label, 0 to 1",
          "last_answer.probability", "", 11, 1e-4),
    Value("LastAnswer.Size", float, "Size in mm; 0: not measured",
          "last_answer.size_mm", "", 15, 0.01),
    Value("LastAnswer.Kept", bool, "Whether the part was kept", "last_answer.kept"),
    Value("Part.Number", int,
          "Number of the newest part of an identification or sort; 0: none since the start",
          "part.number", "part", 96),
    Value("Part.Label", str, "Label of the part", "part.label", "part_label", 104),
    Value("Part.LabelId", int, "Id of the label, from 1; 0: UNKNOWN",
          "part.label_id", "part_label_id", 97),
    Value("Part.Probability", float, "Probability of the label, 0 to 1",
          "part.probability", "part_probability", 98, 1e-4),
    Value("Part.Size", float, "Size in mm; 0: not measured",
          "part.size_mm", "part_size", 99, 0.01),
    Value("Part.Place", str, "Place where a sort released it; empty: not sorted",
          "part.place", "part_place", 120),
    Value("Part.PlaceId", int, "Number of that place, from 1, rejects last; 0: not sorted",
          "part.place_id", "part_place_id", 100),
    Value("Part.Grasps", int, "Grasps of its identification",
          "part.n_grasps", "", 101),
    Value("Pose.Number", int, "Number of the pose that the cell waits for; 0: none",
          "pose_seq", "pose_seq", 16),
    Value("FrameAge", float, "Age in s of the newest frame of the taxels",
          "status.live.frame_age_s", "frame_age", 21, 1e-3),
    Value("RecordingFault", str,
          "Reason why the recording has stopped; empty: no problem, or no recording",
          "status.recording_fault", "recording_fault"),
    Value("FaultNumber", int, "Number of the latched fault; 0: none",
          "status.fault_number", "fault_number"),
    Value("FaultText", str, "Text of the latched fault; empty: none",
          "status.fault", "fault_text"),
)
# fmt: on
"""Values of a snapshot."""
PLATE = (
    Value("Identification.Name", str, "Name of the cell", "config.name"),
    Value("Identification.Simulated", bool, "Whether there is no hardware", "config.simulated"),
    Value("Identification.Version", str, "Version of the cell's program", "version"),
    Value(
        "Identification.Boot",
        int,
        "Number that differs after each start of the program, 1 to 65535",
        "boot",
        "boot",
        27,
    ),
)
"""Values of the service itself."""
REFUSAL = (
    Value("LastRefusal.Number", int, "Fault number of the last refused call; 0: none", "number"),
    Value("LastRefusal.Text", str, "Reason of the refusal", "text"),
    Value("LastRefusal.Remedy", str, "Remedy", "remedy"),
)
"""Values of the last refusal of an interface."""


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
