"""Contact, loss, slide and too much force on a simulated gripper: what it notices, and how soon.

Each with force messages of 500, 333 and 200 Hz and with whole frames at 50 Hz alone, on the plant
of `force_ramps`, in virtual time. Torque figures, friction, noise and the moments of the events
are drawn at random from seeds that nothing was tuned with. Prints median and worst: the largest
true force from the touch until the ramp begins, in N beyond the contact force; then the time in ms
from the true event to the end of the command that it ends.
"""

import math
import random
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median

from benchmarks._measure import line, repeats
from benchmarks.performance.force_ramps import NOISE_N, PARTS, PadForces, Part, Rig
from gripper.errors import ForceAboveCap, GripperError, LimitExceeded, PartLost, PartSlipped
from gripper.force.ramp import ForceRamp
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase

RATES_HZ = {"500 Hz": 500.0, "333 Hz": 333.0, "200 Hz": 200.0, "frames": None}
CONTACT_N, CAP_N = 0.6, 15.0
STEEL = PARTS["steel ball, 200 N/mm"]
_FIRST_SEED = 5000
_NOTHING = Part(width_m=0.0, stiffness_n_m=1.0)
_TRAPPED_M_S, _TRAPPED_M, _SLIDE_M_S = 0.02, 0.001, 0.02
"""Speed in m/s at which something trapped beside the part grows, and how far in m; of a slide."""
_FRAME_CENTRE_N_M, _SCAN_CENTRE_N_M = 0.0014, 0.0009
"""Noise of the centre of force along one axis times the force in N m, of a mean of three frames and
of one scan: 0.47 mm at 3 N as `cell.hand.local` has it, and 0.3 mm, which the noise of a scan makes
of a force that is spread over the whole pad."""
_SETTLED_S = 0.3
"""Time in s of a hold before anything happens to the part."""


