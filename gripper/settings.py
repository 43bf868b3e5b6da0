"""Settings of a gripper: each with its unit, default and range, declared once.

Settings are checked when they are made. The cell's config file has the same settings in mm and ms,
with these defaults and ranges.
"""

from dataclasses import dataclass, field, fields
from math import inf, isfinite
from typing import Any, ClassVar

from gripper.dynamixel.control_table import WATCHDOG_UNIT_S
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.latency import LEAST_RATE_HZ
from gripper.dynamixel.models import ServoModel, require_current_control
from gripper.errors import LimitExceeded

HARD_FORCE_CAP_N = 50.0
"""Largest grip force in N of any setting; not a safety function, see the documentation."""

_OVERSHOOT_N, _OVERSHOOT_SHARE = 0.3, 0.1
"""Largest overshoot of a ramp in N, and as a share of its force; the larger of the two counts."""


def setting(default: Any, *, low: float = -inf, above: float = -inf, high: float = inf) -> Any:
    """Return a dataclass field with its default and range; ``above`` itself is not allowed."""
    return field(default=default, metadata={"low": low, "above": above, "high": high})


def check_number(
    name: str, value: float, *, low: float = -inf, above: float = -inf, high: float = inf
) -> float:
    """Return a value; raise LimitExceeded when it is not finite or outside its range."""
    bounds = [
        (value >= low, "at least", low),
        (value > above, "above", above),
        (value <= high, "at most", high),
    ]
    if not isfinite(value) or not all(ok for ok, _, _ in bounds):
        broken = [f"{word} {limit:g}" for ok, word, limit in bounds if not ok and isfinite(limit)]
        why = " and ".join(broken) or "a number"
        raise LimitExceeded(f"{name} is {value}, must be finite and {why}")
    return value


def check_settings(settings: Any) -> None:
    """Check every declared number of a settings object; raises LimitExceeded."""
    for key in fields(settings):
        if "low" in key.metadata and (value := getattr(settings, key.name)) is not None:
            check_number(key.name, value, **key.metadata)


