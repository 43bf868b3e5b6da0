"""What the gripper tells: states of servos and gripper, cycles of its loop, outcomes."""

from dataclasses import dataclass
from enum import Enum

from gripper.force import ForceSample
from gripper.timing import LoopStatistics

__all__ = [
    "Cycle",
    "GraspOutcome",
    "GraspResult",
    "GripperPhase",
    "GripperState",
    "LoopStatistics",
    "ServoState",
]


class GripperPhase(Enum):
    """What the gripper is doing.

    OFF: torque is off or unknown. IDLE: torque on, nothing held. HELD_AFTER_FAULT: goals are
    frozen after a fault, or torque was found on at the start; a part may be held.
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
        """Whether the fingers are on their way, with nothing in their grip yet or any more."""
        return self in (
            GripperPhase.OPENING,
            GripperPhase.APPROACHING,
            GripperPhase.RELEASING,
        )


class GraspResult(Enum):
    """How a grasp ended."""

    FORCE_REACHED = "force_reached"
    FORCE_NOT_REACHED = "force_not_reached"
    NO_CONTACT = "no_contact"
    OBSTRUCTED = "obstructed"
    PART_LOST = "part_lost"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoState:
    """Feedback of one servo, from registers 120 to 146.

    Attributes
    ----------
    servo_id
        The servo.
    angle_rad
        Angle in the linkage's sense: 0 at zero_raw, grows while the gripper opens.
    velocity_rad_s
        Velocity in the same sense.
    current_a
        Present Current; positive drives the gripper open.
    position_raw
        Present Position as read.
    temperature_c, voltage_v
        Present Temperature and Present Input Voltage.
    tick_ms
        Realtime Tick: the servo's own time, modulo 32768 ms.
    alert
        True while Hardware Error Status (register 70) is not zero.
    """

    servo_id: int
    angle_rad: float
    velocity_rad_s: float
    current_a: float
    position_raw: int
    temperature_c: float
    voltage_v: float
    tick_ms: int
    alert: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperState:
    """Feedback of the gripper, read in one transaction.

    Attributes
    ----------
    t_s
        Monotonic time at which the answers were there, in s.
    aperture_m
        Opening between the pads in m.
    aperture_velocity_m_s
        Its rate in m/s; below 0 while closing.
    current_a
        Mean magnitude of the servo currents in A.
    force_from_current_n
        Grip force that the current can hold up while the force rises, in N. Not a measurement:
        friction makes it too low by up to twice the friction band once the force falls.
    temperature_c
        Temperature of the warmest servo in degrees Celsius.
    voltage_v
        Lowest supply voltage in V.
    servos
        Feedback of each servo.
    """

    t_s: float
    aperture_m: float
    aperture_velocity_m_s: float
    current_a: float
    force_from_current_n: float
    temperature_c: float
    voltage_v: float
    servos: tuple[ServoState, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One period of the loop, as the observer gets it after the goals were written.

    Attributes
    ----------
    t_s
        Monotonic time in s.
    phase
        What the gripper is doing.
    state
        Feedback of this period.
    force
        Newest force sample, None where there is none.
    setpoint_n
        Force that is asked for in N; 0 while no force is controlled.
    goal_current_a
        Mean magnitude of the goal currents in A.
    level
        Level of the ramp that is held, None while the force changes.
    """

    t_s: float
    phase: GripperPhase
    state: GripperState
    force: ForceSample | None
    setpoint_n: float
    goal_current_a: float
    level: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOutcome:
    """How a grasp ended; the part is held unless the result says that there is none.

    Attributes
    ----------
    result
        The end.
    contact_t_s, contact_aperture_m
        When and where both pads touched; None without contact.
    final_aperture_m
        Opening at the end in m.
    final_force_n
        Grip force at the end in N, mean of the last samples; 0 without contact.
    overshoot_n
        Largest mean of three samples minus the end of the ramp in N, at least 0.
    ended_early
        Whether the ramp was ended on request, before its usual end: the force that was reached or
        not is then the set-point at that time.
    """

    result: GraspResult
    contact_t_s: float | None
    contact_aperture_m: float | None
    final_aperture_m: float
    final_force_n: float
    overshoot_n: float
    ended_early: bool = False
