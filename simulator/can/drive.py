"""A CiA 402 drive with one axis as a CANopen device.

This module adds to `simulator.can.node` the state machine, profile position with its handshake,
homing to a limit switch, quick stop, following error.
Other functions of drives (PDOs, further modes, user units) are left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable
from canopen.profiles.p402 import OperationMode, State402
from canopen.sdo import constants as sdo

from motion import object_dictionary as od
from motion.object_dictionary import HomingMethod, Status
from simulator.can.node import CanopenDevice

STEP_S = 1e-3
"""Period in s of the drive's position loop."""
FOLLOWING_TIME_CONSTANT_S = 0.004
"""Time constant in s of the mechanism behind the set-point; an assumption."""
_REGISTER_GENERIC, _REGISTER_COMMUNICATION = 0x01, 0x11
"""Bits of the error register 1001h (CiA 301, 7.5.2.2)."""
_SWITCHED_ON_BIT, _VOLTAGE_BIT, _NO_QUICK_STOP_BIT, _ENABLE_BIT = 0x1, 0x2, 0x4, 0x8
_START_BIT, _RESET_BIT = 0x10, 0x80
"""Bits of the controlword (CiA 402-2)."""
_STANDING = 100.0
"""Largest speed in increments/s of a mechanism that counts as standing."""
_POWERED = ("OPERATION ENABLED", "QUICK STOP ACTIVE", "FAULT REACTION ACTIVE")
"""States in which the motor has current."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveMount:
    """A simulated drive and the axis that it moves."""

    node_id: int
    """CANopen node-ID."""
    increments: float
    """Increments per m or rad of the axis; negative: it counts in the other direction."""
    absolute: bool = False
    """Whether its encoder has the true position without homing."""
    start: float
    low_switch: float
    high_switch: float
    """True position at power-on and of the limit switches at its lower and upper end in m or rad.
    """


class ProfileMotion:
    """Set-point with bounded velocity and acceleration, and the mechanism behind it; increments.

    Parameters
    ----------
    position
        Position of the mechanism at the start in increments.
    low, high
        Positions of the limit switches.
    """

    def __init__(self, position: float, low: float, high: float) -> None:
        self.demand = self.actual = position
        self.speed = self.actual_speed = 0.0
        """Set-point and mechanism: place in increments, velocity in increments/s."""
        self.braking = 0.0
        """Deceleration in increments/s² of a running stop; 0: no stop."""
        self._goal: float | None = None
        self._limits = (0.0, 0.0)
        self._switches = (low, high)

    @property
    def resting(self) -> bool:
        """Whether the set-point is at its goal."""
        return self._goal is None and self.speed == 0.0

    def switches(self, forced: int) -> tuple[bool, bool]:
        """Return whether the negative and the positive limit switch are active.

        ``forced`` is -1 or 1 for a switch that is always active, 0 for none.
        """
        low, high = self._switches
        return self.actual <= low or forced < 0, self.actual >= high or forced > 0

    def go(self, goal: float, velocity: float, acceleration: float) -> None:
        """Move to a goal within a velocity and an acceleration."""
        self._goal, self._limits = goal, (velocity, acceleration)
        self.braking = 0.0

    def stop(self, deceleration: float) -> None:
        """Brake to standstill."""
        self._goal, self.braking = None, deceleration

    def freeze(self) -> None:
        """Stop at once at the mechanism's position: the power stage is off."""
        self.demand, self.speed, self._goal, self.braking = self.actual, 0.0, None, 0.0

    def step(self, dt_s: float, *, blocked: bool) -> None:
        """Move on by ``dt_s`` s; a mechanism that is blocked stays where it is."""
        target, change = 0.0, self.braking
        if self._goal is not None:
            velocity, change = self._limits
            left = self._goal - self.demand
            target = math.copysign(min(velocity, math.sqrt(2.0 * change * abs(left))), left)
        most = change * dt_s
        self.speed += min(max(target - self.speed, -most), most)
        self.demand += self.speed * dt_s
        if self._goal is not None and abs(self._goal - self.demand) <= 0.5 + abs(target) * dt_s:
            self.demand, self.speed, self._goal = self._goal, 0.0, None
        self.actual_speed = 0.0
        if not blocked:
            share = 1.0 - math.exp(-dt_s / FOLLOWING_TIME_CONSTANT_S)
            way = (self.demand - self.actual) * share
            self.actual += way
            self.actual_speed = way / dt_s


