"""Gearings of simulated servos as data: of the data sheet, assumed, or drawn for one servo.

The friction law is M6 of M. Duclusaud, G. Passault et al., "Extended Friction Models for the
Physics Simulation of Servo Actuators" (arXiv 2410.08650).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from gripper.dynamixel.models import ServoModel
from simulator.servo.data_sheets import data_sheet

_VISCOUS_SHARE = 0.01
"""Viscous friction at no-load speed over the stall torque; an assumption."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction:
    """Friction of a gearing at its output; it opposes the motion.

    With s = exp(-(speed / ``stribeck_rad_s``) ** ``stribeck_exponent``), each pair is a steady part
    and a part times s, which is largest at rest and fades with speed.
    """

    base_nm: tuple[float, float] = (0.0, 0.0)
    """Friction without load in N.m."""
    drive: tuple[float, float] = (0.0, 0.0)
    """Shares of the motor's torque; at first the steady part."""
    load: tuple[float, float] = (0.0, 0.0)
    """Shares of the load's torque."""
    drive_quadratic_per_nm: float = 0.0
    load_quadratic_per_nm: float = 0.0
    """Factors times s on the square of the motor's or the load's torque; of two opposing torques
    the smaller one is used."""
    stribeck_rad_s: float = 1.0
    stribeck_exponent: float = 1.0
    viscous_nm_s: float = 0.0
    """Viscous friction in N.m s/rad."""

    def fading(self, speed_rad_s: float) -> float:
        """Return s at a speed of the output in rad/s: 1 at rest, towards 0 with speed."""
        return math.exp(-((abs(speed_rad_s) / self.stribeck_rad_s) ** self.stribeck_exponent))

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
        (base, base_s), (drive, drive_s), (load, load_s) = self.base_nm, self.drive, self.load
        drive_quadratic, load_quadratic = self.drive_quadratic_per_nm, self.load_quadratic_per_nm
        friction_nm = base_factor * base + abs(load * load_nm - drive * driving_nm)
        if not (base_s or drive_s or load_s or drive_quadratic or load_quadratic):
            return friction_nm
        share = self.fading(speed_rad_s)
        friction_nm += share * (base_factor * base_s + abs(load_s * load_nm - drive_s * driving_nm))
        if load_nm * driving_nm < 0.0:
            if abs(load_nm) < abs(driving_nm):
                friction_nm += share * load_quadratic * load_nm * load_nm
            else:
                friction_nm += share * drive_quadratic * driving_nm * driving_nm
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
                base_nm=(more * sheet.friction_nm, 0.0),
                load=(self.load_friction, 0.0),
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
