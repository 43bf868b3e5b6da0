"""Motors and gearings of simulated servos as data: of data sheets, assumed, or drawn for one servo.

Data sheets: ROBOTIS e-Manual, "Specifications" of each model. The driver has figures of its own, so
that an error of one side shows as a difference. The friction law is a part of M6 of M. Duclusaud,
G. Passault et al., "Extended Friction Models for the Physics Simulation of Servo Actuators" (arXiv
2410.08650).

Servos are drawn at random from the spread that real servos of a model have. Its sources: sweeps of
an OpenMANIPULATOR-X with four XM430-W350, and their procedure
(smorales2405/open_manipulator_x_torque_control, Ident_..._procedure.md): friction 21 to 74 mA,
viscous 0 to 11 mA s/rad, torque 1.80 N.m/A in motion, breakaway 1.7 times the friction. Another
robot: 1.65 N.m/A. XL330-M288: logs of a pendulum (Rhoban/bam, revision af22604).
"""

import math
import random
from dataclasses import dataclass, replace

from gripper.dynamixel.models import ServoModel

_RAD_S = math.tau / 60.0
"""rad/s of one rev/min."""
_FRICTION_SHARE = 0.054
"""Friction over the stall torque where no graph gives it; that of the XM430-W350's graph."""


@dataclass(frozen=True, slots=True)
class DataSheet:
    """Figures of one model at its nominal voltage."""

    voltage_v: float
    stall_torque_nm: float
    stall_current_a: float
    no_load_rad_s: float
    inertia_kg_m2: float
    """Inertia of rotor and gears at the output; no vendor gives it, so these are estimates."""
    kt_of_graph_nm_a: float | None = None
    friction_of_graph_nm: float | None = None
    """Torque at the output with rising load, T = kt I - friction, by a graph; None: without one."""

    @property
    def friction_nm(self) -> float:
        """Friction with rising load."""
        of_stall_nm = _FRICTION_SHARE * self.stall_torque_nm
        return of_stall_nm if self.friction_of_graph_nm is None else self.friction_of_graph_nm

    @property
    def kt_nm_a(self) -> float:
        """Torque of the motor over its current with rising load."""
        of_stall_nm_a = (self.stall_torque_nm + self.friction_nm) / self.stall_current_a
        return of_stall_nm_a if self.kt_of_graph_nm_a is None else self.kt_of_graph_nm_a

    @property
    def winding_ohm(self) -> float:
        """Resistance of the winding, by the current of the stalled motor."""
        return self.voltage_v / self.stall_current_a


_SHEETS = {
    # Voltage, stall torque and current, speed without load, inertia; torque constant and friction.
    # The performance graph of the XM430-W350 (forum.robotis.com/t/5827); 0.012 kg m² is an upper
    # bound of its inertia.
    "XM430-W350": DataSheet(12.0, 4.1, 2.3, 46 * _RAD_S, 0.012, 1.769, 0.2214),
    "XM430-W210": DataSheet(12.0, 3.0, 2.3, 77 * _RAD_S, 0.0043),
    "XL330-M288": DataSheet(5.0, 0.52, 1.47, 103 * _RAD_S, 0.0012),
    "XC330-M288": DataSheet(5.0, 0.93, 1.8, 81 * _RAD_S, 0.0012),
    # Peak current, closing speed of 75 mm/s; torque constant and friction are assumed.
    "RH-P12-RN(A)": DataSheet(24.0, 32.0, 3.33, 0.76, 0.1, 10.0, 1.8),
}


def data_sheet(model: ServoModel) -> DataSheet:
    """Return the data sheet of a model; that of a plug-in's model is its own."""
    return _SHEETS.get(model.name) or DataSheet(
        model.nominal_voltage_v,
        model.stall_torque_nm,
        model.stall_current_a,
        model.no_load_rad_s,
        model.rotor_inertia_kg_m2,
    )


_LOAD_FRICTION = {"RH-P12-RN(A)": 0.3}
"""Friction over the torque of the load in a gearing of 1181 : 1; an assumption."""
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
        opposing = self.load_quadratic_per_nm and load_nm * driving_nm < 0.0
        if opposing and abs(load_nm) < abs(driving_nm):
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


def data_sheet_drive(model: ServoModel, load_friction: float = 0.0) -> Drive:
    """Return motor and gearing by the data sheet of a model, with Coulomb friction.

    The torque of a data sheet is measured with rising load: friction there is added to the motor's
    torque. Its back-EMF follows from the no-load speed.

    Parameters
    ----------
    load_friction
        Friction over the torque of the load, on top of that of the data sheet.
    """
    sheet, more = data_sheet(model), 1.0 + load_friction
    viscous_nm_s = _VISCOUS_SHARE * sheet.stall_torque_nm / sheet.no_load_rad_s
    idle_share = sheet.friction_nm / sheet.kt_nm_a / sheet.stall_current_a
    return Drive(
        kt_nm_a=more * sheet.kt_nm_a,
        back_emf_v_s=sheet.voltage_v * (1.0 - idle_share) / sheet.no_load_rad_s,
        friction=Friction(
            base_nm=more * sheet.friction_nm, load=load_friction, viscous_nm_s=viscous_nm_s
        ),
        inertia_kg_m2=sheet.inertia_kg_m2,
        winding_ohm=sheet.winding_ohm,
    )


