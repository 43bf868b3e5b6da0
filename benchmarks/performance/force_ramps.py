"""Force ramps on a simulated gripper: the force loop, a plain PI and plain current feed-forward.

Parts of three stiffnesses between foam pads, ramps of 1, 3 and 10 N/s, in virtual time. The three
laws take turns on the same plant with the same approach, sensor and noise; the torque figures are
right in one run and wrong in the two others. Each figure is the worst of the runs, of the true
force. The seeds are none of those that the loop was tuned with. At the end the force loop alone
meets more noise and figures that are more wrong.

``python -m benchmarks.performance.force_ramps --page`` writes the figures into
docs/explanations/force-loop.md; the tests run some of them again and compare.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks._measure import in_turns, line, repeats
from benchmarks.performance._force_plant import Part, PlainFeedForward, PlainPi, Quality, Rig, Truth
from gripper.force import grip_control
from gripper.settings import ForceLoopSettings

PARTS = {
    "steel ball, 200 N/mm": Part(width_m=0.0095, stiffness_n_m=2e5),
    "cork, 5 N/mm": Part(width_m=0.012, stiffness_n_m=5e3),
    "foam ball, 0.2 N/mm": Part(width_m=0.06, stiffness_n_m=200.0),
}
RATES_N_S = (1.0, 3.0, 10.0)
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
_PLAIN = ForceLoopSettings(damping_n_s_m=0.0, end_time_s=0.0)


@contextmanager
def _law(law: type[Any] | None) -> Iterator[ForceLoopSettings]:
    """Let the gripper use a law; None is its own."""
    if law is None:
        yield ForceLoopSettings()
        return
    with mock.patch.object(grip_control, "ForceController", law):
        yield _PLAIN


LAWS: dict[str, type[Any] | None] = {
    "force loop": None,
    "plain PI": PlainPi,
    "feed-forward": PlainFeedForward,
}


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


def run(law: str, case: Case, truths: Sequence[Truth], *, noise_n: float = NOISE_N) -> Quality:
    """Return the worst of one ramp under a law, over how the gripper may differ."""
    with _law(LAWS[law]) as tuning:
        rigs = [
            Rig(PARTS[case.part], truth, noise_n, tuning, supervised=LAWS[law] is None)
            for truth in truths
        ]
        return worst([rig.grasp(case.final_n, case.rate_n_s) for rig in rigs])


def worst(runs: Sequence[Quality]) -> Quality:
    """Return the worst of each figure."""
    return Quality(
        overshoot_n=max(run.overshoot_n for run in runs),
        settling_s=max(run.settling_s for run in runs),
        holding_n=max(run.holding_n for run in runs),
        lost=any(run.lost for run in runs),
    )


def met(quality: Quality, final_n: float) -> tuple[bool, bool, bool]:
    """Return which aims are met: overshoot of 5 % or 0.2 N, 0.3 s to settle, 0.15 N in the hold."""
    if quality.lost:
        return False, False, False
    return (
        quality.overshoot_n <= max(0.2, 0.05 * final_n),
        quality.settling_s <= 0.3,
        quality.holding_n <= 0.15,
    )


def _cell(quality: Quality) -> str:
    if quality.lost:
        return f"{'part lost':^17}"
    return f"{quality.overshoot_n:5.2f} {quality.settling_s:5.2f} {quality.holding_n:5.2f}"


def _counts(found: Mapping[Case, Quality]) -> tuple[int, int, int]:
    """Return how many ramps meet the aims of overshoot, settling and holding."""
    marks = [met(quality, case.final_n) for case, quality in found.items()]
    overshoot, settling, holding = (sum(one) for one in zip(*marks, strict=True))
    return overshoot, settling, holding


def _mean_n(found: Mapping[Case, Quality]) -> float:
    return sum(quality.holding_n for quality in found.values()) / len(found)


def main(effort: float = 1.0, *, page: bool = False) -> None:
    """Measure and print; with ``page`` write the figures into the docs too."""
    truths = TRUTHS[: repeats(len(TRUTHS), effort)]
    cases = CASES[:: max(1, round(1.0 / effort / 10.0))] if effort < 1.0 else CASES
    line(
        "compared", f"{len(cases)} ramps x {len(truths)} truths x 3 laws, sensor noise {NOISE_N} N"
    )
    line("", "overshoot in N, settling in s, holding error in N; the worst of each")
    line("", f"{'':<14} " + " ".join(f"{law:^17}" for law in LAWS))
    found: dict[str, dict[Case, Quality]] = {law: {} for law in LAWS}
    for case in cases:
        turns = {law: partial(run, law, case, truths) for law in LAWS}
        for law, (quality,) in in_turns(turns, 1).items():
            found[law][case] = quality
        own = met(found["force loop"][case], case.final_n)
        missed = "".join(mark for mark, ok in zip("OSH", own, strict=True) if not ok)
        line(
            case.part,
            f"{case.final_n:2.0f} N {case.rate_n_s:3.0f} N/s  "
            + "  ".join(_cell(found[law][case]) for law in LAWS)
            + (f"  {missed}" if missed else ""),
        )
    hard_truths = HARD_TRUTHS[: len(truths)]
    found["force loop, hard"] = hard = {
        case: run("force loop", case, hard_truths, noise_n=HARD_NOISE_N) for case in cases
    }
    for law, qualities in found.items():
        overshoot, settling, holding = _counts(qualities)
        lost = sum(quality.lost for quality in qualities.values())
        line(
            f"  {law}",
            f"of {len(qualities)} ramps: overshoot met in {overshoot}, settling in {settling}, "
            f"holding in {holding}; part lost in {lost}",
        )
    worst_hard = worst(list(hard.values()))
    line(
        "  worst, hard",
        f"overshoot {worst_hard.overshoot_n:.2f} N, holding error {worst_hard.holding_n:.2f} N",
    )
    own_n = _mean_n(found["force loop"])
    line(
        "  ratio",
        f"mean holding error {own_n:.2f} N; plain PI {_mean_n(found['plain PI']) / own_n:.1f} "
        f"times that, feed-forward {_mean_n(found['feed-forward']) / own_n:.1f} times",
    )
    if page:
        write_page(found)


def row(case: Case, quality: Quality) -> str:
    """Return the line of one ramp in the table of the page."""
    aims = ("overshoot", "settling", "hold")
    missed = [aim for aim, ok in zip(aims, met(quality, case.final_n), strict=True) if not ok]
    figures = (
        "part lost |  | "
        if quality.lost
        else f"{quality.overshoot_n:.2f} N | {quality.settling_s:.2f} s | {quality.holding_n:.2f} N"
    )
    return (
        f"| {case.part} | {case.final_n:g} N | {case.rate_n_s:g} N/s | {figures} "
        f"| {', '.join(missed)} |"
    )


def write_page(found: Mapping[str, Mapping[Case, Quality]]) -> None:
    """Write the figures of all laws between the marks of the page."""
    own, hard = found["force loop"], found["force loop, hard"]
    worst_hard = worst(list(hard.values()))
    n = len(own)
    lines = [
        BEGIN,
        "| part | to | rate | overshoot | settling | error in the hold | aims missed |",
        "|---|---|---|---|---|---|---|",
        *(row(case, quality) for case, quality in own.items()),
        "",
        f"Ramps of {n} that meet the aim, and mean error in the hold:",
        "",
        "| law | overshoot | settling | hold | mean error |",
        "|---|---|---|---|---|",
        *(
            f"| {law} | {' | '.join(map(str, _counts(qualities)))} | {_mean_n(qualities):.2f} N |"
            for law, qualities in found.items()
        ),
        "",
        f"The worst of the hard ramps is {worst_hard.overshoot_n:.2f} N above and "
        f"{worst_hard.holding_n:.2f} N off in the hold. "
        f"{_lost_text(sum(q.lost for q in (*own.values(), *hard.values())))}",
        END,
    ]
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    PAGE.write_text(before + "\n".join(lines) + after, encoding="utf-8")
    line("  written", str(PAGE))


def _lost_text(n_lost: int) -> str:
    return "No part was lost." if n_lost == 0 else f"Parts taken for lost: {n_lost}."


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Force ramps on a simulated gripper.")
    parser.add_argument("--page", action="store_true", help=f"write the figures into {PAGE.name}")
    main(page=parser.parse_args().page)
