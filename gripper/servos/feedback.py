"""Feedback of the servos of one gripper in SI units, checked to be new and possible.

Under torque it is compared with possible motion. Position is the measurement of motion. A second
one comes from the motor alone: the voltage on its winding is R i + k_e w, so that voltage and
current show the speed w without the encoder.
"""

from collections import deque
from collections.abc import Callable
from math import copysign, hypot, inf, pi
from typing import NamedTuple

from gripper.clock import Clock
from gripper.dynamixel import control_table as ct
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.drive import SIGMAS
from gripper.dynamixel.models import ServoModel
from gripper.errors import (
    BusCorrupt,
    FeedbackImplausible,
    GripContradicted,
    LimitExceeded,
    PositionContradicted,
)
from gripper.mechanics.transmission import Mechanics
from gripper.servos.motion import ServoMotion
from gripper.servos.winding import Supply, WindingHeat, winding_a
from gripper.settings import ServoSettings
from gripper.values.state import ServoFeedback, ServoState

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
_BORDER_RAD = 0.01
"""Distance in rad from a limit at which a finger is surely inside or outside. [chosen]"""
_CURRENT_RESERVE = 1.5
"""Largest possible current in multiples of its cap and of the stall current: regulation, noise."""
_CURRENT_MORE_A = 0.3
"""Current in A added to the multiple of the cap: at a low cap the regulation overshoots by more."""

_GRIP_STAYS = (
    "The goals are frozen and the grip kept. Look at the part, check encoder, horn and linkage, "
    "then clear the fault and release"
)
_LETTING_GO = (
    "The fingers stopped while letting go. Take the part out by hand, check encoder, horn and "
    "linkage, then clear the fault with a reboot"
)
_ADVICE = (
    "the position of the finger is unknown. The torque is switched off, and a held part may have "
    "dropped. Check encoder, horn and linkage before clearing the fault"
)
_COMPARED_S, _UNSEEN_RAD = 0.1, 0.01
"""Time in s over which the travels of motor and position are compared, and the difference in rad
beyond their errors that is a contradiction: backlash, time between the readings. [chosen]"""
_UNSEEN_FREE_RAD = 0.3
"""That difference in a release with free pads: it goes on, but no finger runs to its stop.
[chosen]"""
_PAUSE_S = 0.025
"""Time in s between two readings above which voltage and current between them are unknown: after
two periods at 100 Hz the motor may have stopped meanwhile. [chosen]"""
_SUPPLY_SD = 0.05
"""Error of the supply's voltage and of the current by it, as a share, on the 330 size. [assumed]"""
_VOLTAGE_SD_V, _RESISTANCE, _RESISTANCE_SD = 0.02, 1.15, 0.13
"""Error of a voltage in V; mean of the winding's resistance over that of the model, and its spread
as a share: units differ by 10 %, and copper that is 80 K warmer adds 31 %. [assumed]"""
_MEASURED_SD, _MEASURED_S = 0.05, 20.0
"""Error of a measured resistance as a share, 13 K, and time in s for which it counts. [assumed]"""


