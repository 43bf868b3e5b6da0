"""One Dynamixel servo as an axis: extended position mode, profile, load and stall supervision."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    BUS_WATCHDOG,
    DRIVE_MODE,
    GOAL_POSITION,
    HARDWARE_ERROR_STATUS,
    OPERATING_MODE,
    PRESENT_BLOCK,
    PRESENT_POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    TORQUE_ENABLE,
    WATCHDOG_UNIT_S,
    Register,
)
from gripper.dynamixel.models import OperatingMode, ServoModel
from gripper.errors import BusCorrupt, BusTimeout, GripperError, PortLost
from gripper.values.servo_checks import hardware_error_names
from motion.bus import Watch
from motion.errors import (
    AxisFault,
    AxisLimitExceeded,
    AxisMissing,
    AxisRestarted,
    AxisSilent,
)

_WATCHDOG_FACTOR = 2.0
"""Time of the bus watchdog over that after which the servo counts as lost. The watchdog is armed
while the servo moves."""
_RETRY_S = 0.005
"""Time in s until the next attempt without an answer."""
_ATTEMPTS = 2
"""Fewest attempts, also on a machine that was busy with other work meanwhile."""
_STALL_S = 0.15
"""Least time in s beyond a limit of load or lag that is a stall; a start takes 0.05 s."""
_REBOOT_S = 0.5
"""Time in s for a reboot of a servo, with reserve."""
_STANDING = 2
"""Largest Present Velocity of a standing servo in counts of 0.229 rev/min."""
_REVERSE_BIT = 0x01
"""The bit of Drive Mode that may be set: all others change the meaning of goals."""

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoAxisSettings:
    """Set-up of a servo in pulses, 4096 a turn."""

    model: ServoModel
    """Required model."""
    low: int
    high: int
    """Limits, less than a turn apart: after a loss of power the servo counts within one turn."""
    zero: int
    """Present Position at 0 of the axis."""
    velocity: int
    acceleration: int
    """Profile Velocity and Acceleration in their counts, at least 1."""
    window: int
    """Largest distance of a reached target; also the reserve at the limits when switched on."""
    lag: int
    """Largest distance to the profile's position of a servo that is not stalled."""
    current_a: float
    """Largest current in A of a servo that is not stalled."""
    loss_s: float
    """Time in s without an answer after which the servo is lost."""


