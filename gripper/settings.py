"""Settings of a gripper; an object that exists is valid."""

from dataclasses import dataclass, field
from math import isfinite

from gripper.errors import LimitExceeded
from gripper.registers import PULSES_PER_TURN, WATCHDOG_UNIT_S
from gripper.servo_models import ServoModel, require_current_control

HARD_FORCE_CAP_N = 50.0
"""No setting allows more grip force in N; it is no safety function, see the documentation."""


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
class ForceLoopSettings:
    """Tuning of the force loop; the defaults suit foam pads and a sensor at 50 Hz.

    Attributes
    ----------
    bias_time_s, bias_rate_n_s
        Time constant in s with which the difference between sensor and model is learnt once the
        first samples are in; it halves where the set-point moves at ``bias_rate_n_s``.
    sample_noise_n
        Standard deviation of one sample in N; with it the first samples count for more.
    start_doubt_n, friction_doubt
        How uncertain the model is at the contact, in N, and by how much more where the force
        begins to move, as a share of the friction band.
    caution, settled_doubt_n
        A rising force stays below the set-point by ``caution`` times the doubt that is beyond
        ``settled_doubt_n`` in N: what is not known yet is approached from below.
    damping_n_s_m
        Drive in N taken away for each m/s that a finger is faster than the ramp needs.
    motion_doubt_n_s_m
        Noise in N added to a sample for each m/s of a finger: inertia makes the model wrong.
    end_time_s
        Time constant in s with which the force arrives at the end of a change; see
        `gripper.reference.Reference`.
    sensor_delay_s
        Time in s by which the sensor's filters lag behind the stamp of a sample.
    dead_band_n, hold_band_n
        Error in N that is left alone while the force keeps its direction: on a ramp, in a hold.
    reversal_band_n, reversal_band_share
        Error in N, or as a share of the set-point if that is more, that it takes to turn the
        direction round, through twice the friction.
    drive_rate_n_s
        Fastest change of the driving force in N/s, within the friction band.
    creep_n_s, creep_share
        Its rate in N/s, beside that of the set-point, where motion is about to begin: from this
        share of the friction band on.
    dither_share
        Square wave on the drive while the force changes, as a share of the friction band.
    push_open_share
        How hard the motor may push the fingers open to lower the force against friction, as a
        share of the friction band.
    bias_max_n, bias_max_share, bias_max_friction_share
        Largest plausible difference between sensor and model in N, plus a share of the
        set-point, plus a share of the friction band.
    taper_n_s
        Rate in N/s at which a long hold gives back drive that friction makes superfluous.
    """

    bias_time_s: float = 0.3
    bias_rate_n_s: float = 5.0
    sample_noise_n: float = 0.3
    start_doubt_n: float = 0.1
    friction_doubt: float = 0.1
    caution: float = 1.0
    settled_doubt_n: float = 0.1
    damping_n_s_m: float = 70.0
    motion_doubt_n_s_m: float = 100.0
    end_time_s: float = 0.1
    sensor_delay_s: float = 0.02
    dead_band_n: float = 0.05
    hold_band_n: float = 0.12
    reversal_band_n: float = 0.22
    reversal_band_share: float = 0.04
    drive_rate_n_s: float = 150.0
    creep_n_s: float = 5.0
    creep_share: float = 0.5
    dither_share: float = 0.2
    push_open_share: float = 1.3
    bias_max_n: float = 2.0
    bias_max_share: float = 0.4
    bias_max_friction_share: float = 0.6
    taper_n_s: float = 1.0

    def __post_init__(self) -> None:
        for name in (
            "bias_time_s",
            "bias_rate_n_s",
            "sample_noise_n",
            "drive_rate_n_s",
            "creep_n_s",
            "bias_max_n",
        ):
            _check(name, getattr(self, name), above=0.0)
        for name in (
            "start_doubt_n",
            "friction_doubt",
            "caution",
            "settled_doubt_n",
            "damping_n_s_m",
            "motion_doubt_n_s_m",
            "end_time_s",
            "sensor_delay_s",
            "dead_band_n",
            "hold_band_n",
            "reversal_band_n",
            "reversal_band_share",
            "creep_share",
            "dither_share",
            "push_open_share",
            "bias_max_share",
            "bias_max_friction_share",
            "taper_n_s",
        ):
            _check(name, getattr(self, name), low=0.0)


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
        Largest force in N that a ramp may ask for; None: force_max_n.
    current_max_a
        Cap of the goal current in A.
    temperature_max_c
        Warmest servo in degrees Celsius at which goals are still written.
    force_stale_s
        Oldest force sample in s that may be used.
    bus_loss_s
        Time without feedback in s after which the bus counts as lost.
    stall_max_s
        Lateness of a period in s after which the loop counts as stalled.
    watchdog_s
        Bus watchdog of the servos in s, 0.02 to 2.54 in steps of 0.02.
    settle_timeout_s
        Time in s after a ramp's end in which its force must be reached.
    settle_tolerance_n, settle_tolerance_share
        What counts as reached: in N, or as a share of the force if that is more.
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
    force_stale_s: float = 0.1
    bus_loss_s: float = 0.1
    stall_max_s: float = 0.25
    watchdog_s: float = 0.2
    settle_timeout_s: float = 0.5
    settle_tolerance_n: float = 0.3
    settle_tolerance_share: float = 0.07
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
        ):
            _check(name, getattr(self, name), above=0.0)
        for name in ("force_noise_n", "settle_tolerance_n", "settle_tolerance_share"):
            _check(name, getattr(self, name), low=0.0)
        _check("loop_rate_hz", self.loop_rate_hz, low=10.0, high=1000.0)
        _check("force_max_n", self.force_max_n, above=0.0, high=HARD_FORCE_CAP_N)
        _check("grasp_force_limit_n", self.grasp_force_limit_n, above=0.0, high=self.force_max_n)
        _check("aperture_min_m", self.aperture_min_m, low=0.0, high=self.aperture_open_m)
        _check("watchdog_s", self.watchdog_s, low=WATCHDOG_UNIT_S, high=127 * WATCHDOG_UNIT_S)
        if self.contact_samples < 1:
            raise LimitExceeded(f"contact_samples is {self.contact_samples}, must be at least 1")

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return 1.0 / self.loop_rate_hz

    @property
    def grasp_force_limit_n(self) -> float:
        """Largest force in N that a ramp may ask for."""
        return self.force_max_n if self.grasp_force_max_n is None else self.grasp_force_max_n

    @property
    def watchdog_raw(self) -> int:
        """Content of Bus Watchdog (register 98) in units of 20 ms, rounded up."""
        return max(1, min(127, round(self.watchdog_s / WATCHDOG_UNIT_S + 0.49)))

    def settle_tolerance_at_n(self, force_n: float) -> float:
        """Return the error in N that counts as reached at a force."""
        return max(self.settle_tolerance_n, self.settle_tolerance_share * force_n)


def _check(
    name: str,
    value: float,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
) -> None:
    wanted = [
        (low is None or value >= low, f"at least {low}"),
        (above is None or value > above, f"above {above}"),
        (high is None or value <= high, f"at most {high}"),
    ]
    if not isfinite(value) or not all(ok for ok, _ in wanted):
        broken = " and ".join(text for ok, text in wanted if not ok) or "a number"
        raise LimitExceeded(f"{name} is {value}, must be finite and {broken}")
