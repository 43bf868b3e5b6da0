"""Gearings of simulated servos as data: ideal, assumed, and identified on real servos.

The friction law is M6 of M. Duclusaud, G. Passault et al., "Extended Friction Models for the
Physics Simulation of Servo Actuators" (arXiv 2410.08650). The same authors identified the values of
real servos (github.com/Rhoban/bam, revision 1b5a1ce, bam/params).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from gripper.dynamixel.models import ServoModel
from simulator.errors import SimulatorSettingsError
from simulator.servo.data_sheets import data_sheet

_VISCOUS_SHARE = 0.01
"""Viscous friction at no-load speed over the stall torque; an assumption."""
_GRAPH_SHARE = 0.5
"""Point of the vendor's performance graph for matching the gearing of another servo: this share of
the stall current, at this share of the no-load speed; an assumption."""


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
        found_nm = base_factor * base + abs(load * load_nm - drive * driving_nm)
        if not (base_s or drive_s or load_s or drive_quadratic or load_quadratic):
            return found_nm
        share = self.fading(speed_rad_s)
        found_nm += share * (base_factor * base_s + abs(load_s * load_nm - drive_s * driving_nm))
        if load_nm * driving_nm < 0.0:
            if abs(load_nm) < abs(driving_nm):
                found_nm += share * load_quadratic * load_nm * load_nm
            else:
                found_nm += share * drive_quadratic * driving_nm * driving_nm
        return found_nm

    def forward_nm(self, driving_nm: float, speed_rad_s: float) -> float:
        """Return the load in N.m for a motor torque at a steady speed in rad/s."""
        share = self.fading(speed_rad_s)
        (base, base_s), (drive, drive_s), (load, load_s) = self.base_nm, self.drive, self.load
        left_nm = driving_nm * (1.0 - drive - share * drive_s) - base - share * base_s
        left_nm = max(0.0, left_nm - self.viscous_nm_s * abs(speed_rad_s))
        one, square = 1.0 + load + share * load_s, share * self.load_quadratic_per_nm
        return 2.0 * left_nm / (one + math.sqrt(one * one + 4.0 * square * left_nm))

    def scaled(self, factor: float) -> "Friction":
        """Return the friction with all torques times ``factor``."""
        base, base_s = self.base_nm
        return replace(
            self,
            base_nm=(factor * base, factor * base_s),
            drive_quadratic_per_nm=self.drive_quadratic_per_nm / factor,
            load_quadratic_per_nm=self.load_quadratic_per_nm / factor,
            viscous_nm_s=factor * self.viscous_nm_s,
        )


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
    """Friction at rest over that at the least speed: 1.3 to 1.8 on an XM430-W350. The law of an
    identified gearing has a growth of its own."""

    def scaled(self, factor: float, winding_ohm: float) -> "Drive":
        """Return the drive with all torques and the inertia times ``factor``, and a winding."""
        return Drive(
            winding_ohm=winding_ohm,
            breakaway=self.breakaway,
            kt_nm_a=factor * self.kt_nm_a,
            back_emf_v_s=factor * self.back_emf_v_s,
            friction=self.friction.scaled(factor),
            inertia_kg_m2=factor * self.inertia_kg_m2,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Gearing:
    """Effect of a gearing on the torque of its motor; the default is an ideal gearing.

    On a servo of its own model an identified gearing has its identified values. With a motor of
    another model one factor scales all torques and the inertia. Forward drive then gives the torque
    of the vendor's graph at half the stall current and half the no-load speed. Slower motion has
    more friction: up to a quarter of that torque is missing at rest.
    """

    load_friction: float = 0.0
    """Friction over the torque of the load, on top of that of the data sheet."""
    backlash_rad: float = 0.0
    """Motion of the motor in rad at the output from one flank of the teeth to the other."""
    output_friction: float = 0.0
    """Share of the friction on the output side of the backlash: bearings, horn, finger."""
    ripple: float = 0.0
    """Amplitude of the torque's ripple over the motor, as a share of it."""
    ripple_per_turn: float = 0.0
    """Periods of the ripple in one turn of the output."""
    identified: Drive | None = None
    """Values of a real servo; None: those of the model and ``load_friction`` are used."""
    identified_on: str = ""
    """Model of that servo."""

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

    def drive_of(self, model: ServoModel) -> Drive:
        """Return motor and gearing of a servo of a model.

        The torque of a model is measured with rising load: the load friction there is added to the
        motor's torque. Its back-EMF follows from the no-load speed. The back-EMF of an identified
        motor equals its torque constant.
        """
        sheet = data_sheet(model)
        if self.identified is None:
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
        if self.identified_on == model.name:
            return self.identified
        current_a = _GRAPH_SHARE * sheet.stall_current_a
        graph_nm = sheet.kt_nm_a * current_a - sheet.friction_nm
        driving_nm = self.identified.kt_nm_a * current_a
        speed_rad_s = _GRAPH_SHARE * sheet.no_load_rad_s
        forward_nm = self.identified.friction.forward_nm(driving_nm, speed_rad_s)
        return self.identified.scaled(graph_nm / forward_nm, sheet.winding_ohm)


