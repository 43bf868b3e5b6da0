"""Feedback of the servos of one gripper in SI units, checked to be new and possible."""

from collections.abc import Callable
from math import inf
from typing import NamedTuple

from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    PRESENT_BLOCK,
    PRESENT_CURRENT,
    PRESENT_INPUT_VOLTAGE,
    PRESENT_POSITION,
    PRESENT_PWM,
    PRESENT_TEMPERATURE,
    REALTIME_TICK,
    TICK_MODULO,
)
from gripper.errors import BusCorrupt
from gripper.mechanics.kinematics import Linkage, transmissions
from gripper.servos.motion import ServoMotion
from gripper.servos.plausibility import FeedbackCheck
from gripper.servos.winding import Supply, WindingHeat, winding_a
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.state import ServoFeedback, ServoState

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
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        clock: Clock,
        check_torque: Callable[[int], None],
    ) -> None:
        self.last: ServoFeedback | None = None
        """The last feedback; None before the first reading."""
        self._bus = bus
        self._linkage = linkage
        self._settings = settings
        self._clock = clock
        self._check_torque = check_torque
        self._ids = [servo.servo_id for servo in settings.servos]
        self.turns: dict[int, int] = {}
        """Turns of each servo's count off that of its zero; empty before the first reading."""
        self._ticks = {servo_id: TickClock(servo_id) for servo_id in self._ids}
        self._heats = {one.servo_id: WindingHeat(one.servo_model) for one in settings.servos}
        self._supplies = {one.servo_id: Supply() for one in settings.servos}
        self._motions = {one.servo_id: ServoMotion(one.servo_model) for one in settings.servos}
        self.check = FeedbackCheck(settings, linkage)
        """Comparison with possible motion."""

    def read(self, *, under_torque: bool, loaded: bool) -> ServoFeedback:
        """Read the feedback of all servos in one transaction.

        Raises BusTimeout or BusCorrupt when an answer is missing, damaged or older than the
        request. Raises ServoFault when a servo has restarted under torque. Raises
        FeedbackImplausible or PositionContradicted as `FeedbackCheck.check`.

        Parameters
        ----------
        under_torque
            True while goals are in force: then the feedback must be possible.
        loaded
            Whether the pads may hold a part.
        """
        sent_s = self._clock.monotonic()
        raws = self._bus.sync_read(self._ids, PRESENT_BLOCK)
        now_s = self._clock.monotonic()
        for servo_id, raw in raws.items():
            problem = self._ticks[servo_id].check(raw[REALTIME_TICK.name], sent_s, now_s)
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
            [
                self._servo_state(one, raws[one.servo_id], now_s, under_torque=under_torque)
                for one in self._settings.servos
            ]
        )
        if under_torque:
            self.check.check(servos, now_s, loaded=loaded)
        self.last = self._gripper_state(servos, now_s)
        return self.last

    def forget(self) -> None:
        """Compare the next feedback with no earlier one: servos were restarted or switched off."""
        self.turns.clear()
        for servo_id in self._ids:
            self._ticks[servo_id].forget()
            self._motions[servo_id].forget()
        self.check.forget()

    def _servo_state(
        self, servo: ServoSettings, raw: dict[str, int], now_s: float, *, under_torque: bool
    ) -> ServoState:
        model, position_raw = servo.servo_model, raw[PRESENT_POSITION.name]
        # Under torque a servo cannot lose or gain a turn: a change is an error and must be found.
        turns = self.turns.setdefault(servo.servo_id, servo.turns(position_raw))
        angle_rad = servo.angle_rad(position_raw, turns)
        tick_ms = raw[REALTIME_TICK.name]
        motion = self._motions[servo.servo_id]
        speed_rad_s = motion.speed_rad_s(tick_ms, angle_rad)
        present_a = raw[PRESENT_CURRENT.name] * model.current_unit_a * servo.direction
        voltage_v = supply_v = raw[PRESENT_INPUT_VOLTAGE.name] * model.voltage_unit_v
        if model.supply_current:
            supply = self._supplies[servo.servo_id]
            supply_v = supply.steady_v(voltage_v, under_torque=under_torque)
        pwm_share = raw[PRESENT_PWM.name] / model.whole_pwm_raw * servo.direction
        current_a, motor_a = winding_a(model, present_a, pwm_share, supply_v, speed_rad_s)
        motor, heat = self.check.motors[servo.servo_id], self._heats[servo.servo_id]
        heat.add(now_s, current_a)
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
            temperature_c=float(raw[PRESENT_TEMPERATURE.name]),
            voltage_v=voltage_v,
            supply_v=supply_v,
            tick_ms=tick_ms,
            limit_a=heat.limit_a,
            alert=servo.servo_id in self._bus.alerts,
        )

    def _gripper_state(self, servos: tuple[ServoState, ...], now_s: float) -> ServoFeedback:
        linkage, n_servos = self._linkage, len(servos)
        angles_rad = [servo.angle_rad for servo in servos]
        opening_m_s = current_a = force_n = 0.0
        paths = transmissions(self._settings, linkage, angles_rad)
        for path, servo in zip(paths, servos, strict=True):
            opening_m_s += linkage.opening_per_rad_m(servo.angle_rad) * servo.velocity_rad_s
            current_a += abs(servo.current_a)
            force_n += path.force_band_n(abs(servo.current_a))[0]
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
        passed_s = ((tick_ms - self._tick_ms) % TICK_MODULO) * _TICK_S
        # A tick slightly back is a lag, not a turn of the modulo. One far back is a restart.
        if passed_s > TICK_MODULO * _TICK_S - _TICK_LATEST_S:
            passed_s -= TICK_MODULO * _TICK_S
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
