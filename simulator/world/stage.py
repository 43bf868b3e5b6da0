"""The stage: moves the object with the axes, unless the fingers hold it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from simulator.errors import SimulatorSettingsError
from simulator.world.shapes import ObjectPose
from simulator.world.world import NOTHING, PhysicalWorld

FIELDS = {"x": "x_m", "y": "y_m", "rotation": "rotation_rad", "roll": "roll_rad"}
"""Parts of a pose that an axis can move, and their fields."""
_MOVING_STEP = 2e-3
"""Step of a moving object between open fingers in m, or in rad divided by 50. Each step
computes its height maps again, in about 1 ms."""
_GRIPPED_N = 0.05
"""Smallest force in N on both pads that holds the object: the friction of its nest."""
_RESTING_STEP = 2e-5
"""Step while the axes stand still: 0.02 mm or 0.06 degrees."""
_PER_M = {"x": 1.0, "y": 1.0, "rotation": 50.0, "roll": 50.0}
"""Way of an axis that counts as 1 m: 0.01 rad as 0.2 mm, for an edge 20 mm from the centre."""


class MovedAxis(Protocol):
    """An axis for the stage."""

    @property
    def position(self) -> float:
        """True position in m or rad."""

    @property
    def moving(self) -> bool:
        """Whether it moves."""


class Stage:
    """Carrier of the object: the pose of the object follows the true positions of the axes.

    While the fingers hold the object, it stays between them, and the axes move both.

    Parameters
    ----------
    axes
        The axes by their part of the pose, one of `FIELDS`.
    """

    def __init__(self, world: PhysicalWorld, axes: Mapping[str, MovedAxis]) -> None:
        self._world = world
        self._axes = dict(axes)
        self._carried: tuple[str, ObjectPose] | None = None
        # Positions of the axes at the present pose of the object.
        self._positions: dict[str, float] = {}
        self._off_pads = False

    def place(self, label: str, pose: ObjectPose) -> ObjectPose:
        """Put an object on the stage; the positions of the axes replace their parts of ``pose``.

        Returns its resting pose. Beside the pads it waits until the axes move it between them.
        Raises SimulatorSettingsError or SimulatorStateError as `PhysicalWorld.place`, for an
        unknown shape or fingers in the way.
        """
        stage_pose = self._at(pose)
        if label == NOTHING:
            self._world.place(label)
            self._carried = None
            return stage_pose
        self._world.shape(label)
        try:
            rested, self._off_pads = self._world.place(label, stage_pose), False
        except SimulatorSettingsError:
            self._world.remove()
            rested, self._off_pads = stage_pose, True
        self._carried = (label, pose)
        return rested

    def advance(self) -> None:
        """Move the object to the positions of the axes."""
        if self._carried is None:
            return
        label, pose = self._carried
        if self._world.placed is None and not self._off_pads:
            # The object was removed.
            self._carried = None
            return
        step = _RESTING_STEP
        if any(axis.moving for axis in self._axes.values()):
            step = _MOVING_STEP
        if all(
            abs(axis.position - self._positions[name]) <= step * _PER_M[name]
            for name, axis in self._axes.items()
        ):
            return
        if min(self._world.contact_force_n()) > _GRIPPED_N:
            # It goes with the fingers that hold it, and stays where they let go.
            self._carried = None
        else:
            self._off_pads = not self._world.carry(label, self._at(pose))

    def _at(self, pose: ObjectPose) -> ObjectPose:
        """Return a pose at the present positions of the axes, and remember these."""
        self._positions = {name: axis.position for name, axis in self._axes.items()}
        return replace(pose, **{FIELDS[name]: place for name, place in self._positions.items()})
