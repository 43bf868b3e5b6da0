"""Force ramps on simulated grippers whose servos are drawn from the spread of real ones.

Parts of three stiffnesses between creeping foam pads, ramps of 1 to 40 N/s, in virtual time. Each
gripper has measured its servos before, as a self-zero does. It runs with force messages and with
frames. The plain alternative is a PI on the force, with the measured friction as feed-forward and a
reset at rest, on the same plants.

Prints for each seed how many ramps meet the aims for the true force: overshoot of at most 10 % or
0.3 N; within 5 % or 0.3 N from 0.3 s after the ramp on; the same in the hold. Then the mean error
in the hold and the parts wrongly taken for lost. The seeds chose nothing. The held force is also
changed, at 20 N/s: a further ramp is up to a force that the part has not had, or down.
"""

import math
import random
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from math import copysign
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from benchmarks._measure import line, repeats
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import XM430_W350
from gripper.errors import GripperError
from gripper.force.control import grip_control
from gripper.force.estimates.grip import Grip
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics, mean_friction_n, mean_yielding_n
from gripper.settings import HARD_FORCE_CAP_N, GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from simulator.clock import VirtualClock
from simulator.servo.bus import MemoryServoStream, ServoBusDevice
from simulator.servo.device import SimulatedServo
from simulator.servo.gearing import Drive, drawn_drive
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, ServoMount
from simulator.servo.motor import ServoMotor

_MESSAGE_S, _FRAME_S = 0.0015, 0.025
"""From a scan to its message in the host: scan 0.6 ms, wire 0.15 ms, a burst's message, adapter;
and from a frame to its sample."""
_FRAME_PERIOD_S = 0.02
FOAM_N_M, FOAM_N_M2 = 5e3, 4e6
"""Each pad: force = FOAM_N_M d + FOAM_N_M2 d^2 for a depth d in m."""
CREEP, CREEP_S = 0.08, 0.5
"""Share of its force that foam loses at a constant depth, and the time constant in s: 7 % in the
first second. A standard linear solid whose springs are those of the foam; assumptions."""
_FREE_M = 0.008
"""Way in m of open fingers to the part."""
_HOLD_S, _SETTLED_S = 1.5, 0.3
_PADS_N, _PADS_N_S = 10.0, 5.0
"""Force in N, and its growth in N/s, with which a cell presses its empty pads on each other."""
_PADS_GIVE_M = 0.004
"""Way in m of each finger beyond the middle, where empty pads press on each other."""
_UNSUPERVISED_M = 0.05
"""Way in m of fingers that run ahead, longer than any here."""


class Part(NamedTuple):
    """A part between two foam pads: its width in m and its own stiffness in N/m."""

    width_m: float
    stiffness_n_m: float

    def press(self, opening_m: float, relaxed_n: float = 0.0) -> tuple[float, float]:
        """Return grip force in N and its slope over the opening in N/m.

        Parameters
        ----------
        opening_m
            Distance between the backs of the pads' foam.
        relaxed_n
            Force in N that the foam of each pad has lost by creep.
        """
        pressed_m = self.width_m - opening_m + relaxed_n / self.stiffness_n_m
        if pressed_m <= 0.0:
            return 0.0, 0.0
        a, b = FOAM_N_M2 / self.stiffness_n_m, 2.0 + FOAM_N_M / self.stiffness_n_m
        depth_m = 2.0 * pressed_m / (b + math.sqrt(b * b + 4.0 * a * pressed_m))
        slope = FOAM_N_M + 2.0 * FOAM_N_M2 * depth_m
        force_n = FOAM_N_M * depth_m + FOAM_N_M2 * depth_m**2 - relaxed_n
        if force_n <= 0.0:
            return 0.0, 0.0
        return force_n, slope / (2.0 + slope / self.stiffness_n_m)


