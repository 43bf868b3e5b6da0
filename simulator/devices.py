"""World and devices of a simulated cell, without the host's ends of the buses."""

from dataclasses import dataclass, field, replace

import numpy as np

from simulator.boards.site import BoardFaults, BoardSite, SerialBoard
from simulator.can.control_unit import SimulatedControlUnit
from simulator.can.drive import DriveMount, SimulatedDrive
from simulator.can.faults import CanLinkFaults, ControlUnitFaults
from simulator.can.link import CanDevice, CanLink
from simulator.servo.bus import ServoBusDevice
from simulator.servo.device import BAUD_RATES, SimulatedServo
from simulator.servo.faults import WireFaults
from simulator.servo.mechanics import FingerMechanics
from simulator.servo.wrist import SimulatedWrist
from simulator.settings import SimulatorSettings
from simulator.world.shapes import ObjectPose
from simulator.world.stage import Stage
from simulator.world.world import PhysicalWorld
from tactile.layout import taxel_order

_PAST_MIDDLE_M = -0.01
"""Half opening in m at the closed end stop of a finger: past the middle, where the pads meet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFaults:
    """All fault knobs of a simulated cell; they are off by default."""

    servo_wire: WireFaults = field(default_factory=WireFaults)
    """The line between host and servos."""
    can: CanLinkFaults = field(default_factory=CanLinkFaults)
    """The link between control unit and host."""
    unit: ControlUnitFaults = field(default_factory=ControlUnitFaults)
    """The control unit."""
    boards: BoardFaults = field(default_factory=BoardFaults)
    """Sensor boards."""


class CellDevices:
    """World and devices, without the host's ends of the buses; for virtual and real time."""

    def __init__(self, settings: SimulatorSettings, *, start_s: float = 0.0) -> None:
        self.settings = settings
        motors = [servo.motor(settings.seed) for servo in settings.servos]
        self.mechanics = FingerMechanics(
            motors,
            [servo.mount for servo in settings.servos],
            settings.linkage,
            aperture_m=settings.aperture_m,
            half_opening_min_m=max(_PAST_MIDDLE_M, settings.linkage.half_opening_min_m),
        )
        self.world = PhysicalWorld(settings.layout, self.mechanics, settings, start_s=start_s)
        rate = BAUD_RATES.index(settings.servo_baud_rate)
        eeprom = {"baud_rate": rate, "return_delay_time": 0}
        servos = [
            SimulatedServo(entry.servo_id, entry.model, motor, settings=eeprom)
            for entry, motor in zip(settings.servos, motors, strict=True)
        ]
        faults = self.faults = CellFaults()
        faults.servo_wire.rng.seed(settings.seed)
        self.servo_bus = ServoBusDevice(servos, settings.servo_baud_rate, faults.servo_wire)
        if settings.mounts:
            order = taxel_order(settings.layout, settings.mounts)
            faults.unit.mounted = np.argsort(order)
        self.unit = SimulatedControlUnit(
            self.world, settings.layout, settings.unit, faults=faults.unit, start_s=start_s
        )
        self.boards: tuple[SerialBoard, ...] = ()
        """The sensor boards on their serial lines; none by default."""
        on_can: CanDevice | None = None
        if settings.boards is not None:
            site = BoardSite(
                world=self.world,
                layout=settings.layout,
                taxel_faults=faults.unit,
                faults=faults.boards,
                seed=settings.seed,
                start_s=start_s,
            )
            self.boards = settings.boards.serial_boards(site)
            on_can = settings.boards.can_device(site)
        self.can = CanLink(
            on_can or self.unit,
            bitrate=settings.unit.bitrate,
            faults=faults.can,
            seed=settings.seed,
        )
        """The bus of the control unit or of the sensor boards."""
        self.axes: dict[str, SimulatedDrive | SimulatedWrist] = {
            moves: SimulatedDrive(mount, start_s=start_s)
            if isinstance(mount, DriveMount)
            else SimulatedWrist(mount, start_s=start_s)
            for moves, mount in settings.axes.items()
        }
        """The drives and servos that carry the object, by their part of the pose."""
        drives = [axis for axis in self.axes.values() if isinstance(axis, SimulatedDrive)]
        self.axes_can = CanLink(*drives, bitrate=settings.axes_can_bitrate) if drives else None
        """The bus of the drives; None without drives."""
        self.stage = Stage(self.world, self.axes) if self.axes else None
        """Carrier of the object; None without axes."""
        self.offset = ObjectPose()
        """Offset of each object from its requested pose."""

    def second_unit(self, now_s: float) -> SimulatedControlUnit:
        """Return another control unit with the same node id, switched on at ``now_s`` s."""
        own = self.unit.settings
        return SimulatedControlUnit(
            self.world,
            self.settings.layout,
            replace(own, serial_number=own.serial_number + 1),
            start_s=now_s,
        )

    def place(self, label: str, pose: ObjectPose | None = None) -> ObjectPose:
        """Put an object between the open pads, or on the axes that carry it.

        See `PhysicalWorld.place` and `Stage.place`.
        """
        return (self.stage or self.world).place(label, (pose or ObjectPose()) + self.offset)

    def advance_to(self, now_s: float) -> None:
        """Advance axes, fingers, object and servos to ``now_s`` s."""
        for axis in self.axes.values():
            axis.advance(now_s)
        if self.stage is not None:
            self.stage.advance()
        self.world.advance_to(now_s)
        self.servo_bus.advance_to(now_s)
        for board in self.boards:
            board.advance_to(now_s)