class MotorTravel:
    """Travel of one servo by voltage and current of its motor, V = R i + k_e w, without encoder.

    R is measured at each rest on a part with enough current. Without a recent measurement it has
    the spread of the model and of its heat; k_e always has the spread of the model. The current is
    that of Present Current: one by the duty would follow the voltage.
    """

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        # k_e in V s/rad, and its largest error as a share.
        self._back_emf_v_s = model.back_emf_v_s
        self._back_emf_error = SIGMAS * hypot(model.kt_sd, model.back_emf_sd)
        self._usual_ohm = _RESISTANCE * model.winding_ohm
        self._supply_sd = _SUPPLY_SD if model.supply_current else 0.0
        self._sums: deque[_Sums] = deque()
        self.forget()

    def forget(self) -> None:
        """Discard what was measured: the motor may be another one."""
        self._ohm, self._ohm_sd, self._measured_s = self._usual_ohm, _RESISTANCE_SD, -inf
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
        if now_s - self._measured_s > _MEASURED_S:
            self._ohm, self._ohm_sd = self._usual_ohm, _RESISTANCE_SD
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
            ohm = volt_s / amp_s
            if abs(ohm - self._usual_ohm) <= SIGMAS * _RESISTANCE_SD * self._usual_ohm:
                self._ohm, self._ohm_sd, self._measured_s = ohm, _MEASURED_SD, now_s

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

    def __init__(self, mechanics: Mechanics) -> None:
        settings, linkage = mechanics.settings, mechanics.linkage
        self.strayed: dict[int, str] = {}
        """Servos whose position has leapt or left its range, with the reason. Where their fingers
        are is unknown until they are restarted."""
        self.motors = {servo.servo_id: MotorTravel(servo.servo_model) for servo in settings.servos}
        """Travel of each servo by its motor."""
        self.letting_go = False
        """Whether a part is let go. While the pads are loaded no contradiction may end it."""
        self._settings, self._linkage = settings, linkage
        self._lowest_rad = tuple(
            angle - max(_BEYOND_CLOSED_RAD, BEYOND_CLOSED_M / linkage.opening_per_rad_m(angle))
            for angle in linkage.angles_rad(0.0)
        )
        self._highest_rad = tuple(
            angle + _BEYOND_OPEN_RAD for angle in linkage.angles_rad(settings.aperture_open_m)
        )
        self._last: dict[int, tuple[float, float]] = {}
        self._inside: set[int] = set()
        """Indexes of the servos inside their range when they were last far from its ends."""

    def forget(self) -> None:
        """Compare the next feedback with no earlier one."""
        self._last.clear()
        self._inside.clear()
        for motor in self.motors.values():
            motor.forget()

    def check(self, servos: tuple[ServoState, ...], now_s: float, *, loaded: bool) -> None:
        """Check the feedback of one transaction.

        Raises FeedbackImplausible where a finger has leapt, or its position or current is
        impossible. Raises PositionContradicted where it has moved steadily, but not as its motor,
        or to where only a load on the pads explains it, and GripContradicted where only the current
        is impossible and the pads are loaded; not while a loaded part is let go.

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
            self._check_current(index, servo, loaded=loaded)
            self._check_turn(servo)
            last_s, last_rad = self._last.get(servo.servo_id, (-inf, servo.angle_rad))
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
            self._last[servo.servo_id] = (now_s, servo.angle_rad)
            if last_s == -inf:
                continue
            motor = self.motors[servo.servo_id]
            if self.letting_go and loaded:
                motor.pause()
                continue
            if not self.letting_go:
                self._check_range(index, servo, last_rad, loaded=loaded)
            motor.push(servo, now_s, loaded=loaded)
            most_rad = _UNSEEN_FREE_RAD if self.letting_go else _UNSEEN_RAD
            if (apart_rad := motor.unseen_rad) > most_rad:
                motor.forget()
                advice = _LETTING_GO if self.letting_go else _GRIP_STAYS
                raise PositionContradicted(
                    f"servo {servo.servo_id}: the travels by its encoder and by voltage and "
                    f"current of its motor differ by {apart_rad:.3f} rad, at most {most_rad} "
                    f"rad are possible: one of them is stuck or drifts. {advice}"
                )

    def _check_turn(self, servo: ServoState) -> None:
        if not -0.5 * pi <= servo.angle_rad <= 1.5 * pi:
            raise FeedbackImplausible(
                f"servo {servo.servo_id}: the count of its position ({servo.position_raw}) is off "
                f"by {abs(servo.angle_rad) / (2.0 * pi):.2f} turns, which no motion makes while "
                f"its torque is on: {_ADVICE}"
            )

    def _check_current(self, index: int, servo: ServoState, *, loaded: bool) -> None:
        settings = self._settings
        model = settings.servos[index].servo_model
        most_a = min(
            _CURRENT_RESERVE * settings.current_max_a + _CURRENT_MORE_A,
            _CURRENT_RESERVE * model.stall_current_a,
        )
        if abs(servo.current_a) <= most_a or (self.letting_go and loaded):
            return
        reports = (
            f"servo {servo.servo_id}: it reports {servo.current_a:.2f} A, at most {most_a:.2f} A "
            f"are possible with current_max_a = {settings.current_max_a} A"
        )
        if not loaded:
            raise FeedbackImplausible(f"{reports}: {_ADVICE}")
        raise GripContradicted(
            f"{reports}. The goals are frozen and the grip kept. Look at the part, check the servo "
            "and its supply, then clear the fault and release"
        )

    def _check_range(self, index: int, servo: ServoState, last_rad: float, *, loaded: bool) -> None:
        low_rad, high_rad = self._lowest_rad[index], self._highest_rad[index]
        # Fingers that a person left outside may be brought back in; at the border they jitter.
        if low_rad + _BORDER_RAD <= last_rad <= high_rad - _BORDER_RAD:
            self._inside.add(index)
        elif not low_rad - _BORDER_RAD <= last_rad <= high_rad + _BORDER_RAD:
            self._inside.discard(index)
        if index not in self._inside or low_rad <= servo.angle_rad <= high_rad:
            return
        stands = f"its finger stands at {servo.angle_rad:.3f} rad"
        can = f"it can be from {low_rad:.3f} to {high_rad:.3f} rad"
        if loaded:
            self._inside.discard(index)  # reported once: a grip that is kept is still controlled
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


_TICK_S = 1e-3
"""One count of Realtime Tick (register 120) in s."""
_TICK_LAG_S = 0.002
"""Age in s from which an answer counts as old: twice the resolution of the tick."""
_TICK_LEAD_S = 0.004
"""Tolerance in s of the progress of a tick: its resolution, and the age of the previous answer."""
_TICK_RATE_ERROR = 0.03
"""Tolerance of the rate of a servo's clock; the e-Manual gives no value."""
_LEAST_RATE, _LARGEST_RATE = 1.0 / (1.0 + _TICK_RATE_ERROR), 1.0 / (1.0 - _TICK_RATE_ERROR)
"""Possible ratios of the host's time to a servo's time: least and largest."""
_TICK_RATE_TIME_S = 5.0
"""Shortest time in s over which the rate of a servo's clock is measured, once it has run so long.
An error of 5 ms at the ends is 0.1 % of it."""
_TICK_PAUSE_S = 0.1
"""Pause in s after which the tolerance of the clock alone bounds a tick."""
_TICK_LONGEST_S = 10.0
"""Pause in s after which ticks are not compared. It is shorter than the modulo of 32.8 s."""
_TICK_LATEST_S = 0.5
"""Limit in s for a tick that goes back: less is an old answer, more is a restarted servo."""


