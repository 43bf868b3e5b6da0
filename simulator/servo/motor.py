"""Electromechanics of one simulated servo: control loops, winding current, heat.

The motor uses its output angle (rad, 0 at raw position 0, not limited to a turn). Torque at the
output is T = kt I - friction; `simulator.servo.mechanics` applies the friction and integrates the
motion. The duty, which a servo reports as its present PWM, is the voltage R I + k_e v over the
supply.

The position loop is a PID of the error in counts (e-Manual, Position PID Gain). In the position
modes its output is the PWM, so the back-EMF damps. In current-based position mode its output is a
current within Goal Current, so only the D gain damps. An X430 regulates the current of the winding.
The 330 size regulates and reports the current of the supply, which is duty times the current of the
winding, and limits the change of its voltage (PWM Slope). See Rhoban/bam, pull request 14.

Present Velocity is the difference of positions over a window, and a low-pass after it: on four
XM430-W350 it follows the position 48 to 50 ms late, on an XL330-M288 20 to 21 ms. Windows and
rounding are fits to logs of these servos (smorales2405/open_manipulator_x_torque_control,
Rhoban/bam): the XM430 drops the fraction of a count, the XL330 rounds.
"""

import itertools
import math
import random
from collections import deque
from collections.abc import Callable
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

from gripper.dynamixel.models import XM430_W350, OperatingMode, ServoModel
from simulator.clock import ROUNDING_S
from simulator.servo.control_table import is_x330
from simulator.servo.gearing import Drive, data_sheet, data_sheet_drive

CURRENT_LOOP_TIME_CONSTANT_S = 0.003
"""Time constant of the winding current in s; an assumption."""
AMBIENT_C = 25.0
"""Temperature of the surroundings in degC."""
THERMAL_TIME_CONSTANT_S = 300.0
"""Time constant in s of heating and cooling of the board, whose temperature a servo reports; an
assumption."""
WINDING_TIME_CONSTANT_S = 45.0
"""Time constant in s of the winding over the board; 30 to 60 s are assumed."""
RISE_AT_FIFTH_OF_STALL_C = 15.0
"""Final heating in K of the winding at a fifth of the stall current, the vendor's limit for steady
work."""
BOARD_SHARE = 0.4
"""Share of it that the board has: an XL330-M288 reported 11 K after 2 min at a current that heats
its winding by 40 K (Rhoban/bam)."""
_COPPER_PER_K = 0.0039
"""Growth of the winding's resistance for each K, as a share."""
OVERLOAD_DUTY = 0.30
"""Sustained loading duty of a servo (1 = stall at the present voltage); an assumption."""
_OVERLOAD_CURRENT = 0.25
"""Sustained measured current over that of the data sheet's stall: users report trips above 600 mA
(XM430, XC330) and 300 to 350 mA (XL330)."""
_OVERLOAD_PULSES, _OVERLOAD_BLOCKED, _OVERLOAD_BLOCKED_330 = 20, 0.18, 0.1
"""Position error in counts and share of the stall current of a motor that counts as blocked. A grip
with 0.40 A of an XM430 never tripped; an XL330 did with 16 mA of the supply, 0.15 A (LEAP_Hand_API,
issue 7)."""
OVERLOAD_BUDGET_S = 0.55
"""Excess of the load over its limit, integrated over time, at which the servo trips.

941 mA at stall trips an XM430-W350 after about 5 s; a fifth of the stall current never does.
"""
_BLOCKED_S = 5.0
"""Time in s after which a blocked motor trips, where the rule is the following error."""
_P_DIVISOR, _P_DIVISOR_X330 = 128.0, 256.0
"""Raw P gain of the position over the gain that acts: by the e-Manual, and on the 330 size by logs
of an XL330-M288 (Rhoban/bam)."""
_I_DIVISOR, _D_DIVISOR = 65536.0, 16.0
"""Raw I and D gain of the position over the gains that act (e-Manual, Position PID Gain)."""
_LOOP_S = 1e-3
"""Period in s of the position loop, whose sums and differences the I and D gain multiply; an
assumption. The D gain takes the true speed: a difference of counts would be rough."""
_LARGEST_OUTPUT = 32767.0
"""Bound of the integral part in counts of the loop's output; an assumption."""
_SLOPE_V_S = 1.977
"""V/s of one count of PWM Slope (e-Manual, register 62)."""
_VELOCITY_LOOP_A_S_RAD = 1.0
"""Gain of the velocity loop in A per rad/s; an assumption."""
_VELOCITY_LOOP_A_RAD = 20.0
"""Integral gain of the velocity loop in A per rad; an assumption."""
_LEAST_SUPPLY_V = 0.1
"""Smallest supply in V for the calculation of duty and load: avoids a division by zero."""