class PadForces:
    """Samples of the force on both pads: force messages, or frames.

    Each message has one scan, and a sample is the mean of the messages since the last one, as
    `tactile.GripForce` makes it. Frames come at 50 Hz; a sample is the mean of three.

    Parameters
    ----------
    noise_n
        Noise in N of a mean of three scans.
    rate_hz
        Force messages a second; None: frames.
    """

    def __init__(self, noise_n: float, seed: int, rate_hz: float | None) -> None:
        self._random = random.Random(seed)
        self._scan_sd_n = noise_n * math.sqrt(3.0)
        self._frames, self._now_s = rate_hz is None, 0.0
        self._period_s = 1.0 / rate_hz if rate_hz else _FRAME_PERIOD_S
        self._due_s = self._random.uniform(0.0, self._period_s)
        self._scans_n: deque[Any] = deque(maxlen=3 if self._frames else 1)
        self._waiting: deque[tuple[float, ForceSample]] = deque()
        self._latest: ForceSample | None = None

    def measure(self, now_s: float, force_n: float) -> None:
        """Take the force in N on each pad at a time in s."""
        self._now_s = now_s
        while self._due_s <= now_s:
            noise = [self._random.gauss(0.0, self._scan_sd_n) if force_n else 0.0 for _ in (0, 1)]
            scan_n = np.add(force_n, noise)
            self._scans_n.append(np.maximum(0.0, scan_n) if self._frames else scan_n)
            t_s, late_s = (now_s, _FRAME_S) if self._frames else (self._due_s, _MESSAGE_S)
            sample = ForceSample(t_s=t_s, force_n=_mean(self._scans_n))
            self._waiting.append((t_s + late_s, sample))
            self._due_s += self._period_s

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample; see `gripper.values.force_sensor.ForceSensor`."""
        arrived: list[tuple[float, ForceSample]] = []
        while self._waiting and self._waiting[0][0] <= self._now_s:
            arrived.append(self._waiting.popleft())
        if arrived:
            newest_s, self._latest = arrived[-1]
            if not self._frames:
                samples = [sample for _, sample in arrived]
                self._latest = ForceSample(
                    t_s=newest_s,
                    force_n=_mean([sample.force_n for sample in samples]),
                    lag_s=newest_s - sum(sample.t_s for sample in samples) / len(samples),
                    noise_n=self._scan_sd_n / math.sqrt(2.0 * len(samples)),
                )
        return self._latest


def _mean(rows: Any) -> tuple[float, float]:
    first, second = np.mean(rows, axis=0).tolist()
    return first, second


class RampQuality(NamedTuple):
    """Overshoot in N, time to settle after the ramp in s, largest error while holding in N.

    ``lost`` is True where the gripper did not find the part, took it for lost, or ended with a
    fault: then the other figures are those of a part that is not held.
    """

    overshoot_n: float
    settling_s: float
    holding_n: float
    lost: bool = False


class Rig:
    """One gripper on one part, in virtual time; the true force is known at every moment.

    Parameters
    ----------
    part, noise_n, rate_hz
        Part, noise and force messages of the sensor as for `PadForces`.
    servos, seed
        Seeds of the servos, None for typical ones, and of the noise.
    figures, factors
        Motor and gearing instead of the drawn ones, and factors on friction and torque.
    settings
        Settings of the gripper that are others than those of the plant.
    """

    def __init__(
        self,
        part: Part,
        noise_n: float,
        *,
        servos: int | None,
        seed: int,
        rate_hz: float | None = None,
        figures: Drive | None = None,
        factors: tuple[float, float] = (1.0, 1.0),
        **settings: Any,
    ) -> None:
        self._part, self._relaxed_n = part, 0.0
        clock = VirtualClock()
        seeds = [None if servos is None else f"{servos} {i}" for i in (0, 1)]
        drawn = (figures or drawn_drive(XM430_W350, servo_seed) for servo_seed in seeds)
        motors = [ServoMotor(XM430_W350, figures=drive) for drive in drawn]
        for motor in motors:
            motor.friction_factor, motor.kt_factor = factors
        directions, open_m = (1, -1), part.width_m + _FREE_M
        self._mechanics = FingerMechanics(
            motors,
            [ServoMount(direction=direction) for direction in directions],
            ParallelogramLinkage(link_m=0.06),
            aperture_m=open_m,
            half_opening_min_m=-_PADS_GIVE_M,
        )
        eeprom = {"baud_rate": 3, "return_delay_time": 0}
        simulated = [
            SimulatedServo(i, XM430_W350, m, settings=eeprom) for i, m in enumerate(motors, 1)
        ]
        self._device = ServoBusDevice(simulated, 1_000_000)
        self._sensor = PadForces(noise_n, seed, rate_hz)
        self.now_s = self.force_n = 0.0
        self.trace: list[tuple[float, float]] = []
        clock.on_advance.append(self._advance)
        usual: dict[str, Any] = {
            "aperture_open_m": max(0.03, open_m),
            "approach_speed_m_s": 0.012,
            "contact_force_n": 0.6,
            # What a law does is measured here, not what stops it.
            "slip_drop_n": 20.0,
            "slip_travel_m": 0.05,
            "force_max_n": HARD_FORCE_CAP_N,
        }
        own = tuple(ServoSettings(servo_id=i, direction=d) for i, d in enumerate(directions, 1))
        self.gripper = Gripper(
            ServoBus(MemoryServoStream(self._device, clock), baudrate=1_000_000, clock=clock),
            Mechanics(
                GripperSettings(servos=own, **(usual | settings)), ParallelLinkage(link_m=0.06)
            ),
            clock=clock,
            force_sensor=self._sensor,
        )

    def _advance(self, now_s: float) -> None:
        dt_s, self.now_s = now_s - self.now_s, now_s
        if dt_s <= 0.0:
            return
        force_n, slope_n_m = self._part.press(self._mechanics.aperture_m, self._relaxed_n)
        self._mechanics.step(dt_s, (force_n, force_n), (slope_n_m, slope_n_m))
        self._device.advance_to(now_s)
        self.force_n = self._part.press(self._mechanics.aperture_m, self._relaxed_n)[0]
        # Foam that nothing presses recovers in the same way.
        elastic_n = self.force_n + self._relaxed_n if self.force_n > 0.0 else 0.0
        share = 1.0 - math.exp(-dt_s / CREEP_S)
        self._relaxed_n += (CREEP * elastic_n - self._relaxed_n) * share
        self._sensor.measure(now_s, self.force_n)
        self.trace.append((now_s, self.force_n))

    def measure_servos(self) -> Mapping[int, DriveCharacteristic]:
        """Measure both servos as the self-zero of a cell does, without the part; by their IDs.

        Raises GripperError where the gripper cannot move or measure them.
        """
        self._part = Part(width_m=0.0, stiffness_n_m=math.inf)
        self.gripper.start()
        self.gripper.open()
        self.gripper.press_pads_together(ForceRamp.linear(_PADS_N, _PADS_N_S))
        self.gripper.measure_load()
        self.gripper.release()
        self.gripper.measure_friction()
        return dict(self.gripper.read_drives().drives)

    def grasp(
        self,
        final_n: float,
        rate_n_s: float,
        drives: Mapping[int, DriveCharacteristic] | None = None,
        *,
        then_n: float | None = None,
    ) -> RampQuality:
        """Grasp and hold, and judge the true force; ``drives``: of `measure_servos`.

        ``then_n``: force in N to which the held force is changed; the figures are those of this.
        """
        ends_s: list[float] = []

        def observe(cycle: Cycle) -> None:
            arrived = math.isclose(cycle.setpoint_n, final_n, rel_tol=1e-6)
            if cycle.phase is not GripperPhase.APPROACHING and arrived:
                ends_s.append(cycle.t_s)

        began_s: float | None = None
        with suppress(GripperError):
            self.gripper.start()
            if drives is not None:
                self.gripper.use_drives(drives)
            outcome = self.gripper.grasp(ForceRamp.linear(final_n, rate_n_s), observe)
            if outcome.result is not GraspResult.PART_LOST and outcome.contact_t_s is not None:
                change_s, sign = outcome.contact_t_s, 1.0
                if then_n is not None:
                    self.gripper.hold(_SETTLED_S)
                    ends_s.clear()
                    change_s, sign, final_n = self.now_s, copysign(1.0, then_n - final_n), then_n
                    self.gripper.hold_at(then_n, 0.0, observe)
                self.gripper.hold(_HOLD_S, observe)
                began_s = change_s
        if began_s is None or not ends_s:
            return RampQuality(0.0, _HOLD_S, final_n, lost=True)
        tolerance_n = hold_aim_n(final_n)
        errors = [(t_s - ends_s[0], n - final_n) for t_s, n in self.trace if t_s >= began_s]
        after = [(t_s, error_n) for t_s, error_n in errors if t_s >= 0.0]
        return RampQuality(
            overshoot_n=max(0.0, *(sign * error_n for _, error_n in errors)),
            settling_s=max((t_s for t_s, n in after if abs(n) > tolerance_n), default=0.0),
            holding_n=max(abs(error_n) for t_s, error_n in after if t_s >= _SETTLED_S),
        )


class PlainPi:
    """PI on the force, with friction as feed-forward by the direction, and a reset at rest.

    It stands in the place of the gripper's own law, and was tuned by hand on other servos. With
    more friction in the hold the fingers of some grippers swing off the part.
    """

    gain, integral_per_s, mean_s, rest_n = 0.2, 1.5, 0.02, 0.3
    ramp_share, hold_share = 0.8, 0.5

    def __init__(self, grip: Grip, now_s: float, **_stiffness: float) -> None:
        self._grip, self._sample_s = grip, now_s
        self._integral_n = 0.0

    def begin(self, now_s: float) -> None:
        """Begin again after a measurement."""

    def resume(self) -> None:
        """Begin again after a pause."""

    def step(self, moment: Moment, _end_n: float, **_limits: bool) -> float:
        """Return the driving force in N of one period."""
        grip, dt_s, sample = self._grip, moment.dt_s, moment.sample
        setpoint_n, paths = grip.setpoint_n, grip.mechanics.transmissions(moment.state.angles_rad)
        friction_n = mean_friction_n(paths)
        if sample is None:
            return grip.balance_n
        share = min(1.0, (sample.t_s - self._sample_s) / self.mean_s)
        grip.force_n += share * (sample.grip_n - grip.force_n)
        self._sample_s = sample.t_s
        grip.rate_n_s = (setpoint_n - grip.planned_n) / dt_s if dt_s > 0.0 else 0.0
        grip.planned_n, error_n = setpoint_n, setpoint_n - grip.force_n
        if grip.rate_n_s == 0.0 and abs(error_n) <= self.rest_n:
            self._integral_n, grip.balance_n = 0.0, grip.force_n
            return grip.balance_n
        self._integral_n += self.integral_per_s * error_n * dt_s
        most_n = 2.0 * friction_n
        self._integral_n = min(max(self._integral_n, -most_n), most_n)
        rises = copysign(1.0, grip.rate_n_s or error_n) > 0.0
        yields_n = mean_yielding_n(paths, setpoint_n) - setpoint_n
        share = self.ramp_share if grip.rate_n_s else self.hold_share
        edge_n = setpoint_n + share * (friction_n if rises else yields_n)
        wanted_n = edge_n + self.gain * error_n + self._integral_n
        grip.balance_n = max(wanted_n, -friction_n)
        return grip.balance_n


PARTS = {
    "steel ball, 200 N/mm": Part(width_m=0.0095, stiffness_n_m=2e5),
    "cork, 5 N/mm": Part(width_m=0.012, stiffness_n_m=5e3),
    "foam ball, 0.2 N/mm": Part(width_m=0.06, stiffness_n_m=200.0),
}
RATES_N_S, FINALS_N = (1.0, 3.0, 10.0, 20.0, 40.0), (2.0, 4.0, 8.0)
LONGEST_WAY_M = 0.025
NOISE_N = 0.2
MESSAGES_HZ = 200.0
"""Noise of a mean of three scans in N, and force messages a second, as a cell has them."""
SEEDS = (1021, 1022, 1023, 1024, 1025)
"""Seeds of the servos, two for each gripper."""


class Setup(NamedTuple):
    """A law with its sensor."""

    law: type[Any] | None = None
    """Class of the law; None is the gripper's own."""
    rate_hz: float | None = MESSAGES_HZ
    """Force messages a second; None: frames at 50 Hz."""
    share: float | None = None
    """Share of the force of the ramp to which the held force is changed; None: it is held."""


