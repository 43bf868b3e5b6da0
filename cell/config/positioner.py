"""Config of the positioner that moves the object, of its axes, and of the places of parts."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.gripper import use_servo_models
from cell.config.section import SIMULATED, Installed, Section, refuse_repeats
from cell.config.sequence import Range, SequenceConfig
from cell.errors import ConfigError, raised_as
from cell.files import checked_label
from cell.plugins import SERVO_MODELS
from gripper.dynamixel.models import MODELS, XM430_W350
from gripper.errors import LimitExceeded

Moves = Literal["x", "y", "rotation", "roll"]
"""Part of a pose that one axis moves; mm for x and y, degrees for the two turns."""


def _turning(model: str) -> str:
    with raised_as(ValueError, ConfigError, LimitExceeded):
        use_servo_models([model])
    if not MODELS[model].turns:
        raise ValueError(f"{model} is a gripper: an axis needs a servo that turns")
    return model


class AxesCanConfig(Section):
    """CAN bus of the drives."""

    interface: str = Field(default=SIMULATED, min_length=1)
    """python-can interface (socketcan, slcan, ...); `simulated`: the built-in interface."""
    channel: str = Field(default="", max_length=200, strict=False, coerce_numbers_to_str=True)
    """Channel of the interface; only socketcan can share the channel of the control unit."""
    bitrate: Literal[125000, 250000, 500000, 1000000] = 1000000
    """Bit rate in bit/s."""
    heartbeat_loss_ms: float = Field(default=125.0, ge=100.0, le=500.0)
    """Time without a heartbeat (every 50 ms) after which a drive is lost in ms, 100 to 500. A drive
    stops by itself after twice this time without its host."""


class _Axis(Section):
    """Keys of each axis; lengths in mm, turns in degrees."""

    kind: str
    """Device of the axis."""
    moves: Moves
    """Part of the pose that it moves: x, y, rotation or roll."""
    increments: float
    """Increments of the device per mm or degree; negative if it counts in the other direction."""
    low: float = Field(ge=-1000.0, le=1000.0)
    """Lower limit in mm or degrees; smaller targets are refused."""
    high: float = Field(ge=-1000.0, le=1000.0)
    """Upper limit in mm or degrees."""

    @model_validator(mode="after")
    def _counts(self) -> Self:
        """Refuse limits and increments that the device cannot count."""
        scale, low, high = abs(self.increments), self.low, self.high
        if not low < high:
            raise ValueError(
                f"axis {self.moves} has the limits {low:g} to {high:g}; low must be below high"
            )
        if not 0.01 <= scale <= 1e6 or scale * max(abs(low), abs(high)) >= 2**31:
            raise ValueError(
                f"axis {self.moves} has {self.increments:g} increments per mm or degree; write "
                "0.01 to 1e6, with limits that fit into 32 bits"
            )
        return self


class DriveAxisConfig(_Axis):
    """An axis with a CiA 402 drive; lengths in mm, turns in degrees."""

    kind: Literal["cia402"]
    """Device of the axis."""
    node_id: int = Field(ge=1, le=126)
    """CANopen node-ID of the drive, 1 to 126; 127 is that of the host."""
    velocity: float = Field(default=20.0, gt=0.0, le=1000.0)
    """Profile velocity in mm or degrees a second."""
    acceleration: float = Field(default=100.0, gt=0.0, le=10000.0)
    """Profile acceleration in mm or degrees a second squared; a quick stop brakes twice as hard."""
    homing: Literal["negative_switch", "positive_switch", "here", "none"]
    """Homing method of the drive: at a limit switch (methods 17, 18), here (37), or none for an
    absolute encoder."""
    home: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    """Home position in mm or degrees."""
    homing_velocity: float = Field(default=5.0, gt=0.0, le=100.0)
    """Speed towards the switch in mm or degrees a second."""
    window: float = Field(default=0.05, gt=0.0, le=10.0)
    """Largest distance of a reached target in mm or degrees."""
    following_error: float = Field(default=1.0, gt=0.0, le=100.0)
    """Following error in mm or degrees at which the drive stops with a fault."""


class ServoAxisConfig(_Axis):
    """An axis with a Dynamixel servo on its own port, in extended position mode."""

    kind: Literal["dynamixel"]
    """Device of the axis."""
    port: str = Field(default=SIMULATED, min_length=1, max_length=200)
    """Serial port of this servo only, for example /dev/ttyUSB1; `simulated`: the built-in port."""
    baud_rate: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000, 4500000] = 1000000
    """Baud rate of the line in bit/s."""
    id: int = Field(default=1, ge=0, le=252)
    """ID of the servo, 0 to 252."""
    model: Annotated[str, AfterValidator(_turning), Installed(SERVO_MODELS)] = "XM430-W350"
    """Model of the servo, one that turns without end."""
    increments: float = XM430_W350.pulses_per_turn / 360.0
    """Pulses per degree or mm: 11.3778 without a gear; negative for the other direction."""
    zero_pulse: int = Field(default=0, ge=0, le=4095)
    """Present Position at 0 of the axis in pulses, 0 to 4095."""
    velocity: float = Field(default=90.0, gt=0.0, le=1000.0)
    """Profile velocity in mm or degrees a second."""
    acceleration: float = Field(default=360.0, gt=0.0, le=10000.0)
    """Profile acceleration in mm or degrees a second squared."""
    window: float = Field(default=1.0, gt=0.0, le=10.0)
    """Largest distance of a reached target in mm or degrees; friction can leave 0.7 degrees."""
    lag: float = Field(default=8.0, gt=0.0, le=100.0)
    """Distance behind its profile at which the servo counts as stalled, in mm or degrees."""
    current_max_a: float = Field(default=1.0, gt=0.0, le=5.0)
    """Current at which the servo counts as stalled in A, up to 5."""
    bus_loss_ms: float = Field(default=100.0, ge=50.0, le=500.0)
    """Time without an answer after which the servo is lost in ms, 50 to 500. A servo stops by
    itself after twice this time without its host."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if abs(self.increments) * (self.high - self.low) > MODELS[self.model].pulses_per_turn:
            raise ValueError(
                f"axis {self.moves} goes from {self.low:g} to {self.high:g}, more than one turn of "
                "its servo: narrow the limits. After a loss of power a servo counts within one turn"
            )
        return self