_WINDOW_S, _LOW_PASS_S = 0.064, 0.016
_WINDOW_X330_S, _LOW_PASS_X330_S = 0.032, 0.004
"""Length of the mean and time constant of the low-pass in s: X430 and alike, 330 size."""
_DITHER_SD = 0.25
"""Standard deviation of the encoder in counts: at rest a count changes in a quarter of the samples
of an XM430-W350 (16 to 41 %)."""
_N_DITHERS = 4099
"""Number of values of the dither before they repeat."""
_CURRENT_SD_A = ((0.1, 3.4e-3), (0.5, 7.2e-3), (math.inf, 13e-3))
"""Speed in rad/s up to which Present Current of an XM430-W350 has a standard deviation in A."""
_SUPPLY_SD = 0.8
"""Standard deviation of the supply of an XL330-M288 that holds, over supply and d² (1 - d) with its
duty d: 0.55 to 0.8 V of 7.3 V at a duty of 0.34 to 0.8, and nearly none at 0 and 1."""
_BEAT_RAD, _BEAT_SD_RAD = 1.16, 0.5
"""Phase of this ripple from one reading to the next, mean and spread: its readings have a peak at
either end, and follow each other with a correlation of 0.1 to 0.6."""


def whole_counts(model: ServoModel) -> Callable[[float], int]:
    """Return what makes whole counts of Present Velocity and Present Current, as logs show it.

    The 330 size rounds, an X430 cuts the fraction off.
    """
    return round if is_x330(model) else math.trunc


class VelocityRegister:
    """Velocity by the positions of the last moments, as the firmware of a model computes it."""

    def __init__(self, model: ServoModel, count: int) -> None:
        x330 = is_x330(model)
        self._window_s = _WINDOW_X330_S if x330 else _WINDOW_S
        self._low_pass_s = _LOW_PASS_X330_S if x330 else _LOW_PASS_S
        self._to_raw = whole_counts(model)
        self._rad_per_pulse, self._unit_rad_s = model.rad_per_pulse, model.velocity_unit_rad_s
        self._time_s = 0.0
        self._count = count
        # Count at the begin of the window, and later changes: time and new count.
        self._first = count
        self._changes: deque[tuple[float, int]] = deque()
        self._step_s = self._share = 0.0
        self._velocity_rad_s = 0.0

    @property
    def raw(self) -> int:
        """Content of the register."""
        return self._to_raw(self._velocity_rad_s / self._unit_rad_s)

    def step(self, count: int, dt_s: float) -> None:
        """Take the count of the encoder ``dt_s`` s after the count before."""
        if dt_s != self._step_s:
            self._step_s, self._share = dt_s, 1.0 - math.exp(-dt_s / self._low_pass_s)
        changes = self._changes
        now_s = self._time_s = self._time_s + dt_s
        if count != self._count:
            self._count = count
            changes.append((now_s, count))
        first_s = now_s - self._window_s + ROUNDING_S
        while changes and changes[0][0] <= first_s:
            _, self._first = changes.popleft()
        mean_rad_s = (count - self._first) * self._rad_per_pulse / self._window_s
        self._velocity_rad_s += (mean_rad_s - self._velocity_rad_s) * self._share


@lru_cache(maxsize=16)
def _dithers(seed: str) -> tuple[list[float], tuple[Any, ...]]:
    """Return deviations of the encoder in counts, and the state of the generator after them."""
    generator = random.Random(seed)
    return [generator.gauss(0.0, _DITHER_SD) for _ in range(_N_DITHERS)], generator.getstate()


