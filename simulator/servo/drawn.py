"""Servos drawn at random from the spread that real servos of a model have.

Sources: sweeps of an OpenMANIPULATOR-X with four XM430-W350, and their procedure
(smorales2405/open_manipulator_x_torque_control, Ident_..._procedure.md): friction 21 to 74 mA,
viscous 0 to 11 mA s/rad, torque 1.80 N.m/A in motion, breakaway 1.7 times the friction. Another
robot: 1.65 N.m/A. XL330-M288: logs of a pendulum (Rhoban/bam, revision af22604).
"""

import math
import random
from dataclasses import dataclass, replace

from gripper.dynamixel.models import ServoModel
from simulator.servo.gearing import IDEAL_GEARING, RH_P12_GEARING, Drive, Friction, Gearing

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
                base_nm=_XM430_FRICTION_A * kt_nm_a,
                viscous_nm_s=_XM430_VISCOUS_A_S * kt_nm_a,
            ),
            inertia_kg_m2=inertia_kg_m2,
            winding_ohm=5.217,
        )
    )


def _x330(torque: float, back_emf_v_s: float, winding_ohm: float, inertia_kg_m2: float) -> Spread:
    """Return the spread of a 330 size with ``torque`` times the torques of an XL330-M288."""
    return Spread(
        typical=Drive(
            kt_nm_a=torque * 0.365,
            back_emf_v_s=back_emf_v_s,
            friction=Friction(
                base_nm=torque * 0.01,
                drive=0.37,
                load=0.06,
                load_quadratic_per_nm=0.3 / torque,
                viscous_nm_s=torque * 0.005,
            ),
            inertia_kg_m2=inertia_kg_m2,
            winding_ohm=winding_ohm,
        ),
        # The friction under load grows little towards rest: a pendulum rises without steps.
        breakaway=(1.0, 1.1),
        load=(0.0, 0.0),
    )


_SPREADS = {
    # Back-EMF by the speed without load, resistance by the current of the stalled motor.
    "XM430-W350": _xm430(1.80, 2.42, 0.0045),
    # Torque by the ratio of the data sheets, inertia by the square of the gears' ratio.
    "XM430-W210": _xm430(1.317, 1.45, 0.0016),
    # Speed at full duty 0.43 to 0.45 V s/rad; 13 to 17 V for each N.m of a rise.
    "XL330-M288": _x330(1.0, 0.44, 3.40, 0.0022),
    "XC330-M288": _x330(1.46, 0.56, 2.78, 0.0035),
}


def drawn_gearing(model: ServoModel, seed: str | None) -> Gearing:
    """Return the gearing of one servo of a model, drawn by a seed; None: the typical servo."""
    spread = _SPREADS.get(model.name)
    if spread is None:
        assumed = RH_P12_GEARING if model.name.startswith("RH-P12") else IDEAL_GEARING
        spread = Spread(typical=assumed.drive_of(model))
    drive = spread.typical
    if seed is not None:
        drive = _drawn(spread, random.Random(seed))
    return Gearing(drive=drive)


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
