"""One Dynamixel servo as an axis: extended position mode, profile, load and stall supervision."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from typing import TypeVar

from gripper.dynamixel import control_table as ct
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.models import OperatingMode, ServoModel
from gripper.errors import BusCorrupt, BusTimeout, GripperError
from gripper.values.servo_checks import hardware_errors_text
from motion import errors
from motion.axes import Axis, AxisSettings, Watch

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


@dataclass(frozen=True, kw_only=True)
class ServoAxisSettings(AxisSettings):
    """An axis with a servo, which is stalled beyond ``lag`` or ``current_a``.

    Its limits are less than a turn apart: after a loss of power the servo counts within one turn.
    """

    servo_id: int
    """ID of the servo."""
    model: ServoModel
    """Required model."""
    zero: int
    """Present Position at 0 of the axis in pulses."""
    current_a: float
    """Largest current in A of a servo that is not stalled."""
    loss_s: float
    """Time in s without an answer after which the servo is lost."""


class ServoAxis(Axis):
    """An axis with one servo on a line of its own; increments from the zero of the axis."""

    settings: ServoAxisSettings

    def __init__(self, settings: ServoAxisSettings, bus: ServoBus, watch: Watch) -> None:
        super().__init__(settings, f"servo {settings.servo_id}", watch)
        self._bus = bus
        self._id = settings.servo_id
        self._loss_s = settings.loss_s
        self._turn = 0
        self._target = 0
        self._stalled_since_s: float | None = None

    def identify(self) -> str:
        """Return state and position in words; see `Axis`.

        Raises AxisMissing also for a Drive Mode that changes the meaning of goals.
        """
        self._loss_s = self.settings.loss_s
        answer = self._ask(lambda: self._bus.ping(self._id))
        drive_mode = self._read(ct.DRIVE_MODE)
        model = self.settings.model
        if answer.model_number != model.number:
            raise errors.AxisMissing(
                f"{self.label} has model number {answer.model_number}, a {model.name} has "
                f"{model.number}: correct ID or model"
            )
        if drive_mode & ~_REVERSE_BIT:
            raise errors.AxisMissing(
                f"{self.label} has Drive Mode {drive_mode}: time-based profiles and torque by goal "
                "must be off; correct it with the vendor's wizard"
            )
        torque = "on" if self._read(ct.TORQUE_ENABLE) else "off"
        error = self._read(ct.HARDWARE_ERROR_STATUS)
        at = self._read(ct.PRESENT_POSITION)
        words = f"torque {torque}, Present Position {at} pulses"
        return words + (f", hardware error {hardware_errors_text(error)}" if error else "")

    def prepare(self, *, reset: bool) -> None:
        """Set the servo up and switch its torque on at its position; nothing moves.

        A servo at fault is restarted with ``reset`` only. Raises MotionError if it is missing,
        stays at fault, or stands outside its limits.
        """
        self.clear_fault(reboot=reset)
        mode = OperatingMode.EXTENDED_POSITION
        self._write(ct.BUS_WATCHDOG, 0)
        if self._read(ct.OPERATING_MODE) != mode:
            self._write(ct.TORQUE_ENABLE, 0)
            self._write(ct.OPERATING_MODE, mode)
        at = self._read(ct.PRESENT_POSITION)
        settings, (low, high) = self.settings, self.settings.limits
        # The turn of the present position is the one within the limits.
        turn = settings.model.pulses_per_turn
        self._turn = round(((low + high) // 2 - (at - settings.zero)) / turn) * turn
        reserve = settings.counts(settings.window)
        if not low - reserve <= self._axis(at) <= high + reserve:
            raise errors.AxisFault(
                f"{self.label} is at {self._axis(at)} pulses, its limits are {low} to {high}: "
                "turn it back by hand with its torque off, or correct zero_pulse"
            )
        self._write(ct.GOAL_POSITION, at)
        self._write(ct.TORQUE_ENABLE, 1)

    def clear_fault(self, *, reboot: bool) -> None:
        """Restart a servo at fault, only with ``reboot``: it loses its torque until its next use.

        Raises MotionError if it is missing, or at fault without ``reboot`` or after it.
        """
        self._ask(lambda: self._bus.demand_answers((self._id,)))
        self.identify()
        error = self._read(ct.HARDWARE_ERROR_STATUS)
        for _ in range(2 if reboot else 0):  # the request may be lost
            if error:
                with suppress(GripperError):  # it may restart without an answer
                    self._bus.reboot(self._id)
                self._watch.pause(_REBOOT_S)
                error = self._read(ct.HARDWARE_ERROR_STATUS)
        if error:
            raise self._fault(error)

    def wake(self) -> None:
        """Check that the servo still answers, has torque and no fault."""
        self._loss_s = self.settings.loss_s
        self._check()

    def go_to(self, position: float) -> None:
        """Begin to move; see `Axis`."""
        target, settings = self.target(position), self.settings
        per_s = abs(settings.increments) * settings.model.rad_per_pulse
        velocity = settings.velocity * per_s / settings.model.velocity_unit_rad_s
        acceleration = settings.acceleration * per_s / settings.model.acceleration_unit_rad_s2
        watchdog_s = _WATCHDOG_FACTOR * settings.loss_s
        self.rest()  # clears a watchdog that has tripped
        self._write(ct.PROFILE_ACCELERATION, max(1, round(acceleration)))
        self._write(ct.PROFILE_VELOCITY, max(1, round(velocity)))
        self._write(ct.BUS_WATCHDOG, round(watchdog_s / ct.WATCHDOG_UNIT_S))
        self._target, self._stalled_since_s = target, None
        self._write(ct.GOAL_POSITION, self._raw(target))

    def arrived(self) -> bool:
        """Return whether the servo stands at its target.

        Raises MotionError if it is silent, at fault, without torque, or stalled.
        """
        self._check()
        values = self._feedback()
        self._check_load(values)
        window = self.settings.counts(self.settings.window)
        near = abs(self._axis(values["present_position"]) - self._target) <= window
        on_goal = self._axis(values["position_trajectory"]) == self._target
        return near and on_goal and abs(values["present_velocity"]) <= _STANDING

    def rest(self) -> None:
        """Disarm the bus watchdog: a standing servo is not polled."""
        self._write(ct.BUS_WATCHDOG, 0)

    def read_increments(self) -> int:
        """Return the present position in pulses from the zero of the axis."""
        return self._axis(self._feedback()["present_position"])

    def stop(self) -> None:
        """Stop the servo at its position; with an implausible reading its torque goes off.

        The bus watchdog stays armed until the stop is confirmed: else nothing ends the motion.
        """
        # Other axes wait for their stop meanwhile.
        self._loss_s = 0.0
        try:
            at = round(self.position * self.settings.increments)
            self._write(ct.GOAL_POSITION, self._raw(at))
        except errors.PositionImplausible:
            self._write(ct.TORQUE_ENABLE, 0)
        self.rest()

    def standing(self) -> bool:
        """Return whether the servo stands still after a stop."""
        return abs(self._feedback()["present_velocity"]) <= _STANDING

    def _axis(self, raw: int) -> int:
        return raw - self.settings.zero + self._turn

    def _raw(self, increments: int) -> int:
        return increments + self.settings.zero - self._turn

    def _feedback(self) -> dict[str, int]:
        ids = (self._id,)
        return self._ask(lambda: self._bus.sync_read(ids, ct.PRESENT_BLOCK))[self._id]

    def _check(self) -> None:
        torque = self._read(ct.TORQUE_ENABLE)
        if self._id in self._bus.alerts and (error := self._read(ct.HARDWARE_ERROR_STATUS)):
            raise self._fault(error)
        if not torque:
            raise errors.AxisRestarted(
                f"{self.label} has lost its torque: it has restarted. Check its supply"
            )

    def _check_load(self, values: dict[str, int]) -> None:
        now_s, settings = self._watch.clock.monotonic(), self.settings
        current_a = abs(settings.model.winding_a(values["present_current"]))
        lag = abs(values["position_trajectory"] - values["present_position"])
        most = settings.counts(settings.lag)
        if current_a <= settings.current_a and lag <= most:
            self._stalled_since_s = None
        elif self._stalled_since_s is None:
            self._stalled_since_s = now_s
        elif now_s - self._stalled_since_s > _STALL_S:
            raise errors.AxisFault(
                f"{self.label} is stalled: {current_a:.2f} A (allowed are {settings.current_a:g} A)"
                f" and {lag} pulses behind its profile (allowed are {most}): remove the obstacle"
            )

    def _read(self, register: ct.Register) -> int:
        return self._ask(lambda: self._bus.read(self._id, register))

    def _write(self, register: ct.Register, raw: int) -> None:
        self._ask(lambda: self._bus.write(self._id, register, raw))

    def _ask(self, call: Callable[[], _T]) -> _T:
        """Make a transaction; without an answer it is repeated until the servo is lost."""
        end_s = self._watch.clock.monotonic() + self._loss_s
        for attempt in count(1):
            try:
                with self._bus.in_loop():
                    answer = call()
                break
            except GripperError as error:
                missing = isinstance(error, BusTimeout | BusCorrupt)
                ended = attempt >= _ATTEMPTS and self._watch.clock.monotonic() >= end_s
                if ended or not missing:
                    raise errors.AxisSilent(
                        f"{self.label} does not answer as it should: {error}"
                    ) from error
            self._watch.pause(_RETRY_S)
        self._watch.look()
        return answer

    def _fault(self, error: int) -> errors.AxisFault:
        return errors.AxisFault(
            f"{self.label} is at fault, hardware error {hardware_errors_text(error)}: remedy the "
            "cause, then clear with a reboot: the servo is without torque for a moment"
        )
