"""Electromechanics of one simulated servo: control loops, winding current, heat.

The motor uses its output angle (rad, 0 at raw position 0, not limited to a turn). Torque at the
output is T = kt I - friction; `simulator.servo.mechanics` applies the friction and integrates the
motion. The duty, which a servo reports as its present PWM, is the voltage R I + k_e v over the
supply. The position loop follows the figure of the e-Manual: a gain of P/128 in counts of PWM for
each count of position. The winding resistance makes a current of it, and the back-EMF damps it.
Integral and feed-forward gains have no effect here. A `simulator.servo.gearing.Gearing` has
friction, backlash and ripple of the torque; the default is ideal.
"""

import math
from enum import IntEnum
from typing import NamedTuple

from gripper.dynamixel.models import XM430_W350, ServoModel
from simulator.errors import SimulatorSettingsError
from simulator.servo.gearing import IDEAL_GEARING, Gearing

CURRENT_LOOP_TIME_CONSTANT_S = 0.003
"""Time constant of the winding current in s; an assumption."""
AMBIENT_C = 25.0
"""Temperature of the surroundings in degC."""
THERMAL_TIME_CONSTANT_S = 300.0
"""Time constant in s of heating and cooling; an assumption."""
RISE_AT_FIFTH_OF_STALL_C = 15.0
"""Final heating in K at a fifth of the stall current, the vendor's limit for steady work."""
OVERLOAD_DUTY = 0.30
"""Sustained loading duty of a servo (1 = stall at the present voltage); an assumption."""
OVERLOAD_BUDGET_S = 0.55
"""Excess of the loading duty over OVERLOAD_DUTY, integrated over time, at which the servo trips.

941 mA at stall trips an XM430-W350 after about 5 s; a fifth of the stall current never does.
"""
_D_GAIN_DIVISOR = 16.0
"""Raw D gain of the position over the gain that acts (e-Manual, Position PID Gain)."""
_D_GAIN_PERIOD_S = 1e-3
"""Period in s of the position loop whose differences the D gain multiplies; an assumption."""
_VELOCITY_LOOP_A_S_RAD = 1.0
"""Gain of the velocity loop in A per rad/s; an assumption."""
_VELOCITY_LOOP_A_RAD = 20.0
"""Integral gain of the velocity loop in A per rad; an assumption."""
COLD_FRICTION_PER_K = 0.025
"""Growth of friction without load for each K below `AMBIENT_C`, as a share: grease thickens; an
assumption. A servo warms with `THERMAL_TIME_CONSTANT_S`."""
_LEAST_SUPPLY_V = 0.1
"""Smallest supply in V for the calculation of duty and load: avoids a division by zero."""


class DriveMode(IntEnum):
    """Quantity that the motor regulates."""

    OFF = 0
    CURRENT = 1
    VELOCITY = 2
    POSITION = 3
    CURRENT_POSITION = 4
    PWM = 5


