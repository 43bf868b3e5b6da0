"""Config of the positioner: who moves the object, and the axes that do."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cell.config.section import SIMULATED, OneOf, Section
from cell.config.sequence import Range, SequenceConfig
from gripper.dynamixel.models import MODELS, XM430_W350

Moves = Literal["x", "y", "rotation", "roll"]
"""Part of a pose that one axis moves; mm for x and y, degrees for the two turns."""


class AxesCanConfig(Section):
    """CAN bus of the drives."""

    interface: str = Field(default=SIMULATED, min_length=1)
    """python-can interface (socketcan, slcan, ...); `simulated` is the built-in one."""
    channel: str = Field(default="", max_length=200)
    """Channel of the interface; the control unit's own is shared on socketcan only."""
    bitrate: Literal[125000, 250000, 500000, 1000000] = 1000000
    """Bit rate in bit/s."""
    heartbeat_loss_ms: float = Field(default=125.0, ge=100.0, le=500.0)
    """Time without a heartbeat (every 50 ms) after which a drive is lost in ms, 100 to 500; a drive
    that misses its host for twice as long stops by itself."""


def check_axis(moves: str, increments: float, low: float, high: float) -> None:
    """Refuse an axis without way or without increments. Raises ValueError."""
    if not low < high:
        raise ValueError(f"axis {moves} has the limits {low:g} to {high:g}; low is below high")
    if not 0.01 <= abs(increments) <= 1e6 or abs(increments) * max(abs(low), abs(high)) >= 2**31:
        raise ValueError(
            f"axis {moves} has {increments:g} increments in one mm or degree; 0.01 to 1e6, and the "
            "limits must fit into 32 bits"
        )


class DriveAxisConfig(Section):
    """An axis with a CiA 402 drive; lengths in mm, turns in degrees."""

    kind: Literal["cia402"]
    """Device of the axis."""
    moves: Moves
    """Part of the pose that it moves: x, y, rotation or roll."""
    node_id: int = Field(ge=1, le=127)
    """CANopen node-ID of the drive, 1 to 127."""
    increments: float
    """Increments of the drive in one mm or degree; negative where it counts the other way."""
    low: float = Field(ge=-1000.0, le=1000.0)
    """Lower limit in mm or degrees; no target below it is ever sent."""
    high: float = Field(ge=-1000.0, le=1000.0)
    """Upper limit in mm or degrees."""
    velocity: float = Field(default=20.0, gt=0.0, le=1000.0)
    """Profile velocity in mm or degrees a second."""
    acceleration: float = Field(default=100.0, gt=0.0, le=10000.0)
    """Profile acceleration in mm or degrees a second squared; a quick stop brakes twice as hard."""
    homing: Literal["negative_switch", "positive_switch", "here", "none"]
    """How the drive finds its position: at a limit switch (methods 17, 18), here (37), or none for
    an absolute encoder."""
    home: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    """Position of the home in mm or degrees."""
    homing_velocity: float = Field(default=5.0, gt=0.0, le=100.0)
    """Speed towards the switch in mm or degrees a second."""
    window: float = Field(default=0.05, gt=0.0, le=10.0)
    """How near counts as reached in mm or degrees."""
    following_error: float = Field(default=1.0, gt=0.0, le=100.0)
    """Following error in mm or degrees at which the drive stops with a fault."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        check_axis(self.moves, self.increments, self.low, self.high)
        return self


class ServoAxisConfig(Section):
    """An axis with a Dynamixel servo on a port of its own, in extended position mode."""

    kind: Literal["dynamixel"]
    """Device of the axis."""
    moves: Moves
    """Part of the pose that it moves: x, y, rotation or roll."""
    port: str = Field(default=SIMULATED, min_length=1, max_length=200)
    """Serial port of this servo alone, as /dev/ttyUSB1; `simulated` is the built-in one."""
    baud_rate: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000] = 1000000
    """Baud rate of the line in bit/s."""
    id: int = Field(default=1, ge=0, le=252)
    """ID of the servo, 0 to 252."""
    model: Annotated[str, OneOf(tuple(m.name for m in MODELS.values() if m.turns))] = "XM430-W350"
    """Model of the servo."""
    increments: float = XM430_W350.pulses_per_turn / 360.0
    """Pulses in one degree or mm: 11.3778 without a gear; negative where it turns the other way."""
    zero_pulse: int = Field(default=0, ge=0, le=4095)
    """Present Position at 0 of the axis in pulses, 0 to 4095."""
    low: float = Field(ge=-1000.0, le=1000.0)
    """Lower limit in mm or degrees; limits are at most a turn of the servo apart."""
    high: float = Field(ge=-1000.0, le=1000.0)
    """Upper limit in mm or degrees."""
    velocity: float = Field(default=90.0, gt=0.0, le=1000.0)
    """Profile velocity in mm or degrees a second."""
    acceleration: float = Field(default=360.0, gt=0.0, le=10000.0)
    """Profile acceleration in mm or degrees a second squared."""
    window: float = Field(default=1.0, gt=0.0, le=10.0)
    """How near counts as reached in mm or degrees; friction leaves a servo 0.7 degrees short."""
    lag: float = Field(default=8.0, gt=0.0, le=100.0)
    """How far behind its profile it is stalled, in mm or degrees."""
    current_max_a: float = Field(default=1.0, gt=0.0, le=5.0)
    """Current at which it is stalled in A, up to 5."""
    bus_loss_ms: float = Field(default=100.0, ge=50.0, le=500.0)
    """Time without an answer after which the servo is lost in ms, 50 to 500; a servo that misses
    its host for twice as long stops by itself."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        check_axis(self.moves, self.increments, self.low, self.high)
        if abs(self.increments) * (self.high - self.low) > MODELS[self.model].pulses_per_turn:
            raise ValueError(
                f"axis {self.moves} goes from {self.low:g} to {self.high:g}, more than a turn of "
                "its servo, which counts within one turn after a loss of power: narrow the limits"
            )
        return self


