"""Shifts of a cell: taught and never-taught objects in mixed order, followed or not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks._measure import line
from cell.learning.drift import DriftTracker
from recognition.drift.drift import NO_DRIFT, Drift
from recognition.evaluation.metrics import auroc
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.grasp import Grasp, by_label
from recognition.recognizer import Posterior
from recognition.recognizers.force_ramp.recognizer import ForceRamp, ForceRampTrainer
from recognition.statistics.fusion import fuse

DRIFTS = {
    "no drift": NO_DRIFT,
    "gain 0.7, -4 mm": Drift(gains=(0.7,), aperture_offset_m=-4e-3),
    "gain 1.2, +2 mm": Drift(gains=(1.2,), aperture_offset_m=2e-3),
}
SEQUENCES = 30
"""Objects in turn of a shift."""
_MOST_GRASPS = 3
_FAR_LOG_GAIN, _FAR_M = 0.25, 1.25e-3
"""A drift that is off by more is a wrong one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A taught recogniser and grasps that did not teach it."""

    taught: ForceRamp
    """What is followed."""
    known: dict[str, list[Grasp]]
    new: dict[str, list[Grasp]]
    """Grasps in the order of time by taught and by never-taught object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Answered:
    new: bool
    right: bool
    unknown: float


Turn = tuple[bool, list[Grasp]]
"""Whether an object was never taught, and its grasps."""


def make_benches(grasps: Sequence[Grasp], n_groups: int) -> list[Bench]:
    """Leave each of some groups of objects out in turn; the first 60 % in time of the others teach.

    Of the objects left out all grasps may come.
    """
    teach, test = chronological_split(grasps, 0.6)
    labels = np.random.default_rng(0).permutation(sorted({g.label for g in grasps})).tolist()
    size = len(labels) // 3
    found = []
    for group in range(n_groups):
        out = set(labels[group * size : (group + 1) * size])
        found.append(
            Bench(
                taught=ForceRampTrainer().fit([g for g in teach if g.label not in out]),
                known=by_label([g for g in test if g.label not in out]),
                new=by_label([g for g in grasps if g.label in out]),
            )
        )
    return found


def draw_shift(bench: Bench, n: int, share_new: float, seed: int) -> list[Turn]:
    """Return n objects in turn, drawn with one to three grasps that follow each other."""
    rng = np.random.default_rng(seed)
    kinds = rng.permutation(np.arange(n) < round(share_new * n))
    return [(bool(new), _turn(bench.new if new else bench.known, rng)) for new in kinds]


def _turn(objects: dict[str, list[Grasp]], rng: np.random.Generator) -> list[Grasp]:
    members = objects[sorted(objects)[rng.integers(len(objects))]]
    n = int(rng.integers(1, _MOST_GRASPS + 1))
    first = int(rng.integers(max(1, len(members) - n + 1)))
    return members[first : first + n]


def compare(
    name: str, benches: Sequence[Bench], *, shares: Sequence[float], n_shifts: int, n: int
) -> None:
    """Print for each drift and share of never-taught objects what following changes."""
    for text, drift in DRIFTS.items():
        for share in shares:
            off, on, wrong, total = list[_Answered](), list[_Answered](), 0, 0
            for bench in benches:
                alone: dict[int, Posterior] = {}
                for seed in range(n_shifts):
                    turns = draw_shift(bench, n, share, 100 * seed + round(10 * share))
                    off += _run(DriftTracker(bench.taught, follow=False), turns, drift, alone)
                    shift = DriftTracker(bench.taught)
                    on += _run(shift, turns, drift, None)
                    wrong += _is_wrong(shift.drift, drift)
                    total += 1
            line(f"  {name}, {text}", f"{100 * share:.0f} % of the objects never taught")
            line("    not followed", _figures(off))
            line("    followed", f"{_figures(on)}; wrong drift in {wrong} of {total}")


def adversary(name: str, benches: Sequence[Bench], *, n_shifts: int, n: int) -> None:
    """Print how often new objects alone, one of them again and again, make a drift up."""
    for n_objects in (1, 2, None):
        wrong = total = 0
        for bench in benches:
            for seed in range(n_shifts):
                rng = np.random.default_rng(seed)
                labels = rng.permutation(sorted(bench.new)).tolist()[:n_objects]
                shift = DriftTracker(bench.taught)
                for _ in range(n):
                    turn = _turn({label: bench.new[label] for label in labels}, rng)
                    shift.add_grasps([a_day_later(grasp) for grasp in turn])
                wrong += _is_wrong(shift.drift, NO_DRIFT)
                total += 1
        what = "all new objects" if n_objects is None else f"{n_objects} new object"
        line(f"  {name}, only new", f"{what}: a drift made up in {wrong} of {total} shifts")


def _run(
    shift: DriftTracker, turns: Sequence[Turn], drift: Drift, alone: dict[int, Posterior] | None
) -> list[_Answered]:
    answered = []
    for new, grasps in turns:
        drifted = [a_day_later(drift.apply(grasp)) for grasp in grasps]
        posteriors = []
        for grasp, felt in zip(grasps, drifted, strict=True):
            told = None if alone is None else alone.get(id(grasp))
            if told is None:
                told = shift.recognizer.posterior(felt)
            if alone is not None:
                alone[id(grasp)] = told
            posteriors.append(told)
        fused = fuse(posteriors)
        answered.append(
            _Answered(new=new, right=fused.best == grasps[0].label, unknown=fused.unknown)
        )
        shift.add_grasps(drifted)
    return answered


def _is_wrong(found: Drift, true: Drift) -> bool:
    return (
        abs(np.log(found.gain / true.gain)) > _FAR_LOG_GAIN
        or abs(found.aperture_offset_m - true.aperture_offset_m) > _FAR_M
    )


def _figures(answered: Sequence[_Answered]) -> str:
    known = [one for one in answered if not one.new]
    new = [one for one in answered if one.new]
    text = (
        f"{_percent([one.right for one in known])} right, "
        f"{_percent([one.unknown > 0.5 for one in known])} called UNKNOWN of {len(known)}"
    )
    if not new:
        return text
    area = auroc([one.unknown for one in known], [one.unknown for one in new])
    return f"{text}; new: {_percent([one.unknown > 0.5 for one in new])}, AUROC {area:.3f}"


def _percent(found: Sequence[bool]) -> str:
    return f"{100 * sum(found) / len(found):.1f} %"
