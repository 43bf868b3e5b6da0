"""The world between the fingers: an object floats between two foam pads, in time steps."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from simulator.clock import ROUNDING_S
from simulator.errors import PartGripped, SimulatorSettingsError, SimulatorStateError
from simulator.servo.mechanics import FingerMechanics
from simulator.world.pads import (
    EQUATION_11,
    Foam,
    PadPair,
    PadsMeet,
    Press,
    PressureGrid,
    SensorLaw,
    ideal_counts,
    noise_counts,
)
from simulator.world.shapes import PAPER_OBJECTS, ObjectPose, Shape, parse_shape, resting_pose
from tactile.layout import TaxelLayout

STEP_S = 1e-3
"""Length of a step of the world in s."""


NOTHING = "nothing"
"""Label for no object."""
FINGERTIP_RADIUS_M = 5e-3
"""Radius in m of the contact patch of a person's fingertip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSettings:
    """Settings of the world."""

    foam: Foam = field(default_factory=Foam)
    """The sheet on each inner pad."""
    pads: PadPair = field(default_factory=PadPair)
    """Position and differences of the inner pads."""
    law: SensorLaw = EQUATION_11
    """Law from force to counts."""
    noise_level: float = 1.0
    """Noise of the converter."""
    seed: int = 0
    """Seed of all noise."""
    objects: Mapping[str, Shape] = field(default_factory=lambda: PAPER_OBJECTS)
    """Objects by name."""


