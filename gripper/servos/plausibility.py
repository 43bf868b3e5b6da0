"""Comparison of the feedback of servos under torque with possible motion of fingers.

Position is the measurement of motion. A second one comes from the motor alone: the voltage on its
winding is R i + k_e w, so that voltage and current show the speed w without the encoder.
"""

from collections import deque
from math import copysign, hypot, pi
from typing import NamedTuple

from gripper.dynamixel.drive import SIGMAS
from gripper.dynamixel.models import ServoModel
from gripper.errors import FeedbackImplausible, LimitExceeded, PositionContradicted
from gripper.mechanics.kinematics import Linkage
from gripper.settings import GripperSettings
from gripper.values.state import ServoState

_SPEED_RESERVE = 1.5
"""Fastest motion of a finger in multiples of the no-load speed: higher supply voltage, backlash."""
_LEAP_RAD = 0.05
"""Possible motion in rad in addition to it: noise of the encoder, time of the reading."""
_LEAP_LONGEST_S = 0.5
"""Pause in s after which two positions are not compared: a person may have moved a finger."""
_BEYOND_CLOSED_RAD, BEYOND_CLOSED_M = 0.08, 0.004
"""Limit for a finger beyond closed, in rad, or in m of the opening if that is more. Pads give,
fingers bend, and the zero is set by hand."""
_BEYOND_OPEN_RAD = 0.5
"""Limit in rad for a finger beyond its widest opening: a person may have moved it."""
_CURRENT_RESERVE = 1.5
"""Largest possible current in multiples of its cap and of the stall current: regulation, noise."""
_CURRENT_MORE_A = 0.3
"""Current in A added to the multiple of the cap: at a low cap the regulation overshoots by more."""

_GRIP_STAYS = (
    "The goals are frozen and the grip kept. Look at the part, check encoder, horn and linkage, "
    "then clear the fault and release"
)
_ADVICE = (
    "the position of the finger is unknown. The torque is switched off, and a held part may have "
    "dropped. Check encoder, horn and linkage before clearing the fault"
)
_COMPARED_S, _UNSEEN_RAD = 0.1, 0.01
"""Time in s over which the travels of motor and position are compared, and the difference in rad
beyond their errors that is a contradiction: backlash, time between the readings. [chosen]"""
_PAUSE_S = 0.025
"""Time in s between two readings above which voltage and current between them are unknown: after
two periods at 100 Hz the motor may have stopped meanwhile. [chosen]"""
_SUPPLY_SD = 0.05
"""Error of the supply's voltage and of the current by it, as a share, on the 330 size. [assumed]"""
_VOLTAGE_SD_V, _RESISTANCE_SD = 0.02, 0.15
"""Error of a voltage in V, and spread of the winding's resistance as a share: 50 K add 20 %.
[assumed]"""
_MEASURED_SD = 0.05
"""Error of a resistance once it was measured, as a share: 13 K. [assumed]"""