class Feedback:
    """Reader of the feedback of all servos.

    Parameters
    ----------
    check_torque
        Called with the ID of a servo that seems to have restarted; raises if it has no torque.
    """

    def __init__(
        self, bus: ServoBus, mechanics: Mechanics, clock: Clock, check_torque: Callable[[int], None]
    ) -> None:
        settings = mechanics.settings
        self.last: ServoFeedback | None = None
        """The last feedback; None before the first reading."""
        self._bus, self._mechanics, self._clock = bus, mechanics, clock
        self._settings = settings
        self._check_torque = check_torque
        self._ids = [servo.servo_id for servo in settings.servos]
        self.turns: dict[int, int] = {}
        """Turns of each servo's count off that of its zero; empty before the first reading."""
        self._ticks = {servo_id: TickClock(servo_id) for servo_id in self._ids}
        self._heats = {servo.servo_id: WindingHeat(servo.servo_model) for servo in settings.servos}
        self._supplies = {servo.servo_id: Supply() for servo in settings.servos}
        self._temperatures_c: dict[int, float] = {}
        self._moves = {servo.servo_id: ServoMotion(servo.servo_model) for servo in settings.servos}
        self.check = FeedbackCheck(mechanics)
        """Comparison with possible motion."""

    def read(self, *, under_torque: bool, loaded: bool) -> ServoFeedback:
        """Read the feedback of all servos; a second time where an answer is impossible.

        One wrong answer must not let a part drop. Raises BusTimeout or BusCorrupt when an answer is
        missing, damaged or older than the request. Raises ServoFault when a servo has restarted
        under torque. Raises FeedbackImplausible, PositionContradicted or GripContradicted as
        `FeedbackCheck.check`.

        Parameters
        ----------
        under_torque
            True while goals are in force: then the feedback must be possible.
        loaded
            Whether the pads may hold a part.
        """
        strayed, turns = dict(self.check.strayed), dict(self.turns)
        try:
            return self._read(under_torque=under_torque, loaded=loaded)
        except (FeedbackImplausible, GripContradicted):
            self.check.strayed, self.turns = strayed, turns
            for motion in self._moves.values():
                motion.withdraw()
        return self._read(under_torque=under_torque, loaded=loaded)

    def _read(self, *, under_torque: bool, loaded: bool) -> ServoFeedback:
        """Read the feedback of all servos in one transaction; arguments and errors as `read`."""
        sent_s = self._clock.monotonic()
        raws = self._bus.sync_read(self._ids, ct.PRESENT_BLOCK)
        now_s = self._clock.monotonic()
        for servo_id, raw in raws.items():
            problem = self._ticks[servo_id].check(raw[ct.REALTIME_TICK.name], sent_s, now_s)
            if problem is not None:
                try:
                    # An old answer has another length, so it cannot pass for this one.
                    if under_torque:
                        self._check_torque(servo_id)
                finally:
                    self._bus.expect_late_answer()
                raise problem
        if not under_torque:
            self.turns.clear()
        servos = tuple(
            self._servo_state(servo, raws[servo.servo_id], now_s, under_torque=under_torque)
            for servo in self._settings.servos
        )
        if under_torque:
            self.check.check(servos, now_s, loaded=loaded)
        self.last = self._gripper_state(servos, now_s)
        return self.last

    def forget(self) -> None:
        """Compare the next feedback with no earlier one: servos were restarted or switched off."""
        self.turns.clear()
        self._temperatures_c.clear()
        for servo_id in self._ids:
            self._ticks[servo_id].forget()
            self._moves[servo_id].forget()
        self.check.forget()

    def _servo_state(
        self, servo: ServoSettings, raw: dict[str, int], now_s: float, *, under_torque: bool
    ) -> ServoState:
        model, position_raw = servo.servo_model, raw[ct.PRESENT_POSITION.name]
        # Under torque a servo cannot lose or gain a turn: a change is an error and must be found.
        turns = self.turns.setdefault(servo.servo_id, servo.turns(position_raw))
        angle_rad = servo.angle_rad(position_raw, turns)
        tick_ms = raw[ct.REALTIME_TICK.name]
        motion = self._moves[servo.servo_id]
        speed_rad_s = motion.speed_rad_s(tick_ms, angle_rad)
        present_a = raw[ct.PRESENT_CURRENT.name] * model.current_unit_a * servo.direction
        voltage_v = supply_v = raw[ct.PRESENT_INPUT_VOLTAGE.name] * model.voltage_unit_v
        if model.supply_current:
            supply = self._supplies[servo.servo_id]
            supply_v = supply.steady_v(voltage_v, under_torque=under_torque)
        pwm_share = raw[ct.PRESENT_PWM.name] / model.whole_pwm_raw * servo.direction
        current_a, motor_a = winding_a(model, present_a, pwm_share, supply_v, speed_rad_s)
        motor, heat = self.check.motors[servo.servo_id], self._heats[servo.servo_id]
        heat.add(now_s, current_a)
        # One wrong reading must not end a grasp: two in a row count.
        temperature_c = float(raw[ct.PRESENT_TEMPERATURE.name])
        before_c = self._temperatures_c.get(servo.servo_id, temperature_c)
        self._temperatures_c[servo.servo_id] = temperature_c
        return ServoState(
            servo_id=servo.servo_id,
            angle_rad=angle_rad,
            velocity_rad_s=speed_rad_s,
            next_rad_s=motion.next_rad_s,
            current_a=current_a,
            motor_a=motor_a,
            pwm_share=pwm_share,
            motor_rad_s=motor.least_rad_s(pwm_share * supply_v, motor_a),
            position_raw=position_raw,
            temperature_c=min(temperature_c, before_c),
            voltage_v=voltage_v,
            supply_v=supply_v,
            tick_ms=tick_ms,
            limit_a=heat.limit_a,
            alert=servo.servo_id in self._bus.alerts,
        )

    def _gripper_state(self, servos: tuple[ServoState, ...], now_s: float) -> ServoFeedback:
        linkage, n_servos = self._mechanics.linkage, len(servos)
        angles_rad = [servo.angle_rad for servo in servos]
        opening_m_s = current_a = force_n = 0.0
        paths = self._mechanics.transmissions(angles_rad)
        for path, servo in zip(paths, servos, strict=True):
            opening_m_s += linkage.opening_per_rad_m(servo.angle_rad) * servo.velocity_rad_s
            current_a += abs(servo.current_a)
            force_n += path.loaded_n(abs(servo.current_a))
        return ServoFeedback(
            t_s=now_s,
            aperture_m=linkage.aperture_m(angles_rad),
            aperture_velocity_m_s=opening_m_s,
            current_a=current_a / n_servos,
            force_from_current_n=force_n / n_servos,
            temperature_c=max([servo.temperature_c for servo in servos]),
            voltage_v=min([servo.voltage_v for servo in servos]),
            servos=servos,
        )


