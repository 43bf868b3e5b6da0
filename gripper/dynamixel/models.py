"""The servo models for a gripper: electrical and torque values, and their registers.

Source: ROBOTIS e-Manual, pages of each model, sections "Specifications" and "Control Table".
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from enum import IntEnum
from functools import cache
from math import tau
from types import MappingProxyType
from typing import Any

from gripper.errors import LimitExceeded

KT_SD = 0.15
"""Standard deviation of the logarithm of torque for current between two servos of one model: 30 %.
[assumed]"""

_SLOW_RAD_S = 0.229 * tau / 60.0
"""Speed in rad/s of one count of the X series: 0.229 rev/min."""


class OperatingMode(IntEnum):
    """Values of Operating Mode (register 11)."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoModel:
    """One model of the series with the values for a gripper and its simulation."""

    name: str
    number: int
    """Name and content of Model Number (register 0)."""
    current_unit_a: float
    """A for one count of the current items."""
    pulses_per_turn: int = 4096
    """Counts of the position items in one turn."""
    goal_range_raw: tuple[int, int] = (-1_048_575, 1_048_575)
    """Least and largest Goal Position (register 116) in current-based position mode."""
    goal_velocity_raw: int = 0
    """Goal Velocity (register 104) in this mode; above 0 where it limits the speed there."""
    profile_in_current_mode: bool = True
    """Whether Profile Velocity (register 112) limits the speed in this mode; the documents of the
    330 size list it for modes 3 and 4 only."""
    ram_shift: int = 0
    """Offset of the RAM addresses from those of the X series."""
    absent: frozenset[str] = frozenset(
        {"acceleration_limit", *(f"external_port_mode_{n}" for n in (1, 2, 3, 4))}
    )
    """Names of the items of the control table that the model lacks; by default those that the X
    series lacks."""
    factory_mode: OperatingMode = OperatingMode.POSITION
    """Factory value of Operating Mode (register 11)."""
    velocity_unit_rad_s: float = _SLOW_RAD_S
    acceleration_unit_rad_s2: float = 214.577 * tau / 3600.0
    """rad/s for one count of the velocity items (0.229 rev/min), and rad/s² for one of Profile
    Acceleration (214.577 rev/min²)."""
    voltage_unit_v: float = 0.1
    """V for one count of the voltage items."""
    whole_pwm_raw: int = 885
    """PWM Limit (register 36) at which the whole supply reaches the motor."""
    error_per_pwm: float = 128.0
    """Position error in counts times Position P Gain for one count of PWM."""
    current_limit_raw: int
    velocity_limit_raw: int
    """Factory values and upper bounds of registers 38 and 44 (the latter: factory value)."""
    temperature_limit_c: int
    min_voltage_raw: int
    max_voltage_raw: int
    """Factory values of registers 31, 34 and 32."""
    shutdown_raw: int
    """Factory value of register 63."""
    position_gains: tuple[int, int, int]
    """Factory D, I and P gain (registers 80, 82, 84)."""
    velocity_gains: tuple[int, int]
    """Factory I and P gain (registers 76, 78)."""
    kt_nm_a: float
    friction_nm: float
    """Torque at the output with rising load: T = kt I - friction."""
    kt_sd: float = KT_SD
    back_emf_sd: float = 0.1
    """Uncertainty of ``kt_nm_a`` and of its ratio to the back-EMF for a servo without a
    measurement, as a share. [assumed]"""
    nominal_voltage_v: float
    stall_torque_nm: float
    stall_current_a: float
    no_load_rad_s: float
    """Speed without load at the nominal voltage, from the data sheet."""
    rotor_inertia_kg_m2: float
    """Inertia of rotor and gears at the output in kg m², estimated: the vendor publishes none. The
    simulated servo uses it, and the impact of an approach follows from it."""
    torque_source: str
    """Source of kt and friction."""

    def current_raw(self, current_a: float) -> int:
        """Return the counts for a current in A, rounded to the nearest."""
        return round(current_a / self.current_unit_a)

    def current_a(self, raw: int) -> float:
        """Return the current in A for counts of a current item."""
        return raw * self.current_unit_a

    @property
    def winding_ohm(self) -> float:
        """Resistance of the motor's winding in ohm, from the current of the stalled motor."""
        return self.nominal_voltage_v / self.stall_current_a

    @property
    def back_emf_v_s(self) -> float:
        """Voltage in V that the motor makes for each rad/s of the output, by its no-load speed."""
        idle_v = self.winding_ohm * self.friction_nm / self.kt_nm_a
        return (self.nominal_voltage_v - idle_v) / self.no_load_rad_s

    @property
    def slow_rad_s(self) -> float:
        """Speed in rad/s that counts as rest: a count of the X series, or of the model."""
        return max(self.velocity_unit_rad_s, _SLOW_RAD_S)

    @property
    def turns(self) -> bool:
        """Whether the model may turn by more than a whole turn."""
        return self.goal_range_raw[1] - self.goal_range_raw[0] > self.pulses_per_turn

    @property
    def rad_per_pulse(self) -> float:
        """Angle in rad of one count of the position items."""
        return tau / self.pulses_per_turn

    @property
    def factory_defaults(self) -> Mapping[str, int]:
        """Factory values by register name, of the items that differ from 0 or between models."""
        position_d, position_i, position_p = self.position_gains
        velocity_i, velocity_p = self.velocity_gains
        return MappingProxyType(
            {
                "model_number": self.number,
                "id": 1,
                "baud_rate": 1,
                "return_delay_time": 250,
                "operating_mode": int(self.factory_mode),
                "secondary_id": 255,
                "protocol_type": 2,
                "moving_threshold": 10,
                "temperature_limit": self.temperature_limit_c,
                "max_voltage_limit": self.max_voltage_raw,
                "min_voltage_limit": self.min_voltage_raw,
                "pwm_limit": self.whole_pwm_raw,
                "current_limit": self.current_limit_raw,
                "velocity_limit": self.velocity_limit_raw,
                "max_position_limit": self.pulses_per_turn - 1,
                "shutdown": self.shutdown_raw,
                "status_return_level": 2,
                "velocity_i_gain": velocity_i,
                "velocity_p_gain": velocity_p,
                "position_d_gain": position_d,
                "position_i_gain": position_i,
                "position_p_gain": position_p,
            }
        )


