"""The servo models for a gripper: electrical and torque values, and their registers.

Source: ROBOTIS e-Manual, pages of each model, sections "Specifications" and "Control Table".
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from math import copysign, sqrt, tau
from types import MappingProxyType
from typing import Any

from gripper.errors import LimitExceeded

KT_SD = 0.15
"""Standard deviation of the logarithm of torque for current between two servos of one model: 30 %.
[assumed]"""

PWM_SLOPE_RAW = 140
"""Factory value of PWM Slope (register 62): 277 mV/ms."""


_ABSENT = frozenset(
    {"pwm_slope", "acceleration_limit", *(f"external_port_mode_{n}" for n in (1, 2, 3, 4))}
)
"""Names of the items of the control table that the X430 size lacks."""


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
    supply_current: bool = False
    """Whether these count the current of the supply, not of the winding: duty times winding
    current (Rhoban/bam, thread 14). Everywhere else in this package amperes are the winding's."""
    pulses_per_turn: int = 4096
    """Counts of the position items in one turn."""
    rad_per_pulse: float = field(init=False)
    """Angle in rad of one count of the position items."""
    goal_range_raw: tuple[int, int] = (-1_048_575, 1_048_575)
    """Least and largest Goal Position (register 116) in current-based position mode."""
    goal_velocity_raw: int = 0
    """Goal Velocity (register 104) in this mode; above 0 where it limits the speed there."""
    profile_in_current_mode: bool = True
    """Whether Profile Velocity (register 112) limits the speed in this mode; the documents of the
    330 size list it for modes 3 and 4 only."""
    ram_shift: int = 0
    """Offset of the RAM addresses from those of the X series."""
    absent: frozenset[str] = _ABSENT
    """Names of the items of the control table that the model lacks; by default those that the X430
    size lacks."""
    factory_mode: OperatingMode = OperatingMode.POSITION
    """Factory value of Operating Mode (register 11)."""
    velocity_unit_rad_s: float = 0.229 * tau / 60.0
    acceleration_unit_rad_s2: float = 214.577 * tau / 3600.0
    """rad/s for one count of the velocity items (0.229 rev/min), and rad/s² for one of Profile
    Acceleration (214.577 rev/min²)."""
    voltage_unit_v: float = 0.1
    """V for one count of the voltage items."""
    whole_pwm_raw: int = 885
    """PWM Limit (register 36) at which the whole supply reaches the motor."""
    error_per_pwm: float = 128.0
    """Position error in counts times Position P Gain for one count of the position loop's output:
    of PWM in mode 3, of Goal Current in mode 5. 128 by the e-Manual; 256 on the XL330-M288, by 16
    logs of duty against error (Rhoban/bam, revision af22604)."""
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
    """D, I and P gain (registers 80, 82, 84) that a start writes for mode 5. Only D damps there:
    the loop makes a current, which no back-EMF opposes. I gain and friction at rest would hunt."""
    kt_nm_a: float
    friction_nm: float
    """Torque at the output with rising load: T = kt I - friction."""
    falling_share: float = 1.0
    """Current for each N m of a load that falls, over that of one that rises."""
    kt_sd: float = KT_SD
    back_emf_sd: float = 0.1
    """Uncertainty of ``kt_nm_a`` and of its ratio to the back-EMF for a servo without a
    measurement, as a share. [assumed]"""
    nominal_voltage_v: float
    stall_torque_nm: float
    stall_current_a: float
    """Figures of the stalled motor at the nominal voltage, from the data sheet: A of the
    winding."""
    holding_a: float
    peak_a: float
    """A of the winding that the servo bears for hours, and for a second. Servos of users tripped
    above them, or became too hot."""
    no_load_rad_s: float
    """Speed without load at the nominal voltage, from the data sheet."""
    rotor_inertia_kg_m2: float
    """Inertia of rotor and gears at the output in kg m², estimated: the vendor publishes none. The
    impact of an approach follows from it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rad_per_pulse", tau / self.pulses_per_turn)

    def current_counts(
        self, winding_a: float, supply_v: float | None = None, against_rad_s: float = 0.0
    ) -> float:
        """Return the unrounded counts of a current item for a winding's current in A (0 or more).

        Where they count the current of the supply, a motor at rest needs R i² / V. The back-EMF of
        a motion that goes with the current is left out: a part that stops the finger ends it before
        the next write, so a moving finger has less current, and never more. A motion against the
        current helps it, and is subtracted.

        Parameters
        ----------
        supply_v
            Voltage of the supply; None: the nominal one.
        against_rad_s
            Speed from 0 up of a motion against the current.
        """
        if not self.supply_current:
            return winding_a / self.current_unit_a
        motor_v = max(0.0, self.winding_ohm * winding_a - self.back_emf_v_s * against_rad_s)
        duty = motor_v / (supply_v or self.nominal_voltage_v)
        return duty * winding_a / self.current_unit_a

    def winding_a(self, raw: int) -> float:
        """Return the current in A of the winding at rest for counts, at the nominal voltage."""
        item_a = raw * self.current_unit_a
        if not self.supply_current:
            return item_a
        return copysign(sqrt(abs(item_a) * self.nominal_voltage_v / self.winding_ohm), item_a)

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
    def damping_a_s(self) -> float:
        """Current in A by which mode 5 brakes for each rad/s: D/16 counts for a pulse in 1 ms.

        The RH-P12-RN(A) has no D gain; the back-EMF is taken there. [assumed]
        """
        d_gain = self.position_gains[0]
        by_gain = d_gain / 16.0 * 1e-3 / self.rad_per_pulse * self.current_unit_a
        return by_gain or self.stall_current_a / self.no_load_rad_s

    @property
    def turns(self) -> bool:
        """Whether the model may turn by more than a whole turn."""
        return self.goal_range_raw[1] - self.goal_range_raw[0] > self.pulses_per_turn

    @property
    def factory_defaults(self) -> Mapping[str, int]:
        """Factory values by register name, of the items that differ from 0 or between models.

        Gains are left out: a servo sets them itself with its mode.
        """
        return {
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
            **({} if "pwm_slope" in self.absent else {"pwm_slope": PWM_SLOPE_RAW}),
        }


_RPM = tau / 60.0
"""Speed in rad/s of one rev/min, as data sheets give it."""
_TABLE: Mapping[str, tuple[Any, ...]] = {
    # XM430-W350, XM430-W210, XL330-M288, XC330-M288, RH-P12-RN(A)
    "number": (1020, 1030, 1200, 1240, 35074),
    "current_unit_a": (2.69e-3, 2.69e-3, 1e-3, 1e-3, 1e-3),
    "current_limit_raw": (1193, 1193, 1750, 2352, 1984),
    "velocity_limit_raw": (350, 330, 445, 350, 2970),
    "temperature_limit_c": (80, 80, 70, 70, 80),
    "min_voltage_raw": (95, 95, 35, 35, 150),
    "max_voltage_raw": (160, 160, 70, 70, 350),
    "shutdown_raw": (52, 52, 53, 52, 52),
    "position_gains": (*[(4000, 0, 800)] * 2, (1000, 0, 1000), (1500, 0, 1000), (0, 0, 8000)),
    "kt_nm_a": (1.80, 1.333, 3.4 / 15, 0.33, 10.0),
    "friction_nm": (0.09, 0.067, 0.2 / 15, 0.025, 1.8),
    "nominal_voltage_v": (12.0, 12.0, 5.0, 5.0, 24.0),
    "stall_torque_nm": (4.1, 3.0, 0.52, 0.93, 32.0),
    "stall_current_a": (2.3, 2.3, 1.47, 1.8, 3.33),
    "holding_a": (0.40, 0.40, 0.383, 0.465, 0.58),
    "peak_a": (0.80, 0.80, 0.717, 1.04, 1.16),
    "no_load_rad_s": (46 * _RPM, 77 * _RPM, 103 * _RPM, 81 * _RPM, 0.76),
    "rotor_inertia_kg_m2": (0.006, 0.0022, 0.0022, 0.0035, 0.1),
}
"""Values of each model. Holding and peak current of the 330 size are 100 and 350 mA, and 120 and
600 mA, of the supply. Sources of kt and friction:

