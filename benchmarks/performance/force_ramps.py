"""Force ramps on a simulated gripper: the force loop, a plain PI and plain current feed-forward.

Parts of three stiffnesses between foam pads, ramps of 1 to 40 N/s, in virtual time. All laws
run on the same plant with the same approach and noise, with force messages and with frames. The
torque figures are right in one run and wrong in the two others. Each figure is the worst of the
runs, of the true force. The loop was tuned with other seeds. The force loop also runs on a plant
with further truths (friction that grows with load, backlash, ripple, creep), and with more noise
and larger errors of the figures.

Prints for each law how many ramps meet the aims, the mean error in the hold, the parts wrongly
taken for lost, and each ramp of the force loop that misses an aim with messages. The last rows have
the gearings of real servos, which the gripper measures once before, as in a self-zero; of these
ramps there is one run each.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from typing import Any, NamedTuple
from unittest import mock

from benchmarks._measure import line, repeats
from benchmarks.performance._force_plant import (
    CREEP,
    Part,
    PlainFeedForward,
    PlainPi,
    RampQuality,
    Rig,
    Truth,
)
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import GripperError
from gripper.force.control import grip_control
from simulator.servo.gearing import GEARINGS

PARTS = {
    "steel ball, 200 N/mm": Part(width_m=0.0095, stiffness_n_m=2e5),
    "cork, 5 N/mm": Part(width_m=0.012, stiffness_n_m=5e3),
    "foam ball, 0.2 N/mm": Part(width_m=0.06, stiffness_n_m=200.0),
}
RATES_N_S, FINALS_N = (1.0, 3.0, 10.0, 20.0, 40.0), (2.0, 4.0, 8.0)
LONGEST_WAY_M = 0.025
TRUTHS, NOISE_N = (Truth(0.0, 0.0, 11), Truth(0.1, -0.15, 12), Truth(-0.1, 0.15, 13)), 0.2
HARD_TRUTHS, HARD_NOISE_N = (Truth(0.0, 0.0, 21), Truth(0.15, -0.2, 22), Truth(-0.15, 0.2, 23)), 0.3
"""Errors of the gripper's figures, and noise of the sensor in N."""
MESSAGES_HZ, GEARED_HZ = 500.0, 200.0
"""Force messages a second: of 200, 333 and 500 that with the best figures; and with the gearings of
real servos, as a cell has them."""


class Setup(NamedTuple):
    """A law with its sensor and plant."""

    law: type[Any] | None = None
    """Class of the law; None is the gripper's own."""
    rate_hz: float | None = MESSAGES_HZ
    """Force messages a second; None: frames at 50 Hz."""
    gearing: str = "ideal"
    """Name of the servos' gearing."""
    creep: float = 0.0
    """As for `Rig`."""
    measured: bool = False
    """Whether the gripper has measured its servos, as a self-zero does."""
    hard: bool = False
    """True with `HARD_TRUTHS` and `HARD_NOISE_N`."""

    def in_use(self) -> AbstractContextManager[Any]:
        """Return a context in which the gripper uses the law."""
        if self.law is None:
            return nullcontext()
        return mock.patch.object(grip_control, "GripModes", self.law)


_FURTHER: dict[str, Any] = {"gearing": "xm430_assumed", "creep": CREEP}
SHOWN = ("force loop, messages", "force loop, messages, further truths")
"""Setups of which each ramp that misses an aim is printed."""
SETUPS: dict[str, Setup] = {
    SHOWN[0]: Setup(),
    SHOWN[1]: Setup(**_FURTHER),
    "force loop, messages, hard": Setup(hard=True),
    "force loop, messages, hard, further truths": Setup(hard=True, **_FURTHER),
    "force loop, frames": Setup(rate_hz=None),
    "force loop, frames, further truths": Setup(rate_hz=None, **_FURTHER),
    "force loop, frames, hard": Setup(rate_hz=None, hard=True),
    "plain PI, messages": Setup(law=PlainPi),
    "plain PI, frames": Setup(law=PlainPi, rate_hz=None),
    "feed-forward": Setup(law=PlainFeedForward),
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


def rig(setup: Setup, case: Case, truth: Truth) -> Rig:
    """Return a gripper with the sensor and plant of a setup, open before the part of a case.

    Each case has noise of its own, so that one unlucky noise does not count in all of them.
    """
    return Rig(
        PARTS[case.part],
        truth._replace(seed=100 * CASES.index(case) + truth.seed),
        HARD_NOISE_N if setup.hard else NOISE_N,
        rate_hz=setup.rate_hz,
        gearing=GEARINGS[setup.gearing],
        creep=setup.creep,
        supervised=setup.law is None,
    )


@cache
def measured_drives(setup: Setup, truth: Truth) -> Mapping[int, DriveCharacteristic] | None:
    """Return the servos that a gripper has measured; None if it cannot start or measure them."""
    with suppress(GripperError):
        return rig(setup, CASES[0], truth).measure_servos()
    return None


def grasp(setup: Setup, case: Case, truth: Truth) -> RampQuality:
    """Return the figures of one ramp of one gripper."""
    drives = None
    if setup.measured and (drives := measured_drives(setup, truth)) is None:
        return RampQuality.not_held(case.final_n)
    with setup.in_use():
        return rig(setup, case, truth).grasp(case.final_n, case.rate_n_s, drives)


def met(quality: RampQuality, final_n: float) -> tuple[bool, bool, bool]:
    """Return which aims are met: overshoot of 5 % or 0.2 N, 0.3 s to settle, 0.15 N in the hold."""
    if quality.lost:
        return False, False, False
    return (
        quality.overshoot_n <= max(0.2, 0.05 * final_n),
        quality.settling_s <= 0.3,
        quality.holding_n <= 0.15,
    )


def row(setup: Setup, n_truths: int, every: int) -> tuple[str, list[str]]:
    """Return the figures of all ramps, and a line for each one that misses an aim."""
    truths, found = (HARD_TRUTHS if setup.hard else TRUTHS)[:n_truths], {}
    for case in CASES[::every]:
        runs = [grasp(setup, case, truth) for truth in truths]
        found[case] = RampQuality(*map(max, zip(*runs, strict=True)))
    marks = {case: met(quality, case.final_n) for case, quality in found.items()}
    counts = ", ".join(f"{sum(one):2d}" for one in zip(*marks.values(), strict=True))
    mean_n = sum(quality.holding_n for quality in found.values()) / len(found)
    lost = sum(quality.lost for quality in found.values())
    missed = [f"{case}: {found[case]}" for case, mark in marks.items() if not all(mark)]
    return f"{counts} of {len(found)}, {mean_n:.2f} N, {lost} lost", missed


def main(effort: float = 1.0) -> None:
    n_truths, every = repeats(len(TRUTHS), effort), max(1, round(0.1 / effort))
    line("compared", "aims of overshoot, settling and hold met, mean error in the hold, parts lost")
    for name, setup in SETUPS.items():
        figures, missed = row(setup, n_truths, every)
        line(name, figures)
        for text in missed if name in SHOWN else ():
            line("", text)
    for name in GEARINGS:
        for sensor, rate_hz in (("messages", GEARED_HZ), ("frames", None)):
            setup = Setup(gearing=name, measured=True, rate_hz=rate_hz)
            line(f"{name}, {sensor}", row(setup, 1, every)[0])