IDEAL_GEARING = Gearing()
"""A gearing with Coulomb friction only."""
XM430_W350_GEARING = Gearing(
    load_friction=0.11,
    backlash_rad=math.radians(0.25),
    output_friction=0.1,
    ripple=0.0125,
    ripple_per_turn=353.5 * 14,
)
"""The gearing of an XM430-W350, with assumptions.

Load: 0.11 was measured on an MX-106 (Duclusaud and Passault, arXiv 2410.08650, model M3 of their
library); there is no published value for an XM430. Backlash: 15 arcmin (e-Manual, Specifications).
The motor is coreless, without cogging. A commutator of 7 segments (assumed) has 14 periods per turn
of the motor, and a peak-to-peak ripple of 1 - cos(pi / 14) = 2.5 %. The ripple of the teeth is not
known and left out. A tenth of the friction at the output is an assumption.
"""
XL330_M288_GEARING = Gearing(
    identified_on="XL330-M288",
    identified=Drive(
        kt_nm_a=0.36601,
        back_emf_v_s=0.36601,
        friction=Friction(
            base_nm=(0.0047712, 0.0046763),
            drive=(0.26679, 1.07e-5),
            load=(8.5e-6, 0.080779),
            drive_quadratic_per_nm=0.0099725,
            load_quadratic_per_nm=0.0049026,
            stribeck_rad_s=2.8904,
            stribeck_exponent=8.6833,
            viscous_nm_s=0.0053597,
        ),
        inertia_kg_m2=0.0018077,
        winding_ohm=2.81,
    ),
)
"""The gearing of an XL330-M288 (xl330/m6.json)."""
XL330_M288_GEARING_2 = Gearing(
    identified_on="XL330-M288",
    identified=Drive(
        kt_nm_a=0.28639,
        back_emf_v_s=0.28639,
        friction=Friction(
            base_nm=(0.0023258, 0.00018563),
            drive=(0.23063, 1.9e-6),
            load=(0.26078, 0.15159),
            drive_quadratic_per_nm=0.0055960,
            load_quadratic_per_nm=0.0037747,
            stribeck_rad_s=0.11533,
            stribeck_exponent=1.0,
            viscous_nm_s=0.018545,
        ),
        inertia_kg_m2=0.0025698,
        winding_ohm=2.0,
    ),
)
"""The same servo identified from other motions (xl330/m6.json of revision 11bb7ec); it shows the
difference between two identifications."""
MX_64_GEARING = Gearing(
    identified_on="MX-64",
    identified=Drive(
        kt_nm_a=1.6017,
        back_emf_v_s=1.6017,
        friction=Friction(
            base_nm=(6.2e-7, 0.12270),
            drive=(0.31147, 0.18774),
            load=(2.0e-8, 0.014066),
            drive_quadratic_per_nm=0.0069085,
            load_quadratic_per_nm=0.01,
            stribeck_rad_s=2.5753,
            stribeck_exponent=0.84090,
            viscous_nm_s=0.025337,
        ),
        inertia_kg_m2=0.012266,
        winding_ohm=2.3164,
    ),
)
"""The gearing of an MX-64 (mx64/m6.json), for motors of other models: no gripper here has one."""
MX_106_GEARING = Gearing(
    identified_on="MX-106",
    identified=Drive(
        kt_nm_a=2.2098,
        back_emf_v_s=2.2098,
        friction=Friction(
            base_nm=(1.0e-5, 0.12195),
            drive=(0.19801, 0.19860),
            load=(0.022216, 0.087103),
            drive_quadratic_per_nm=0.0099999,
            load_quadratic_per_nm=7.3e-5,
            stribeck_rad_s=1.7463,
            stribeck_exponent=1.1428,
            viscous_nm_s=0.050716,
        ),
        inertia_kg_m2=0.026016,
        winding_ohm=2.0337,
    ),
)
"""The gearing of an MX-106 (mx106/m6.json), for motors of other models: no gripper here has one."""
RH_P12_GEARING = Gearing(
    load_friction=0.3,
    backlash_rad=math.radians(0.25),
    output_friction=0.1,
)
"""The gearing of an RH-P12-RN(A) of 1181 : 1, assumed: nobody has identified one."""

GEARINGS: Mapping[str, Gearing] = MappingProxyType(
    {
        "ideal": IDEAL_GEARING,
        "xm430_assumed": XM430_W350_GEARING,
        "xl330": XL330_M288_GEARING,
        "xl330_2": XL330_M288_GEARING_2,
        "mx64": MX_64_GEARING,
        "mx106": MX_106_GEARING,
        "rh_p12_assumed": RH_P12_GEARING,
    }
)
"""Gearings by name."""