class ServoAxis:
    """One servo on a line of its own; positions in pulses from the zero of the axis."""

    def __init__(
        self, bus: ServoBus, servo_id: int, name: str, settings: ServoAxisSettings, watch: Watch
    ) -> None:
        self.name = f"{name} (servo {servo_id})"
        self._bus = bus
        self._id = servo_id
        self._settings = settings
        self._watch = watch
        self._loss_s = settings.loss_s
        self._turn = 0
        self._target: int | None = None
        self._stalled_since_s: float | None = None

    def identify(self) -> str:
        """Return state and position in words; nothing is changed and nothing moves.

        Raises AxisMissing without an answer, for another model, or for a set-up for other goals.
        """
        self._loss_s = self._settings.loss_s
        try:
            answer = self._ask(lambda: self._bus.ping(self._id))
            drive_mode = self._read(DRIVE_MODE)
        except AxisSilent as silence:
            raise AxisMissing(f"{silence}; are ID and baud rate right?") from silence
        model = self._settings.model
        if answer.model_number != model.number:
            raise AxisMissing(
                f"{self.name} has model number {answer.model_number}, a {model.name} has "
                f"{model.number}: correct ID or model"
            )
        if drive_mode & ~_REVERSE_BIT:
            raise AxisMissing(
                f"{self.name} has Drive Mode {drive_mode}: time-based profiles and torque by goal "
                "must be off; correct it with the vendor's wizard"
            )
        torque = "on" if self._read(TORQUE_ENABLE) else "off"
        error = self._read(HARDWARE_ERROR_STATUS)
        at = self._read(PRESENT_POSITION)
        words = f"torque {torque}, Present Position {at} pulses"
        return words + (f", hardware error {_names(error)}" if error else "")

    def prepare(self, *, reset: bool) -> None:
        """Set the servo up and switch its torque on at its position; nothing moves.

        A servo at fault is restarted with ``reset`` only. Raises MotionError if it is missing,
        stays at fault, or stands outside its limits.
        """
        self.clear_fault(reboot=reset)
        mode = OperatingMode.EXTENDED_POSITION
        self._write(BUS_WATCHDOG, 0)
        if self._read(OPERATING_MODE) != mode:
            self._write(TORQUE_ENABLE, 0)
            self._write(OPERATING_MODE, mode)
        at = self._read(PRESENT_POSITION)
        low, high, reserve = self._settings.low, self._settings.high, self._settings.window
        # The turn of the present position is the one within the limits.
        middle = (low + high) // 2
        turn = self._settings.model.pulses_per_turn
        self._turn = round((middle - (at - self._settings.zero)) / turn) * turn
        if not low - reserve <= self._axis(at) <= high + reserve:
            raise AxisFault(
                f"{self.name} is at {self._axis(at)} pulses, its limits are {low} to {high}: "
                "turn it back by hand with its torque off, or correct zero_pulse"
            )
        self._write(GOAL_POSITION, at)
        self._write(TORQUE_ENABLE, 1)
        self._target = None

    def clear_fault(self, *, reboot: bool) -> None:
        """Restart a servo at fault, only with ``reboot``: it loses its torque until its next use.

        Raises MotionError if it is missing, or at fault without ``reboot`` or after it.
        """
        self._ask(lambda: self._bus.demand_answers((self._id,)))
        self.identify()
        error = self._read(HARDWARE_ERROR_STATUS)
        if error and reboot:
            self._ask(lambda: self._bus.reboot(self._id))
            self._watch.pause(_REBOOT_S)
            error = self._read(HARDWARE_ERROR_STATUS)
        if error:
            raise AxisFault(self._fault_text(error))

    def wake(self) -> None:
        """Check that the servo still answers, has torque and no fault."""
        self._loss_s = self._settings.loss_s
        self._check()

    def go_to(self, target: int) -> None:
        """Begin to move; the only place where a goal is written, and its limits with it.

        Raises AxisLimitExceeded if the target is outside the limits; nothing moves.
        """
        settings = self._settings
        if not settings.low <= target <= settings.high:
            raise AxisLimitExceeded(
                f"{self.name} was asked for {target} pulses, its limits are {settings.low} to "
                f"{settings.high}"
            )
        self._write(PROFILE_ACCELERATION, settings.acceleration)
        self._write(PROFILE_VELOCITY, settings.velocity)
        watchdog_s = _WATCHDOG_FACTOR * settings.loss_s
        self._write(BUS_WATCHDOG, round(watchdog_s / WATCHDOG_UNIT_S))
        self._target, self._stalled_since_s = target, None
        self._write(GOAL_POSITION, target + settings.zero - self._turn)

    def arrived(self) -> bool:
        """Return whether the servo stands at its target.

        Raises MotionError if it is silent, at fault, without torque, or stalled.
        """
        self._check()
        values = self._feedback()
        if self._target is None:
            return False
        self._check_load(values)
        near = abs(self._axis(values["present_position"]) - self._target) <= self._settings.window
        on_goal = self._axis(values["position_trajectory"]) == self._target
        return near and on_goal and abs(values["present_velocity"]) <= _STANDING

    def rest(self) -> None:
        """Disarm the bus watchdog: a standing servo is not polled."""
        self._write(BUS_WATCHDOG, 0)

    @property
    def position(self) -> int:
        """Present position in pulses from the zero of the axis."""
        return self._axis(self._feedback()["present_position"])

    def stop(self) -> None:
        """Stop the servo at its position; with an implausible reading its torque goes off."""
        # Other axes wait for their stop meanwhile.
        self._loss_s = 0.0
        self._target = None
        self._write(BUS_WATCHDOG, 0)
        at = self._feedback()["present_position"]
        settings, slack = self._settings, self._settings.lag + self._settings.window
        if settings.low - slack <= self._axis(at) <= settings.high + slack:
            self._write(GOAL_POSITION, at)
        else:
            self._write(TORQUE_ENABLE, 0)

    def standing(self) -> bool:
        """Return whether the servo stands still after a stop."""
        return abs(self._feedback()["present_velocity"]) <= _STANDING

    def _axis(self, raw: int) -> int:
        return raw - self._settings.zero + self._turn

    def _feedback(self) -> dict[str, int]:
        ids = (self._id,)
        return self._ask(lambda: self._bus.sync_read(ids, PRESENT_BLOCK))[self._id]

    def _check(self) -> None:
        torque = self._read(TORQUE_ENABLE)
        if self._bus.alert(self._id) and (error := self._read(HARDWARE_ERROR_STATUS)):
            raise AxisFault(self._fault_text(error))
        if not torque:
            raise AxisRestarted(
                f"{self.name} has lost its torque: it has restarted. Check its supply, then clear "
                "the fault and start again"
            )

    def _check_load(self, values: dict[str, int]) -> None:
        now_s = self._watch.clock.monotonic()
        current_a = abs(self._settings.model.winding_a(values["present_current"]))
        lag = abs(values["position_trajectory"] - values["present_position"])
        if current_a <= self._settings.current_a and lag <= self._settings.lag:
            self._stalled_since_s = None
        elif self._stalled_since_s is None:
            self._stalled_since_s = now_s
        elif now_s - self._stalled_since_s > _STALL_S:
            raise AxisFault(
                f"{self.name} is stalled: {current_a:.2f} A (allowed are "
                f"{self._settings.current_a:g} A) and {lag} pulses behind its profile (allowed "
                f"are {self._settings.lag}); remove the obstacle, then clear the fault and "
                "start again"
            )

    def _read(self, register: Register) -> int:
        return self._ask(lambda: self._bus.read(self._id, register))

    def _write(self, register: Register, raw: int) -> None:
        self._ask(lambda: self._bus.write(self._id, register, raw))

    def _ask(self, call: Callable[[], _T]) -> _T:
        """Make a transaction; without an answer it is repeated until the servo is lost."""
        end_s = self._watch.clock.monotonic() + self._loss_s
        attempts = 0
        while True:
            attempts += 1
            try:
                with self._bus.in_loop():
                    answer = call()
                break
            except PortLost as error:
                raise AxisSilent(f"the line of {self.name} is lost: {error}") from error
            except (BusTimeout, BusCorrupt) as error:
                if attempts >= _ATTEMPTS and self._watch.clock.monotonic() >= end_s:
                    raise self._silent(error) from error
            except GripperError as error:
                raise self._silent(error) from error
            self._watch.pause(_RETRY_S)
        self._watch.look()
        return answer

    def _silent(self, error: Exception) -> AxisSilent:
        return AxisSilent(
            f"{self.name} does not answer as it should: {error}; check its supply and cable"
        )

    def _fault_text(self, error: int) -> str:
        return (
            f"{self.name} is at fault, hardware error {_names(error)}; remedy the cause, then "
            "clear the fault and start again: it restarts then, without torque for a moment"
        )


def _names(error: int) -> str:
    return ", ".join(hardware_error_names(error))