AxisConfig = Annotated[DriveAxisConfig | ServoAxisConfig, Field(discriminator="kind")]


class PositionerConfig(Section):
    """Who changes position and rotation between two grasps."""

    kind: Literal["simulated", "operator", "callback", "axes"] = "simulated"
    """simulated: the simulated cell; operator: a person at the terminal; callback: the host; axes:
    drives of the cell's own."""
    socket: str = Field(default="", max_length=200)
    """Socket of a simulated cell in another process (`positioner_socket` of `simulate`)."""
    can: AxesCanConfig = AxesCanConfig()
    """CAN bus of the drives, for axes of kind cia402."""
    axes: tuple[AxisConfig, ...] = Field(default=(), max_length=4)
    """The axes, for kind axes: one for each part of the pose that is moved."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.kind == "axes") != bool(self.axes):
            raise ValueError("positioner.axes lists axes if and only if positioner.kind is axes")
        moved = [axis.moves for axis in self.axes]
        if len(set(moved)) != len(moved):
            raise ValueError(f"positioner.axes move {', '.join(moved)}: each part of a pose once")
        nodes = [axis.node_id for axis in self.drives]
        if len(set(nodes)) != len(nodes):
            raise ValueError(f"positioner.axes have the node-IDs {nodes}: give each drive its own")
        ports = [port for port in self.ports[bool(self.drives) :] if port != SIMULATED]
        if len(set(ports)) != len(ports):
            raise ValueError(f"positioner.axes use the ports {ports}: give each servo its own")
        return self

    @property
    def drives(self) -> tuple[DriveAxisConfig, ...]:
        """The axes with a drive on the CAN bus."""
        return tuple(axis for axis in self.axes if isinstance(axis, DriveAxisConfig))

    @property
    def ports(self) -> tuple[str, ...]:
        """Interface and ports that the axes use."""
        servos = [axis.port for axis in self.axes if isinstance(axis, ServoAxisConfig)]
        return (*([self.can.interface] if self.drives else []), *servos)

    def check_sequence(self, sequence: SequenceConfig) -> None:
        """Refuse a sequence that the axes cannot follow. Raises ValueError."""
        if self.kind != "axes":
            return
        limits: dict[str, Range] = {axis.moves: (axis.low, axis.high) for axis in self.axes}
        for name, (low, high) in sequence.ranges.items():
            moves = name.partition("_")[0]
            least, most = limits.get(moves, (0.0, 0.0))
            if moves != "force" and not least <= low <= high <= most:
                reason = f"its axis goes from {least:g} to {most:g}"
                if moves not in limits:
                    reason = "no axis moves it: write [0, 0]"
                raise ValueError(f"sequence.{name} asks for {low:g} to {high:g}; {reason}")