- XM430-W350: sweeps of the four servos of an OpenMANIPULATOR-X: 1.80 N m/A, friction 20 to 75 mA
  (smorales2405/open_manipulator_x_torque_control).
- XM430-W210: stall point of the data sheet, with the friction current of the XM430-W350.
- XL330-M288: slow rise of a weight: 13 to 17 V on the winding for each N m and 0.1 to 0.3 V without
  a load, falling 0.45 of it (logs of Rhoban/bam, revision af22604). The stall torque of the data
  sheet is 1.6 times as much; the uncertainty covers both.
- XC330-M288: by analogy: data sheet, with the XL330's ratio of slow rise and data sheet.
- RH-P12-RN(A), a gripper with one built-in servo: 170 N at each finger, 1.984 A and a lever of 2 x
  57 mm make 10 N m/A, and 5 where both fingers press with them together; measure before relying on
  it. 3.33 A is its peak current, 0.76 rad/s its closing speed of 75 mm/s. Torque constant,
  friction, inertia, gains and the currents of a hold are unpublished: they are assumed.
"""


def _of_the_table(column: int, name: str, **further: Any) -> ServoModel:
    """Return the model of a column, with further values."""
    values = {key: row[column] for key, row in _TABLE.items()}
    return ServoModel(name=name, **values, **further)


_SIZE_330: Mapping[str, Any] = {
    "supply_current": True,
    "error_per_pwm": 256.0,
    "falling_share": 0.45,
    "kt_sd": 0.25,
    "profile_in_current_mode": False,
    "absent": _ABSENT - {"pwm_slope"},
}
XM430_W350 = _of_the_table(0, "XM430-W350")
XM430_W210 = _of_the_table(1, "XM430-W210")
XL330_M288 = _of_the_table(2, "XL330-M288", **_SIZE_330)
XC330_M288 = _of_the_table(3, "XC330-M288", **_SIZE_330)
RH_P12_RN_A = _of_the_table(
    4,
    "RH-P12-RN(A)",
    goal_range_raw=(0, 1150),
    goal_velocity_raw=2970,
    ram_shift=448,
    absent=frozenset(
        {"pwm_slope", "drive_mode", "protocol_type", "startup_configuration", "backup_ready"}
    ),
    factory_mode=OperatingMode.CURRENT_BASED_POSITION,
    velocity_unit_rad_s=0.01 * _RPM,
    acceleration_unit_rad_s2=tau / 3600.0,
    whole_pwm_raw=2009,
    kt_sd=0.3,
    back_emf_sd=0.3,
)

_MODELS = {m.name: m for m in (XM430_W350, XM430_W210, XL330_M288, XC330_M288, RH_P12_RN_A)}
MODELS: Mapping[str, ServoModel] = MappingProxyType(_MODELS)
"""Models with a current limit, by name."""


def add_model(model: ServoModel) -> None:
    """Add a model to `MODELS`. Raises LimitExceeded where another model has its name or number."""
    for other in _MODELS.values():
        if other != model and (other.name == model.name or other.number == model.number):
            raise LimitExceeded(
                f"servo model {model.name} with number {model.number} exists with other values "
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
    raise LimitExceeded(f"servo model {name!r} is not known: use one of {', '.join(MODELS)}")


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
    names = {model.number: model.name for model in MODELS.values()} | _OTHER_MODELS
    return names.get(number, f"of model number {number}")
