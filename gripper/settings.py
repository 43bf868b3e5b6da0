"""Settings of a gripper; an object that exists is valid."""

from dataclasses import dataclass, field
from enum import StrEnum

from gripper.correctable import CORRECTABLE
from gripper.errors import LimitExceeded
from gripper.loop_settings import ForceLoopSettings, check_number
from gripper.registers import PULSES_PER_TURN, WATCHDOG_UNIT_S
from gripper.servo_models import ServoModel, require_current_control

__all__ = [
    "HARD_FORCE_CAP_N",
    "ForceLoopSettings",
    "GripperSettings",
    "OverForce",
    "ServoSettings",
    "largest_setpoint_n",
]

HARD_FORCE_CAP_N = 50.0
"""No setting allows more grip force in N; it is no safety function, see the documentation."""


_OVERSHOOT_N, _OVERSHOOT_SHARE = 0.2, 0.05


def largest_setpoint_n(force_max_n: float) -> float:
    """Return the largest force in N that a ramp may ask for under a cap of the force.

    A ramp overshoots by at most 0.2 N, or 5 % where that is more; with it the cap holds.
    """
    return min(force_max_n - _OVERSHOOT_N, force_max_n / (1.0 + _OVERSHOOT_SHARE))


class OverForce(StrEnum):
    """What is done once when the force exceeds its cap; nothing ever pushes on.

    LOWER leaves a share of the currents, OPEN opens by a small step, LIMP switches the torque off.
    """

    LOWER = "lower"
    OPEN = "open"
    LIMP = "limp"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoSettings:
    """One servo.

    Attributes
    ----------
    servo_id
        ID on the bus, 0 to 252.
    model
        Name of the model, see `gripper.registers.MODELS`.
    direction
        1 where growing positions open the gripper, -1 where they close it.
    zero_raw
        Present Position at angle 0 of the linkage, 0 to 4095.
    """

    servo_id: int
    model: str = "XM430-W350"
    direction: int = 1
    zero_raw: int = 2048

    def __post_init__(self) -> None:
        require_current_control(self.model)
        if not 0 <= self.servo_id <= 252:
            raise LimitExceeded(f"servo_id is {self.servo_id}, must be from 0 to 252")
        if self.direction not in (-1, 1):
            raise LimitExceeded(f"direction is {self.direction}, must be 1 or -1")
        if not 0 <= self.zero_raw < PULSES_PER_TURN:
            raise LimitExceeded(f"zero_raw is {self.zero_raw}, must be from 0 to 4095")

    @property
    def servo_model(self) -> ServoModel:
        """Figures of the model."""
        return require_current_control(self.model)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSettings:
    """All that a gripper needs to know beside its linkage.

    Attributes
    ----------
    servos
        One servo that drives both fingers, or two that drive one each (finger 0, finger 1).
    loop_rate_hz
        Rate of the loop in Hz.
    aperture_open_m
        Opening of `Gripper.open` and `Gripper.release` in m.
    aperture_min_m
        Opening in m below which nothing can be held: the end of an approach.
    approach_speed_m_s, open_speed_m_s
        Rate of the aperture while closing and opening, in m/s.
    approach_force_n
        Grip force in N beyond friction that the current allows while approaching.
    contact_force_n
        Force on each pad in N that counts as contact.
    contact_samples
        New samples in a row that confirm a contact.
    contact_timeout_s
        Longest approach in s.
    force_max_n
        Cap of the measured grip force in N, at most `HARD_FORCE_CAP_N`.
    force_noise_n
        What the mean of three samples may exceed the cap by, in N, because of noise.
    grasp_force_max_n
        Largest force in N that a ramp may ask for; None, or what is more than `largest_setpoint_n`
        of the cap: that.
    current_max_a
        Cap of the goal current in A.
    temperature_max_c
        Warmest servo in degrees Celsius at which goals are still written.
    temperature_derate_k
        So many degrees below it the cap of the current begins to fall, to half at the maximum.
    force_stale_s
        Oldest force sample in s that may be used.
    bus_loss_s
        Time without feedback in s after which the bus counts as lost.
    stall_max_s
        Lateness of a period in s after which the loop counts as stalled.
    overruns_max
        So many periods in a row whose work took too long end the command; the grip is kept.
    watchdog_s
        Bus watchdog of the servos in s, 0.02 to 2.54 in steps of 0.02.
    watchdog_self_test
        True to prove after the first opening that the bus watchdog stops the motors, by a motion
        of a few mm; without the proof no grasp is begun.
    over_force
        What is done when the force exceeds its cap.
    over_force_share
        Share of the goal currents that `OverForce.LOWER` leaves, in one step.
    over_force_open_m
        Opening in m by which `OverForce.OPEN` opens, in one step.
    imbalance_n, imbalance_share, imbalance_s
        The fingers' forces may differ by so much in N, or by a share of the grip force if that is
        more, for so long in s.
    slip_drop_n, slip_drop_share, slip_travel_m
        A drop of the held force in N, or as a share if that is more, or closing in m while
        holding, that is reported as a slip.
    slide_m
        Way in m along both pads by which the centre of a held force may move, at 4 N and more; in
        inverse proportion below.
    runaway_speed_m_s, runaway_travel_m
        Fingers that close faster than the force loop wants by so much in m/s, over so far in m,
        have lost the part.
    settle_timeout_s
        Time in s after a ramp's end in which its force must be reached.
    settle_tolerance_n, settle_tolerance_share
        What counts as reached: in N, or as a share of the force if that is more.
    taper_after_s
        Time in s after which a hold begins to give back current that friction makes superfluous.
    corrected_registers
        Registers that a start makes to agree while the torque is off; the others are compared.
    force_loop
        Tuning of the force loop.
    """

    servos: tuple[ServoSettings, ...]
    loop_rate_hz: float = 200.0
    aperture_open_m: float = 0.03
    aperture_min_m: float = 0.0005
    approach_speed_m_s: float = 0.02
    open_speed_m_s: float = 0.06
    approach_force_n: float = 1.0
    contact_force_n: float = 0.5
    contact_samples: int = 3
    contact_timeout_s: float = 5.0
    force_max_n: float = HARD_FORCE_CAP_N
    force_noise_n: float = 0.5
    grasp_force_max_n: float | None = None
    current_max_a: float = 0.8
    temperature_max_c: float = 70.0
    temperature_derate_k: float = 10.0
    force_stale_s: float = 0.1
    bus_loss_s: float = 0.07
    stall_max_s: float = 0.25
    overruns_max: int = 10
    watchdog_s: float = 0.2
    watchdog_self_test: bool = False
    over_force: OverForce = OverForce.LOWER
    over_force_share: float = 0.5
    over_force_open_m: float = 0.0005
    imbalance_n: float = 2.0
    imbalance_share: float = 0.5
    imbalance_s: float = 0.2
    slip_drop_n: float = 0.8
    slip_drop_share: float = 0.15
    slip_travel_m: float = 0.0015
    slide_m: float = 0.0015
    runaway_speed_m_s: float = 0.02
    runaway_travel_m: float = 0.0005
    settle_timeout_s: float = 0.5
    settle_tolerance_n: float = 0.3
    settle_tolerance_share: float = 0.07
    taper_after_s: float = 1.0
    corrected_registers: frozenset[str] = CORRECTABLE
    force_loop: ForceLoopSettings = field(default_factory=ForceLoopSettings)

    def __post_init__(self) -> None:
        ids = [servo.servo_id for servo in self.servos]
        if len(ids) not in (1, 2) or len(set(ids)) != len(ids):
            raise LimitExceeded(f"servos have the IDs {ids}, must be one or two different ones")
        for name in (
            "aperture_open_m",
            "approach_speed_m_s",
            "open_speed_m_s",
            "approach_force_n",
            "contact_force_n",
            "contact_timeout_s",
            "current_max_a",
            "temperature_max_c",
            "force_stale_s",
            "bus_loss_s",
            "stall_max_s",
            "settle_timeout_s",
            "over_force_open_m",
            "imbalance_n",
            "imbalance_s",
            "slip_drop_n",
            "slip_travel_m",
            "slide_m",
            "runaway_speed_m_s",
            "runaway_travel_m",
        ):
            check_number(name, getattr(self, name), above=0.0)
        for name in (
            "force_noise_n",
            "settle_tolerance_n",
            "settle_tolerance_share",
            "temperature_derate_k",
            "imbalance_share",
            "slip_drop_share",
            "taper_after_s",
        ):
            check_number(name, getattr(self, name), low=0.0)
        check_number("over_force_share", self.over_force_share, low=0.0, high=1.0)
        check_number("loop_rate_hz", self.loop_rate_hz, low=10.0, high=1000.0)
        check_number("force_max_n", self.force_max_n, above=0.0, high=HARD_FORCE_CAP_N)
        if self.grasp_force_max_n is not None:
            check_number(
                "grasp_force_max_n", self.grasp_force_max_n, above=0.0, high=self.force_max_n
            )
        check_number("the largest force of a ramp under it", self.grasp_force_limit_n, above=0.0)
        check_number("aperture_min_m", self.aperture_min_m, low=0.0, high=self.aperture_open_m)
        check_number("watchdog_s", self.watchdog_s, low=WATCHDOG_UNIT_S, high=127 * WATCHDOG_UNIT_S)
        if self.overruns_max < 1:
            raise LimitExceeded(f"overruns_max is {self.overruns_max}, must be at least 1")
        if not self.corrected_registers <= CORRECTABLE:
            raise LimitExceeded(
                f"corrected_registers names {sorted(self.corrected_registers - CORRECTABLE)}, only "
                f"{', '.join(sorted(CORRECTABLE))} can be corrected"
            )
        if self.contact_samples < 1:
            raise LimitExceeded(f"contact_samples is {self.contact_samples}, must be at least 1")

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return 1.0 / self.loop_rate_hz

    @property
    def grasp_force_limit_n(self) -> float:
        """Largest force in N that a ramp may ask for: its overshoot stays below the cap."""
        largest_n = largest_setpoint_n(self.force_max_n)
        return (
            largest_n if self.grasp_force_max_n is None else min(largest_n, self.grasp_force_max_n)
        )

    @property
    def watchdog_raw(self) -> int:
        """Content of Bus Watchdog (register 98) in units of 20 ms, rounded up."""
        return max(1, min(127, round(self.watchdog_s / WATCHDOG_UNIT_S + 0.49)))

    def current_cap_a(self, temperature_c: float) -> float:
        """Return the cap of the goal current in A at the warmest servo's temperature."""
        over_k = temperature_c - (self.temperature_max_c - self.temperature_derate_k)
        if over_k <= 0.0:
            return self.current_max_a
        return self.current_max_a * max(
            0.5, 1.0 - 0.5 * over_k / max(self.temperature_derate_k, 1e-9)
        )

    def derates(self, temperature_c: float) -> bool:
        """Say whether the warmest servo's temperature lowers the cap of the current."""
        return temperature_c > self.temperature_max_c - self.temperature_derate_k

    def settle_tolerance_at_n(self, force_n: float) -> float:
        """Return the error in N that counts as reached at a force."""
        return max(self.settle_tolerance_n, self.settle_tolerance_share * force_n)