_RPM = tau / 60.0
"""Speed in rad/s of one rev/min, as data sheets give it."""
_ESTIMATE = (
    "stall point of the data sheet and a no-load friction of 5.4 % of the stall torque, as "
    "measured on the XM430-W350; measure before relying on it"
)
"""Source of torque figures that only the data sheet gives."""


def _estimated(stall_torque_nm: float, stall_current_a: float) -> dict[str, Any]:
    friction_nm = 0.054 * stall_torque_nm
    return {
        "kt_nm_a": (stall_torque_nm + friction_nm) / stall_current_a,
        "friction_nm": friction_nm,
        "stall_torque_nm": stall_torque_nm,
        "stall_current_a": stall_current_a,
        "torque_source": _ESTIMATE,
    }


XM430_W350 = ServoModel(
    name="XM430-W350",
    number=1020,
    current_unit_a=2.69e-3,
    current_limit_raw=1193,
    velocity_limit_raw=350,
    temperature_limit_c=80,
    min_voltage_raw=95,
    max_voltage_raw=160,
    shutdown_raw=52,
    position_gains=(0, 0, 800),
    velocity_gains=(1920, 100),
    kt_nm_a=1.769,
    friction_nm=0.2214,
    nominal_voltage_v=12.0,
    stall_torque_nm=4.1,
    stall_current_a=2.3,
    no_load_rad_s=46 * _RPM,
    rotor_inertia_kg_m2=0.012,
    torque_source="fit to the vendor's performance graph, forum.robotis.com/t/5827",
)
XM430_W210 = replace(
    XM430_W350,
    name="XM430-W210",
    number=1030,
    velocity_limit_raw=330,
    no_load_rad_s=77 * _RPM,
    rotor_inertia_kg_m2=0.0043,
    **_estimated(3.0, 2.3),
)
XL330_M288 = ServoModel(
    name="XL330-M288",
    number=1200,
    current_unit_a=1e-3,
    current_limit_raw=1750,
    velocity_limit_raw=445,
    temperature_limit_c=70,
    min_voltage_raw=35,
    max_voltage_raw=70,
    shutdown_raw=53,
    position_gains=(0, 0, 400),
    velocity_gains=(1600, 180),
    nominal_voltage_v=5.0,
    no_load_rad_s=103 * _RPM,
    rotor_inertia_kg_m2=0.0012,
    **_estimated(0.52, 1.47),
    profile_in_current_mode=False,
)
XC330_M288 = replace(
    XL330_M288,
    name="XC330-M288",
    number=1240,
    current_limit_raw=2352,
    velocity_limit_raw=350,
    shutdown_raw=52,
    position_gains=(500, 0, 1100),
    velocity_gains=(1600, 50),
    no_load_rad_s=81 * _RPM,
    **_estimated(0.93, 1.8),
)

