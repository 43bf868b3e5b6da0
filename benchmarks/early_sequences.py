"""Identifications whose ramps end as soon as they suffice, replayed from single grasps.

A look sees a grasp up to that frame alone, so that what it decides is what the cell would decide;
time is that of the ramps, from the first frame to the look or the end. Objects that are left out of
teaching are to be called UNKNOWN. Simulated grasps; with TACTILE_CELL_DATA also the recorded ones,
of which only the first 60 % of each object in time are used: 60 % of these teach, the rest test.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks._posed_grasps import Sensing
from benchmarks.sequences import PAPER, posed
from cell.dataset import read_dataset
from recognition.early import EarlyRecognizer, EarlyTrainer, cut, looking, suffices
from recognition.fusion import DecisionKind, StopRule, decide
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.splits import by_label, chronological_split

RULE = StopRule(error_rate=0.02, max_grasps=4)
_WAYS = ("whole ramps", "ended early")


@dataclass(frozen=True)
class Told:
    """What each look at a grasp tells, and when in s; the last one is the whole ramp."""

    posteriors: tuple[Posterior, ...]
    at_s: tuple[float, ...]


@dataclass
class Tally:
    """Sums over sequences."""

    n: int = 0
    right: int = 0
    unknown: int = 0
    seconds: float = 0.0
    grasps: int = 0

    def add(self, label: str, told: Sequence[Told], *, early: bool) -> None:
        """Run one sequence over grasps of an object."""
        rule = looking(RULE)
        taken: list[Posterior] = []
        for one in told:
            looks = range(len(one.posteriors) - 1) if early else range(0)
            sure = [i for i in looks if suffices([*taken, one.posteriors[i]], rule)]
            at = sure[0] if sure else len(one.posteriors) - 1
            taken.append(one.posteriors[at])
            self.seconds += one.at_s[at]
            answer = decide(taken, RULE)
            if answer.kind is not DecisionKind.CONTINUE:
                break
        self.n += 1
        self.grasps += len(taken)
        self.right += answer.label == label
        self.unknown += answer.kind is DecisionKind.UNKNOWN

    def text(self) -> str:
        """Return the figures in words."""
        return (
            f"{100 * self.right / self.n:.1f} % named right, {100 * self.unknown / self.n:.1f} % "
            f"UNKNOWN of {self.n}; {self.seconds / self.n:.2f} s in ramps, "
            f"{self.grasps / self.n:.2f} grasps"
        )


def told_by(early: EarlyRecognizer, grasp: Grasp) -> Told:
    ends = early.looks(grasp)
    heads = early.heads.recognizers
    return Told(
        posteriors=(
            *(heads[i].posterior(cut(grasp, end)) for i, end in enumerate(ends)),
            early.whole.posterior(grasp),
        ),
        at_s=(*(float(grasp.t_s[end - 1]) for end in ends), float(grasp.t_s[-1])),
    )


def run(
    tallies: dict[str, Tally], early: EarlyRecognizer, test: Sequence[Grasp], n_orders: int
) -> None:
    """Add sequences of each object, in random orders of its grasps."""
    rng = np.random.default_rng(1)
    for label, grasps in by_label(test).items():
        told = [told_by(early, grasp) for grasp in grasps]
        for _ in range(n_orders):
            order = rng.permutation(len(told))[: RULE.max_grasps]
            for way, tally in tallies.items():
                tally.add(label, [told[i] for i in order], early=way == _WAYS[1])


def compare(
    train: Sequence[Grasp],
    test: Sequence[Grasp],
    groups: Sequence[Sequence[str]],
    n_orders: int,
    *,
    use_aperture: bool,
) -> float:
    """Print taught objects, then those of each group left out in turn; return the time's ratio."""
    trainer = EarlyTrainer(base=make_trainer("force_ramp", use_aperture=use_aperture))
    taught, untaught = ({way: Tally() for way in _WAYS} for _ in range(2))
    run(taught, trainer.fit(train), test, n_orders)
    for group in groups:
        early = trainer.fit([g for g in train if g.label not in group])
        run(untaught, early, [g for g in test if g.label in group], n_orders)
    for what, tallies in (("taught", taught), ("not taught", untaught)):
        for way, tally in tallies.items():
            line(f"    {what}, {way}", tally.text())
    return taught[_WAYS[1]].seconds / taught[_WAYS[0]].seconds


def main(effort: float = 1.0) -> None:
    line("compared", "replayed identifications, ramps whole and ended early")
    n_train, n_test = repeats(12, effort, least=5), repeats(20, effort, least=4)
    labels = sorted(PAPER) if effort >= 0.1 else sorted(PAPER)[:3]
    for noise in (1.0, 2.0) if effort >= 0.1 else (1.0,):
        for use_aperture in (True, False) if effort >= 0.1 else (True,):
            sensing = Sensing(noise=noise, aperture_known=use_aperture)
            shapes = {label: PAPER[label] for label in labels}
            train, test = (
                [grasp for grasp, _ in posed(shapes, n, sensing, seed)]
                for n, seed in ((n_train, 0), (n_test, 100_000))
            )
            groups = [[label] for label in (labels if effort >= 0.1 else labels[:1])]
            what = "opening too" if use_aperture else "touch alone"
            line(f"  {what}, noise {noise:g} x", f"{len(train)} teach {len(labels)} objects")
            n_orders = repeats(60, effort, least=3)
            share = compare(train, test, groups, n_orders, use_aperture=use_aperture)
            line("  ratio", f"ended early, ramps take {share:.2f} x the time")
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        line("  recorded", "left out, TACTILE_CELL_DATA names no folder with pinch36.npz")
        return
    recorded, _ = chronological_split(read_dataset(Path(folder) / "pinch36.npz"), 0.6)
    train, test = map(list, chronological_split(recorded, 0.6))
    names = sorted({grasp.label for grasp in train})
    for use_aperture in (True, False):
        what = "opening too" if use_aperture else "touch alone"
        line(f"  recorded, {what}", f"{len(train)} teach {len(names)} objects, halves left out")
        groups = [names[::2], names[1::2]]
        share = compare(train, test, groups, 10, use_aperture=use_aperture)
        line("  ratio", f"ended early, ramps take {share:.2f} x the time")


if __name__ == "__main__":
    main()
