"""Force ramps on a simulated gripper: the force loop, a plain PI and plain current feed-forward.

Parts of three stiffnesses between foam pads, ramps of 1, 3 and 10 N/s, in virtual time. The three
laws take turns on the same plant with the same approach, sensor and noise; the torque figures are
right in one run and wrong in the two others. Each figure is the worst of the runs, of the true
force. The seeds are none of those that the loop was tuned with. At the end the force loop alone
meets more noise and figures that are more wrong.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
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


def _case(
    name: str,
    part: Part,
    truth: Truth,
    final_n: float,
    rate_n_s: float,
    *,
    noise_n: float = NOISE_N,
) -> Quality:
    with _law(LAWS[name]) as tuning:
        return Rig(part, truth, noise_n, tuning).grasp(final_n, rate_n_s)


def _worst(runs: list[Quality]) -> Quality:
    return Quality(
        overshoot_n=max(run.overshoot_n for run in runs),
        settling_s=max(run.settling_s for run in runs),
        holding_n=max(run.holding_n for run in runs),
    )


def _cell(quality: Quality) -> str:
    return f"{quality.overshoot_n:5.2f} {quality.settling_s:5.2f} {quality.holding_n:5.2f}"


def met(quality: Quality, final_n: float) -> tuple[bool, bool, bool]:
    """Return which aims are met: overshoot of 5 % or 0.2 N, 0.3 s to settle, 0.15 N in the hold."""
    return (
        quality.overshoot_n <= max(0.2, 0.05 * final_n),
        quality.settling_s <= 0.3,
        quality.holding_n <= 0.15,
    )


def main(effort: float = 1.0) -> None:
    truths = TRUTHS[: repeats(len(TRUTHS), effort)]
    cases = [
        (name, part, final_n, rate_n_s)
        for name, part in PARTS.items()
        for final_n in FINALS_N
        for rate_n_s in RATES_N_S
        if final_n / part.stiffness_n_m < LONGEST_WAY_M
    ]
    cases = cases[:: max(1, round(1.0 / effort / 10.0))] if effort < 1.0 else cases
    line(
        "compared", f"{len(cases)} ramps x {len(truths)} truths x 3 laws, sensor noise {NOISE_N} N"
    )
    line("", "overshoot in N, settling in s, holding error in N; the worst of each")
    line("", f"{'':<14} " + " ".join(f"{law:^17}" for law in LAWS))
    totals: dict[str, list[tuple[bool, bool, bool]]] = {law: [] for law in LAWS}
    errors_n: dict[str, list[float]] = {law: [] for law in LAWS}
    for name, part, final_n, rate_n_s in cases:
        found: dict[str, list[Quality]] = {law: [] for law in LAWS}
        for truth in truths:
            turns = {law: partial(_case, law, part, truth, final_n, rate_n_s) for law in LAWS}
            for law, runs in in_turns(turns, 1).items():
                found[law] += runs
        worst = {law: _worst(runs) for law, runs in found.items()}
        for law, quality in worst.items():
            totals[law].append(met(quality, final_n))
            errors_n[law].append(quality.holding_n)
        own = met(worst["force loop"], final_n)
        missed = "".join(mark for mark, ok in zip("OSH", own, strict=True) if not ok)
        line(
            name,
            f"{final_n:2.0f} N {rate_n_s:3.0f} N/s  "
            + "  ".join(_cell(quality) for quality in worst.values())
            + (f"  {missed}" if missed else ""),
        )
    hard = [
        _worst(
            [
                _case("force loop", part, truth, final_n, rate_n_s, noise_n=HARD_NOISE_N)
                for truth in HARD_TRUTHS[: len(truths)]
            ]
        )
        for _, part, final_n, rate_n_s in cases
    ]
    totals["force loop, hard"] = [
        met(quality, final_n) for quality, (_, _, final_n, _) in zip(hard, cases, strict=True)
    ]
    for law, marks in totals.items():
        counts = [sum(mark[i] for mark in marks) for i in range(3)]
        line(
            f"  {law}",
            f"of {len(marks)} ramps: overshoot met in {counts[0]}, settling in {counts[1]}, "
            f"holding in {counts[2]}",
        )
    worst_hard = _worst(hard)
    line(
        "  worst, hard",
        f"overshoot {worst_hard.overshoot_n:.2f} N, holding error {worst_hard.holding_n:.2f} N",
    )
    mean_n = {law: sum(values) / len(values) for law, values in errors_n.items()}
    line(
        "  ratio",
        f"mean holding error {mean_n['force loop']:.2f} N; plain PI "
        f"{mean_n['plain PI'] / mean_n['force loop']:.1f} times that, feed-forward "
        f"{mean_n['feed-forward'] / mean_n['force loop']:.1f} times",
    )


if __name__ == "__main__":
    main()