AxisConfig = Annotated[DriveAxisConfig | ServoAxisConfig, Field(discriminator="kind")]


class PositionerConfig(Section):
    """Device or person that changes position and rotation between two grasps."""

    kind: Literal["simulated", "operator", "callback", "axes"] = "simulated"
    """simulated: the simulated cell; operator: a person at the terminal; callback: the host; axes:
    drives of the cell."""
    socket: str = Field(default="", max_length=200)
    """Socket of a simulated cell in another process (`positioner_socket` of `simulate`)."""
    can: AxesCanConfig = AxesCanConfig()
    """CAN bus of the drives, for axes of kind cia402."""
    axes: tuple[AxisConfig, ...] = Field(default=(), max_length=4)
    """The axes, for kind axes: one for each moved part of the pose."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.kind == "axes") != bool(self.axes):
            raise ValueError(
                "positioner.kind axes needs positioner.axes; other kinds must not have it"
            )
        refuse_repeats((axis.moves for axis in self.axes), "moves of positioner.axes")
        refuse_repeats((axis.node_id for axis in self.drives), "node-IDs of positioner.axes")
        return self

    @property
    def drives(self) -> tuple[DriveAxisConfig, ...]:
        """The axes with a drive on the CAN bus."""
        return tuple(axis for axis in self.axes if isinstance(axis, DriveAxisConfig))

    @property
    def ports(self) -> tuple[str, ...]:
        """CAN interface and serial ports of the axes."""
        servos = [axis.port for axis in self.axes if isinstance(axis, ServoAxisConfig)]
        return (*([self.can.interface] if self.drives else []), *servos)

    def check_poses(self, sequence: SequenceConfig, sort: "SortConfig") -> None:
        """Check that the axes reach the poses of a sequence and of places. Raises ValueError."""
        if self.kind != "axes":
            return
        limits: dict[str, Range] = {axis.moves: (axis.low, axis.high) for axis in self.axes}
        asked = {f"sequence.{name}": value for name, value in sequence.ranges.items()}
        poses = {f"sort.places[{i}].pose": place.pose for i, place in enumerate(sort.places)}
        for key, pose in (poses | {"sort.reject_pose": sort.reject_pose}).items():
            values = {} if pose is None else pose.model_dump()
            asked |= {f"{key}.{name}": (value, value) for name, value in values.items()}
        for key, (low, high) in asked.items():
            moves = key.rpartition(".")[2].partition("_")[0]
            least, most = limits.get(moves, (0.0, 0.0))
            if moves != "force" and not least <= low <= high <= most:
                reason = f"its axis goes from {least:g} to {most:g}"
                if moves not in limits:
                    reason = "no axis moves it: write 0"
                raise ValueError(f"{key} asks for {low:g} to {high:g}; {reason}")


class PlacePoseConfig(Section):
    """Pose of a place, for a positioner with its own axes."""

    x_mm: float = Field(default=0.0, ge=-10000.0, le=10000.0)
    """Position along the fingers in mm, -10000 to 10000."""
    y_mm: float = Field(default=0.0, ge=-10000.0, le=10000.0)
    """Position across the fingers in mm, -10000 to 10000."""
    rotation_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the approach axis in degrees, -360 to 360."""
    roll_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the object's own axis in degrees, -360 to 360."""


class PlaceConfig(Section):
    """The place of one kind of part."""

    label: Annotated[str, AfterValidator(checked_label)] = Field(min_length=1, max_length=60)
    """Name of the part."""
    place: str = Field(min_length=1, max_length=60)
    """Name of its place; several parts may share one."""
    pose: PlacePoseConfig | None = None
    """Pose of the place; none: the host or a person finds it by its name."""


class SortConfig(Section):
    """Places to which a sort brings the named parts."""

    places: tuple[PlaceConfig, ...] = Field(default=(), max_length=1000)
    """Places of the taught parts; empty: each part has a place with its own name."""
    reject: str = Field(default="reject", min_length=1, max_length=60)
    """Name of the place for unknown parts, and for parts that changed on the way."""
    reject_pose: PlacePoseConfig | None = None
    """Pose of that place; none: the host or a person finds it by its name."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        refuse_repeats((entry.label for entry in self.places), "labels of sort.places")
        return self
