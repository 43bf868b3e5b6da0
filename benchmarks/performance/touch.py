"""Contact, loss, slide and too much force on a simulated gripper: what it notices, and how soon.

Each with force messages of 500, 333 and 200 Hz and with whole frames at 50 Hz alone, on the plant
of `force_ramps`, in virtual time. Torque figures, friction, noise and the moments of the events
are drawn at random from seeds that nothing was tuned with. Impact: the largest true force from the
touch until the ramp begins, beyond the contact force. Times count from the true event to the end
of the command that it ends.
"""

import argparse
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

from benchmarks._measure import line, repeats
from benchmarks.performance._force_plant import Part, Rig, Sensor, Truth
from benchmarks.performance.force_ramps import PARTS
from gripper.errors import ForceAboveCap, GripperError, LimitExceeded, PartLost, PartSlipped
from gripper.force.ramp import ForceRamp
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase

RATES_HZ: dict[str, float | None] = {
    "500 Hz": 500.0,
    "333 Hz": 333.0,
    "200 Hz": 200.0,
    "frames": None,
}
NOISE_N = 0.2
CONTACT_N = 0.6
CAP_N = 15.0
"""Cap of the force in N in the runs that pass it."""
STEEL = PARTS["steel ball, 200 N/mm"]
_FIRST_SEED = 5000
_NOTHING = Part(width_m=0.0, stiffness_n_m=1.0)
_TRAPPED_M_S, _TRAPPED_M = 0.02, 0.001
"""Speed in m/s at which something trapped beside the part grows, and how far in m."""
_SLIDE_M_S = 0.02
_FRAME_CENTRE_N_M, _SCAN_CENTRE_N_M = 0.0014, 0.0009
"""Noise of the centre of force along one axis times the force in N m, of a mean of three frames and
of one scan: 0.47 mm at 3 N as `cell.hand.local` has it, and 0.3 mm, which the noise of a scan makes
of a force that is spread over the whole pad."""
_ALL_FROM = 0.1
"""Effort from which on all figures are measured; below, the first one of each kind."""
_SETTLED_S = 0.3
"""Time in s of a hold before anything happens to the part."""


