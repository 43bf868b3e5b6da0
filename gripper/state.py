"""Values that the gripper takes and returns: time, force, servo and gripper states, outcomes."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

_HARDWARE_ERROR_BITS = {
    0: "input voltage",
    2: "overheating",
    3: "encoder",
    4: "electrical shock",
    5: "overload",
}
"""Bits of Hardware Error Status (e-Manual, Control Table, register 70)."""

_STANDS_M_S = 0.005
"""Rate of the opening in m/s below which the fingers stand: two counts of each servo."""


class Clock(Protocol):
    """A monotonic clock that can wait; the standard module ``time`` is one."""

    def monotonic(self) -> float:
        """Return the time in s since an arbitrary start; it never goes back."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait for ``seconds`` s."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSample:
    """Normal force on both fingers, tared and calibrated."""

    t_s: float
    """Monotonic time of the measurement in s."""
    force_n: tuple[float, float]
    """Normal force on finger 0 and on finger 1 in N."""
    valid: bool = True
    """False when the value must not be used for control (saturated pad, too many bad taxels)."""
    reason: str = ""
    """Why it is not valid; empty where it is."""
    centre_m: tuple[float, float] | None = None
    """Centre of the grip force in the grip frame in m, along the fingers and across them: the mean
    of both pads' centres; None where it is not known, or nothing touches."""
    centre_noise_m: float = 0.0
    """Standard deviation of each coordinate of ``centre_m``, as ``noise_n`` is of the force."""
    lag_s: float = 0.02
    """How much older than ``t_s`` the force is in the mean, in s: filters, transmission."""
    noise_n: float = 0.3
    """Standard deviation of `grip_n` in N, on top of that of the samples before it."""
    frame_s: float | None = None
    """Monotonic time in s at which the newest whole frame was scanned: a second measurement; None
    where the samples come from frames themselves."""
    frame_n: tuple[float, float] = (0.0, 0.0)
    """Normal force on finger 0 and on finger 1 in N in that frame alone."""

    @property
    def measured_s(self) -> float:
        """Monotonic time in s at which the force was as it is here."""
        return self.t_s - self.lag_s

    @property
    def grip_n(self) -> float:
        """Grip force in N: the mean of both fingers, which are equal in equilibrium."""
        return 0.5 * (self.force_n[0] + self.force_n[1])


class ForceSensor(Protocol):
    """Source of force samples; called once every period of the force loop, must not block."""

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample, None while there is none; the caller judges its age."""
        ...


class GripperPhase(Enum):
    """Phase of the gripper.

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
        """True while the fingers are on their way, with nothing in their grip yet or any more."""
        return self in (
            GripperPhase.OPENING,
            GripperPhase.APPROACHING,
            GripperPhase.RELEASING,
        )