class PhysicalWorld:
    """Two opposing pads, moved by servos, and a rigid object that floats between them.

    No force is commanded: the grip force is the reaction of foam and object at the positions of the
    mechanics. Without an object the gripping pads meet each other; the other pads touch nothing.

    Parameters
    ----------
    layout
        The taxels; the inner pad of each finger grips.
    fingers
        The mechanics that carry the pads; stepped by this world.
    """

    def __init__(
        self,
        layout: TaxelLayout,
        fingers: FingerMechanics,
        settings: WorldSettings | None = None,
        *,
        start_s: float = 0.0,
    ) -> None:
        self._layout = layout
        self._fingers = fingers
        self._settings = settings or WorldSettings()
        self.objects = dict(self._settings.objects)
        """Shapes by name: those of the settings, and further ones."""
        self._grids = tuple(
            PressureGrid(layout.pads[pad], self._settings.foam) for pad in layout.gripping_pads
        )
        pads = self._settings.pads
        self._foams = pads.foams(self._settings.foam)
        self._empty = PadsMeet(self._grids, self._foams, pads)
        self._gains = np.array([pads.gains[pad.finger] for pad in layout.pads])[layout.taxel_pad]
        self._rng = np.random.default_rng(self._settings.seed)
        self._fast_rng = np.random.default_rng([self._settings.seed, 1])
        self._gripping = np.flatnonzero(np.isin(layout.taxel_pad, layout.gripping_pads))
        self._grip_slices = tuple(layout.taxels_of(pad) for pad in layout.gripping_pads)
        self._time_s = start_s
        self._press: Press | None = None
        self.placed: tuple[str, ObjectPose] | None = None
        """Name and resting pose of the object; None without an object."""
        self._force_n = (0.0, 0.0)
        self._stiffness_n_m = (0.0, 0.0)
        self._fingertip_n: NDArray[np.float64] | None = None
        self.pressed: str | None = None
        """Name of the pad under a fingertip; None without a press."""
        self.force_gain = 1.0
        """Factor on the measured force of each taxel; other than 1 for pads with another law."""

    def place(self, label: str, pose: ObjectPose | None = None) -> ObjectPose:
        """Put an object between the open pads; it replaces the present object.

        Raises SimulatorSettingsError if the shape is unknown or lies beside the pads, PartGripped
        if the fingers hold an object, and SimulatorStateError if the opening is too small.

        Parameters
        ----------
        label
            Name of one of `objects`, a shape as text (`simulator.world.shapes`), or `NOTHING`.
        pose
            Its pose; by default at the pads' centre.

        Returns
        -------
        ObjectPose
            Its resting pose: a box settles on a face.
        """
        if min(self._force_n) > 0.0:  # an object that rests on one pad is in its nest
            raise PartGripped(
                f"the fingers hold an object with {max(self._force_n):.2f} N: release it first"
            )
        if label == NOTHING:
            self.remove()
            return pose or ObjectPose()
        shape = self.shape(label)
        pose = resting_pose(shape, pose or ObjectPose())
        press = Press(shape, pose, self._grids, self._foams)
        near_m, far_m = self._fingers.finger_position_m
        need_m = press.reach_m
        if need_m[0] - pose.z_m > near_m or need_m[1] + pose.z_m > far_m:
            raise SimulatorStateError(
                f"the pads are {1e3 * near_m:.2f} and {1e3 * far_m:.2f} mm from the centre plane, "
                f"{label} reaches {1e3 * (need_m[0] - pose.z_m):.2f} and "
                f"{1e3 * (need_m[1] + pose.z_m):.2f} mm: open the gripper first"
            )
        self._press = press
        self.placed = (label, pose)
        self._force_n = self._stiffness_n_m = (0.0, 0.0)
        return pose

    def remove(self) -> None:
        """Remove the object, also from closed fingers; no effect without an object."""
        self._press = None
        self.placed = None
        self._force_n = self._stiffness_n_m = (0.0, 0.0)

    def slide(self, along_m: float) -> None:
        """Move the object along the fingers by ``along_m`` m, in the grip or not.

        Beyond the pads it is removed; no effect without an object.
        """
        if self.placed is None or self._press is None:
            return
        label, pose = self.placed
        self._put(label, replace(pose, x_m=pose.x_m + along_m))

    def carry(self, label: str, pose: ObjectPose) -> bool:
        """Move an object to a pose with its carrier, in the grip or not.

        Returns whether it is between the pads there; beside them it is removed.
        """
        return self._put(label, resting_pose(self.shape(label), pose))

    def shape(self, label: str) -> Shape:
        """Return the shape of a label or text. Raises SimulatorSettingsError for an unknown one."""
        if label in self.objects:
            return self.objects[label]
        try:
            return parse_shape(label)
        except SimulatorSettingsError:
            if ":" in label:
                raise
            raise SimulatorSettingsError(
                f"there is no object {label!r:.60}; there are {', '.join(self.objects) or 'none'}; "
                "or write a shape, for example cylinder:diameter=6mm,length=20mm"
            ) from None

    def _put(self, label: str, pose: ObjectPose) -> bool:
        """Move the object in the plane of the pads; its position across the plane stays."""
        if self._press is not None:
            pose = replace(pose, z_m=self._press.z_m)
        try:
            press = Press(self.shape(label), pose, self._grids, self._foams)
        except SimulatorSettingsError:
            self.remove()
            return False
        press.swell_m = self._press.swell_m if self._press is not None else 0.0
        self._press, self.placed = press, (label, pose)
        return True

    def swell(self, thickness_m: float) -> None:
        """Make the object thicker by ``thickness_m`` m, half towards each finger; 0 ends it."""
        if self._press is not None:
            self._press.swell_m = 0.5 * thickness_m

    def press(self, pad: int, x_m: float, y_m: float, force_n: float) -> None:
        """Press a pad with a person's fingertip; it replaces the previous press.

        The finger with the pad does not move: the person also holds it. Raises
        SimulatorSettingsError if the fingertip is beside the pad, or the force is negative.

        Parameters
        ----------
        pad
            Number of the pad in the layout.
        x_m, y_m
            Place on the pad in its plane in m.
        """
        if not (math.isfinite(force_n) and force_n >= 0.0):
            raise SimulatorSettingsError(f"force_n is {force_n}, must be at least 0")
        grid = PressureGrid(self._layout.pads[pad], self._settings.foam)
        share = 1.0 - ((grid.x_m - x_m) ** 2 + (grid.y_m - y_m) ** 2) / FINGERTIP_RADIUS_M**2
        pressure = np.sqrt(np.maximum(share, 0.0))
        if not pressure.any():
            raise SimulatorSettingsError(
                f"x = {1e3 * x_m:.1f} mm, y = {1e3 * y_m:.1f} mm is beside the pad "
                f"{grid.pad.name}; choose a place on the pad"
            )
        pressure *= force_n / (pressure.sum() * grid.cell_area_m2)
        everything = (slice(None), slice(None))
        self.pressed = grid.pad.name
        self._fingertip_n = np.zeros(self._layout.n_taxels)
        self._fingertip_n[self._layout.taxels_of(pad)] = grid.taxel_force_n(
            pressure, grid.shares(everything)
        )

    def lift(self) -> None:
        """Remove the fingertip; no effect without a press."""
        self._fingertip_n = self.pressed = None

    def advance_to(self, now_s: float) -> None:
        """Step the fingers and the object until ``now_s`` s; a rest below a step waits."""
        fingers, contact = self._fingers, self._press or self._empty
        while self._time_s + STEP_S <= now_s + ROUNDING_S:
            self._time_s += STEP_S
            fingers.step(STEP_S, self._force_n, self._stiffness_n_m)
            position_m = fingers.finger_position_m
            force_n, stiffness_n_m = contact.settle(position_m)
            if self._meet_beside(position_m):
                (more_n, _), (stiffer_n_m, _) = self._empty.settle(position_m)
                force_n = force_n[0] + more_n, force_n[1] + more_n
                stiffness_n_m = stiffness_n_m[0] + stiffer_n_m, stiffness_n_m[1] + stiffer_n_m
            self._force_n, self._stiffness_n_m = force_n, stiffness_n_m

    def _meet_beside(self, position_m: tuple[float, float]) -> bool:
        """Return whether the pads press on each other beside a thin object."""
        return self._press is not None and sum(position_m) < self._empty.highest_m

    def skip_to(self, now_s: float) -> None:
        """Leave out the time until ``now_s`` s: nothing has happened meanwhile."""
        self._time_s = max(self._time_s, now_s)

    def contact_force_n(self) -> tuple[float, float]:
        """Return the force in N on each pad; both are equal except for the nest's friction."""
        return self._force_n

    def taxel_force_n(self) -> NDArray[np.float64]:
        """Return the force in N on each taxel at this moment, shape (n_taxels,)."""
        force_n = np.zeros(self._layout.n_taxels)
        if self._fingertip_n is not None:
            force_n += self._fingertip_n
        if max(self._force_n) > 0.0:
            position_m, contact = self._fingers.finger_position_m, self._press or self._empty
            for side, taxels in enumerate(self._grip_slices):
                force_n[taxels] += contact.taxel_force_n(side, position_m)
                if self._meet_beside(position_m):
                    force_n[taxels] += self._empty.taxel_force_n(side, position_m)
        return force_n

    def measured_force_n(self) -> NDArray[np.float64]:
        """Return the measured force in N of each taxel, (n_taxels,), with the gains of the pads."""
        return self.force_gain * self._gains * self.taxel_force_n()

    def scan(self) -> NDArray[np.uint16]:
        """Convert all taxels: the sensor's law, new noise, rounding; counts (n_taxels,)."""
        force_n = self.measured_force_n() if self._pressed else None
        return self._converted(force_n, self._layout.n_taxels, self._rng)

    def scan_gripping(self) -> NDArray[np.uint16]:
        """Convert the taxels of the gripping pads, each with new noise of the same size.

        Counts (n_taxels,), 0 on the other pads. Its noise does not change that of `scan`.
        """
        counts = np.zeros(self._layout.n_taxels, dtype=np.uint16)
        gripping = self._gripping
        force_n = self.measured_force_n()[gripping] if self._pressed else None
        counts[gripping] = self._converted(force_n, len(gripping), self._fast_rng)
        return counts

    @property
    def _pressed(self) -> bool:
        return max(self._force_n) > 0.0 or self._fingertip_n is not None

    def _converted(
        self, force_n: NDArray[np.float64] | None, n: int, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the counts (n,) of taxels under these forces; None: no taxel is pressed."""
        adc_max = self._layout.adc_max
        counts = noise_counts(rng, n, adc_max, self._settings.noise_level)
        if force_n is not None:
            counts += ideal_counts(force_n, adc_max, self._settings.law)
        np.maximum(counts, 0.0, out=counts)
        np.minimum(counts, adc_max, out=counts)
        return np.rint(counts, out=counts).astype(np.uint16)