class CentreSensor:
    """A sensor whose samples have the centre of the force too.

    Parameters
    ----------
    place_m
        The centre in m along the fingers at a time in s.
    scan_n
        Noise of the grip force of one scan in N; None for frames.
    """

    def __init__(
        self, sensor: Sensor, place_m: Callable[[float], float], scan_n: float | None, seed: int
    ) -> None:
        self._sensor = sensor
        self._place_m = place_m
        self._scan_n = scan_n
        self._random = random.Random(seed)
        self._latest: ForceSample | None = None

    def measure(self, now_s: float, force_n: float) -> None:
        """Take the force in N on each pad at a time in s."""
        self._sensor.measure(now_s, force_n)

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample."""
        found, before = self._sensor.latest_force(), self._latest
        if found is None or (before is not None and found.t_s == before.t_s):
            return before
        if found.grip_n <= 0.0:
            self._latest = found
            return found
        if self._scan_n is None:
            noise_m = _FRAME_CENTRE_N_M / found.grip_n
        else:
            noise_m = _SCAN_CENTRE_N_M / found.grip_n * found.noise_n / self._scan_n
        x_m, y_m = (self._random.gauss(0.0, noise_m) for _ in (0, 1))
        self._latest = replace(
            found,
            centre_m=(self._place_m(found.measured_s) + x_m, y_m),
            centre_noise_m=noise_m,
        )
        return self._latest


class TouchRig(Rig):
    """A gripper on a part to which something happens at a time.

    Parameters
    ----------
    part, rate_hz, seed, noise_n, settings
        As for `Rig`; torque figures and friction are drawn with the seed.
    """

    def __init__(
        self,
        part: Part,
        rate_hz: float | None,
        seed: int,
        noise_n: float = NOISE_N,
        **settings: float,
    ) -> None:
        self.random = random.Random(seed)
        truth = Truth(
            kt_error=self.random.uniform(-0.15, 0.15),
            friction_error=self.random.uniform(-0.2, 0.2),
            seed=seed,
        )
        usual = {"slip_drop_n": 0.8, "slip_travel_m": 0.0015, "force_max_n": CAP_N}
        self.begins_s = math.inf
        """Time in s from which on the event happens; none where it is infinite."""
        self.over_s = math.inf
        """Time in s at which the true force first passed the cap."""
        self.changed: Callable[[float], Part] = lambda _: part
        self.slide_m_s = 0.0
        super().__init__(part, truth, noise_n, rate_hz=rate_hz, **(usual | settings))

    def _new_sensor(self, noise_n: float, seed: int, rate_hz: float | None) -> Sensor:
        sensor = super()._new_sensor(noise_n, seed, rate_hz)
        scan_n = None if rate_hz is None else noise_n * math.sqrt(1.5)
        return CentreSensor(sensor, self._place_m, scan_n, seed + 1)

    def _place_m(self, t_s: float) -> float:
        return self.slide_m_s * max(0.0, t_s - self.begins_s)

    def _advance(self, now_s: float) -> None:
        if now_s >= self.begins_s:
            self._part = self.changed(now_s - self.begins_s)
        super()._advance(now_s)
        if self.force_n > CAP_N:
            self.over_s = min(self.over_s, now_s)

    def most_n(self, from_s: float, to_s: float) -> float:
        """Return the largest true force in N within a time."""
        return max(force_n for t_s, force_n in self._trace if from_s <= t_s <= to_s)


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
    return rig.most_n(start_s, begun[0]) - CONTACT_N


def _held(rig: TouchRig, force_n: float) -> None:
    rig.gripper.start()
    outcome = rig.gripper.grasp(ForceRamp.linear(force_n, 10.0))
    if outcome.result not in (GraspResult.FORCE_REACHED, GraspResult.FORCE_NOT_REACHED):
        raise SystemExit(f"the part is not held: {outcome}")


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
    rig = TouchRig(STEEL, rate_hz, seed)
    rig.changed = lambda _: _NOTHING
    _held(rig, force_n)
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
    rig = TouchRig(STEEL, rate_hz, seed)
    rig.slide_m_s = _SLIDE_M_S
    _held(rig, 3.0)
    return _after_hold(rig, PartSlipped)


def trapped(rate_hz: float | None, seed: int) -> float:
    """Return the time in s from the cap to the fault, where something trapped pushes.

    The sudden growth of the force is a fault too. NaN where it pushes the fingers open before the
    true force is above the cap.
    """
    rig = TouchRig(STEEL, rate_hz, seed)
    rig.changed = lambda t_s: replace(
        STEEL, width_m=STEEL.width_m + min(_TRAPPED_M, _TRAPPED_M_S * t_s)
    )
    _held(rig, 12.0)
    noticed_s = _after_hold(rig, ForceAboveCap, LimitExceeded)
    return math.nan if rig.over_s == math.inf else noticed_s


def quiet(rate_hz: float | None, seed: int) -> str:
    """Return what was reported in a hold of 2 s in which nothing happens; empty without."""
    force_n = random.Random(-seed).choice([1.0, 3.0, 3.0, 14.2])
    rig = TouchRig(STEEL, rate_hz, seed)
    try:
        _held(rig, force_n)
        rig.gripper.hold(2.0)
    except GripperError as error:
        return f"{type(error).__name__} at {force_n} N, seed {seed}: {error}"
    return ""


def random_ramp(rate_hz: float | None, seed: int) -> str:
    """Return what a random ramp on a random part reported; empty where the part is held."""
    choice = random.Random(-seed)
    part = choice.choice(list(PARTS.values()))
    final_n = choice.choice([0.8, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0])
    rate_n_s = choice.choice([1.0, 2.0, 5.0, 10.0, 20.0])
    rig = TouchRig(
        part, rate_hz, seed, choice.choice([0.1, 0.2]), slip_drop_n=20.0, slip_travel_m=0.05
    )
    rig.gripper.start()
    what = f"{part.stiffness_n_m:g} N/m to {final_n} N at {rate_n_s} N/s, seed {seed}"
    try:
        outcome = rig.gripper.grasp(ForceRamp.linear(final_n, rate_n_s))
        if outcome.result is GraspResult.PART_LOST:
            return f"lost in the ramp: {what}"
        if outcome.contact_t_s is None:
            return f"no contact: {what}"
        rig.gripper.hold(0.5)
    except GripperError as error:
        return f"{type(error).__name__}: {what}: {error}"
    return ""


TIMES: dict[str, Callable[[float | None, int], float]] = {
    "taken, hold of 3 N": partial(taken_in_a_hold, force_n=3.0),
    "taken, hold of 1.5 N": partial(taken_in_a_hold, force_n=1.5),
    "taken, ramp of 3 N/s": taken_in_a_ramp,
    "slide of 20 mm/s, 3 N": slides,
    "force above the cap": trapped,
}
"""Events whose detection takes time."""

QUIET: dict[str, Callable[[float | None, int], str]] = {
    "holds of 1 to 14.2 N": quiet,
    "random ramps": random_ramp,
}
"""Holds and ramps in which nothing happens: each report is a wrong one."""

IMPACTS: dict[str, Callable[[float | None, int], float]] = {
    f"impact, steel, {1e3 * speed_m_s:g} mm/s": partial(impact, speed_m_s=speed_m_s)
    for speed_m_s in (0.012, 0.015, 0.024)
}


def _times(found_s: Sequence[float]) -> str:
    happened = sorted(t_s for t_s in found_s if not math.isnan(t_s))
    noticed = [t_s for t_s in happened if t_s < math.inf]
    if not noticed:
        return f"none of {len(happened)}"
    text = f"{1e3 * median(happened):6.1f}{1e3 * noticed[-1]:7.1f}"
    if len(noticed) < len(found_s):
        text += f" ({len(noticed)} of {len(happened)})"
    return text


def _impacts(over_n: Sequence[float]) -> str:
    missed = over_n.count(math.inf)
    return f"{median(over_n):5.2f}{max(over_n):5.2f}" + (f" ({missed} missed)" if missed else "")


def main(effort: float = 1.0, *, only: str = "", first_seed: int = _FIRST_SEED) -> None:
    """Measure and print; ``only`` names the figures that are wanted by a part of their name."""
    n, n_quiet = repeats(40, effort), repeats(100, effort)
    wanted = slice(None if effort >= _ALL_FROM else 1)

    def rows(table: Mapping[str, Callable[[float | None, int], Any]]) -> list[str]:
        return [name for name in table if only in name][wanted]

    def cells(run: Callable[[float | None, int], Any], count: int) -> dict[str, list[Any]]:
        seeds = range(first_seed, first_seed + count)
        return {name: [run(rate_hz, i) for i in seeds] for name, rate_hz in RATES_HZ.items()}

    line("compared", f"{n} runs each, {n_quiet} quiet holds, {3 * n_quiet} random ramps")
    line("", f"noise {NOISE_N} N of a mean of three scans, {NOISE_N * math.sqrt(3.0):.2f} N of one")
    line("", "   ".join(f"{name:^18}" for name in RATES_HZ))
    line("", "N over contact: median and worst")
    for name in rows(IMPACTS):
        line(name, "   ".join(f"{_impacts(c):^18}" for c in cells(IMPACTS[name], n).values()))
    line("", "ms until it is noticed: median and worst")
    for name in rows(TIMES):
        line(name, "   ".join(f"{_times(c):^18}" for c in cells(TIMES[name], n).values()))
    line("", "wrong reports")
    for name in rows(QUIET):
        reports = cells(QUIET[name], n_quiet * (3 if QUIET[name] is random_ramp else 1))
        line(name, "   ".join(f"{sum(map(bool, texts)):^18}" for texts in reports.values()))
        for sensor, texts in reports.items():
            for text in filter(None, texts):
                line("", f"{sensor}: {text[:150]}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="What a simulated gripper notices, and how soon.")
    parser.add_argument("--only", default="", help="part of the name of the figures wanted")
    parser.add_argument("--effort", type=float, default=1.0, help="share of the runs")
    parser.add_argument("--seed", type=int, default=_FIRST_SEED, help="first seed")
    given = parser.parse_args()
    main(given.effort, only=given.only, first_seed=given.seed)