class MotorTravel:
    """Travel of one servo by voltage and current of its motor, V = R i + k_e w, without encoder.

    R is measured at each rest on a part; before, it has the spread of the model, as k_e always has.
    The current is that of Present Current: one by the duty would follow the voltage.
    """

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        # k_e in V s/rad, and its largest error as a share.
        self._back_emf_v_s = model.back_emf_v_s
        self._back_emf_error = SIGMAS * hypot(model.kt_sd, model.back_emf_sd)
        self._sums: deque[_Sums] = deque()
        self.forget()

    def forget(self) -> None:
        """Discard what was measured: the motor may be another one."""
        self._ohm, self._ohm_sd = self._model.winding_ohm, _RESISTANCE_SD
        self.pause()

    def pause(self) -> None:
        """Compare the next feedback with no earlier one."""
        self._sums.clear()
        self.unseen_rad = 0.0
        """Difference of the travels of motor and position in rad, beyond the errors of both."""

    def least_rad_s(self, voltage_v: float, current_a: float | None) -> float:
        """Return the speed in rad/s that a motor has at least, by its own voltage and current."""
        if current_a is None:
            return 0.0
        induced_v = voltage_v - self._ohm * current_a
        certain_v = max(0.0, abs(induced_v) - self._unknown_v(voltage_v, current_a, 1.0))
        return copysign(certain_v, induced_v) / ((1.0 + self._back_emf_error) * self._back_emf_v_s)

    def push(self, servo: ServoState, now_s: float, *, loaded: bool) -> None:
        """Add the feedback of one period, with whether the pads may hold a part."""
        sums = self._sums
        if servo.motor_a is None:
            self.pause()
            return
        if sums and now_s - sums[-1].t_s > _PAUSE_S:
            self.pause()
        volt_v, motor_a = servo.supply_v * servo.pwm_share, servo.motor_a
        last = sums[-1] if sums else _Sums(now_s, servo.angle_rad, volt_v, motor_a)
        # After a lost answer the mean of both ends counts.
        dt_s = now_s - last.t_s
        volt_s = last.volt_s + 0.5 * dt_s * (last.volt_v + volt_v)
        amp_s = last.amp_s + 0.5 * dt_s * (last.motor_a + motor_a)
        sums.append(_Sums(now_s, servo.angle_rad, volt_v, motor_a, volt_s, amp_s))
        while len(sums) > 2 and now_s - sums[1].t_s >= _COMPARED_S:
            sums.popleft()
        old, new = sums[0], sums[-1]
        time_s, volt_s = new.t_s - old.t_s, new.volt_s - old.volt_s
        amp_s, travel_rad = new.amp_s - old.amp_s, new.angle_rad - old.angle_rad
        model, v_s = self._model, self._back_emf_v_s
        off_v_s = abs(volt_s - self._ohm * amp_s - v_s * travel_rad)
        off_v_s -= self._back_emf_error * v_s * abs(travel_rad) + self._unknown_v(
            volt_s, amp_s, time_s
        )
        counts_rad = 2.0 * model.rad_per_pulse
        off_rad = off_v_s / v_s - counts_rad
        if off_rad > 0.0:
            self.unseen_rad += dt_s / _COMPARED_S * off_rad
            return
        self.unseen_rad = 0.0
        rests = loaded and time_s >= _COMPARED_S and abs(travel_rad) <= counts_rad
        sd_v_s = hypot(_VOLTAGE_SD_V * time_s, self._supply_sd * volt_s, v_s * counts_rad)
        if rests and sd_v_s < _MEASURED_SD * self._ohm * abs(amp_s):
            ohm, off = volt_s / amp_s, SIGMAS * _RESISTANCE_SD * model.winding_ohm
            if abs(ohm - model.winding_ohm) <= off:
                self._ohm, self._ohm_sd = ohm, _MEASURED_SD

    @property
    def _supply_sd(self) -> float:
        return _SUPPLY_SD if self._model.supply_current else 0.0

    def _unknown_v(self, volt_s: float, amp_s: float, time_s: float) -> float:
        ohm_v_s, supply_v_s = self._ohm_sd * self._ohm * amp_s, self._supply_sd * volt_s
        return SIGMAS * hypot(ohm_v_s, supply_v_s, _VOLTAGE_SD_V * time_s)


class _Sums(NamedTuple):
    """Position, voltage and current of a motor, and the sums of both up to a time."""

    t_s: float
    angle_rad: float
    volt_v: float
    motor_a: float
    volt_s: float = 0.0
    amp_s: float = 0.0