def largest_setpoint_n(force_max_n: float) -> float:
    """Return the largest force in N that a ramp may ask for under a cap of the force.

    A ramp overshoots by at most 0.3 N, or 10 % where that is more; with it the cap holds.
    """
    return min(force_max_n - _OVERSHOOT_N, force_max_n / (1.0 + _OVERSHOOT_SHARE))


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoSettings:
    """One servo."""

    servo_id: int
    """ID on the bus, 0 to 252."""
    model: str = "XM430-W350"
    """Name of the model, see `gripper.dynamixel.models.MODELS`."""
    direction: int = 1
    """1 where growing positions open the gripper, -1 where they close it."""
    zero_raw: int = 2048
    """Present Position at angle 0 of the linkage, 0 to 4095."""
    measured: DriveCharacteristic | None = None
    """Drive characteristic that was measured on a bench; None: that of the catalogue."""
    servo_model: ServoModel = field(init=False, repr=False, compare=False)
    """Data of the model."""
    drive: DriveCharacteristic = field(init=False, repr=False, compare=False)
    """Drive characteristic of the servo before a measurement."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "servo_model", require_current_control(self.model))
        drive = self.measured or DriveCharacteristic.catalogue(self.servo_model)
        object.__setattr__(self, "drive", drive)
        check_number("servo_id", self.servo_id, low=0, high=252)
        if self.direction not in (-1, 1):
            raise LimitExceeded(f"direction is {self.direction}, must be 1 or -1")
        check_number("zero_raw", self.zero_raw, low=0, high=self.servo_model.pulses_per_turn - 1)

    def turns(self, position_raw: int) -> int:
        """Return how many whole turns a position is off that of the linkage, -90 to 270 degrees.

        A count over several turns may be off by whole ones.
        """
        turn_raw = self.servo_model.pulses_per_turn
        return round((position_raw - self.zero_raw) / turn_raw - 0.25 * self.direction)

    def angle_rad(self, position_raw: int, turns: int) -> float:
        """Return the angle of the linkage in rad at a position that is off by some turns."""
        turned_raw = position_raw - self.zero_raw - turns * self.servo_model.pulses_per_turn
        return turned_raw * self.servo_model.rad_per_pulse * self.direction


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSettings:
    """Settings of a gripper beside its linkage."""

    servos: tuple[ServoSettings, ...] = (ServoSettings(servo_id=1), ServoSettings(servo_id=2))
    """One servo that drives both fingers, or two that drive one each (finger 0, finger 1)."""
    loop_rate_hz: float = setting(200.0, low=LEAST_RATE_HZ, high=1000.0)
    """Rate of the loop in Hz. In a longer period a push accelerates a finger too much."""
    aperture_open_m: float = setting(0.018, low=0.002, high=0.4)
    """Opening of `Gripper.open` and `Gripper.release` in m."""
    aperture_min_m: float = setting(0.0005, low=-0.02, high=0.4)
    """Opening in m at which an approach ends: fingers without a touch are empty. Below 0 if they
    shall meet."""
    aperture_pressed_m: float | None = setting(None, low=-0.02, high=0.4)
    """Opening in m at which a ramp ends below its force: the part is too small or too soft. Below 0
    if the foam of the pads yields around a small part; None: ``aperture_min_m``."""
    approach_speed_m_s: float = setting(0.015, low=0.004, high=0.2)
    travel_speed_m_s: float = setting(0.06, low=0.004, high=0.2)
    open_speed_m_s: float = setting(0.06, low=0.002, high=0.2)
    """Rate of the opening in m/s while closing near a possible part, while closing before it, and
    while opening."""
    approach_force_n: float = setting(1.0, above=0.0, high=10.0)
    """Grip force in N beyond friction that the current allows while approaching."""
    pad_stiffness_n_m: float = setting(55e3, low=1e3, high=1e6)
    """Stiffness in N/m of a pad under the hardest part: by default a flat part on a whole pad of 55
    x 20 mm with foam of 3 mm and 150 kPa, as in the simulated cell. With the moving mass it sets
    the impact of an approach, see `gripper.mechanics.impact`."""
    contact_force_n: float = setting(0.6, low=0.1, high=5.0)
    """Force on each pad in N that counts as contact."""
    contact_samples: int = setting(3, low=1, high=50)
    """New samples in a row that confirm a contact."""
    contact_timeout_s: float = setting(5.0, low=1.0, high=60.0)
    """Longest approach in s."""
    force_max_n: float = setting(15.0, low=1.0, high=HARD_FORCE_CAP_N)
    """Cap of the measured grip force in N, at most `HARD_FORCE_CAP_N`."""
    force_noise_n: float = setting(0.5, low=0.0, high=5.0)
    """Excess of the mean of a few samples over the cap in N that noise may cause."""
    current_max_a: float = setting(0.8, low=0.05)
    """Cap of the goal current in A, at most stall current and Current Limit (register 38) of each
    servo's model."""
    temperature_max_c: float = setting(65.0, low=30.0, high=80.0)
    """Warmest servo in degrees Celsius that may press or hold a part."""
    force_stale_s: float = setting(0.1, low=0.02, high=1.0)
    """Oldest force sample in s that may be used."""
    bus_loss_s: float = setting(0.07, low=0.02, high=2.0)
    """Time without feedback in s after which the bus counts as lost: at least four periods, so that
    a finger that falls silent alone is found before."""
    feedback_loss_max_share: float = setting(0.05, low=0.001, high=1.0)
    """Largest share of periods without feedback; counted over a window in which one loss for
    ``bus_loss_s`` is just this share."""
    stall_max_s: float = setting(0.25, low=0.01, high=5.0)
    """Lateness of a period in s after which the loop counts as stalled."""
    overruns_max: int = setting(10, low=1, high=1000)
    """Periods in a row with too long work that end the command; the grip is kept."""
    watchdog_s: float = setting(0.1, low=WATCHDOG_UNIT_S, high=127 * WATCHDOG_UNIT_S)
    """Bus watchdog of the servos in s, 0.02 to 2.54 in steps of 0.02."""
    watchdog_self_test: bool = False
    """True to prove after the first opening that the bus watchdog stops the motors, by a motion
    of a few mm; a grasp then needs this proof."""
    over_force_share: ClassVar[float] = 0.5
    """Share of the goal currents that stays where one pad alone shows a force above its cap.
    [chosen]"""
    imbalance_n: ClassVar[float] = 2.0
    imbalance_share: ClassVar[float] = 0.5
    imbalance_s: ClassVar[float] = 0.2
    """Largest difference of the fingers' forces, and its longest time in s. It is in N, or a share
    of the grip force if that is more. [chosen]"""
    slip_drop_share: ClassVar[float] = 0.15
    slip_drop_n: float = setting(0.8, above=0.0, high=20.0)
    slip_travel_m: float = setting(0.0015, above=0.0, high=0.05)
    """Signs of a slip: a drop of the held force as a share [chosen], or in N if that is more; or
    closing in m while holding."""
    slide_m: ClassVar[float] = 0.0015
    """Distance in m along the pads by which the centre of a held force may move; larger with more
    noise, smaller for a sudden motion: see `gripper.force.supervision.slip`. [chosen]"""
    runaway_speed_m_s: ClassVar[float] = 0.02
    runaway_travel_m: float = setting(0.0005, above=0.0, high=0.05)
    """Excess in m/s over the closing speed that the force loop needs [chosen], and its distance in
    m, after which the part counts as lost."""
    settle_timeout_s: float = setting(0.5, above=0.0, high=10.0)
    """Time in s after a ramp's end in which its force must be reached."""
    settle_tolerance_n: float = setting(0.3, low=0.0, high=5.0)
    settle_tolerance_share: float = setting(0.07, low=0.0, high=0.5)
    """Tolerance of a reached force in N, or as a share of the force if that is more."""

    def __post_init__(self) -> None:
        ids = [servo.servo_id for servo in self.servos]
        if len(ids) not in (1, 2) or len(set(ids)) != len(ids):
            raise LimitExceeded(f"servos have the IDs {ids}, must be one or two different IDs")
        check_settings(self)
        check_number("aperture_min_m", self.aperture_min_m, high=self.aperture_open_m)
        check_number("aperture_pressed_m", self.least_pressed_m, high=self.aperture_min_m)
        check_number("bus_loss_s", self.bus_loss_s, low=4.0 * self.period_s)
        for servo in self.servos:
            model = servo.servo_model
            most_c = model.temperature_limit_c
            check_number("temperature_max_c", self.temperature_max_c, high=most_c)
            most_a = min(model.stall_current_a, model.winding_a(model.current_limit_raw))
            if self.current_max_a > most_a:
                raise LimitExceeded(
                    f"current_max_a is {self.current_max_a:g} A, servo {servo.servo_id} "
                    f"({servo.model}) makes at most {most_a:g} A"
                )

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return 1.0 / self.loop_rate_hz

    @property
    def least_pressed_m(self) -> float:
        """Smallest opening in m of fingers whose force rises."""
        least_m = self.aperture_pressed_m
        return self.aperture_min_m if least_m is None else least_m

    @property
    def watchdog_raw(self) -> int:
        """Content of Bus Watchdog (register 98) in units of 20 ms, rounded up."""
        return max(1, min(127, round(self.watchdog_s / WATCHDOG_UNIT_S + 0.49)))

    def settle_tolerance_at_n(self, force_n: float) -> float:
        """Return the error in N that counts as reached at a force."""
        return max(self.settle_tolerance_n, self.settle_tolerance_share * force_n)