class TickClock:
    """Latest possible time of a servo's tick (register 120) on the host's clock.

    An answer that was made before its request is an old answer. A tick that has jumped shows that
    the servo has restarted.

    An answer is made before it is received. The least difference between host and tick so far,
    continued at the largest possible rate, bounds the age of each later answer. At first the
    tolerance of a servo's clock bounds the rate, later the ticks of the last seconds. This follows
    a drift. While answers are refused as old, the most likely rate is used, so a lasting lag is
    never accepted.
    """

    def __init__(self, servo_id: int) -> None:
        self._servo_id = servo_id
        self.forget()

    def forget(self) -> None:
        """Compare the next tick with no earlier one, after the servo was restarted on purpose."""
        self._begin(0, -inf, -inf)

    def _begin(self, tick_ms: int, sent_s: float, received_s: float) -> None:
        self._sent_s = sent_s
        self._tick_ms, self._tick_s = tick_ms, 0.0
        self._latest_s = received_s
        self._rate = _LARGEST_RATE
        self._mark = self._next_mark = TickMark(0.0, sent_s, received_s)

    def check(self, tick_ms: int, sent_s: float, received_s: float) -> BusCorrupt | None:
        """Return the problem of an answer, None when it is new.

        Parameters
        ----------
        tick_ms
            Its tick in ms, modulo 32768.
        sent_s, received_s
            Host's time before the request and after the answer in s.
        """
        most_s = received_s - self._sent_s
        if most_s > _TICK_LONGEST_S:
            self._begin(tick_ms, sent_s, received_s)
            return None
        passed_s = ((tick_ms - self._tick_ms) % ct.TICK_MODULO) * _TICK_S
        # A tick slightly back is a lag, not a turn of the modulo. One far back is a restart.
        if passed_s > ct.TICK_MODULO * _TICK_S - _TICK_LATEST_S:
            passed_s -= ct.TICK_MODULO * _TICK_S
        if passed_s > most_s * (1.0 + _TICK_RATE_ERROR) + _TICK_LEAD_S:
            self._begin(tick_ms, sent_s, received_s)
            return BusCorrupt(
                f"the tick of servo {self._servo_id} moved by {passed_s * 1e3:.0f} ms while at "
                f"most {most_s * 1e3:.0f} ms passed: the servo has restarted"
            )
        # After a pause the bound need not be sharp.
        self._latest_s += passed_s * (_LARGEST_RATE if passed_s > _TICK_PAUSE_S else self._rate)
        self._tick_ms = tick_ms
        self._tick_s += passed_s
        old_s = sent_s - self._latest_s
        if old_s > _TICK_LAG_S:
            likely = self._mark.rate(self._tick_s, self._latest_s - self._mark.latest_s + _TICK_S)
            self._rate = min(self._rate, likely)
            return BusCorrupt(
                f"an old answer of servo {self._servo_id}: by its tick it is at least "
                f"{old_s * 1e3:.0f} ms older than the request; something on the line delays or "
                f"repeats answers"
            )
        self._latest_s = min(self._latest_s, received_s)
        self._sent_s = sent_s
        if self._tick_s - self._next_mark.tick_s >= _TICK_RATE_TIME_S:
            self._mark = self._next_mark
            self._next_mark = TickMark(self._tick_s, sent_s, self._latest_s)
        # Both ends may be off by the allowed age of an answer.
        host_s = received_s - self._mark.sent_s + 2.0 * _TICK_LAG_S
        self._rate = self._mark.rate(self._tick_s, host_s)
        return None


class TickMark(NamedTuple):
    """Answer from which the rate of a servo's clock is measured."""

    tick_s: float
    """Progress of the tick since the first answer in s."""
    sent_s: float
    latest_s: float
    """Host's time before its request, and the latest host's time of its tick, in s."""

    def rate(self, tick_s: float, host_s: float) -> float:
        """Return host seconds per servo second since the mark, limited to possible values."""
        ticks_s = tick_s - self.tick_s
        if ticks_s <= 0.0:
            return _LARGEST_RATE
        return min(_LARGEST_RATE, max(_LEAST_RATE, host_s / ticks_s))
