"""The positioner that drives its own axes: made from the config, moved between two grasps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import radians
from typing import Any, ClassVar

from cell.config.positioner import DriveAxisConfig, ServoAxisConfig
from cell.control.plan import Pose
from cell.control.positioner import Destination, unwatched
from cell.errors import PositionerError, PositionerFault
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import MODELS
from gripper.dynamixel.serial_port import ByteStream
from gripper.values.state import GripperPhase
from motion.axes import Axes, Axis, Watch
from motion.drive import Cia402Drive, DriveBus, DriveSettings
from motion.errors import AxisLimitExceeded, MotionError, PositionNotReached
from motion.object_dictionary import HomingMethod
from motion.servo import ServoAxis, ServoAxisSettings
from tactile.can.bus import CanBus

_FIELDS = {"x": "x_m", "y": "y_m", "rotation": "rotation_rad", "roll": "roll_rad"}
"""What an axis can move, and the field of the pose that it is."""
_LINEAR = ("x", "y")
_HOMING = {
    "negative_switch": HomingMethod.NEGATIVE_SWITCH,
    "positive_switch": HomingMethod.POSITIVE_SWITCH,
    "here": HomingMethod.HERE,
    "none": None,
}
_FINGERS_REST = (GripperPhase.OFF, GripperPhase.IDLE)
"""Phases of the gripper in which nothing is held and no finger moves."""
_FINGERS_HOLD = (GripperPhase.HOLDING,)
"""Phases in which a part is held and no finger moves."""

Bring = Callable[[str | None, Callable[[], None]], None]
"""Asks for an object: its label or None, and the function that supervises the wait."""


def si_per_unit(moves: str) -> float:
    """Return one mm or degree of an axis in m or rad."""
    return 1e-3 if moves in _LINEAR else radians(1.0)


def drive_axes(
    configs: Sequence[DriveAxisConfig], bus: CanBus, watch: Watch, *, loss_s: float
) -> list[Axis]:
    """Return the axes with drives on one CAN bus; ``loss_s`` s of silence are a lost drive.

    Nothing moves. ``watch`` supervises the cell while an axis moves.
    """
    drives = DriveBus(bus, watch, loss_s)
    return [
        Cia402Drive(
            DriveSettings(
                **_settings(config),
                lag=config.following_error * si_per_unit(config.moves),
                node_id=config.node_id,
                homing=_HOMING[config.homing],
                home=config.home * si_per_unit(config.moves),
                homing_velocity=config.homing_velocity * si_per_unit(config.moves),
            ),
            drives,
        )
        for config in configs
    ]


def servo_axis(config: ServoAxisConfig, stream: ByteStream, watch: Watch) -> Axis:
    """Return an axis with a servo alone on its line; nothing moves."""
    bus = ServoBus(
        stream,
        baudrate=config.baud_rate,
        clock=watch.clock,
        name=f"the line of axis {config.moves} ({config.port})",
    )
    settings = ServoAxisSettings(
        **_settings(config),
        lag=config.lag * si_per_unit(config.moves),
        servo_id=config.id,
        model=MODELS[config.model],
        zero=config.zero_pulse,
        current_a=config.current_max_a,
        loss_s=1e-3 * config.bus_loss_ms,
    )
    return ServoAxis(settings, bus, watch)


def _settings(config: DriveAxisConfig | ServoAxisConfig) -> dict[str, Any]:
    """Return the settings of each axis in SI units."""
    si = si_per_unit(config.moves)
    scaled = ("low", "high", "velocity", "acceleration", "window")
    return {
        "name": config.moves,
        "linear": config.moves in _LINEAR,
        "increments": config.increments / si,
        **{name: getattr(config, name) * si for name in scaled},
    }


@dataclass(kw_only=True)
class AxesPositioner:
    """Moves the object with the cell's own axes: between open fingers, or kept in the grip."""

    axes: Axes
    moved: tuple[str, ...]
    """The fields of the pose that they move: x, y, rotation, roll."""
    bring: Bring
    """Asks for an object on the axes."""
    phase: Callable[[], GripperPhase]
    """Returns the present phase of the gripper."""
    blocks: ClassVar[bool] = False

    def present(self, label: str | None, supervise: Callable[[], None] = unwatched) -> None:
        """Have an object put on the axes; see `Positioner`."""
        self.bring(label, supervise)

    def move_to(self, pose: Pose, supervise: Callable[[], None] = unwatched) -> Pose:
        """Move all axes to the pose; return where they are.

        Raises PositionerError if the pose is outside the limits, no axis moves a part of it, the
        fingers move, or the motion takes too long. The motion is then stopped. Raises
        PositionerFault if a drive is at fault or silent; all axes are then stopped.
        """
        reached = self._move(pose, _FINGERS_REST, supervise)
        return replace(pose, **{_FIELDS[part]: value for part, value in reached.items()})

    def carry_to(self, destination: Destination, supervise: Callable[[], None] = unwatched) -> None:
        """Move all axes to a place with the part that is kept in the grip.

        Raises PositionerError if the place has no pose; else as `move_to`. The part is still kept.
        """
        if destination.pose is None:
            raise PositionerError(
                f"sort.places has no pose for {destination.place}, the place of "
                f"{destination.label}. Add one, or use a host with the callback `places`. The part "
                "is kept"
            )
        if not self.axes.ready:
            raise PositionerError(
                f"the axes must be homed before they go to {destination.place}. Homing needs "
                "empty fingers: release the part; it is kept until then"
            )
        self._move(destination.pose, _FINGERS_HOLD, supervise)

    def _move(
        self, pose: Pose, phases: Sequence[GripperPhase], supervise: Callable[[], None]
    ) -> dict[str, float]:
        """Move to a pose if the gripper is in an allowed phase; return where the axes are."""
        for part, name in _FIELDS.items():
            value = getattr(pose, name)
            if part not in self.moved and value != 0.0:
                raise PositionerError(
                    f"{pose} asks for {part}, which no axis moves; nothing has moved. Plan poses "
                    f"with 0 there, or add an axis (positioner.axes)"
                )
        phase = self.phase()
        if phase not in phases:
            raise PositionerError(
                f"the fingers are {phase.value}: axes move only while the fingers rest, empty or "
                "with a kept part"
            )
        targets = {part: getattr(pose, _FIELDS[part]) for part in self.moved}
        try:
            return self.axes.move(targets, supervise)
        except (AxisLimitExceeded, PositionNotReached) as error:
            raise PositionerError(str(error)) from error
        except MotionError as error:
            raise PositionerFault(str(error)) from error