class PlacedForces(PadForces):
    """Samples with the centre of the force too, which is at a place in m at a time in s."""

    def __init__(
        self, place_m: Callable[[float], float], noise_n: float, seed: int, rate_hz: float | None
    ) -> None:
        super().__init__(noise_n, seed, rate_hz)
        self._place_m, self._scan_n = place_m, noise_n * math.sqrt(1.5)
        self._places = random.Random(seed + 1)
        self._placed: ForceSample | None = None

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample."""
        sample, before = super().latest_force(), self._placed
        if sample is None or (before is not None and sample.t_s == before.t_s):
            return before
        if sample.grip_n > 0.0:
            noise_m = _FRAME_CENTRE_N_M / sample.grip_n
            if not self._frames:
                noise_m = _SCAN_CENTRE_N_M / sample.grip_n * sample.noise_n / self._scan_n
            x_m, y_m = (self._places.gauss(0.0, noise_m) for _ in (0, 1))
            centre_m = self._place_m(sample.measured_s) + x_m, y_m
            sample = replace(sample, centre_m=centre_m, centre_noise_m=noise_m)
        self._placed = sample
        return sample


class TouchRig(Rig):
    """A gripper on a part to which something happens at a time.

    The servos are drawn with the seed; ``settings`` are as for `Rig`.
    """

    def __init__(self, part: Part, rate_hz: float | None, seed: int, **settings: float) -> None:
        self.random = random.Random(seed)
        usual = {"slip_drop_n": 0.8, "slip_travel_m": 0.0015, "force_max_n": CAP_N}
        self.begins_s = self.over_s = math.inf
        """Times in s from which on the event happens, and at which the true force passed the cap.
        """
        self.changed: Callable[[float], Part] = lambda _: part
        self.slide_m_s = 0.0
        super().__init__(
            part, NOISE_N, servos=seed, seed=seed, rate_hz=rate_hz, **(usual | settings)
        )

    def _new_sensor(self, noise_n: float, seed: int, rate_hz: float | None) -> PadForces:
        return PlacedForces(self._place_m, noise_n, seed, rate_hz)

    def _place_m(self, t_s: float) -> float:
        return self.slide_m_s * max(0.0, t_s - self.begins_s)

    def _advance(self, now_s: float) -> None:
        if now_s >= self.begins_s:
            self._part = self.changed(now_s - self.begins_s)
        super()._advance(now_s)
        if self.force_n > CAP_N:
            self.over_s = min(self.over_s, now_s)


def impact(rate_hz: float | None, seed: int, *, speed_m_s: float) -> float:
    """Return by how many N the fingers pass the force of a contact on steel 8 mm away.

    Infinite where the grasp ended with a fault.
    """
    rig = TouchRig(STEEL, rate_hz, seed, approach_speed_m_s=speed_m_s)
    begun: list[float] = []

    def observe(cycle: Cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING and cycle.setpoint_n > 0.0:
            begun.append(cycle.t_s)

    rig.gripper.start()
    start_s = rig.now_s
    try:
        outcome = rig.gripper.grasp(ForceRamp.linear(3.0, 3.0), observe)
    except GripperError:
        return math.inf
    if outcome.contact_t_s is None:
        raise SystemExit(f"the fingers did not find the part: {outcome}")
    return max(n for t_s, n in rig.trace if start_s <= t_s <= begun[0]) - CONTACT_N


def _held(rate_hz: float | None, seed: int, force_n: float) -> TouchRig:
    rig = TouchRig(STEEL, rate_hz, seed)
    rig.gripper.start()
    outcome = rig.gripper.grasp(ForceRamp.linear(force_n, 10.0))
    if outcome.result not in (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED):
        raise SystemExit(f"the part is not held: {outcome}")
    return rig


def _after_hold(rig: TouchRig, *errors: type[GripperError]) -> float:
    """Return the time in s from the event to one of some errors; infinite without."""
    rig.begins_s = rig.now_s + _SETTLED_S + rig.random.uniform(0.0, 0.1)
    try:
        rig.gripper.hold(1.0)
    except errors:
        return rig.now_s - (rig.over_s if ForceAboveCap in errors else rig.begins_s)
    except GripperError:
        return math.inf
    return math.inf


def taken_in_a_hold(rate_hz: float | None, seed: int, *, force_n: float) -> float:
    """Return the time in s until a part that is taken out of a hold counts as lost, or slipped."""
    rig = _held(rate_hz, seed, force_n)
    rig.changed = lambda _: _NOTHING
    return _after_hold(rig, PartLost, PartSlipped)


def taken_in_a_ramp(rate_hz: float | None, seed: int) -> float:
    """Return the time in s until a part that is taken out at 3 N of a ramp counts as lost."""
    rig = TouchRig(STEEL, rate_hz, seed)
    rig.changed = lambda _: _NOTHING

    def take(cycle: Cycle) -> None:
        if cycle.setpoint_n > 3.0 and rig.begins_s == math.inf:
            rig.begins_s = cycle.t_s + rig.random.uniform(0.0, 0.02)

    rig.gripper.start()
    outcome = rig.gripper.grasp(ForceRamp.linear(8.0, 3.0), take)
    return rig.now_s - rig.begins_s if outcome.result is GraspResult.PART_LOST else math.inf


def slides(rate_hz: float | None, seed: int) -> float:
    """Return the time in s until a part that slides along the pads counts as slipping."""
    rig = _held(rate_hz, seed, 3.0)
    rig.slide_m_s = _SLIDE_M_S
    return _after_hold(rig, PartSlipped)


def trapped(rate_hz: float | None, seed: int) -> float:
    """Return the time in s from the cap to the fault, where something trapped pushes.

    The sudden growth of the force is a fault too. NaN where it pushes the fingers open before the
    true force is above the cap.
    """
    rig = _held(rate_hz, seed, 12.0)
    rig.changed = lambda t_s: STEEL._replace(
        width_m=STEEL.width_m + min(_TRAPPED_M, _TRAPPED_M_S * t_s)
    )
    noticed_s = _after_hold(rig, ForceAboveCap, LimitExceeded)
    return math.nan if rig.over_s == math.inf else noticed_s


EVENTS: dict[str, tuple[float, Callable[[float | None, int], float]]] = {
    "impact, steel, 12 mm/s": (1.0, partial(impact, speed_m_s=0.012)),
    "impact, steel, 15 mm/s": (1.0, partial(impact, speed_m_s=0.015)),
    "impact, steel, 24 mm/s": (1.0, partial(impact, speed_m_s=0.024)),
    "taken, hold of 3 N": (1e3, partial(taken_in_a_hold, force_n=3.0)),
    "taken, hold of 1.5 N": (1e3, partial(taken_in_a_hold, force_n=1.5)),
    "taken, ramp of 3 N/s": (1e3, taken_in_a_ramp),
    "slide of 20 mm/s, 3 N": (1e3, slides),
    "force above the cap": (1e3, trapped),
}
"""What is measured in N, or in s and shown in ms."""


def _text(times: list[float], factor: float) -> str:
    happened = sorted(factor * value for value in times if not math.isnan(value))
    noticed = [value for value in happened if value < math.inf]
    if not noticed:
        return f"none of {len(happened)}"
    few = f" ({len(noticed)} of {len(happened)})" if len(noticed) < len(times) else ""
    return f"{median(happened):6.2f}{noticed[-1]:7.2f}{few}"


def main(effort: float = 1.0) -> None:
    seeds = range(_FIRST_SEED, _FIRST_SEED + repeats(40, effort))
    line("compared", f"{len(seeds)} runs each; {', '.join(RATES_HZ)}")
    for name, (factor, run) in list(EVENTS.items())[:: 1 if effort >= 0.1 else 4]:
        cells = (_text([run(rate, seed) for seed in seeds], factor) for rate in RATES_HZ.values())
        line(name, "   ".join(f"{cell:^18}" for cell in cells))