SETUPS: dict[str, Setup] = {
    "force law, messages": Setup(),
    "force law, frames": Setup(rate_hz=None),
    "then to half, messages": Setup(share=0.5),
    "then to half, frames": Setup(rate_hz=None, share=0.5),
    "then to 1.2 times, messages": Setup(share=1.2),
    "then to 1.2 times, frames": Setup(rate_hz=None, share=1.2),
    "plain PI, messages": Setup(law=PlainPi),
    "plain PI, frames": Setup(law=PlainPi, rate_hz=None),
}


class Case(NamedTuple):
    """One ramp on one part."""

    part: str
    final_n: float
    rate_n_s: float


CASES = tuple(
    Case(name, final_n, rate_n_s)
    for name, part in PARTS.items()
    for final_n in FINALS_N
    for rate_n_s in RATES_N_S
    if final_n / part.stiffness_n_m < LONGEST_WAY_M
)


def rig(setup: Setup, case: Case, servos: int | None) -> Rig:
    """Return a gripper with the sensor of a setup, open before the part of a case.

    Each case has noise of its own, so that one unlucky noise does not count in all of them.
    """
    # The gripper takes a part for lost where its fingers run ahead, as under laws whose force
    # arrives with a knee.
    unsupervised = {} if setup.law is None else {"runaway_travel_m": _UNSUPERVISED_M}
    return Rig(
        PARTS[case.part],
        NOISE_N,
        servos=servos,
        seed=1000 * (servos or 0) + CASES.index(case),
        rate_hz=setup.rate_hz,
        **unsupervised,
    )


