"""Settings of a simulated cell: layout, servos, control unit, foam, objects, faults."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from gripper.dynamixel.models import XM430_W350, ServoModel
from simulator.boards.site import SimulatedBoards
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.drive import DriveMount
from simulator.servo.gearing import data_sheet_drive, drawn_drive
from simulator.servo.mechanics import FingerLinkage, ParallelogramLinkage, ServoMount
from simulator.servo.motor import OverloadRule, ServoMotor, ServoNoise
from simulator.servo.wrist import WristMount
from simulator.world.world import WorldSettings
from tactile.layout import PadMount, TaxelLayout, paper_layout


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedServoSettings:
    """One servo: its mounting in the gripper, and its differences from its model."""

    servo_id: int
    """ID on the bus."""
    model: ServoModel = XM430_W350
    """The servo model."""
    mount: ServoMount = field(default_factory=ServoMount)
    """Direction and zero."""
    gearing: Literal["typical", "drawn", "ideal"] = "drawn"
    """Its torque, friction and inertia: of a typical servo, drawn by the cell's seed from the
    spread of its model, or of the data sheet. An ideal servo measures without noise."""
    friction_factor: float = 1.0
    """Factor on its friction without load."""
    kt_factor: float = 1.0
    """Factor on torque and back-EMF of its motor."""
    overload_rule: OverloadRule = OverloadRule.DUTY
    """Rule of its overload protection."""

    def motor(self, seed: int) -> ServoMotor:
        """Return a new motor of this servo in a cell with a seed."""
        drawn_by = f"{seed} servo {self.servo_id}"
        if self.gearing == "ideal":
            motor = ServoMotor(self.model, figures=data_sheet_drive(self.model))
        else:
            drive = drawn_drive(self.model, drawn_by if self.gearing == "drawn" else None)
            motor = ServoMotor(self.model, figures=drive, noise=ServoNoise(drawn_by))
        for name in ("friction_factor", "kt_factor", "overload_rule"):
            setattr(motor, name, getattr(self, name))
        return motor


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatorSettings(WorldSettings):
    """A simulated cell and its world: by default the paper's sensor on two XM430-W350.

    ``seed`` is the seed of all random values: the servos are drawn by it too.
    """

    layout: TaxelLayout = field(default_factory=paper_layout)
    """The taxels."""
    servos: tuple[SimulatedServoSettings, ...] = (
        SimulatedServoSettings(servo_id=1),
        SimulatedServoSettings(servo_id=2),
    )
    """One servo for both fingers, or one servo for each finger."""
    linkage: FingerLinkage = field(default_factory=lambda: ParallelogramLinkage(link_m=0.06))
    """Geometry from servo angle to half opening."""
    servo_baud_rate: int = 1_000_000
    """Baud rate of the servos."""
    unit: ControlUnitSettings = field(default_factory=ControlUnitSettings)
    """The control unit; its bit rate is that of the CAN bus, with other sensor boards too."""
    mounts: tuple[PadMount, ...] = ()
    """Pads that are mounted differently from the layout."""
    boards: SimulatedBoards | None = None
    """Boards on serial lines or on CAN that read the pads; None: the control unit reads them."""
    aperture_m: float = 0.03
    """Opening between the pads at the start in m."""
    axes: Mapping[str, DriveMount | WristMount] = field(default_factory=dict)
    """Drives and servos that carry the object, by their part of the pose: ``x``, ``y``,
    ``rotation`` or ``roll``."""
    axes_can_bitrate: int = 1_000_000
    """Bit rate of the drives' CAN bus in bit/s."""
    faults: tuple[str, ...] = ()
    """Faults at the start, for example ``can.loss=0.05@2s``."""
