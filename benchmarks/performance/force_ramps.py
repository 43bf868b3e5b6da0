"""Force ramps on a simulated gripper: the force loop, a plain PI and plain current feed-forward.

Parts of three stiffnesses between foam pads, ramps of 1 to 40 N/s, in virtual time. All laws
run on the same plant with the same approach and noise, with force messages and with frames. The
torque figures are right in one run and wrong in the two others. Each figure is the worst of the
runs, of the true force. The loop was tuned with other seeds. The force loop also runs on a plant
with further truths (friction that grows with load, backlash, ripple, creep), and with more noise
and larger errors of the figures. The last runs have the gearings of real servos, which the gripper
measures once before, as in a self-zero. ``--gearing`` runs one of them alone, ``--friction`` and
``--kt`` multiply its friction and torque, and ``--frames`` removes the force messages. With
``--factors`` half of the ramps run with each pair of factors, and with up to 1.6 A: more friction
and less torque need more current.

``python -m benchmarks.performance.force_ramps --page`` writes the figures into
docs/explanations/force-loop.md; the tests run some of them again and compare.
"""

import argparse
import itertools
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
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
from gripper.dynamixel.models import XM430_W350
from gripper.errors import GripperError
from gripper.force.control import grip_control
from simulator.servo.gearing import GEARINGS

PARTS = {
    "steel ball, 200 N/mm": Part(width_m=0.0095, stiffness_n_m=2e5),
    "cork, 5 N/mm": Part(width_m=0.012, stiffness_n_m=5e3),
    "foam ball, 0.2 N/mm": Part(width_m=0.06, stiffness_n_m=200.0),
}
RATES_N_S = (1.0, 3.0, 10.0, 20.0, 40.0)
FINALS_N = (2.0, 4.0, 8.0)
LONGEST_WAY_M = 0.025
TRUTHS = (
    Truth(kt_error=0.0, friction_error=0.0, seed=11),
    Truth(kt_error=0.1, friction_error=-0.15, seed=12),
    Truth(kt_error=-0.1, friction_error=0.15, seed=13),
)
NOISE_N = 0.2
HARD_TRUTHS = (
    Truth(kt_error=0.0, friction_error=0.0, seed=21),
    Truth(kt_error=0.15, friction_error=-0.2, seed=22),
    Truth(kt_error=-0.15, friction_error=0.2, seed=23),
)
HARD_NOISE_N = 0.3
PAGE = Path(__file__).parents[2] / "docs" / "explanations" / "force-loop.md"
BEGIN, END = (
    "<!-- made by `python -m benchmarks.performance.force_ramps --page`: begin -->",
    "<!-- end of what is made -->",
)
MESSAGES_HZ = 500.0
"""Force messages a second: of 200, 333 and 500 that with the best figures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """A law with its sensor and plant."""

    law: type[Any] | None = None
    """Class of the law; None is the gripper's own."""
    rate_hz: float | None = MESSAGES_HZ
    """Force messages a second; None: frames at 50 Hz."""
    gearing: str = "ideal"
    """Name of the servos' gearing."""
    factors: tuple[float, float] = (1.0, 1.0)
    """As for `Rig`."""
    current_max_a: float = 0.8
    """Cap of the current in A."""
    measured: bool = False
    """Whether the gripper has measured its servos, as a self-zero does."""
    creep: float = 0.0
    """As for `Rig`."""
    hard: bool = False
    """True with `HARD_TRUTHS` and `HARD_NOISE_N`."""

    def in_use(self) -> AbstractContextManager[Any]:
        """Return a context in which the gripper uses the law."""
        if self.law is None:
            return nullcontext()
        return mock.patch.object(grip_control, "GripModes", self.law)