@cache
def measured_drives(rate_hz: float | None, servos: int | None) -> Mapping[int, DriveCharacteristic]:
    """Return the servos that a gripper has measured."""
    return rig(Setup(rate_hz=rate_hz), CASES[0], servos).measure_servos()


def grasp(setup: Setup, case: Case, servos: int | None) -> RampQuality:
    """Return the figures of one ramp of one gripper."""
    drives = measured_drives(setup.rate_hz, servos)
    with mock.patch.object(grip_control, "ForceLaw", setup.law or grip_control.ForceLaw):
        then_n = None if setup.share is None else setup.share * case.final_n
        return rig(setup, case, servos).grasp(case.final_n, case.rate_n_s, drives, then_n=then_n)


def hold_aim_n(final_n: float) -> float:
    """Return the largest error in N of a held force."""
    return max(0.3, 0.05 * final_n)


def met(quality: RampQuality, final_n: float) -> tuple[bool, bool, bool]:
    """Return which aims are met: overshoot, settling within 0.3 s, hold."""
    held = not quality.lost
    return (
        held and quality.overshoot_n <= max(0.3, 0.1 * final_n),
        held and quality.settling_s <= _SETTLED_S,
        held and quality.holding_n <= hold_aim_n(final_n),
    )


def row(setup: Setup, servos: int | None, every: int = 1) -> tuple[str, list[str]]:
    """Return the figures of all ramps of a gripper, and a line for each that misses an aim."""
    qualities = {case: grasp(setup, case, servos) for case in CASES[::every]}
    share = setup.share or 1.0
    marks = {case: met(quality, share * case.final_n) for case, quality in qualities.items()}
    counts = ", ".join(f"{sum(aim):2d}" for aim in zip(*marks.values(), strict=True))
    held = [quality.holding_n for quality in qualities.values() if not quality.lost]
    mean_n = sum(held) / max(1, len(held))
    missed = [f"{case}: {qualities[case]}" for case, mark in marks.items() if not all(mark)]
    return (
        f"{counts} of {len(qualities)}, {mean_n:.2f} N, {len(qualities) - len(held)} lost",
        missed,
    )


def main(effort: float = 1.0) -> None:
    every = max(1, round(0.1 / effort))
    line("compared", "aims of overshoot, settling and hold met, mean error in the hold, parts lost")
    for name, setup in SETUPS.items():
        for servos in SEEDS[: repeats(len(SEEDS), effort)]:
            figures, missed = row(setup, servos, every)
            line(f"{name}, servos {servos}", figures)
            for text in missed if setup.law is None else ():
                line("", text)
