"""The stage: carries the object to where the axes are, unless the fingers hold it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from simulator.errors import SimulatorSettingsError
from simulator.world.shapes import ObjectPose
from simulator.world.world import NOTHING, PhysicalWorld

FIELDS = {"x": "x_m", "y": "y_m", "rotation": "rotation_rad", "roll": "roll_rad"}
"""What an axis can move, and the field of the pose that it is."""
_MOVING_STEP = 2e-3
"""Way in m, or in rad divided by `_RAD_PER_M`, after which an object on its way between open
fingers is put anew: each time its height maps are worked out, in about 1 ms."""
_GRIPPED_N = 0.05
"""Force in N on both pads from which they hold the object: the friction of its nest."""
_RESTING_STEP = 2e-5
"""The same once the axes stand: 0.02 mm or 0.06 degrees."""
_RAD_PER_M = 50.0
"""Angle in rad that counts as a way of 1 m: 0.01 rad as 0.2 mm, an edge 20 mm from the centre."""


class MovedAxis(Protocol):
    """An axis as the stage sees it."""

    @property
    def position(self) -> float:
        """True position in m or rad."""

    @property
    def moving(self) -> bool:
        """Whether it moves."""


class Stage:
    """What carries the object: its pose in the world follows the true positions of the axes.

    An object that the fingers hold stays between them: the axes move both to another place.

    Parameters
    ----------
    axes
        The axes by what they move, of `FIELDS`.
    """

    def __init__(self, world: PhysicalWorld, axes: Mapping[str, MovedAxis]) -> None:
        self._world = world
        self._axes = dict(axes)
        self._carried: tuple[str, ObjectPose] | None = None
        self._shown: ObjectPose | None = None
        self._beside = False

    @property
    def empty(self) -> bool:
        """Whether there is no axis: objects stay where they are placed."""
        return not self._axes

    def place(self, label: str, pose: ObjectPose) -> ObjectPose:
        """Put an object on the stage; what an axis moves is where the axis is, not as in ``pose``.

        Returns where it came to rest. Beside the pads it waits until the axes bring it between
        them. Raises SimulatorSettingsError or SimulatorStateError as `PhysicalWorld.place`, for an
        unknown shape and for fingers that are in the way.
        """
        wanted = self._at(pose)
        if label == NOTHING:
            self._world.place(label)
            self._carried = None
            return wanted
        self._world.shape(label)
        try:
            rested, self._beside = self._world.place(label, wanted), False
        except SimulatorSettingsError:
            self._world.remove()
            rested, self._beside = wanted, True
        self._carried, self._shown = (label, pose), wanted
        return rested

    def advance(self) -> None:
        """Carry the object to where the axes are."""
        if self._carried is None or self._shown is None:
            return
        label, pose = self._carried
        if self._world.placed is None and not self._beside:
            # Somebody has taken it off.
            self._carried = None
            return
        moving = any(axis.moving for axis in self._axes.values())
        wanted = self._at(pose)
        if _way(self._shown, wanted) <= (_MOVING_STEP if moving else _RESTING_STEP):
            return
        if min(self._world.contact_force_n()) > _GRIPPED_N:
            # It goes with the fingers that hold it, and stays where they let go.
            self._carried = None
        else:
            self._beside = not self._world.carry(label, wanted)
            self._shown = wanted

    def _at(self, pose: ObjectPose) -> ObjectPose:
        found = {FIELDS[name]: axis.position for name, axis in self._axes.items()}
        return replace(pose, **found)


def _way(one: ObjectPose, other: ObjectPose) -> float:
    """Return how far two poses are apart in m, turns counted as by `_RAD_PER_M`."""
    turned = max(abs(one.rotation_rad - other.rotation_rad), abs(one.roll_rad - other.roll_rad))
    return max(abs(one.x_m - other.x_m), abs(one.y_m - other.y_m), turned / _RAD_PER_M)
