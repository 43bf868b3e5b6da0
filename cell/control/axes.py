"""The positioner with axes of its own: made from the config, moved between two grasps."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import radians

from cell.config.positioner import DriveAxisConfig, PositionerConfig
from cell.control.plan import Pose
from cell.control.positioner import unwatched
from cell.errors import PositionerError, PositionerFault
from gripper.state import Clock, GripperPhase
from motion.axes import Axes, Axis
from motion.bus import DriveBus, Watch
from motion.drive import Cia402Drive, DriveSettings
from motion.errors import AxisLimitExceeded, MotionError, PositionNotReached
from motion.object_dictionary import HomingMethod
from tactile.can.bus import CanBus

_FIELDS = {"x": "x_m", "y": "y_m", "rotation": "rotation_rad", "roll": "roll_rad"}
"""What an axis can move, and the field of the pose that it is."""
_HOMING = {
    "negative_switch": HomingMethod.NEGATIVE_SWITCH,
    "positive_switch": HomingMethod.POSITIVE_SWITCH,
    "here": HomingMethod.HERE,
    "none": None,
}
_FINGERS_REST = (GripperPhase.OFF, GripperPhase.IDLE)
"""Phases of the gripper in which nothing is held and no finger moves."""

Bring = Callable[[str | None, Callable[[], None]], None]
"""Has somebody bring an object: its label or None, and the supervision of the wait."""


def si_per_unit(moves: str) -> float:
    """Return how many m or rad one mm or degree of an axis is."""
    return 1e-3 if moves in ("x", "y") else radians(1.0)


def make_axes(config: PositionerConfig, bus: CanBus, clock: Clock, period_s: float) -> Axes:
    """Return the axes of a config on an open bus; nothing moves yet.

    Parameters
    ----------
    config
        The positioner's section.
    bus
        Bus of the drives.
    clock
        Source of time.
    period_s
        While an axis moves, the cell is supervised once in so many s.
    """
    watch = Watch(clock, period_s)
    drives = DriveBus(bus, watch)
    return Axes([_drive_axis(axis, drives) for axis in config.axes], watch)


def _drive_axis(config: DriveAxisConfig, bus: DriveBus) -> Axis:
    def increments(value: float) -> int:
        return round(value * config.increments)

    def count(value: float) -> int:
        return max(1, abs(increments(value)))

    low, high = sorted((increments(config.low), increments(config.high)))
    homing = _HOMING[config.homing]
    if config.increments < 0 and homing is not None and homing is not HomingMethod.HERE:
        # The switch at the lower end of the axis is the positive one of a drive that is turned.
        homing = HomingMethod(HomingMethod.NEGATIVE_SWITCH + HomingMethod.POSITIVE_SWITCH - homing)
    settings = DriveSettings(
        low=low,
        high=high,
        velocity=count(config.velocity),
        acceleration=count(config.acceleration),
        window=count(config.window),
        following_error=count(config.following_error),
        homing=homing,
        home=increments(config.home),
        homing_velocity=count(config.homing_velocity),
    )
    si = si_per_unit(config.moves)
    return Axis(
        name=config.moves,
        device=Cia402Drive(bus, config.node_id, f"axis {config.moves}", settings),
        increments=config.increments / si,
        low=config.low * si,
        high=config.high * si,
        velocity=config.velocity * si,
        acceleration=config.acceleration * si,
        unit="mm" if config.moves in ("x", "y") else "deg",
        shown=1.0 / si,
    )


class AxesPositioner:
    """Moves the object with axes of the cell's own, only while the fingers rest and are empty.

    Parameters
    ----------
    axes
        The axes.
    moved
        What they move, of x, y, rotation and roll.
    bring
        Has an object put where the axes carry it.
    phase
        Returns the present phase of the gripper.
    """

    blocks = False

    def __init__(
        self,
        axes: Axes,
        moved: Sequence[str],
        *,
        bring: Bring,
        phase: Callable[[], GripperPhase],
    ) -> None:
        self.axes = axes
        self._moved = tuple(moved)
        self._bring = bring
        self._phase = phase

    def present(self, label: str | None, supervise: Callable[[], None] = unwatched) -> None:
        """Have an object put on the axes; see `Positioner`."""
        self._bring(label, supervise)

    def move_to(self, pose: Pose, supervise: Callable[[], None] = unwatched) -> Pose:
        """Move all axes to the pose; return where they are.

        Raises
        ------
        PositionerError
            If the pose is outside the limits, part of it is moved by no axis, the fingers do not
            rest, or the way took too long; a way that was begun was stopped.
        PositionerFault
            If a drive is at fault or silent; all axes were stopped.
        """
        for part, name in _FIELDS.items():
            value = getattr(pose, name)
            if part not in self._moved and value != 0.0:
                raise PositionerError(
                    f"{pose} asks for {part}, which no axis moves; nothing has moved. Plan poses "
                    f"with 0 there, or add an axis (positioner.axes)"
                )
        phase = self._phase()
        if phase not in _FINGERS_REST:
            raise PositionerError(
                f"the fingers are {phase.value}: axes move only while they rest and hold nothing; "
                "release the part first"
            )
        targets = {part: getattr(pose, _FIELDS[part]) for part in self._moved}
        try:
            reached = self.axes.move(targets, supervise)
        except (AxisLimitExceeded, PositionNotReached) as error:
            raise PositionerError(str(error)) from error
        except MotionError as error:
            raise PositionerFault(f"{type(error).__name__}: {error}") from error
        return replace(pose, **{_FIELDS[part]: value for part, value in reached.items()})
