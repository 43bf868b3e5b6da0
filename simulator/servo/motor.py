"""Electromechanics of one simulated servo: control loops, winding current, heat.

The motor works in its own output angle (rad, 0 at raw position 0, not limited to a turn). Torque at
the output is T = kt I - friction, the friction being applied by `simulator.servo.mechanics`, where
the motion is integrated. The position loop is read as the e-Manual draws it, a gain of P/128 in
counts of PWM for each count of position; through the winding resistance that is a current, and the
back-EMF is its damping. Integral and feed-forward gains have no effect here. Backlash, ripple of
the torque and friction that grows with the load are those of a `Gearing`; the default is ideal.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from gripper.dynamixel.models import XM430_W350, ServoModel
from simulator.errors import SimulatorSettingsError

CURRENT_LOOP_TIME_CONSTANT_S = 0.003
"""Time constant in s with which the winding current follows its goal; an assumption."""
AMBIENT_C = 25.0
"""Temperature of the surroundings in degC."""
THERMAL_TIME_CONSTANT_S = 300.0
"""Time constant in s of heating and cooling; an assumption."""
RISE_AT_FIFTH_OF_STALL_C = 15.0
"""Final heating in K at a fifth of the stall current, the vendor's limit for steady work."""
OVERLOAD_DUTY = 0.30
"""Loading duty (1 = stall at the present voltage) that a servo bears for ever; an assumption."""
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
_VISCOUS_SHARE = 0.01
"""Viscous friction at no-load speed over the stall torque; an assumption."""
_LEAST_SUPPLY_V = 0.1
"""Supply in V below which duty and load are worked out as at this one: no division by zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gearing:
    """What a real gearing does to the torque of its motor; the defaults are an ideal one."""

    load_friction: float = 0.0
    """Friction over the torque of the load, on top of `ServoModel.friction_nm`."""
    backlash_rad: float = 0.0
    """Way of the motor at the output from one flank of the teeth to the other."""
    output_friction: float = 0.0
    """Share of the friction that brakes the output behind the backlash: bearings, horn, finger."""
    ripple: float = 0.0
    """Amplitude of the torque's ripple over the motor, as a share of it."""
    ripple_per_turn: float = 0.0
    """Periods of the ripple in one turn of the output."""

    def __post_init__(self) -> None:
        for name in ("load_friction", "output_friction", "ripple"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise SimulatorSettingsError(
                    f"{name} of a gearing is from 0 to below 1, got {getattr(self, name)}"
                )
        if not (0.0 <= self.backlash_rad < math.pi and math.isfinite(self.ripple_per_turn)):
            raise SimulatorSettingsError(
                f"backlash_rad is from 0 to below pi and ripple_per_turn is finite, got "
                f"{self.backlash_rad} and {self.ripple_per_turn}"
            )


IDEAL_GEARING = Gearing()
"""A gearing whose friction is Coulomb's alone."""
XM430_W350_GEARING = Gearing(
    load_friction=0.11,
    backlash_rad=math.radians(0.25),
    output_friction=0.1,
    ripple=0.0125,
    ripple_per_turn=353.5 * 14,
)
"""The gearing of an XM430-W350, as far as it is known.

Load: 0.11 was measured on an MX-106 (Duclusaud and Passault, arXiv 2410.08650, model M3 of their
library); nobody has published it for an XM430. Backlash: 15 arcmin (e-Manual, Specifications). The
motor is coreless, so no iron cogs; a commutator of 7 segments, an assumption, has 14 periods a turn
of the motor and a ripple from crest to trough of 1 - cos(pi / 14) = 2.5 %. That of the teeth's mesh
is not known and left out. A tenth of the friction at the output is an assumption.
"""


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
        Electrical and torque figures. Its torque is that with rising load, so what the load's
        friction takes from it there is added to what the motor makes.
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
        self.kt_nm_a = model.kt_nm_a * (1.0 + gearing.load_friction)
        self.friction_nm = model.friction_nm * (1.0 + gearing.load_friction)
        self.viscous_nm_s = _VISCOUS_SHARE * model.stall_torque_nm / model.no_load_rad_s
        self.inertia_kg_m2 = model.rotor_inertia_kg_m2
        self.voltage_v = model.nominal_voltage_v
        self._resistance_ohm = model.nominal_voltage_v / model.stall_current_a
        idle_a = model.friction_nm / model.kt_nm_a
        self._back_emf = (
            model.nominal_voltage_v - idle_a * self._resistance_ohm
        ) / model.no_load_rad_s
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
        """How far the motor is ahead of the output within the backlash, from -1/2 to 1/2 of it,
        and the motor's velocity; set by the mechanics."""
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
        """Angle at which the encoder is stuck, None when it works."""
        self.encoder_offset_rad = 0.0
        """How much more than the true angle the encoder reports."""
        self.command = DriveCommand()

    @property
    def sensed_rad(self) -> float:
        """Angle that the encoder reports, rad."""
        true_rad = self.angle_rad if self.stuck_at_rad is None else self.stuck_at_rad
        return true_rad + self.encoder_offset_rad

    @property
    def sensed_velocity_rad_s(self) -> float:
        """Velocity that follows from the encoder, rad/s."""
        return self.velocity_rad_s if self.stuck_at_rad is None else 0.0

    def overload(self) -> None:
        """Use up the overload budget, as a long stall does."""
        self.load_excess_s = 2.0 * OVERLOAD_BUDGET_S

    def drive(self, command: DriveCommand) -> None:
        """Take a new command; a change of mode starts the profile where the motor is."""
        if command.mode is not self.command.mode:
            self.reference_rad = self.sensed_rad
            self.reference_velocity_rad_s = 0.0
            self._integral_a = 0.0
        self.command = command

    def torque_nm(self, dt_s: float) -> float:
        """Advance loops and winding by ``dt_s`` s and return kt I in N.m, friction left aside."""
        command = self.command
        mode = command.mode
        if mode is DriveMode.OFF:
            self.current_a = 0.0
            self.duty = 0.0
            self._account(dt_s)
            return 0.0
        velocity = self.velocity_rad_s if self.stuck_at_rad is None else 0.0
        back_emf_v = self._back_emf * self.velocity_rad_s
        if mode is DriveMode.CURRENT_POSITION or mode is DriveMode.POSITION:
            if command.profile_velocity_rad_s > 0.0:
                self._advance_reference(dt_s)
            else:
                self.reference_rad, self.reference_velocity_rad_s = command.position_rad, 0.0
            goal_a = (
                command.p_gain * self._p_current * (self.reference_rad - self.sensed_rad)
                - (command.d_gain * self._d_current + self._back_emf / self._resistance_ohm)
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
        torque_nm = self.kt_nm_a * current_a
        gearing = self.gearing
        if gearing.ripple:
            turned_rad = self.angle_rad + self.lead_rad
            torque_nm *= 1.0 + gearing.ripple * math.sin(gearing.ripple_per_turn * turned_rad)
        return torque_nm

    def _account(self, dt_s: float) -> None:
        """Let the current heat the motor and use up the overload budget."""
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