class DriveCommand(NamedTuple):
    """Command of the servo's firmware to its motor."""

    mode: DriveMode = DriveMode.OFF
    """What is regulated."""
    current_a: float = 0.0
    """Set-point (CURRENT) or limit of the magnitude (CURRENT_POSITION), A."""
    position_rad: float = 0.0
    """Goal of the position modes, rad."""
    velocity_rad_s: float = 0.0
    """Goal of VELOCITY, rad/s."""
    duty: float = 1.0
    """Set-point (PWM) or limit of the magnitude (all others), 1 = supply voltage."""
    p_gain: float = 0.0
    d_gain: float = 0.0
    """Raw position gains."""
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
    """

    def __init__(
        self,
        model: ServoModel = XM430_W350,
        *,
        angle_rad: float = math.pi,
        gearing: Gearing = IDEAL_GEARING,
    ) -> None:
        if not math.isfinite(angle_rad):
            raise SimulatorSettingsError(f"the angle of a motor is finite, got {angle_rad} rad")
        self.model = model
        self.gearing = gearing
        drive = gearing.drive_of(model)
        self._kt_nm_a, self._back_emf_v_s = drive.kt_nm_a, drive.back_emf_v_s
        self._friction = drive.friction
        self.inertia_kg_m2 = drive.inertia_kg_m2
        self.kt_factor = 1.0
        """Knob: torque and back-EMF of the motor over those of its model."""
        self.friction_factor = 1.0
        """Knob: friction without load over that of its model, including the viscous part."""
        self.wear_per_turn = 0.0
        """Knob: growth of this friction in each turn of the output, as a share."""
        self.worn = 0.0
        """Growth of the friction so far, as a share."""
        self.voltage_v = model.nominal_voltage_v
        self._resistance_ohm = model.winding_ohm
        count_a = model.stall_current_a / model.whole_pwm_raw / model.rad_per_pulse
        self._p_current = count_a / model.error_per_pwm
        self._d_current = count_a / _D_GAIN_DIVISOR * _D_GAIN_PERIOD_S
        self._heat = RISE_AT_FIFTH_OF_STALL_C / (0.2 * model.stall_current_a) ** 2
        self._alpha_dt_s = 0.0
        self._alpha = 0.0
        self._integral_a = 0.0
        self.angle_rad = angle_rad
        self.velocity_rad_s = 0.0
        """True motion of the output, where the encoder is; set by the mechanics."""
        self.lead_rad = 0.0
        self.rotor_velocity_rad_s = 0.0
        """Lead of the motor over the output within the backlash, from -1/2 to 1/2 of it, and the
        velocity of the motor; set by the mechanics."""
        self.current_a = 0.0
        """Winding current, A, positive towards growing angles."""
        self.duty = 0.0
        """Applied voltage over supply voltage, -1 to 1."""
        self.temperature_c = AMBIENT_C
        self.reference_rad = angle_rad
        self.reference_velocity_rad_s = 0.0
        """Angle and velocity of the profile now."""
        self.load_excess_s = 0.0
        """Integrated overload, trips at `OVERLOAD_BUDGET_S`."""
        self.stuck_at_rad: float | None = None
        """Angle of a stuck encoder in rad; None: the encoder works."""
        self.encoder_offset_rad = 0.0
        """Offset of the encoder from the true angle in rad."""
        self.command = DriveCommand()

    @property
    def sensed_rad(self) -> float:
        """Angle that the encoder reports, rad."""
        true_rad = self.angle_rad if self.stuck_at_rad is None else self.stuck_at_rad
        return true_rad + self.encoder_offset_rad

    @property
    def sensed_velocity_rad_s(self) -> float:
        """Velocity from the encoder in rad/s."""
        return self.velocity_rad_s if self.stuck_at_rad is None else 0.0

    @property
    def kt_nm_a(self) -> float:
        """Torque of the motor at the output over its current in N.m/A."""
        return self._kt_nm_a * self.kt_factor

    @property
    def no_load_factor(self) -> float:
        """Friction without load over that of a new, warm servo of its kind."""
        cold_k = AMBIENT_C - self.temperature_c
        cold = 1.0 + COLD_FRICTION_PER_K * cold_k if cold_k > 0.0 else 1.0
        return self.friction_factor * (1.0 + self.worn) * cold

    @property
    def viscous_nm_s(self) -> float:
        """Viscous friction in N.m s/rad."""
        return self._friction.viscous_nm_s * self.no_load_factor

    def friction_nm(self, driving_nm: float = 0.0, load_nm: float = 0.0) -> float:
        """Return friction in N.m at the present speed, without its viscous part.

        See `simulator.servo.gearing.Friction.torque_nm`.
        """
        return self._friction.torque_nm(
            driving_nm, load_nm, self.velocity_rad_s, self.no_load_factor
        )

    def overload(self) -> None:
        """Use up the overload budget, as by a long stall."""
        self.load_excess_s = 2.0 * OVERLOAD_BUDGET_S

    def drive(self, command: DriveCommand) -> None:
        """Take a new command; a change of mode starts the profile at the motor's position."""
        if command.mode is not self.command.mode:
            self.reference_rad = self.sensed_rad
            self.reference_velocity_rad_s = 0.0
            self._integral_a = 0.0
        self.command = command

    def torque_nm(self, dt_s: float) -> float:
        """Advance loops and winding by ``dt_s`` s and return kt I in N.m, without friction."""
        command = self.command
        mode = command.mode
        if mode is DriveMode.OFF:
            self.current_a = 0.0
            self.duty = 0.0
            self._account(dt_s)
            return 0.0
        velocity = self.velocity_rad_s if self.stuck_at_rad is None else 0.0
        back_emf_v_s = self._back_emf_v_s * self.kt_factor
        back_emf_v = back_emf_v_s * self.velocity_rad_s
        if mode is DriveMode.CURRENT_POSITION or mode is DriveMode.POSITION:
            if command.profile_velocity_rad_s > 0.0:
                self._advance_reference(dt_s)
            else:
                self.reference_rad, self.reference_velocity_rad_s = command.position_rad, 0.0
            goal_a = (
                command.p_gain * self._p_current * (self.reference_rad - self.sensed_rad)
                - (command.d_gain * self._d_current + back_emf_v_s / self._resistance_ohm)
                * velocity
            )
            if mode is DriveMode.CURRENT_POSITION:
                limit_a = command.current_a
                goal_a = limit_a if goal_a > limit_a else -limit_a if goal_a < -limit_a else goal_a
        elif mode is DriveMode.CURRENT:
            goal_a = command.current_a
        elif mode is DriveMode.VELOCITY:
            goal_a = self._velocity_loop(velocity, dt_s)
        else:
            goal_a = (command.duty * self.voltage_v - back_emf_v) / self._resistance_ohm
        limit_v = abs(command.duty) * self.voltage_v
        highest_a = (limit_v - back_emf_v) / self._resistance_ohm
        lowest_a = (-limit_v - back_emf_v) / self._resistance_ohm
        goal_a = highest_a if goal_a > highest_a else lowest_a if goal_a < lowest_a else goal_a
        if dt_s != self._alpha_dt_s:
            self._alpha_dt_s = dt_s
            self._alpha = 1.0 - math.exp(-dt_s / CURRENT_LOOP_TIME_CONSTANT_S)
        current_a = self.current_a + (goal_a - self.current_a) * self._alpha
        self.current_a = current_a
        supply_v = self.voltage_v if self.voltage_v > _LEAST_SUPPLY_V else _LEAST_SUPPLY_V
        duty = (current_a * self._resistance_ohm + back_emf_v) / supply_v
        self.duty = 1.0 if duty > 1.0 else -1.0 if duty < -1.0 else duty
        self._account(dt_s)
        torque_nm = self._kt_nm_a * self.kt_factor * current_a
        gearing = self.gearing
        if gearing.ripple:
            turned_rad = self.angle_rad + self.lead_rad
            torque_nm *= 1.0 + gearing.ripple * math.sin(gearing.ripple_per_turn * turned_rad)
        return torque_nm

    def _account(self, dt_s: float) -> None:
        """Update temperature and overload budget by the current, and wear by the motion."""
        if self.wear_per_turn:
            self.worn += self.wear_per_turn * abs(self.velocity_rad_s) * dt_s / math.tau
        current_a = self.current_a
        final_c = AMBIENT_C + self._heat * current_a * current_a
        self.temperature_c += (final_c - self.temperature_c) * (dt_s / THERMAL_TIME_CONSTANT_S)
        supply_v = self.voltage_v if self.voltage_v > _LEAST_SUPPLY_V else _LEAST_SUPPLY_V
        load = abs(current_a) * self._resistance_ohm / supply_v
        excess_s = self.load_excess_s + (load - OVERLOAD_DUTY) * dt_s
        self.load_excess_s = excess_s if excess_s > 0.0 else 0.0

    def _velocity_loop(self, velocity_rad_s: float, dt_s: float) -> float:
        error = self.command.velocity_rad_s - velocity_rad_s
        bound_a = self.model.stall_current_a
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