Range = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A typical servo of a model, and the range of each of its figures over the typical one."""

    typical: Drive
    torque: Range = (0.92, 1.08)
    """Torque and back-EMF for the same current and speed. [assumed; XM430: 1.65 to 1.95 N.m/A]"""
    back_emf: Range = (0.95, 1.05)
    """Back-EMF for the same torque. [assumed]"""
    winding: Range = (0.94, 1.06)
    """Resistance of the winding. [assumed]"""
    friction: Range = (0.52, 1.94)
    """Friction without load: 20 to 75 mA of an XM430-W350, for other models the same range."""
    viscous: Range = (0.0, 2.2)
    """Viscous friction: 0 to 11 mA s/rad of an XM430-W350."""
    inertia: Range = (0.67, 1.33)
    """Inertia: 0.003 to 0.006 kg m² of an XM430-W350."""
    breakaway: Range = (1.3, 1.8)
    """Friction at rest over that in motion, not over the typical one."""
    load: Range = (0.0, 0.11)
    """Share of the load's torque, on top of the typical one: nobody has measured an XM430, an
    MX-106 has 0.11 (Duclusaud and Passault, arXiv 2410.08650)."""


_XM430_FRICTION_A, _XM430_VISCOUS_A_S = 0.0387, 0.005
"""Middle of the XM430's friction in A, and of its viscous part in A s/rad."""


def _xm430(kt_nm_a: float, back_emf_v_s: float, inertia_kg_m2: float) -> Spread:
    return Spread(
        typical=Drive(
            kt_nm_a=kt_nm_a,
            back_emf_v_s=back_emf_v_s,
            friction=Friction(
                base_nm=_XM430_FRICTION_A * kt_nm_a, viscous_nm_s=_XM430_VISCOUS_A_S * kt_nm_a
            ),
            inertia_kg_m2=inertia_kg_m2,
            winding_ohm=5.217,
        )
    )


def _x330(torque: float, back_emf_v_s: float, winding_ohm: float, inertia_kg_m2: float) -> Spread:
    """Return the spread of a 330 size with ``torque`` times the torques of an XL330-M288."""
    return Spread(
        typical=Drive(
            kt_nm_a=torque * 0.42,
            back_emf_v_s=back_emf_v_s,
            friction=Friction(
                # Without a load 0.10 to 0.12 A at 1 to 5 rad/s (Rhoban/bam, issue 14), and 0.07 A
                # at the speed of the data sheet.
                base_nm=torque * 0.024,
                drive=0.35,
                load=0.05,
                load_quadratic_per_nm=1.2 / torque,
                viscous_nm_s=torque * 0.001,
            ),
            inertia_kg_m2=inertia_kg_m2,
            winding_ohm=winding_ohm,
        ),
        # Most pendulums of the logs rise without steps; two of them stick, one at 1.28.
        breakaway=(1.0, 1.3),
        load=(0.0, 0.0),
    )


_SPREADS = {
    # Back-EMF by the speed without load, resistance by the current of the stalled motor.
    "XM430-W350": _xm430(1.80, 2.42, 0.0045),
    # Torque by the ratio of the data sheets, inertia by the square of the gears' ratio.
    "XM430-W210": _xm430(1.317, 1.45, 0.0016),
    # Speed at full duty 0.43 to 0.45 V s/rad; 15 to 17 V for each N.m of a rise, more at a larger
    # torque. The logs of one servo have 11 to 13 V below 0.1 N.m.
    "XL330-M288": _x330(1.0, 0.44, 3.40, 0.0022),
    "XC330-M288": _x330(1.46, 0.56, 2.78, 0.0035),
}


def drawn_drive(model: ServoModel, seed: str | None) -> Drive:
    """Return motor and gearing of one servo of a model, drawn by a seed; None: a typical servo."""
    sheet = data_sheet_drive(model, _LOAD_FRICTION.get(model.name, 0.0))
    spread = _SPREADS.get(model.name) or Spread(typical=sheet)
    return spread.typical if seed is None else _drawn(spread, random.Random(seed))


def _drawn(spread: Spread, rng: random.Random) -> Drive:
    typical, friction = spread.typical, spread.typical.friction
    torque = rng.uniform(*spread.torque)
    base = math.exp(rng.uniform(*map(math.log, spread.friction)))
    return Drive(
        kt_nm_a=torque * typical.kt_nm_a,
        back_emf_v_s=torque * rng.uniform(*spread.back_emf) * typical.back_emf_v_s,
        friction=replace(
            friction,
            base_nm=base * friction.base_nm,
            load=friction.load + rng.uniform(*spread.load),
            viscous_nm_s=rng.uniform(*spread.viscous) * friction.viscous_nm_s,
        ),
        inertia_kg_m2=rng.uniform(*spread.inertia) * typical.inertia_kg_m2,
        winding_ohm=rng.uniform(*spread.winding) * typical.winding_ohm,
        breakaway=rng.uniform(*spread.breakaway),
    )