class ServoNoise:
    """Noise of one servo's measurements, the same for the same seed and order of reads.

    Sizes are from logs: Present Current less Goal Current, counts at rest, and the supply of a
    servo that holds (see the module).
    """

    def __init__(self, seed: str) -> None:
        dithers, state = _dithers(seed)
        self._random = random.Random()
        self._random.setstate(state)
        self._phase_rad = 0.0
        self.dither = itertools.cycle(dithers).__next__
        """Returns the next deviation of the encoder in counts."""

    def current_a(self, velocity_rad_s: float) -> float:
        """Return the next deviation of an X430's current in A."""
        speed = abs(velocity_rad_s)
        return self._random.gauss(0.0, next(sd for most, sd in _CURRENT_SD_A if speed <= most))

    def voltage_v(self, supply_v: float, duty: float) -> float:
        """Return the next deviation of a 330 size's supply in V, at a duty of 0 to 1."""
        self._phase_rad += self._random.gauss(_BEAT_RAD, _BEAT_SD_RAD)
        sd_v = _SUPPLY_SD * supply_v * duty * duty * (1.0 - duty)
        return math.sqrt(2.0) * sd_v * math.sin(self._phase_rad)


FOLLOWS_POSITION = frozenset(
    {OperatingMode.POSITION, OperatingMode.EXTENDED_POSITION, OperatingMode.CURRENT_BASED_POSITION}
)
"""Modes with a position loop."""


class OverloadRule(Enum):
    """Load that the overload protection integrates; the vendor has published no rule."""

    DUTY = "duty"
    """Voltage of the winding over the supply."""
    CURRENT = "current"
    """Measured current."""
    FOLLOWING_ERROR = "following_error"
    """Position error of a motor with current, in the position modes."""


class DriveCommand(NamedTuple):
    """Command of the servo's firmware to its motor."""

    mode: int | None = None
    """Operating Mode; None: no torque."""
    current_a: float = 0.0
    """Current in A: set-point (CURRENT) or limit of the magnitude (CURRENT_BASED_POSITION)."""
    position_rad: float = 0.0
    """Goal of the position modes, rad."""
    velocity_rad_s: float = 0.0
    """Goal of VELOCITY, rad/s."""
    duty: float = 1.0
    """Set-point (PWM) or limit of the magnitude (all others), 1 = supply voltage."""
    p_gain: float = 0.0
    i_gain: float = 0.0
    d_gain: float = 0.0
    """Raw position gains."""
    slope_raw: int = 0
    """Content of PWM Slope; 0: the voltage may jump."""
    profile_velocity_rad_s: float = 0.0
    profile_acceleration_rad_s2: float = 0.0
    """Limits of the reference's motion towards the goal; 0 = none."""