class FeedbackCheck:
    """Comparison of the feedback of servos under torque with possible motion of fingers."""

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self.strayed: dict[int, str] = {}
        """Servos whose position has leapt or left its range, with the reason. Where their fingers
        are is unknown until they are restarted."""
        self.motors = {one.servo_id: MotorTravel(one.servo_model) for one in settings.servos}
        """Travel of each servo by its motor."""
        self.letting_go = False
        """Whether a part is let go, which no contradiction of a position may end."""
        self._settings = settings
        self._linkage = linkage
        self._lowest_rad = tuple(
            angle - max(_BEYOND_CLOSED_RAD, BEYOND_CLOSED_M / linkage.opening_per_rad_m(angle))
            for angle in linkage.angles_rad(0.0)
        )
        self._highest_rad = tuple(
            angle + _BEYOND_OPEN_RAD for angle in linkage.angles_rad(settings.aperture_open_m)
        )
        self._last: dict[int, tuple[float, float]] = {}

    def forget(self) -> None:
        """Compare the next feedback with no earlier one."""
        self._last.clear()
        for motor in self.motors.values():
            motor.forget()

    def check(self, servos: tuple[ServoState, ...], now_s: float, *, loaded: bool) -> None:
        """Check the feedback of one transaction.

        Raises FeedbackImplausible where a finger has leapt, or its position or current is
        impossible. Raises PositionContradicted where it has moved steadily, but not as its motor,
        or to where only a load on the pads explains it; not while a part is let go.

        Parameters
        ----------
        servos
            Feedback of the servos, whose torque is on.
        now_s
            Monotonic time after the answer in s.
        loaded
            Whether the pads may hold a part.
        """
        for index, servo in enumerate(servos):
            self._check_current(index, servo)
            last = self._last.get(servo.servo_id)
            self._last[servo.servo_id] = (now_s, servo.angle_rad)
            self._check_turn(servo)
            if last is None:
                self._check_link(servo)
                continue
            last_s, last_rad = last
            model = self._settings.servos[index].servo_model
            passed_s = now_s - last_s
            farthest_rad = _SPEED_RESERVE * model.no_load_rad_s * passed_s + _LEAP_RAD
            leapt_rad = servo.angle_rad - last_rad
            if passed_s < _LEAP_LONGEST_S and abs(leapt_rad) > farthest_rad:
                self.strayed[servo.servo_id] = f"its position leapt by {leapt_rad:+.3f} rad"
                raise FeedbackImplausible(
                    f"servo {servo.servo_id}: {self.strayed[servo.servo_id]} within "
                    f"{passed_s * 1e3:.0f} ms, at most {farthest_rad:.3f} rad are possible: "
                    f"{_ADVICE}"
                )
            self._check_link(servo)
            motor = self.motors[servo.servo_id]
            if self.letting_go:
                motor.pause()
                continue
            self._check_range(index, servo, last_rad, loaded=loaded)
            motor.push(servo, now_s, loaded=loaded)
            if (apart_rad := motor.unseen_rad) > _UNSEEN_RAD:
                motor.forget()
                raise PositionContradicted(
                    f"servo {servo.servo_id}: the travels by its encoder and by voltage and "
                    f"current of its motor differ by {apart_rad:.3f} rad, at most {_UNSEEN_RAD} "
                    f"rad are possible: one of them is stuck or drifts. {_GRIP_STAYS}"
                )

    def _check_turn(self, servo: ServoState) -> None:
        if not -0.5 * pi <= servo.angle_rad <= 1.5 * pi:
            raise FeedbackImplausible(
                f"servo {servo.servo_id}: the count of its position ({servo.position_raw}) is off "
                f"by {abs(servo.angle_rad) / (2.0 * pi):.2f} turns, which no motion makes while "
                f"its torque is on: {_ADVICE}"
            )

    def _check_current(self, index: int, servo: ServoState) -> None:
        settings = self._settings
        model = settings.servos[index].servo_model
        most_a = min(
            _CURRENT_RESERVE * settings.current_max_a + _CURRENT_MORE_A,
            _CURRENT_RESERVE * model.stall_current_a,
        )
        if abs(servo.current_a) > most_a:
            raise FeedbackImplausible(
                f"servo {servo.servo_id}: it reports {servo.current_a:.2f} A, at most "
                f"{most_a:.2f} A are possible with current_max_a = {settings.current_max_a} A: "
                f"{_ADVICE}"
            )

    def _check_range(self, index: int, servo: ServoState, last_rad: float, *, loaded: bool) -> None:
        low_rad, high_rad = self._lowest_rad[index], self._highest_rad[index]
        # Fingers that a person left outside may be brought back in.
        if not low_rad <= last_rad <= high_rad or low_rad <= servo.angle_rad <= high_rad:
            return
        stands = f"its finger stands at {servo.angle_rad:.3f} rad"
        can = f"it can be from {low_rad:.3f} to {high_rad:.3f} rad"
        if loaded:
            raise PositionContradicted(
                f"servo {servo.servo_id}: {stands}, {can}, but the pads are loaded: something "
                f"pushes it, or its encoder drifts. {_GRIP_STAYS}"
            )
        self.strayed[servo.servo_id] = stands
        raise FeedbackImplausible(f"servo {servo.servo_id}: {stands}, {can}: {_ADVICE}")

    def _check_link(self, servo: ServoState) -> None:
        try:
            self._linkage.opening_per_rad_m(servo.angle_rad)
        except LimitExceeded as error:
            raise FeedbackImplausible(f"servo {servo.servo_id}: {error}. {_ADVICE}") from None