RH_P12_RN_A = ServoModel(
    name="RH-P12-RN(A)",
    number=35074,
    current_unit_a=1e-3,
    goal_range_raw=(0, 1150),
    goal_velocity_raw=2970,
    ram_shift=448,
    absent=frozenset({"drive_mode", "protocol_type", "startup_configuration", "backup_ready"}),
    factory_mode=OperatingMode.CURRENT_BASED_POSITION,
    velocity_unit_rad_s=0.01 * _RPM,
    acceleration_unit_rad_s2=tau / 3600.0,
    whole_pwm_raw=2009,
    current_limit_raw=1984,
    velocity_limit_raw=2970,
    temperature_limit_c=80,
    min_voltage_raw=150,
    max_voltage_raw=350,
    shutdown_raw=52,
    position_gains=(0, 0, 8000),
    velocity_gains=(1920, 100),
    kt_nm_a=10.0,
    friction_nm=1.8,
    kt_sd=0.3,
    back_emf_sd=0.3,
    nominal_voltage_v=24.0,
    stall_torque_nm=32.0,
    stall_current_a=3.33,
    no_load_rad_s=0.76,
    rotor_inertia_kg_m2=0.1,
    torque_source=(
        "170 N at each finger, 1.984 A and a lever of 2 x 57 mm make 10 N m/A, and 5 where both "
        "fingers press with them together; measure before relying on it"
    ),
)
"""A gripper with one built-in servo (e-Manual, RH-P12-RN(A)). 3.33 A is its peak current, 0.76
rad/s its closing speed of 75 mm/s. Torque constant, friction, inertia and gains are unpublished:
they are assumed."""

_MODELS = {m.name: m for m in (XM430_W350, XM430_W210, XL330_M288, XC330_M288, RH_P12_RN_A)}
MODELS: Mapping[str, ServoModel] = MappingProxyType(_MODELS)
"""Models with a current limit, by name."""


def add_model(model: ServoModel) -> None:
    """Add a model to `MODELS`. Raises LimitExceeded where another model has its name or number."""
    for other in _MODELS.values():
        if other != model and (other.name == model.name or other.number == model.number):
            raise LimitExceeded(
                f"servo model {model.name} with number {model.number} is there with other values "
                f"({other.name}, {other.number}): give it a name and number of its own"
            )
    _MODELS[model.name] = model


def ram_shift(number: int) -> int:
    """Return `ServoModel.ram_shift` of the model with a Model Number (register 0)."""
    return next((m.ram_shift for m in MODELS.values() if m.number == number), 0)


WITHOUT_CURRENT_CONTROL = frozenset({"XL430-W250", "XC430-W150", "XC430-W240", "2XL430-W250"})
"""Models of the series without Goal Current (register 102); they are refused."""


@cache
def require_current_control(name: str) -> ServoModel:
    """Return the model with that name; LimitExceeded when it cannot limit its current.

    Grip force is limited through Goal Current (register 102) in current-based position mode. A
    model without current items cannot grip with a bounded force.
    """
    model = MODELS.get(name)
    if model is not None:
        return model
    if name in WITHOUT_CURRENT_CONTROL:
        raise LimitExceeded(
            f"{name} measures load, not current: it has no Goal Current and no current-based "
            f"position mode, so its grip force cannot be bounded. Use one of {', '.join(MODELS)}"
        )
    upper = {one.upper(): one for one in MODELS}
    near = get_close_matches(name.upper(), upper, n=1)
    meant = f"did you mean {upper[near[0]]}? " if near else ""
    raise LimitExceeded(f"servo model {name!r} is not known: {meant}use one of {', '.join(MODELS)}")


_OTHER_MODELS = {
    350: "XL-320",
    1000: "XH430-W350",
    1010: "XH430-W210",
    1040: "XH430-V350",
    1050: "XH430-V210",
    1060: "XL430-W250",
    1070: "XC430-W150",
    1080: "XC430-W240",
    1090: "2XL430-W250",
    1110: "XH540-W270",
    1120: "XM540-W270",
    1130: "XM540-W150",
    1190: "XL330-M077",
    1210: "XC330-T181",
    1220: "XC330-T288",
    1230: "XC330-M181",
}
"""Names of further models by Model Number (register 0), for messages (e-Manual)."""


def model_name(number: int) -> str:
    """Return the name of a model number, or the number where no name is known."""
    known = {model.number: model.name for model in MODELS.values()} | _OTHER_MODELS
    return known.get(number, f"of model number {number}")