class ServoMotor:
    """Motor, gear, winding and encoder of one servo.

    Parameters
    ----------
    model
        Electrical and torque figures.
    angle_rad
        Output angle at the start, rad.
    noise
        Noise of what the servo measures; None: exact measurements.
    """

    def __init__(
        self,
        model: ServoModel = XM430_W350,
        *,
        angle_rad: float = math.pi,
        figures: Drive | None = None,
        noise: ServoNoise | None = None,
    ) -> None:
        self.model, self._rad_per_pulse = model, model.rad_per_pulse
        self._noise, self._dither = noise, 0.0
        self.figures = drive = figures or data_sheet_drive(model)
        self._kt_nm_a, self._back_emf_v_s = drive.kt_nm_a, drive.back_emf_v_s
        self._friction = drive.friction
        self.breakaway = drive.breakaway
        """Friction at rest over that in motion."""
        self.inertia_kg_m2 = drive.inertia_kg_m2
        self.kt_factor = 1.0
        """Knob: torque and back-EMF of the motor over those of its model."""
        self.friction_factor = 1.0
        """Knob: friction without load over that of its model, including the viscous part."""
        self.voltage_v = data_sheet(model).voltage_v
        self._cold_ohm = self._resistance_ohm = drive.winding_ohm
        self._stall_a = data_sheet(model).stall_current_a
        self._of_supply = is_x330(model)
        share = _OVERLOAD_BLOCKED_330 if self._of_supply else _OVERLOAD_BLOCKED
        self._blocked_a = share * self._stall_a
        self._p_divisor = _P_DIVISOR_X330 if self._of_supply else _P_DIVISOR
        self._heat = RISE_AT_FIFTH_OF_STALL_C / (0.2 * self._stall_a) ** 2
        self._alpha_dt_s = self._alpha = 0.0
        self._integral_a = self._integral = self._error = 0.0
        self.angle_rad: float
        self.velocity_rad_s: float
        """True motion of the output, where the encoder is; set by the mechanics."""
        self.current_a = 0.0
        """Winding current, A, positive towards growing angles."""
        self.duty = 0.0
        """Applied voltage over supply voltage, -1 to 1."""
        self.temperature_c, self.winding_rise_k = AMBIENT_C, 0.0
        """Temperature of the board, and rise of the winding over it."""
        self.overload_rule = OverloadRule.DUTY
        self.reference_rad, self.reference_velocity_rad_s = angle_rad, 0.0
        """Angle and velocity of the profile now."""
        self.load_excess_s = 0.0
        """Integrated overload, trips at `OVERLOAD_BUDGET_S`."""
        self.stuck_at_rad: float | None = None
        """Angle of a stuck encoder in rad; None: the encoder works."""
        self.encoder_offset_rad = 0.0
        """Offset of the encoder from the true angle in rad."""
        self.command = DriveCommand()
        self.drive(self.command)
        self.place(angle_rad)

    def place(self, angle_rad: float) -> None:
        """Put the output at rest at an angle in rad; the encoder starts there."""
        self.angle_rad = angle_rad
        self.velocity_rad_s = 0.0
        self.velocity_register = VelocityRegister(self.model, self.sensed_count)
        """Velocity that the firmware computes from the counts."""

    @property
    def sensed_rad(self) -> float:
        """Angle that the encoder reports, rad."""
        true_rad = self.angle_rad if self.stuck_at_rad is None else self.stuck_at_rad
        return true_rad + self.encoder_offset_rad

    @property
    def sensed_count(self) -> int:
        """Count of the encoder, not limited to a turn."""
        if self.stuck_at_rad is not None:
            return math.floor(self.sensed_rad / self._rad_per_pulse + 0.5)
        angle_rad = self.angle_rad + self.encoder_offset_rad
        return math.floor(angle_rad / self._rad_per_pulse + 0.5 + self._dither)

    @property
    def kt_nm_a(self) -> float:
        """Torque of the motor at the output over its current in N.m/A."""
        return self._kt_nm_a * self.kt_factor

    @property
    def viscous_nm_s(self) -> float:
        """Viscous friction in N.m s/rad."""
        return self._friction.viscous_nm_s * self.friction_factor

    def friction_nm(self, driving_nm: float = 0.0, load_nm: float = 0.0) -> float:
        """Return friction in N.m at the present speed, without its viscous part.

        See `simulator.servo.gearing.Friction.torque_nm`.
        """
        return self._friction.torque_nm(
            driving_nm, load_nm, self.velocity_rad_s, self.friction_factor
        )

    def overload(self) -> None:
        """Use up the overload budget, as by a long stall."""
        self.load_excess_s = 2.0 * OVERLOAD_BUDGET_S

    def drive(self, command: DriveCommand) -> None:
        """Take a new command; a change of mode starts the profile at the motor's position."""
        if command.mode != self.command.mode:
            self.reference_rad = self.sensed_rad
            self.reference_velocity_rad_s = 0.0
            self._integral_a = self._integral = 0.0
        self.command = command
        self._limit_a, self._limit = abs(command.current_a), abs(command.duty)

    def measured_a(self) -> float:
        """Measure the current in A: of the winding, or of the supply (330 size)."""
        if self._of_supply:
            return abs(self.duty) * self.current_a
        if self._noise is None or self.command.mode is None:
            return self.current_a
        return self.current_a + self._noise.current_a(self.velocity_rad_s)

    def measured_v(self) -> float:
        """Measure the supply in V."""
        if self._noise is None or not self._of_supply:
            return self.voltage_v
        return self.voltage_v + self._noise.voltage_v(self.voltage_v, abs(self.duty))

    def torque_nm(self, dt_s: float) -> float:
        """Advance loops and winding by ``dt_s`` s and return kt I in N.m, without friction."""
        if self._noise is not None and not self._of_supply:
            self._dither = self._noise.dither()
        count = self.sensed_count
        self.velocity_register.step(count, dt_s)
        command = self.command
        if command.mode is None:
            self.current_a = 0.0
            self.duty = 0.0
            self._account(dt_s)
            return 0.0
        if dt_s != self._alpha_dt_s:
            self._alpha_dt_s = dt_s
            self._alpha = 1.0 - math.exp(-dt_s / CURRENT_LOOP_TIME_CONSTANT_S)
        supply_v = self.voltage_v if self.voltage_v > _LEAST_SUPPLY_V else _LEAST_SUPPLY_V
        back_emf_v = self._back_emf_v_s * self.kt_factor * self.velocity_rad_s
        goal_a, duty = self._demand(count, dt_s)
        limit = self._limit
        if goal_a is None or self._of_supply:
            if goal_a is not None:
                duty = self._duty_for_supply(goal_a, back_emf_v, supply_v)
            duty = limit if duty > limit else -limit if duty < -limit else duty
            if command.slope_raw:
                most = command.slope_raw * _SLOPE_V_S * dt_s / supply_v
                duty = min(max(duty, self.duty - most), self.duty + most)
            self.duty = duty
            goal_a = (duty * supply_v - back_emf_v) / self._resistance_ohm
            self.current_a += (goal_a - self.current_a) * self._alpha
        else:
            highest_a = (limit * supply_v - back_emf_v) / self._resistance_ohm
            lowest_a = (-limit * supply_v - back_emf_v) / self._resistance_ohm
            goal_a = highest_a if goal_a > highest_a else lowest_a if goal_a < lowest_a else goal_a
            self.current_a += (goal_a - self.current_a) * self._alpha
            duty = (self.current_a * self._resistance_ohm + back_emf_v) / supply_v
            self.duty = 1.0 if duty > 1.0 else -1.0 if duty < -1.0 else duty
        self._account(dt_s)
        return self._kt_nm_a * self.kt_factor * self.current_a

    def _demand(self, count: int, dt_s: float) -> tuple[float | None, float]:
        """Return the current in A that the mode asks for, or None and the duty."""
        command = self.command
        mode = command.mode
        if mode == OperatingMode.CURRENT_BASED_POSITION:
            goal_a = self._position_loop(count, dt_s) * self.model.current_unit_a
            limit_a = self._limit_a
            return limit_a if goal_a > limit_a else -limit_a if goal_a < -limit_a else goal_a, 0.0
        if mode == OperatingMode.CURRENT:
            return command.current_a, 0.0
        if mode == OperatingMode.VELOCITY:
            return self._velocity_loop(dt_s), 0.0
        if mode == OperatingMode.PWM:
            return None, command.duty
        return None, math.trunc(self._position_loop(count, dt_s)) / self.model.whole_pwm_raw

    def _position_loop(self, count: int, dt_s: float) -> float:
        """Return the output of the position loop in counts of PWM or Goal Current."""
        command = self.command
        if command.profile_velocity_rad_s > 0.0:
            self._advance_reference(dt_s)
        else:
            self.reference_rad, self.reference_velocity_rad_s = command.position_rad, 0.0
        rad_per_pulse = self._rad_per_pulse
        error = self._error = self.reference_rad / rad_per_pulse - count
        output = command.p_gain / self._p_divisor * error
        if command.d_gain and self.stuck_at_rad is None:
            moved = self.velocity_rad_s * _LOOP_S / rad_per_pulse
            output -= command.d_gain / _D_DIVISOR * moved
        if command.i_gain:
            integral = self._integral + command.i_gain / _I_DIVISOR * error * dt_s / _LOOP_S
            self._integral = min(max(integral, -_LARGEST_OUTPUT), _LARGEST_OUTPUT)
            output += self._integral
        return output

    def _duty_for_supply(self, goal_a: float, back_emf_v: float, supply_v: float) -> float:
        """Return the duty d at which the supply gives a current, goal = d (d V - emf) / R."""
        if goal_a == 0.0:
            return back_emf_v / supply_v
        square = back_emf_v * back_emf_v + 4.0 * supply_v * self._resistance_ohm * abs(goal_a)
        return (back_emf_v + math.copysign(math.sqrt(square), goal_a)) / (2.0 * supply_v)

    def _account(self, dt_s: float) -> None:
        """Update temperature and overload budget."""
        current_a = self.current_a
        final_k = (1.0 - BOARD_SHARE) * self._heat * current_a * current_a
        self.winding_rise_k += (final_k - self.winding_rise_k) * (dt_s / WINDING_TIME_CONSTANT_S)
        board_c = AMBIENT_C + BOARD_SHARE / (1.0 - BOARD_SHARE) * self.winding_rise_k
        self.temperature_c += (board_c - self.temperature_c) * (dt_s / THERMAL_TIME_CONSTANT_S)
        hot_k = self.temperature_c + self.winding_rise_k - AMBIENT_C
        self._resistance_ohm = self._cold_ohm * (1.0 + _COPPER_PER_K * hot_k)
        # Load over its limit; below 0 the servo recovers.
        current_a = current_a if current_a > 0.0 else -current_a
        if self.overload_rule is OverloadRule.DUTY:
            supply_v = self.voltage_v if self.voltage_v > _LEAST_SUPPLY_V else _LEAST_SUPPLY_V
            over = current_a * self._resistance_ohm / supply_v - OVERLOAD_DUTY
        elif self.overload_rule is OverloadRule.CURRENT:
            measured_a = abs(self.duty) * current_a if self._of_supply else current_a
            over = measured_a / self._stall_a - _OVERLOAD_CURRENT
        else:
            follows = self.command.mode in FOLLOWS_POSITION
            loaded = current_a > self._blocked_a
            blocked = follows and loaded and abs(self._error) > _OVERLOAD_PULSES
            over = OVERLOAD_BUDGET_S / _BLOCKED_S if blocked else -OVERLOAD_DUTY
        excess_s = self.load_excess_s + over * dt_s
        self.load_excess_s = excess_s if excess_s > 0.0 else 0.0

    def _velocity_loop(self, dt_s: float) -> float:
        velocity_rad_s = self.velocity_rad_s if self.stuck_at_rad is None else 0.0
        error = self.command.velocity_rad_s - velocity_rad_s
        bound_a = self._stall_a
        integral_a = self._integral_a + _VELOCITY_LOOP_A_RAD * error * dt_s
        self._integral_a = min(max(integral_a, -bound_a), bound_a)
        return _VELOCITY_LOOP_A_S_RAD * error + self._integral_a

    def _advance_reference(self, dt_s: float) -> None:
        """Move the reference towards the goal within the profile's velocity and acceleration."""
        command = self.command
        speed = fastest = command.profile_velocity_rad_s
        left = command.position_rad - self.reference_rad
        if command.profile_acceleration_rad_s2 > 0.0:
            gain = command.profile_acceleration_rad_s2
            along = math.copysign(self.reference_velocity_rad_s, left)
            along = along if self.reference_velocity_rad_s * left >= 0.0 else 0.0
            speed = min(fastest, abs(along) + gain * dt_s, math.sqrt(2.0 * gain * abs(left)))
        if speed * dt_s >= abs(left):
            self.reference_rad, self.reference_velocity_rad_s = command.position_rad, 0.0
            return
        self.reference_velocity_rad_s = math.copysign(speed, left)
        self.reference_rad += self.reference_velocity_rad_s * dt_s