_FURTHER: dict[str, Any] = {"gearing": "xm430_assumed", "creep": CREEP}
OWN, OWN_TRUTHS = "force loop, messages", "force loop, messages, further truths"
SETUPS: dict[str, Setup] = {
    OWN: Setup(),
    OWN_TRUTHS: Setup(**_FURTHER),
    "force loop, messages, hard": Setup(hard=True),
    "force loop, messages, hard, further truths": Setup(hard=True, **_FURTHER),
    "force loop, frames": Setup(rate_hz=None),
    "force loop, frames, further truths": Setup(rate_hz=None, **_FURTHER),
    "force loop, frames, hard": Setup(rate_hz=None, hard=True),
    "plain PI, messages": Setup(law=PlainPi),
    "plain PI, frames": Setup(law=PlainPi, rate_hz=None),
    "feed-forward": Setup(law=PlainFeedForward),
}
"""What takes turns; the page shows each ramp of the first two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One ramp on one part."""

    part: str
    final_n: float
    rate_n_s: float


CASES = tuple(
    Case(part=name, final_n=final_n, rate_n_s=rate_n_s)
    for name, part in PARTS.items()
    for final_n in FINALS_N
    for rate_n_s in RATES_N_S
    if final_n / part.stiffness_n_m < LONGEST_WAY_M
)

FAST = tuple(case for case in CASES if case.rate_n_s >= 10.0)
"""Ramps of 10 N/s and more."""
GEARED_HZ = 200.0
"""Force messages a second with the gearings of real servos: as a cell has them."""
FACTORS = tuple(itertools.product((0.5, 1.0, 1.5, 2.0, 3.0), (0.7, 1.0, 1.3)))
"""Factors on friction and torque of the gearings."""
STRONG_A = 1.6
"""Cap of the current in A with factors."""