class SimulatedDrive(CanopenDevice):
    """One drive on its bus; it has no clock, the time is an argument."""

    def __init__(self, mount: DriveMount, *, start_s: float = 0.0) -> None:
        self.mount = mount
        ends = sorted(mount.increments * end for end in (mount.low_switch, mount.high_switch))
        self.motion = ProfileMotion(mount.increments * mount.start, *ends)
        """Set-point and mechanism."""
        self.dead = False
        """Fault knob: it receives and sends nothing; its motion goes on."""
        self.blocked = False
        """Fault knob: the axis is blocked."""
        self.forced_switch = 0
        """Fault knob: -1 or 1 for a limit switch that is always active."""
        self.resumes = True
        """Whether it has transition 16, from a quick stop back to operation; it is optional."""
        self.slipped = 0.0
        """Fault knob: offset of the axis from the encoder's position in m or rad."""
        self._stepped_s = start_s
        self._host_due_s = math.inf
        self._zero = 0.0
        self._error_code = self._control = 0
        super().__init__(mount.node_id, od.of_node(mount.node_id), start_s)
        self._values |= {
            "Statusword": lambda _subindex: self.statusword,
            "Modes of operation display": lambda _subindex: self.number("Modes of operation"),
            "Error code": lambda _subindex: self._error_code,
            "Position actual value": lambda _subindex: round(self.motion.actual - self._zero),
            "Velocity actual value": lambda _subindex: round(self.motion.actual_speed),
        }
        self.power_cycle()

    @property
    def position(self) -> float:
        """True position of the axis in m or rad."""
        return self.motion.actual / self.mount.increments + self.slipped

    @property
    def moving(self) -> bool:
        """Whether the set-point moves, or the mechanism has not reached it."""
        return self.motion.speed != 0.0 or abs(self.motion.actual_speed) > _STANDING

    @property
    def statusword(self) -> int:
        """Object 6041h."""
        word = State402.SW_MASK[self.state][1] | Status.REMOTE | Status.VOLTAGE_ENABLED
        word |= Status.TARGET_REACHED if self._reached else 0
        word |= Status.INTERNAL_LIMIT if self._at_switch else 0
        word |= Status.ACKNOWLEDGED if self._acknowledged else 0
        return word | (Status.MODE_ERROR if self._error_code == od.FOLLOWING_ERROR_CODE else 0)

    # -- device on the bus ---------------------------------------------------------------------

    def advance(self, now_s: float) -> None:
        """Let the time pass until ``now_s`` s: boot-up, heartbeat, motion."""
        if self._boot_due_s <= now_s:
            self.state = "SWITCH ON DISABLED"
        super().advance(now_s)
        if now_s >= self._host_due_s:
            self._host_due_s = math.inf
            self._node.emcy.send(od.HOST_LOST_CODE, _REGISTER_COMMUNICATION, b"")
            self._abort_connection()
            # The default of 1029h:01 (CiA 301, 7.5.2.32).
            if self.nmt_state == "OPERATIONAL":
                self._node.nmt.state = "PRE-OPERATIONAL"
        while self._stepped_s + STEP_S <= now_s + 1e-9:
            self._stepped_s += STEP_S
            self._step()

    def _take(self, can_id: int, _data: bytes) -> None:
        node_id, silence_ms = divmod(self.number("Consumer heartbeat time.Host"), 1 << 16)
        if silence_ms and can_id == od.COB_HEARTBEAT + node_id:
            self._host_due_s = self._network.now_s + 1e-3 * silence_ms

    def _changed(self) -> None:
        if self.nmt_state == "STOPPED":
            self._abort_connection()

    def _reset(self, *, everything: bool) -> None:
        """Lose set-up and position, by a reset of the communication too; the axis stays."""
        del everything
        super()._reset(everything=True)
        self.state = "NOT READY TO SWITCH ON"
        self._error_code = self._control = 0
        self._acknowledged = self._reached = self._at_switch = False
        self._host_due_s = math.inf
        self._homing: Iterator[None] | None = None
        self._lag_s = 0.0
        self.motion.freeze()
        self._zero = 0.0 if self.mount.absolute else self.motion.actual

    def fail(self, code: int) -> None:
        """Go to fault: brake, then switch the power stage off; error code and EMCY."""
        if self.state in ("FAULT", "FAULT REACTION ACTIVE"):
            return
        self._error_code = code
        self.state = "FAULT REACTION ACTIVE" if self.state in _POWERED else "FAULT"
        self._brake()
        self._node.emcy.send(code, _REGISTER_GENERIC, b"")

    # -- objects -------------------------------------------------------------------------------

    def _written(self, od: ODVariable, value: Any) -> None:
        if od.name == "Controlword":
            self._command(value)
        elif od.name == "Modes of operation":
            if value not in (0, OperationMode.PROFILED_POSITION, OperationMode.HOMING):
                raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE)
            if self.motion.speed != 0.0:
                raise canopen.SdoAbortedError(sdo.ABORT_APPLICATION_DEVICE_STATE)
            self._acknowledged = self._reached = False
        elif od.name == "Host":
            # Supervision begins with the first heartbeat (CiA 301, 7.2.8.3.3).
            self._host_due_s = math.inf
        elif od.name == "Homing method" and value not in [0, *HomingMethod]:
            raise canopen.SdoAbortedError(sdo.ABORT_INVALID_VALUE)

    # -- state machine -------------------------------------------------------------------------

    def _command(self, word: int) -> None:
        """Carry out a controlword (CiA 402-2, transitions 2 to 16)."""
        before, self._control = self._control, word
        if word & _RESET_BIT and not before & _RESET_BIT:
            if self.state == "FAULT":
                self.state, self._error_code, self._lag_s = "SWITCH ON DISABLED", 0, 0.0
                self._node.emcy.send(0, 0, b"")
            return
        if self.state in ("FAULT", "FAULT REACTION ACTIVE", "NOT READY TO SWITCH ON"):
            return
        low = word & 0x0F
        if not low & _VOLTAGE_BIT:
            self._switch_off("SWITCH ON DISABLED")
        elif not low & _NO_QUICK_STOP_BIT:
            self._quick_stop()
        elif self.state == "QUICK STOP ACTIVE":
            if self.resumes and low == State402.CW_OPERATION_ENABLED:
                self.state = "OPERATION ENABLED"
        elif not low & _SWITCHED_ON_BIT:
            self._switch_off("READY TO SWITCH ON")
        elif self.state != "SWITCH ON DISABLED":
            if low == State402.CW_SWITCH_ON and self.state == "OPERATION ENABLED":
                self.motion.freeze()
            self.state = "OPERATION ENABLED" if low & _ENABLE_BIT else "SWITCHED ON"
        if self.state == "OPERATION ENABLED":
            self._start(word, rising=bool(word & _START_BIT and not before & _START_BIT))

    def _switch_off(self, state: str) -> None:
        self.motion.freeze()
        self._homing = None
        self.state = state

    def _abort_connection(self) -> None:
        """Carry out the option of 6007h when the host is lost or stopped the node (CiA 402-2)."""
        stops = self.number("Abort connection option code") == od.STOP_WHEN_HOST_IS_LOST
        if stops and self.state == "OPERATION ENABLED":
            self._quick_stop()

    def _quick_stop(self) -> None:
        if self.state == "OPERATION ENABLED":
            self.state = "QUICK STOP ACTIVE"
            self._brake()
        elif self.state != "QUICK STOP ACTIVE":
            self._switch_off("SWITCH ON DISABLED")

    def _brake(self) -> None:
        self._homing = None
        self.motion.stop(self.number("Quick stop deceleration") or 1e6)

    def _start(self, word: int, *, rising: bool) -> None:
        mode = self.number("Modes of operation")
        if mode == OperationMode.PROFILED_POSITION:
            if not word & _START_BIT:
                self._acknowledged = False
            elif rising:
                target = self.number("Target position")
                low = self.number("Software position limit.Min position limit")
                high = self.number("Software position limit.Max position limit")
                # A drive moves to its software limit at most.
                goal = min(max(target, low), high) + self._zero
                velocity = self.number("Profile velocity")
                acceleration = self.number("Profile acceleration")
                self.motion.go(goal, velocity, acceleration or 1e9)
                self._acknowledged, self._reached, self._at_switch = True, False, False
        elif mode == OperationMode.HOMING and rising:
            self._homing = self._home(self.number("Homing method"))
            self._acknowledged = self._reached = False
        elif mode == OperationMode.HOMING and not word & _START_BIT:
            self._homing = None

    # -- motion --------------------------------------------------------------------------------

    def _step(self) -> None:
        motion = self.motion
        if self._homing is not None:
            if next(self._homing, True):
                self._homing = None
        elif self.state == "OPERATION ENABLED":
            self._watch_switches()
        motion.step(STEP_S, blocked=self.blocked)
        if self.state == "FAULT REACTION ACTIVE" and self.motion.speed == 0.0:
            self._switch_off("FAULT")
        if self.state == "OPERATION ENABLED":
            self._watch_lag()
            if (
                self.number("Modes of operation") == OperationMode.PROFILED_POSITION
                and motion.resting
            ):
                near = abs(motion.demand - motion.actual) <= self.number("Position window")
                self._reached = near and not self._at_switch

    def _watch_switches(self) -> None:
        negative, positive = self.motion.switches(self.forced_switch)
        into = (negative and self.motion.speed < 0.0) or (positive and self.motion.speed > 0.0)
        if into and not self._at_switch:
            self._at_switch = True
            self.motion.stop(self.number("Quick stop deceleration") or 1e6)

    def _watch_lag(self) -> None:
        motion, window = self.motion, self.number("Following error window")
        beyond = abs(motion.demand - motion.actual) > window
        self._lag_s = self._lag_s + STEP_S if beyond else 0.0
        if self._lag_s * 1e3 > self.number("Following error time out"):
            self.fail(od.FOLLOWING_ERROR_CODE)

    def _home(self, method: int) -> Iterator[None]:
        """Home in steps: to the switch, then slowly back; home is where the switch opens.

        There the position is the negative home offset (CiA 402-2, 607Ch).
        """
        motion, acceleration = self.motion, self.number("Homing acceleration")
        if method != HomingMethod.HERE:
            direction = -1.0 if method == HomingMethod.NEGATIVE_SWITCH else 1.0
            for way, active, speed in ((direction, False, "switch"), (-direction, True, "zero")):
                velocity = self.number(f"Homing speeds.Speed during search for {speed}")
                while motion.switches(self.forced_switch)[direction > 0.0] is active:
                    motion.go(motion.demand + way * 1e9, velocity, acceleration or 1e9)
                    yield
        self._zero = motion.actual + self.number("Home offset")
        motion.stop(acceleration or 1e6)
        yield
        while not motion.resting:
            yield
        self._acknowledged = self._reached = True

    def _silenced(self) -> bool:
        return self.dead
