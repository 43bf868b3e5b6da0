"""Config of the gripper: servos, linkage, limits; and its conversion to SI."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.section import MILLI, SIMULATED, Installed, Section, declared_values, setting_of
from cell.errors import ConfigError, raised_as
from cell.files import SERVO_BENCH, read_json
from cell.plugins import SERVO_MODELS
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import (
    MODELS,
    WITHOUT_CURRENT_CONTROL,
    ServoModel,
    add_model,
    require_current_control,
)
from gripper.errors import LimitExceeded
from gripper.mechanics.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.settings import GripperSettings, ServoSettings

_SCALE_SD, _FRICTION_SD = 0.05, 0.1
"""Uncertainty of a torque by an arm and a kitchen scale, and of a friction, which changes with the
temperature; standard deviations of logarithms. [assumed]"""
_EMPTY_M = 0.0003
"""Smallest opening in m of fingers that touch nothing. Below it the pads may press on each other,
and the servos cannot resolve a thinner sheet."""


class ContactConfig(Section):
    """Approach of the fingers, and detection of contact."""

    samples: int = setting_of(GripperSettings, "contact_samples")
    """Tactile samples in a row on both pads that confirm a contact, 1 to 50."""
    approach_force_n: float = setting_of(GripperSettings, "approach_force_n")
    """Grip force of the motors above friction while closing in N, up to 10."""
    pad_stiffness_n_mm: float = setting_of(GripperSettings, "pad_stiffness_n_m", 1e3)
    """Stiffness of a pad under the hardest part in N/mm, 1 to 1000; with the mass of motors and
    fingers it limits the approach speed, so that no impact exceeds force_max_n."""


class SlipConfig(Section):
    """When a held part counts as slipping or lost; then the goals are frozen."""

    drop_n: float = setting_of(GripperSettings, "slip_drop_n")
    """Sudden drop of the held force that means a slip in N, up to 20; above the sensor's noise. A
    drop by less than 15 % of the force is none."""


def use_servo_models(names: Iterable[str]) -> None:
    """Load servo models for `gripper`, in this process. Raises ConfigError or LimitExceeded."""
    for name in names:
        add_model(SERVO_MODELS[name])


def _with_current_control(model: str) -> str:
    with raised_as(ValueError, ConfigError, LimitExceeded):
        if model in WITHOUT_CURRENT_CONTROL:
            require_current_control(model)
        use_servo_models([model])
    return model


class ServoConfig(Section):
    """One Dynamixel servo of the gripper."""

    id: int = Field(ge=0, le=252)
    """ID on the bus, 0 to 252."""
    model: Annotated[str, AfterValidator(_with_current_control), Installed(SERVO_MODELS)] = (
        "XM430-W350"
    )
    """Model; it must be able to control current (an XL430 cannot and is refused)."""
    direction: Literal[1, -1] = 1
    """1 if an increasing position opens the finger, -1 if it closes the finger."""
    zero_pulse: int = Field(default=2048, ge=0, le=4095)
    """Present Position at angle 0 of the linkage, in pulses of 360/4096 degrees, 0 to 4095."""
    measured: str = ""
    """Result of `tactile-cell hand bench` for this servo, a JSON file; empty: the values of the
    catalogue with 30 % are used until pads and motions have measured the servo."""


class ParallelLinkageConfig(Section):
    """Fingers on parallelograms: half opening = link_mm * sin(angle) + offset_mm."""

    kind: Literal["parallel_linkage"] = "parallel_linkage"
    """Kind of drive."""
    link_mm: float = Field(default=60.0, gt=5.0, le=500.0)
    """Length of the parallelogram's links in mm, 5 to 500."""
    offset_mm: float = Field(default=0.0, ge=-50.0, le=50.0)
    """Half opening at angle 0 in mm, -50 to 50."""


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
    """Serial port of the servos, for example /dev/ttyUSB0, or `simulated`; a file must name it."""
    baud_rate: Literal[115200, 1000000, 2000000, 3000000, 4000000, 4500000] = 1000000
    """Baud rate of the servo bus in bit/s; 1000000 is enough for 200 Hz, 115200 is not."""
    servos: tuple[ServoConfig, ...] = Field(
        default=(ServoConfig(id=1), ServoConfig(id=2)), min_length=1, max_length=2
    )
    """One servo for both fingers, or one servo for each finger."""
    linkage: Annotated[ParallelLinkageConfig | RackPinionConfig, Field(discriminator="kind")] = (
        ParallelLinkageConfig()
    )
    """Conversion of servo angle to opening."""
    loop_rate_hz: float = setting_of(GripperSettings, "loop_rate_hz", at_most=500.0)
    """Rate of the force loop in Hz, 100 to 500."""
    aperture_open_mm: float = setting_of(GripperSettings, "aperture_open_m", MILLI)
    """Opening between the pads before a grasp in mm, 2 to 400; a little more than the widest
    object. Each mm less makes a grasp about 0.03 s shorter."""
    aperture_min_mm: float = setting_of(GripperSettings, "aperture_min_m", MILLI, at_least=-4.0)
    """Smallest opening of the fingers in mm, -4 to 400; a ramp ends there, and no object is
    smaller. Values below 0.3 are for ramps only, because the foam of the pads yields around a small
    part. Fingers that touch nothing stop at 0.3."""
    pads_meet: bool = True
    """Whether the pads of empty fingers can press flat on each other; a self-zero needs it."""
    approach_speed_mm_s: float = setting_of(GripperSettings, "approach_speed_m_s", MILLI)
    """Closing speed near a possible part in mm/s of opening, 4 to 200. If an impact at this speed
    could exceed force_max_n, the fingers close more slowly, and a note states that speed."""
    travel_speed_mm_s: float = setting_of(GripperSettings, "travel_speed_m_s", MILLI)
    """Closing speed in mm/s of opening, 4 to 200, while the fingers are wider open than all parts
    touched since the start. The impact on a wider part stays below force_max_n too. A value up to
    approach_speed_mm_s has no effect."""
    open_speed_mm_s: float = setting_of(GripperSettings, "open_speed_m_s", MILLI)
    """Opening speed in mm/s of opening, 2 to 200."""
    contact_force_n: float = setting_of(GripperSettings, "contact_force_n")
    """Force on both pads that counts as contact in N, 0.1 to 5; well above the sensor's noise."""
    contact_timeout_s: float = setting_of(GripperSettings, "contact_timeout_s")
    """Longest time to look for contact in s, 1 to 60."""
    force_max_n: float = setting_of(GripperSettings, "force_max_n")
    """Cap of the grip force in N, 1 to 50; set it by a risk assessment. A ramp with its overshoot
    of 0.3 N or 10 % must stay below it. With a low cap the fingers approach slowly, or not at all.
    """
    current_max_a: float = setting_of(GripperSettings, "current_max_a")
    """Cap of the goal current of each servo in A, 0.05 to the stall current of its model, or to its
    current limit if that is less."""
    temperature_max_c: float = setting_of(GripperSettings, "temperature_max_c")
    """Servo temperature in C above which no ramp starts and a running ramp is held, 30 to 80."""
    force_stale_ms: float = setting_of(GripperSettings, "force_stale_s", MILLI)
    """Largest age of a tactile force for control in ms, 20 to 1000; without force messages at least
    2.5 times tactile.sync_period_ms."""
    force_noise_n: float = setting_of(GripperSettings, "force_noise_n")
    """Tolerance above the cap for the mean of a few samples in N, up to 5; three times as much for
    one sample."""
    bus_loss_ms: float = setting_of(GripperSettings, "bus_loss_s", MILLI)
    """Time without answers of the servos after which their bus has a fault in ms, 20 to 2000 and at
    least four periods of loop_rate_hz."""
    feedback_loss_max_share: float = setting_of(GripperSettings, "feedback_loss_max_share")
    """Share of the loop's periods without answers of the servos, 0.001 to 1; more is a fault.
    Counted over bus_loss_ms divided by this share, about 1.5 s with the defaults."""
    stall_max_ms: float = setting_of(GripperSettings, "stall_max_s", MILLI)
    """Lateness of one period at which the loop counts as stalled in ms, 10 to 5000."""
    watchdog_ms: float = setting_of(GripperSettings, "watchdog_s", MILLI)
    """Bus watchdog of the servos in ms, 20 to 2540 in steps of 20; armed while torque is on."""
    watchdog_self_test: bool = False
    """Whether the first opening proves for each servo that its watchdog stops the motor."""
    contact: ContactConfig = ContactConfig()
    """Approach and contact."""
    slip: SlipConfig = SlipConfig()
    """When a held part slips or is lost."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for servo in self.servos:
            if self.watchdog_self_test and not MODELS[servo.model].profile_in_current_mode:
                raise ValueError(
                    f"watchdog_self_test needs a slow motion, which servo {servo.id} "
                    f"({servo.model}) does not have in this mode; set watchdog_self_test to false"
                )
        if self.aperture_min_mm >= self.aperture_open_mm:
            raise ValueError(
                f"aperture_min_mm {self.aperture_min_mm:g} must be below "
                f"aperture_open_mm {self.aperture_open_mm:g}"
            )
        with raised_as(ValueError, LimitExceeded):
            gripper_settings(self, overruns_max=1)
        return self


def gripper_settings(config: GripperConfig, *, overruns_max: int) -> GripperSettings:
    """Return limits and tuning of a gripper in SI.

    ``overruns_max`` consecutive overlong periods end a command. Raises
    gripper.errors.LimitExceeded if values do not fit each other.
    """
    values = declared_values(config, GripperSettings)
    least_m = values["aperture_min_m"]
    values |= {"aperture_min_m": max(least_m, _EMPTY_M), "aperture_pressed_m": least_m}
    return GripperSettings(
        servos=tuple(
            ServoSettings(
                servo_id=servo.id,
                model=servo.model,
                direction=servo.direction,
                zero_raw=servo.zero_pulse,
                measured=measured_drive(Path(servo.measured), MODELS[servo.model])
                if servo.measured
                else None,
            )
            for servo in config.servos
        ),
        watchdog_self_test=config.watchdog_self_test,
        overruns_max=overruns_max,
        **values,
    )


def measured_drive(path: Path, model: ServoModel) -> DriveCharacteristic:
    """Return the drive characteristic of a servo from the result of its bench.

    Values of steps that were left out are the catalogue's. Raises ConfigError if there is no such
    file, if it is damaged, or if it is of another model.
    """
    content = read_json(path, SERVO_BENCH, error=ConfigError)
    if content is None:
        raise ConfigError(f"{path}: no such file; `tactile-cell hand bench` writes it")
    if content.get("model") != model.name:
        raise ConfigError(f"{path} is of a {content.get('model')}, this servo is a {model.name}")
    values: Mapping[str, Any] = content.get("values", {})
    if not values:
        raise ConfigError(f"{path} has no values: repeat `tactile-cell hand bench`, all its steps")
    drive = DriveCharacteristic.catalogue(model)
    changes: dict[str, float] = {}
    if (rising := values.get("rising_a_nm")) is not None:
        kt_nm_a = 1.0 / rising
        falls = rising * drive.falling_a_nm / drive.rising_a_nm
        changes |= {"rising_a_nm": rising, "falling_a_nm": falls, "kt_nm_a": kt_nm_a}
        changes["load_sd"] = _SCALE_SD
    if (falling := values.get("falling_a_nm")) is not None:
        changes["falling_a_nm"] = falling
    if (coulomb := values.get("coulomb_a")) is not None:
        changes |= {"coulomb_a": coulomb, "viscous_a_s": max(0.0, values["viscous_a_s"])}
        changes |= {"breakaway_a": values.get("breakaway_a", coulomb), "friction_sd": _FRICTION_SD}
    return replace(drive, **changes)


def linkage_of(config: GripperConfig) -> Linkage:
    """Return the linkage of a gripper."""
    drive, n_servos = config.linkage, len(config.servos)
    offset_m = drive.offset_mm * MILLI
    if isinstance(drive, ParallelLinkageConfig):
        return ParallelLinkage(link_m=drive.link_mm * MILLI, offset_m=offset_m, n_servos=n_servos)
    return RackPinion(
        pinion_radius_m=drive.pinion_radius_mm * MILLI, offset_m=offset_m, n_servos=n_servos
    )
