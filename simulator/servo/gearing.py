"""Gearings of simulated servos as data: of the data sheet, assumed, or drawn for one servo.

The friction law is a part of M6 of M. Duclusaud, G. Passault et al., "Extended Friction Models for
the Physics Simulation of Servo Actuators" (arXiv 2410.08650).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from gripper.dynamixel.models import ServoModel
from simulator.servo.data_sheets import data_sheet

_VISCOUS_SHARE = 0.01
"""Viscous friction at no-load speed over the stall torque; an assumption."""
_STRIBECK_RAD_S = 1.0
"""Speed in rad/s at which friction that fades with speed has fallen to 37 %; an assumption."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction:
    """Friction of a gearing at its output; it opposes the motion."""

    base_nm: float = 0.0
    """Friction without load in N.m."""
    drive: float = 0.0
    load: float = 0.0
    """Shares of the torque of the motor, and of that of the load."""
    load_quadratic_per_nm: float = 0.0
    """Factor on the square of the load's torque, where that opposes a larger torque of the motor;
    it is largest at rest and fades with speed."""
    viscous_nm_s: float = 0.0
    """Viscous friction in N.m s/rad."""

    def torque_nm(
        self, driving_nm: float, load_nm: float, speed_rad_s: float, base_factor: float = 1.0
    ) -> float:
        """Return the friction in N.m, without its viscous part.

        Parameters
        ----------
        driving_nm, load_nm
            Torque of the motor and of the load at the output; opposing torques have opposite signs.
        base_factor
            Factor on the friction without load.
        """
        friction_nm = base_factor * self.base_nm + abs(
            self.load * load_nm - self.drive * driving_nm
        )
        opposing = load_nm * driving_nm < 0.0 and abs(load_nm) < abs(driving_nm)
        if self.load_quadratic_per_nm and opposing:
            share = math.exp(-abs(speed_rad_s) / _STRIBECK_RAD_S)
            friction_nm += share * self.load_quadratic_per_nm * load_nm * load_nm
        return friction_nm


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Motor and gearing of one servo, at its output."""

    kt_nm_a: float
    """Torque of the motor over its current."""
    back_emf_v_s: float
    """Its back-EMF over the speed in V s/rad."""
    friction: Friction
    inertia_kg_m2: float
    """Inertia of rotor and gears in kg m²."""
    winding_ohm: float
    """Resistance of its winding."""
    breakaway: float = 1.05
    """Friction at rest over that at the least speed: 1.3 to 1.8 on an XM430-W350."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gearing:
    """Effect of a gearing on the torque of its motor; the default is an ideal gearing."""

    load_friction: float = 0.0
    """Friction over the torque of the load, on top of that of the data sheet."""
    backlash_rad: float = 0.0
    """Motion of the motor in rad at the output from one flank of the teeth to the other."""
    output_friction: float = 0.0
    """Share of the friction on the output side of the backlash: bearings, horn, finger."""
    drive: Drive | None = None
    """Values of one servo; None: those of its data sheet with ``load_friction``."""

    def drive_of(self, model: ServoModel) -> Drive:
        """Return motor and gearing of a servo of a model.

        The torque of a data sheet is measured with rising load: the load friction there is added to
        the motor's torque. Its back-EMF follows from the no-load speed.
        """
        if self.drive is not None:
            return self.drive
        sheet = data_sheet(model)
        more = 1.0 + self.load_friction
        viscous_nm_s = _VISCOUS_SHARE * sheet.stall_torque_nm / sheet.no_load_rad_s
        idle_share = sheet.friction_nm / sheet.kt_nm_a / sheet.stall_current_a
        return Drive(
            kt_nm_a=more * sheet.kt_nm_a,
            back_emf_v_s=sheet.voltage_v * (1.0 - idle_share) / sheet.no_load_rad_s,
            friction=Friction(
                base_nm=more * sheet.friction_nm,
                load=self.load_friction,
                viscous_nm_s=viscous_nm_s,
            ),
            inertia_kg_m2=sheet.inertia_kg_m2,
            winding_ohm=sheet.winding_ohm,
        )


IDEAL_GEARING = Gearing()
"""A gearing with Coulomb friction only."""
RH_P12_GEARING = Gearing(
    load_friction=0.3,
    backlash_rad=math.radians(0.25),
    output_friction=0.1,
)
"""The gearing of an RH-P12-RN(A) of 1181 : 1, assumed: nobody has identified one."""

GEARINGS: Mapping[str, Gearing] = MappingProxyType(
    {"ideal": IDEAL_GEARING, "rh_p12_assumed": RH_P12_GEARING}
)
"""Gearings by name."""
