"""Drive characteristic of one servo: the relation of current and torque, with its uncertainty.

Two measured lines bound the load that a current holds: the load rises at ``rising_a_nm * load +
breakaway_a``, and falls at ``falling_a_nm * load - yielding_share * breakaway_a``, where that is
above 0 A. Below 0 A the motor helps the load to fall; the load is gone at ``-breakaway_a``. In free
motion the current is ``offset_a +- friction_a(speed)``. Loads are torques at the output by the
force of the pads; only ``kt_nm_a`` does not depend on the pads.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import exp, hypot, inf, log
from typing import Any, NamedTuple, Self

from gripper.dynamixel.models import KT_SD, ServoModel
from gripper.errors import LimitExceeded

SIGMAS = 2.0
"""Standard deviations up to which a value is plausible: 95 % of all servos. [statistics]"""
_FRICTION_SD = 0.7
"""Standard deviation of the logarithm of the friction current between two servos of one model: a
quarter to four times. The catalogue alone is so uncertain. [assumed]"""
INERTIA_SD = 0.5
"""The same of the inertia: an identified gearing of one model has 2.4 times the catalogue's (arXiv
2410.08650). [assumed]"""

_MEASURED_FRICTION_SD, _MEASURED_LOAD_SD = 0.1, 0.02
"""The same within a day, once both were measured. [assumed]"""
_LEAST_MOVING_SHARE = 0.1
"""Least friction in fast motion over that at rest: a fit of slow motions may fall below 0 A there.
[chosen]"""


@dataclass(frozen=True, kw_only=True)
class DriveCharacteristic:
    """Relation of current, torque and motion of one servo, with its uncertainty.

    Each ``_sd`` is the standard deviation of a natural logarithm, about a share.
    """

    coulomb_a: float
    viscous_a_s: float = 0.0
    """Friction current of free motion in A: Coulomb's, and its growth in A for each rad/s."""
    offset_a: float = 0.0
    """Half the sum of both directions' currents in A: gravity, and the offset of the sensor."""
    breakaway_a: float
    """Current in A beyond that of the load at which the load begins to rise."""
    friction_sd: float = _FRICTION_SD
    """Uncertainty of the four currents."""
    rising_a_nm: float
    falling_a_nm: float
    """Growth of the current in A for each N m of a load that rises, or falls."""
    yielding_share: float = 1.0
    """Current by which friction without a load helps to hold one, over ``breakaway_a``: 1 where
    losses grow with the load, less where they grow with the torque of the motor."""
    load_sd: float = KT_SD
    """Uncertainty of ``rising_a_nm``."""
    kt_nm_a: float
    """Torque at the output in N m for each A of a rising load, by catalogue or bench."""
    temperature_c: float | None = None
    """Temperature of the servo in degrees Celsius; None: not measured."""
    measured_s: float = 0.0
    """Unix time of the measurement in s; 0: never, these are figures of the catalogue."""

    def __post_init__(self) -> None:
        signed = "viscous_a_s", "offset_a", "temperature_c", "measured_s"
        for name, value in (vars(self) | {"temperature_c": self.temperature_c or 0.0}).items():
            if not (-inf if name in signed else 0.0) < value < inf:
                above = "" if name in signed else "above 0 and "
                raise LimitExceeded(f"{name} is {value}, must be {above}finite")

    @classmethod
    def catalogue(cls, model: ServoModel) -> Self:
        """Return the values of a model, with the uncertainty between servos of one model."""
        friction_a = model.friction_nm / model.kt_nm_a
        return cls(
            coulomb_a=friction_a,
            breakaway_a=friction_a,
            rising_a_nm=1.0 / model.kt_nm_a,
            falling_a_nm=model.falling_share / model.kt_nm_a,
            load_sd=model.kt_sd,
            kt_nm_a=model.kt_nm_a,
        )

    @classmethod
    def from_stored(cls, values: Mapping[str, Any]) -> Self:
        """Rebuild from stored values; those of other versions are left out."""
        return cls(**{item.name: values[item.name] for item in fields(cls) if item.name in values})

    @property
    def measured(self) -> bool:
        """Whether the friction was measured."""
        return self.friction_sd < _FRICTION_SD

    def disagreement(self, model: ServoModel) -> float:
        """Return the torque for current by the pads over that by the motor constant; 1: they agree.

        A weak pad and a weak motor of the model look alike.
        """
        times = 1.0 / (self.rising_a_nm * self.kt_nm_a)
        return 1.0 if abs(log(times)) <= SIGMAS * hypot(self.load_sd, model.kt_sd) else times

    @property
    def once_measured(self) -> Self:
        """The same values, with at most the uncertainty of a measurement."""
        return replace(
            self,
            friction_sd=min(self.friction_sd, _MEASURED_FRICTION_SD),
            load_sd=min(self.load_sd, _MEASURED_LOAD_SD),
        )

    @property
    def distrusted(self) -> Self:
        """The same values, with the friction uncertainty of an unmeasured servo of its model."""
        return replace(self, friction_sd=_FRICTION_SD)

    def with_friction(self, factor: float) -> Self:
        """Return the same values with another friction, by a factor on all of its currents."""
        return replace(
            self,
            coulomb_a=factor * self.coulomb_a,
            viscous_a_s=factor * self.viscous_a_s,
            breakaway_a=factor * self.breakaway_a,
        )

    @property
    def breakaway_share(self) -> float:
        """Friction at rest under a load over that of free motion."""
        return self.breakaway_a / self.coulomb_a

    @cached_property
    def least_breakaway_a(self) -> float:
        """Least plausible friction at rest in A."""
        return self.breakaway_a * exp(-SIGMAS * self.friction_sd)

    @cached_property
    def most_breakaway_a(self) -> float:
        """Largest plausible friction at rest in A."""
        return self.breakaway_a * exp(SIGMAS * self.friction_sd)

    @cached_property
    def most_torque_nm_a(self) -> float:
        """Largest plausible torque for current in N m / A: the pads may be weak."""
        return max(exp(SIGMAS * self.load_sd) / self.rising_a_nm, self.kt_nm_a)

    def friction_a(self, speed_rad_s: float) -> float:
        """Return the friction current in A of free motion at a speed in rad/s.

        Friction never drives: a viscous term below 0 leaves a share of that at rest.
        """
        moving_a = self.coulomb_a + self.viscous_a_s * abs(speed_rad_s)
        return max(_LEAST_MOVING_SHARE * self.coulomb_a, moving_a)

    def inertia_a_s2(self, model: ServoModel) -> float:
        """Return the current in A that accelerates a servo of a model by 1 rad/s²."""
        return model.rotor_inertia_kg_m2 / self.kt_nm_a

    def moving_a(self, speed_rad_s: float) -> float:
        """Return the larger one of the friction currents in A at rest and at a speed in rad/s."""
        return max(self.breakaway_a, self.friction_a(speed_rad_s))


class DriveReport(NamedTuple):
    """Measured drive characteristics of a gripper's servos."""

    drives: Mapping[int, DriveCharacteristic]
    """By the servos' IDs; unmeasured servos have no entry."""
    notes: tuple[str, ...] = ()
    """Unusual changes since the last report, each with its likely cause."""
