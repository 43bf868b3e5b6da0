"""Config of the gripper: servos, linkage, limits."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cell.config_grip import (
    ContactConfig,
    ImbalanceConfig,
    OverForceConfig,
    ServoCareConfig,
    SettleConfig,
    SlipConfig,
)
from cell.config_section import SIMULATED, Section
from gripper.settings import largest_setpoint_n


class ServoConfig(Section):
    """One Dynamixel servo of the gripper."""

    id: int = Field(ge=0, le=252)
    """ID on the bus, 0 to 252."""
    model: Literal["XM430-W350", "XM430-W210", "XL330-M288", "XC330-M288"] = "XM430-W350"
    """Model; it must be able to control current (an XL430 cannot and is refused)."""
    direction: Literal[1, -1] = 1
    """1 if growing position opens the finger, -1 if it closes it."""
    zero_pulse: int = Field(default=2048, ge=0, le=4095)
    """Present Position at angle 0 of the linkage, in pulses of 360/4096 degrees, 0 to 4095."""


class ParallelLinkageConfig(Section):
    """Fingers on parallelograms: half opening = link_mm * sin(angle) + offset_mm."""

    kind: Literal["parallel_linkage"] = "parallel_linkage"
    """Kind of drive."""
    link_mm: float = Field(default=60.0, gt=5.0, le=500.0)
    """Length of the parallelogram's links in mm, 5 to 500."""
    offset_mm: float = Field(default=0.0, ge=-200.0, le=200.0)
    """Half opening at angle 0 in mm, -200 to 200."""


class RackPinionConfig(Section):
    """Fingers on racks: half opening = pinion_radius_mm * angle + offset_mm."""

    kind: Literal["rack_pinion"]
    """Kind of drive."""
    pinion_radius_mm: float = Field(gt=2.0, le=100.0)
    """Pitch radius of the pinion in mm, 2 to 100."""
    offset_mm: float = Field(default=0.0, ge=-200.0, le=200.0)
    """Half opening at angle 0 in mm, -200 to 200."""


class GripperConfig(Section):
    """Servos, linkage and limits of the gripper."""

    port: str = Field(default=SIMULATED, min_length=1)
    """Serial port of the servos, as /dev/ttyUSB0; `simulated` is the built-in simulated gripper."""
    baud_rate: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000] = 1000000
    """Baud rate of the servo bus in bit/s; 1000000 serves 200 Hz, 57600 does not."""
    servos: tuple[ServoConfig, ...] = Field(
        default=(ServoConfig(id=1), ServoConfig(id=2)), min_length=1, max_length=2
    )
    """One servo that drives both fingers, or two that drive a finger each."""
    linkage: Annotated[ParallelLinkageConfig | RackPinionConfig, Field(discriminator="kind")] = (
        ParallelLinkageConfig()
    )
    """How servo angle becomes opening."""
    loop_rate_hz: float = Field(default=200.0, ge=20.0, le=500.0)
    """Rate of the force loop in Hz, 20 to 500."""
    aperture_open_mm: float = Field(default=18.0, gt=0.0, le=400.0)
    """Opening between the pads before a grasp in mm, up to 400; a little more than the object."""
    aperture_min_mm: float = Field(default=0.5, ge=0.0, le=400.0)
    """Smallest opening that the fingers are closed to in mm; below it there is no object."""
    approach_speed_mm_s: float = Field(default=12.0, gt=0.0, le=200.0)
    """Closing speed until contact in mm/s of opening, up to 200; the impact grows with it."""
    open_speed_mm_s: float = Field(default=60.0, gt=0.0, le=200.0)
    """Opening speed in mm/s of opening, up to 200."""
    contact_force_n: float = Field(default=0.6, gt=0.0, le=5.0)
    """Force on both pads that counts as contact in N, up to 5; well above the sensor's noise."""
    contact_timeout_s: float = Field(default=5.0, gt=0.0, le=60.0)
    """Longest time to look for contact in s, up to 60."""
    force_max_n: float = Field(default=15.0, gt=0.0, le=50.0)
    """Cap of the grip force in N, up to 50; set it per risk assessment. A ramp may ask for so much
    that its overshoot, 0.2 N or 5 %, stays below it."""
    current_max_a: float = Field(default=0.8, gt=0.0, le=2.3)
    """Cap of the goal current of each servo in A, up to 2.3."""
    temperature_max_c: float = Field(default=70.0, ge=30.0, le=80.0)
    """Servo temperature above which no ramp is started and a running one held, C, 30 to 80."""
    force_stale_ms: float = Field(default=100.0, ge=10.0, le=1000.0)
    """Oldest tactile force that control may use in ms, 10 to 1000."""
    bus_loss_ms: float = Field(default=70.0, ge=20.0, le=2000.0)
    """Time without answers of the servos after which their bus is given up in ms, 20 to 2000."""
    stall_max_ms: float = Field(default=250.0, ge=10.0, le=5000.0)
    """Lateness of one period after which the loop counts as stalled in ms, 10 to 5000."""
    watchdog_ms: float = Field(default=100.0, ge=20.0, le=2540.0)
    """Bus watchdog of the servos in ms, 20 to 2540 in steps of 20; armed while torque is on."""
    watchdog_self_test: bool = False
    """Whether the first opening proves for each servo that its watchdog stops the motor."""
    contact: ContactConfig = ContactConfig()
    """Approach and contact."""
    settle: SettleConfig = SettleConfig()
    """When a ramp's force counts as reached."""
    slip: SlipConfig = SlipConfig()
    """When a held part slips or is lost."""
    imbalance: ImbalanceConfig = ImbalanceConfig()
    """How different the fingers' forces may be."""
    over_force: OverForceConfig = OverForceConfig()
    """What is done with too much force."""
    servo_care: ServoCareConfig = ServoCareConfig()
    """Heat of the servos, and what a start may rewrite."""

    @property
    def ramp_force_max_n(self) -> float:
        """Largest force of a ramp in N: with its overshoot it stays below the cap."""
        return largest_setpoint_n(self.force_max_n)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [servo.id for servo in self.servos]
        if len(set(ids)) != len(ids):
            raise ValueError(f"servo ids {ids} repeat; give each servo its own id")
        if self.aperture_min_mm >= self.aperture_open_mm:
            raise ValueError(
                f"aperture_min_mm {self.aperture_min_mm:g} must be below "
                f"aperture_open_mm {self.aperture_open_mm:g}"
            )
        if self.contact_force_n > self.ramp_force_max_n:
            raise ValueError(
                f"contact_force_n {self.contact_force_n:g} must be at most "
                f"{self.ramp_force_max_n:.2f}, what a ramp may reach under "
                f"force_max_n {self.force_max_n:g}"
            )
        return self
