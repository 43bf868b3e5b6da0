"""How a grip is watched and what is done about it: sections of the gripper's configuration."""

from typing import Literal

from pydantic import Field

from cell.config_section import Section


class ContactConfig(Section):
    """How the fingers approach, and when they touch."""

    samples: int = Field(default=3, ge=1, le=50)
    """Tactile samples in a row on both pads that confirm a contact, 1 to 50."""
    approach_force_n: float = Field(default=1.0, gt=0.0, le=10.0)
    """Grip force beyond friction that the motors may make while closing in N, up to 10."""


class SettleConfig(Section):
    """When the end of a force ramp counts as reached."""

    timeout_s: float = Field(default=0.5, gt=0.0, le=10.0)
    """Longest time after the ramp in s, up to 10; then the force counts as not reached."""
    tolerance_n: float = Field(default=0.3, ge=0.0, le=5.0)
    """Error that counts as reached in N, up to 5."""
    tolerance_share: float = Field(default=0.07, ge=0.0, le=0.5)
    """The same as a share of the force, 0 to 0.5; the larger of the two counts."""


class SlipConfig(Section):
    """When a held part counts as slipping or lost; the goals are frozen, nothing grips again."""

    drop_n: float = Field(default=0.8, gt=0.0, le=20.0)
    """Sudden drop of the held force that is a slip in N, up to 20; above the sensor's noise."""
    drop_share: float = Field(default=0.15, ge=0.0, le=1.0)
    """The same as a share of the held force, 0 to 1; the larger of the two counts."""
    travel_mm: float = Field(default=1.5, gt=0.0, le=50.0)
    """Closing at a steady force that is a slip in mm of opening, up to 50."""
    slide_mm: float = Field(default=1.5, gt=0.0, le=50.0)
    """Way along both pads that the centre of a force of 4 N may move in mm, up to 50; more at less
    force."""
    runaway_mm_s: float = Field(default=20.0, gt=0.0, le=500.0)
    """Closing speed beyond what the ramp needs at which the part is gone, in mm/s, up to 500."""
    runaway_mm: float = Field(default=0.5, gt=0.0, le=50.0)
    """How far the fingers must have run so in mm, up to 50."""


class ImbalanceConfig(Section):
    """How different the forces of the two fingers may be; beyond it both are frozen."""

    difference_n: float = Field(default=2.0, gt=0.0, le=50.0)
    """Allowed difference in N, up to 50."""
    difference_share: float = Field(default=0.5, ge=0.0, le=2.0)
    """The same as a share of the grip force, 0 to 2; the larger of the two counts."""
    time_s: float = Field(default=0.2, gt=0.0, le=10.0)
    """How long a larger difference may last in s, up to 10."""


class OverForceConfig(Section):
    """What is done when the force exceeds gripper.force_max_n; nothing ever pushes on."""

    reaction: Literal["lower", "open", "limp"] = "lower"
    """lower: less current in one step, the part stays held; open: the fingers open by one small
    step; limp: the torque goes off, a held part may drop."""
    noise_n: float = Field(default=0.5, ge=0.0, le=5.0)
    """What the mean of three samples may exceed the cap by in N, up to 5; one sample, thrice."""
    left_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the current that `lower` leaves, 0 to 1."""
    open_mm: float = Field(default=0.5, gt=0.0, le=5.0)
    """Opening by which `open` opens in mm, up to 5."""


class ServoCareConfig(Section):
    """What keeps the servos from overheating, and what a start may rewrite in them."""

    derate_c: float = Field(default=10.0, ge=0.0, le=40.0)
    """Degrees below temperature_max_c from which less current is allowed, to half, 0 to 40."""
    taper_after_s: float = Field(default=1.0, ge=0.0, le=600.0)
    """Time of a hold after which current is given back that friction makes superfluous, in s."""
    taper_n_s: float = Field(default=1.0, ge=0.0, le=50.0)
    """How fast it is given back in N/s of driving force, 0 to 50; 0 never."""
    corrected_registers: tuple[
        Literal["return_delay_time", "operating_mode", "status_return_level", "position_p_gain"],
        ...,
    ] = ("return_delay_time", "operating_mode", "status_return_level", "position_p_gain")
    """Registers that a start rewrites where they differ; all others are compared, and refused."""
