"""Tuning of the force loop; an object that exists is valid."""

from dataclasses import dataclass
from math import isfinite

from gripper.errors import LimitExceeded


def check_number(
    name: str,
    value: float,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
) -> None:
    """Raise LimitExceeded when a value is not finite or outside its bounds."""
    wanted = [
        (low is None or value >= low, f"at least {low}"),
        (above is None or value > above, f"above {above}"),
        (high is None or value <= high, f"at most {high}"),
    ]
    if not isfinite(value) or not all(ok for ok, _ in wanted):
        broken = " and ".join(text for ok, text in wanted if not ok) or "a number"
        raise LimitExceeded(f"{name} is {value}, must be finite and {broken}")


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
    damping_n_s_m: float = 100.0
    motion_doubt_n_s_m: float = 140.0
    end_time_s: float = 0.11
    sensor_delay_s: float = 0.02
    dead_band_n: float = 0.03
    hold_band_n: float = 0.04
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
            check_number(name, getattr(self, name), above=0.0)
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
            check_number(name, getattr(self, name), low=0.0)
