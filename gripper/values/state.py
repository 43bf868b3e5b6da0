"""States of servos and gripper, and one period of the force loop for observers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from gripper.values.force_sensor import ForceSample

STANDING_M_S = 0.002
"""Rate of the opening in m/s below which the fingers stand: that of one servo at rest whose count
changes by one (`gripper.servos.motion.slow_rad_s`), on links of 60 mm. [resolution]"""
_EMPTY_STANDING_M_S = 2.5 * STANDING_M_S
"""The same where the current of empty fingers is judged: each servo, and a reserve of a half."""


class GripperPhase(Enum):
    """Phase of the gripper.

    OFF: torque is off or unknown. IDLE: torque on, nothing held. BACKING_OFF: `Gripper.hold_at`
    lowers or raises the force. HELD_AFTER_FAULT: goals are frozen after a fault, or torque was
    found on at the start; a part may be held.
    """

    OFF = "off"
    IDLE = "idle"
    OPENING = "opening"
    APPROACHING = "approaching"
    RAMPING = "ramping"
    HOLDING = "holding"
    BACKING_OFF = "backing_off"
    RELEASING = "releasing"
    HELD_AFTER_FAULT = "held_after_fault"

    @property
    def moving(self) -> bool:
        """True while the fingers move without a part in their grip."""
        return self in (GripperPhase.OPENING, GripperPhase.APPROACHING, GripperPhase.RELEASING)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoState:
    """Feedback of one servo, from registers 120 to 146."""

    servo_id: int
    """The servo."""
    angle_rad: float
    """Angle in the direction of the linkage: 0 at zero_raw, grows while the gripper opens."""
    velocity_rad_s: float
    """Velocity in the same direction, by the positions: see `gripper.servos.motion`."""
    next_rad_s: float
    """Below 200 Hz the expected velocity at the next reading; else the same."""
    current_a: float
    """Current of the winding; positive drives the gripper open. Present Current, or by Present PWM
    where that register has the current of the supply."""
    motor_a: float | None
    """The same by Present Current alone; None where the duty is too small for it."""
    position_raw: int
    """Present Position as read."""
    temperature_c: float
    voltage_v: float
    """Present Temperature and Present Input Voltage."""
    supply_v: float
    """Voltage of the supply for conversions: without the noise of single readings."""
    tick_ms: int
    """Realtime Tick: the servo's own time, modulo 32768 ms; recordings keep it."""
    pwm_share: float = 0.0
    """Present PWM in the same direction, as a share of the supply."""
    motor_rad_s: float = 0.0
    """Smallest speed that voltage and current prove; 0 if none."""
    limit_a: float
    """Largest current in A that the heat of the winding allows."""
    alert: bool
    """True while Hardware Error Status (register 70) is not zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoFeedback:
    """Feedback of the gripper, read in one transaction."""

    t_s: float
    """Monotonic time of the received answers in s."""
    aperture_m: float
    """Opening between the pads in m."""
    aperture_velocity_m_s: float
    """Its rate in m/s; below 0 while closing."""
    current_a: float
    """Mean magnitude of the servo currents in A."""
    force_from_current_n: float
    """Grip force that the current can hold up while the force rises, in N. Not a measurement:
    friction makes it too low by up to twice the friction band once the force falls."""
    temperature_c: float
    """Temperature of the warmest servo in degrees Celsius."""
    voltage_v: float
    """Lowest supply voltage in V."""
    servos: tuple[ServoState, ...]
    angles_rad: tuple[float, ...] = field(init=False, repr=False)
    """Angle of each servo in rad."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "angles_rad", tuple([servo.angle_rad for servo in self.servos]))


def shows_nothing(
    state: ServoFeedback | None, force: ForceSample | None, contact_force_n: float
) -> bool:
    """Return whether pads and current both show that nothing is held.

    Parameters
    ----------
    state, force
        Newest feedback and force sample, or None.
    contact_force_n
        Least force in N of a touch. The current counts only while the fingers stand: in motion it
        moves them.
    """
    if state is None or force is None or not force.valid:
        return False
    stands = abs(state.aperture_velocity_m_s) < _EMPTY_STANDING_M_S
    pressed_n = state.force_from_current_n if stands else 0.0
    return max(*force.force_n, pressed_n) < contact_force_n


class TimeSpan(NamedTuple):
    """A span of monotonic time, both ends in s."""

    since_s: float
    until_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One period of the loop; observers get it after the goals were written."""

    t_s: float
    """Monotonic time in s."""
    phase: GripperPhase
    """Phase of the gripper."""
    state: ServoFeedback
    """Feedback of this period."""
    goal_current_a: float
    """Mean magnitude of the goal currents in A."""
    force: ForceSample | None = None
    """Newest force sample, or None."""
    setpoint_n: float = 0.0
    """Force set-point in N; 0 while no force is controlled."""


Observer = Callable[[Cycle], None]
"""Function called once a period, after the goals were written; its errors end the command."""