def rig(setup: Setup, case: Case, truth: Truth) -> Rig:
    """Return a gripper with the sensor and plant of a setup, open before the part of a case.

    Each case has noise of its own, so that one unlucky noise does not count in all of them.
    """
    own_noise = replace(truth, seed=100 * CASES.index(case) + truth.seed)
    return Rig(
        PARTS[case.part],
        own_noise,
        HARD_NOISE_N if setup.hard else NOISE_N,
        rate_hz=setup.rate_hz,
        gearing=GEARINGS[setup.gearing],
        factors=setup.factors,
        creep=setup.creep,
        supervised=setup.law is None,
        current_max_a=setup.current_max_a,
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
    return rig(setup, case, truth).grasp(case.final_n, case.rate_n_s, drives)


def run(setup: Setup, case: Case, n_truths: int = len(TRUTHS)) -> RampQuality:
    """Return the worst figures of one ramp over the grippers with different errors."""
    truths = HARD_TRUTHS if setup.hard else TRUTHS
    with setup.in_use():
        return worst([grasp(setup, case, truth) for truth in truths[:n_truths]])


def worst(runs: Sequence[RampQuality]) -> RampQuality:
    """Return the worst of each figure."""
    return RampQuality(
        overshoot_n=max(run.overshoot_n for run in runs),
        settling_s=max(run.settling_s for run in runs),
        holding_n=max(run.holding_n for run in runs),
        lost=any(run.lost for run in runs),
    )


def met(quality: RampQuality, final_n: float) -> tuple[bool, bool, bool]:
    """Return which aims are met: overshoot of 5 % or 0.2 N, 0.3 s to settle, 0.15 N in the hold."""
    if quality.lost:
        return False, False, False
    return (
        quality.overshoot_n <= max(0.2, 0.05 * final_n),
        quality.settling_s <= 0.3,
        quality.holding_n <= 0.15,
    )


def _counts(found: Mapping[Case, RampQuality]) -> tuple[int, int, int]:
    """Return how many ramps meet the aims of overshoot, settling and holding."""
    marks = [met(quality, case.final_n) for case, quality in found.items()]
    overshoot, settling, holding = (sum(one) for one in zip(*marks, strict=True))
    return overshoot, settling, holding


def _mean_n(found: Mapping[Case, RampQuality]) -> float:
    return sum(quality.holding_n for quality in found.values()) / len(found)


def main(effort: float = 1.0, *, page: bool = False) -> None:
    """Measure and print; with ``page`` write the figures into the docs too."""
    n_truths = repeats(len(TRUTHS), effort)
    cases = CASES[:: max(1, round(1.0 / effort / 10.0))] if effort < 1.0 else CASES
    line("compared", f"{len(cases)} ramps x {n_truths} truths x {len(SETUPS)} laws and plants")
    found: dict[str, dict[Case, RampQuality]] = {name: {} for name in SETUPS}
    for case in cases:
        for name, setup in SETUPS.items():
            found[name][case] = run(setup, case, n_truths)
    lines = tables(found)
    print("\n".join(lines), flush=True)
    if page:
        write_page(lines)
    geared(effort)


def geared(
    effort: float,
    names: Sequence[str] = tuple(GEARINGS),
    rate_hz: float | None = GEARED_HZ,
    factors: tuple[float, float] = (1.0, 1.0),
) -> None:
    """Print the ramps with each gearing, of servos that the gripper has measured."""
    cases = CASES[:: max(1, round(1.0 / effort / 10.0))] if effort < 1.0 else CASES
    sensor = "frames" if rate_hz is None else f"{rate_hz:g} messages a second"
    line(
        "gearings",
        f"of {len(cases)} ramps, {sensor}: overshoot, settling, hold met, mean error, lost",
    )
    for name in names:
        setup = Setup(gearing=name, measured=True, rate_hz=rate_hz, factors=factors)
        found = {case: run(setup, case, repeats(len(TRUTHS), effort)) for case in cases}
        counts = ", ".join(f"{n:2d}" for n in _counts(found))
        line(name, f"{counts}, {_mean_n(found):.2f} N, {_lost(found):2d}")


def factored(effort: float, names: Sequence[str], rate_hz: float | None) -> None:
    """Print half of the ramps with each gearing and pair of factors."""
    cases = CASES[:: 2 if effort >= 1.0 else round(2.0 / effort)]
    line("gearings", f"{len(cases)} ramps, friction, torque: overshoot, settling, hold met, lost")
    for name, (friction, kt) in itertools.product(names, FACTORS):
        setup = Setup(
            gearing=name,
            measured=True,
            rate_hz=rate_hz,
            factors=(friction, kt),
            current_max_a=STRONG_A,
        )
        found = {case: run(setup, case, 1) for case in cases}
        counts = ", ".join(f"{n:2d}" for n in _counts(found))
        line(f"{name} {friction:g}, {kt:g}", f"{counts}, {_lost(found):2d}")


def true_values(name: str) -> tuple[float, ...]:
    """Return the true values of a gearing that a gripper measures.

    They are those of both lines of the load in A for each N m, the yielding share, the friction at
    rest in A and the inertia in kg m².
    """
    true_drive = GEARINGS[name].drive_of(XM430_W350)
    law, kt_nm_a = true_drive.friction, true_drive.kt_nm_a
    by_motor, by_load, base_nm = sum(law.drive), sum(law.load), sum(law.base_nm)
    return (
        (1.0 + by_load) / (1.0 - by_motor) / kt_nm_a,
        (1.0 - by_load) / (1.0 + by_motor) / kt_nm_a,
        (1.0 - by_motor) / (1.0 + by_motor),
        base_nm / (1.0 - by_motor) / kt_nm_a,
        true_drive.inertia_kg_m2,
    )


def measured_errors(name: str, part: str) -> tuple[list[list[float]], float]:
    """Return the errors of both measured servos of a gearing, as shares, and its friction in A.

    The errors are in the order of `true_values`.
    """
    true, found = true_values(name), []
    case = next(case for case in CASES if case.part == part)
    gripper = rig(Setup(gearing=name, measured=True, rate_hz=GEARED_HZ), case, TRUTHS[0])
    for drive in gripper.measure_servos().values():
        lines = drive.rising_a_nm, drive.falling_a_nm, drive.yielding_share, drive.breakaway_a
        shown = *lines, drive.inertia_a_s2(XM430_W350) / drive.rising_a_nm
        found.append([a / b - 1.0 for a, b in zip(shown, true, strict=True)])
    return found, true[3]


def measured_lines() -> None:
    """Print the errors of both lines of the load and of the friction, for each gearing."""
    line("gearings", "errors of rising, falling, yielding share, friction at rest, mass")
    for name in GEARINGS:
        parts = [measured_errors(name, part) for part in PARTS]
        columns = zip(*(servo for found, _ in parts for servo in found), strict=True)
        spans = (f"{100 * min(one):.0f} to {100 * max(one):.0f} %" for one in columns)
        line(name, f"{', '.join(spans)}; friction {1e3 * parts[0][1]:.0f} mA")


def _missed(case: Case, quality: RampQuality) -> str:
    """Return the initials of the aims that are missed: overshoot, settling, hold."""
    marks = zip("OSH", met(quality, case.final_n), strict=True)
    return "".join(mark for mark, ok in marks if not ok)


def _lost(qualities: Mapping[Case, RampQuality]) -> int:
    return sum(quality.lost for quality in qualities.values())


def row(case: Case, plain: RampQuality, further: RampQuality) -> str:
    """Return the line of one ramp in the table of the page, without and with further truths."""
    figures = " | ".join(
        ("part lost |  | " if q.lost else f"{q.overshoot_n:.2f} | {q.settling_s:.2f} | ")
        + ("" if q.lost else f"{q.holding_n:.2f}")
        + f" | {_missed(case, q)}"
        for q in (plain, further)
    )
    return f"| {case.part} | {case.final_n:g} N | {case.rate_n_s:g} N/s | {figures} |"


def tables(found: Mapping[str, Mapping[Case, RampQuality]]) -> list[str]:
    """Return the figures of all laws as the lines of the page."""
    own, further = found[OWN], found[OWN_TRUTHS]
    return [
        "| part | to | rate | overshoot (N) | settling (s) | hold (N) | missed "
        "| with further truths: overshoot | settling | hold | missed |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *(row(case, own[case], further[case]) for case in own),
        "",
        f"Ramps of {len(own)} that meet the aim, mean error in the hold, and parts wrongly taken "
        f"for lost:",
        "",
        "| law, sensor, plant | overshoot | settling | hold | mean error | lost |",
        "|---|---|---|---|---|---|",
        *(
            f"| {name} | {' | '.join(map(str, _counts(qualities)))} | {_mean_n(qualities):.2f} N "
            f"| {_lost(qualities)} |"
            for name, qualities in found.items()
        ),
    ]


def write_page(lines: Sequence[str]) -> None:
    """Write lines between the marks of the page."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    PAGE.write_text(before + "\n".join([BEGIN, *lines, END]) + after, encoding="utf-8")
    line("  written", str(PAGE))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Force ramps on a simulated gripper.")
    parser.add_argument("--page", action="store_true", help=f"write the figures into {PAGE.name}")
    parser.add_argument("--gearing", choices=tuple(GEARINGS), help="this gearing alone")
    parser.add_argument("--friction", type=float, default=1.0, help="factor with --gearing")
    parser.add_argument("--kt", type=float, default=1.0, help="factor on torque with --gearing")
    parser.add_argument("--factors", action="store_true", help="gearings with all factors")
    parser.add_argument("--frames", action="store_true", help="gearings without force messages")
    parser.add_argument("--measured", action="store_true", help="the measured servos alone")
    parser.add_argument("--effort", type=float, default=1.0, help="0.1: one truth alone")
    given = parser.parse_args()
    if given.measured:
        measured_lines()
    elif given.frames or given.gearing or given.factors:
        names = (given.gearing,) if given.gearing else tuple(GEARINGS)
        rate_hz = None if given.frames else GEARED_HZ
        if given.factors:
            factored(given.effort, names, rate_hz)
        else:
            geared(given.effort, names, rate_hz, (given.friction, given.kt))
    else:
        main(given.effort, page=given.page)