class GraspResult(Enum):
    """Kind of end of a grasp."""

    FORCE_REACHED = "force_reached"
    FORCE_NOT_REACHED = "force_not_reached"
    NO_CONTACT = "no_contact"
    PART_LOST = "part_lost"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoState:
    """Feedback of one servo, from registers 120 to 146."""

    servo_id: int
    """The servo."""
    angle_rad: float
    """Angle in the direction of the linkage: 0 at zero_raw, grows while the gripper opens."""
    velocity_rad_s: float
    """Velocity in the same direction."""
    current_a: float
    """Present Current; positive drives the gripper open."""
    position_raw: int
    """Present Position as read."""
    temperature_c: float
    voltage_v: float
    """Present Temperature and Present Input Voltage."""
    tick_ms: int
    """Realtime Tick: the servo's own time, modulo 32768 ms."""
    alert: bool
    """True while Hardware Error Status (register 70) is not zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperState:
    """Feedback of the gripper, read in one transaction."""

    t_s: float
    """Monotonic time at which the answers were there, in s."""
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
    """Feedback of each servo."""

    @property
    def angles_rad(self) -> tuple[float, ...]:
        """Angle of each servo in rad."""
        return tuple(servo.angle_rad for servo in self.servos)


def shows_nothing(
    state: GripperState | None, force: ForceSample | None, contact_force_n: float
) -> bool:
    """Return whether pads and current both show that nothing is held.

    Parameters
    ----------
    state, force
        Newest feedback and force sample, None where there is none.
    contact_force_n
        Force in N from which on something is touched. The current counts while the fingers stand:
        in motion it is what moves them.
    """
    if state is None or force is None or not force.valid:
        return False
    stands = abs(state.aperture_velocity_m_s) < _STANDS_M_S
    pressed_n = state.force_from_current_n if stands else 0.0
    return max(*force.force_n, pressed_n) < contact_force_n


def hardware_error_names(bits: int) -> tuple[str, ...]:
    """Return the names of the bits of Hardware Error Status (register 70), lowest bit first."""
    return tuple(
        _HARDWARE_ERROR_BITS.get(bit, f"undefined bit {bit}") for bit in range(8) if bits >> bit & 1
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoCondition:
    """Torque and errors of one servo, as read one by one: a silent servo hides no other."""

    servo_id: int
    """The servo."""
    answers: bool = True
    """False where it did not answer; its torque is then unknown, and the rest False and 0."""
    torque_on: bool = False
    """Whether its torque is on."""
    error_bits: int = 0
    """Hardware Error Status (register 70)."""
    shut_down: bool = False
    """Whether one of these errors keeps the torque off until a reboot (register 63)."""
    strayed: str = ""
    """Why its position is not to be used until a reboot; empty where it is."""

    @property
    def able(self) -> bool:
        """True when the servo can be moved, by switching its torque on where that is off."""
        return self.answers and not self.shut_down and not self.strayed

    def __str__(self) -> str:
        if not self.answers:
            return f"servo {self.servo_id} does not answer"
        torque = "its torque on" if self.torque_on else "no torque"
        errors = ", ".join(hardware_error_names(self.error_bits))
        strayed = f", and where its finger is, is unknown: {self.strayed}" if self.strayed else ""
        return f"servo {self.servo_id} has {torque}" + (f" ({errors})" if errors else "") + strayed


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseReport:
    """End of a release: what was opened, and what could not be."""

    state: GripperState
    """Last feedback; of the servos that were opened alone."""
    opened: tuple[int, ...]
    """IDs of the servos whose fingers are open."""
    left: tuple[ServoCondition, ...] = ()
    """The servos that could not be moved."""
    wider: tuple[int, ...] = ()
    """IDs of the servos that report a finger as wider open than the gripper opens; they stay."""

    def __str__(self) -> str:
        if not self.left and not self.wider:
            return "the fingers are open"
        if not self.left:
            wider = ", ".join(map(str, self.wider))
            return (
                f"the fingers are open, by what their servos report; the finger of servo {wider} "
                f"was not moved, as it is said to stand wider open than the gripper opens. If it "
                f"does not, check encoder, horn and zero_pulse of the servo"
            )
        opened = ", ".join(map(str, self.opened))
        remedies = []
        if any(condition.shut_down for condition in self.left):
            remedies.append("after its cause is remedied, clear the error with a reboot")
        if any(condition.strayed for condition in self.left):
            remedies.append(
                "push that finger open by hand and check encoder and horn; after the reset, clear "
                "with a reboot, which restarts the servo"
            )
        if any(not condition.answers for condition in self.left):
            remedies.append(
                "a servo that does not answer may still have its torque: check its supply and cable"
            )
        return (
            f"the finger of servo {opened} is open, the other one was not moved: "
            f"{'; '.join(map(str, self.left))}. {'; '.join(remedies).capitalize()}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One period of the loop, as its observer receives it after the goals were written."""

    t_s: float
    """Monotonic time in s."""
    phase: GripperPhase
    """Phase of the gripper."""
    state: GripperState
    """Feedback of this period."""
    force: ForceSample | None
    """Newest force sample, None where there is none."""
    setpoint_n: float
    """Force that is asked for in N; 0 while no force is controlled."""
    goal_current_a: float
    """Mean magnitude of the goal currents in A."""
    level: int | None = None
    """Level of the ramp that is held, None while the force changes."""


Observer = Callable[[Cycle], None]
"""Function called once a period, after the goals were written; what it raises ends the command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOutcome:
    """End of a grasp; the part is held unless the result is that there is none."""

    result: GraspResult
    """The end."""
    contact_t_s: float | None
    contact_aperture_m: float | None
    """When and where both pads touched; None without contact."""
    final_aperture_m: float
    """Opening at the end in m."""
    final_force_n: float
    """Grip force at the end in N, mean of the last samples: as many as their noise asks for, three
    frames; 0 without contact."""
    overshoot_n: float
    """Largest mean of the last samples, as in ``final_force_n``, minus the end of the ramp in N, at
    least 0."""
    ended_early: bool = False
    """Whether the ramp was ended on request, before its usual end: the force that was reached or
    not is then the set-point at that time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationRow:
    """Comparison of one register of a servo with its requirement."""

    servo_id: int
    """The servo."""
    item: str
    """Name of the register."""
    expected: str
    found: str
    """As text, in raw units of the register."""
    ok: bool
    """True when they agree, or were made to agree."""
    corrected: bool = False
    """True when the register was rewritten to agree."""

    def __str__(self) -> str:
        return f"servo {self.servo_id} {self.item}: expected {self.expected}, found {self.found}"


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationReport:
    """All comparisons of a start."""

    rows: tuple[VerificationRow, ...]
    """One for each servo and item."""

    @property
    def ok(self) -> bool:
        """True when every row agrees."""
        return all(row.ok for row in self.rows)

    @property
    def failed(self) -> tuple[VerificationRow, ...]:
        """The rows that do not agree."""
        return tuple(row for row in self.rows if not row.ok)
