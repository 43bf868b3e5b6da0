"""Values that the gripper takes and returns: time, force, servo and gripper states, outcomes."""

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
    """Normal force on both fingers, tared and calibrated.

    Attributes
    ----------
    t_s
        Monotonic time of the measurement in s.
    force_n
        Normal force on finger 0 and on finger 1 in N.
    valid
        False when the value must not be used for control (saturated pad, too many bad taxels).
    reason
        Why it is not valid; empty where it is.
    centre_m
        Centre of the grip force in the grip frame in m, along the fingers and across them: the
        mean of both pads' centres; None where it is not known, or nothing touches.
    centre_noise_m
        Standard deviation of each coordinate of ``centre_m``, as ``noise_n`` is of the force.
    lag_s
        How much older than ``t_s`` the force is in the mean, in s: filters, transmission.
    noise_n
        Standard deviation of `grip_n` in N, on top of that of the samples before it.
    frame_s
        Monotonic time in s at which the newest whole frame was scanned: a second measurement; None
        where the samples come from frames themselves.
    frame_n
        Normal force on finger 0 and on finger 1 in N in that frame alone.
    """

    t_s: float
    force_n: tuple[float, float]
    valid: bool = True
    reason: str = ""
    centre_m: tuple[float, float] | None = None
    centre_noise_m: float = 0.0
    lag_s: float = 0.02
    noise_n: float = 0.3
    frame_s: float | None = None
    frame_n: tuple[float, float] = (0.0, 0.0)

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
    """Feedback of one servo, from registers 120 to 146.

    Attributes
    ----------
    servo_id
        The servo.
    angle_rad
        Angle in the direction of the linkage: 0 at zero_raw, grows while the gripper opens.
    velocity_rad_s
        Velocity in the same direction.
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
    """Torque and errors of one servo, as read one by one: a silent servo hides no other.

    Attributes
    ----------
    servo_id
        The servo.
    answers
        False where it did not answer; its torque is then unknown, and the rest False and 0.
    torque_on
        Whether its torque is on.
    error_bits
        Hardware Error Status (register 70).
    shut_down
        Whether one of these errors keeps the torque off until a reboot (register 63).
    strayed
        Why its position is not to be used until a reboot; empty where it is.
    """

    servo_id: int
    answers: bool = True
    torque_on: bool = False
    error_bits: int = 0
    shut_down: bool = False
    strayed: str = ""

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
    """End of a release: what was opened, and what could not be.

    Attributes
    ----------
    state
        Last feedback; of the servos that were opened alone.
    opened
        IDs of the servos whose fingers are open.
    left
        The servos that could not be moved.
    wider
        IDs of the servos that report a finger as wider open than the gripper opens; they stay.
    """

    state: GripperState
    opened: tuple[int, ...]
    left: tuple[ServoCondition, ...] = ()
    wider: tuple[int, ...] = ()

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
    """One period of the loop, as its observer receives it after the goals were written.

    Attributes
    ----------
    t_s
        Monotonic time in s.
    phase
        Phase of the gripper.
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
    """End of a grasp; the part is held unless the result is that there is none.

    Attributes
    ----------
    result
        The end.
    contact_t_s, contact_aperture_m
        When and where both pads touched; None without contact.
    final_aperture_m
        Opening at the end in m.
    final_force_n
        Grip force at the end in N, mean of the last samples: as many as their noise asks for, three
        frames; 0 without contact.
    overshoot_n
        Largest mean of the last samples, as in ``final_force_n``, minus the end of the ramp in N,
        at least 0.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationRow:
    """Comparison of one register of a servo with its requirement.

    Attributes
    ----------
    servo_id
        The servo.
    item
        Name of the register.
    expected, found
        As text, in raw units of the register.
    ok
        True when they agree, or were made to agree.
    corrected
        True when the register was rewritten to agree.
    """

    servo_id: int
    item: str
    expected: str
    found: str
    ok: bool
    corrected: bool = False

    def __str__(self) -> str:
        return f"servo {self.servo_id} {self.item}: expected {self.expected}, found {self.found}"


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationReport:
    """All comparisons of a start.

    Attributes
    ----------
    rows
        One for each servo and item.
    torque_was_on
        True when a servo had its torque on: it may hold a part, and nothing was changed.
    """

    rows: tuple[VerificationRow, ...]
    torque_was_on: bool = False

    @property
    def ok(self) -> bool:
        """True when every row agrees."""
        return all(row.ok for row in self.rows)

    @property
    def failed(self) -> tuple[VerificationRow, ...]:
        """The rows that do not agree."""
        return tuple(row for row in self.rows if not row.ok)
