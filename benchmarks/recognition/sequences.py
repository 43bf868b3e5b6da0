"""Sequences that decide: dependence, wanted and got errors.

Simulated grasps; with TACTILE_CELL_DATA also the recorded ones, of which only the first 60 % of
each object in time are used: 60 % of these teach, the rest test.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks._measure import line, repeats, share
from benchmarks.recognition._grasps import LEFT_OUT, PAPER, recorded
from benchmarks.recognition._posed_grasps import Sensing, draw_placing, posed_grasp
from recognition.evaluation.splits import chronological_split
from recognition.grasp import Grasp, by_label
from recognition.recognizer import DEPENDENCE, Posterior, Recognizer
from recognition.recognizers import make_trainer
from recognition.statistics.fusion import Decision, DecisionKind, StopRule, decide, fuse

HARD = {
    "ball 9.5": "sphere:diameter=9.5mm",
    "ball 10.5": "sphere:diameter=10.5mm",
    "rod 6": "cylinder:diameter=6mm,length=20mm",
    "rod 7": "cylinder:diameter=7mm,length=20mm",
}
WANTED = (0.1, 0.05, 0.02, 0.01)
MAX_GRASPS = 5

Rows = dict[str, list[Posterior]]


def posed_grasps(shapes: Mapping[str, str], n: int, sensing: Sensing, seed: int) -> list[Grasp]:
    """Return n grasps of each shape."""
    rng = np.random.default_rng(seed)
    return [
        posed_grasp(label, shape, draw_placing(rng), seed + i, sensing)
        for label, shape in shapes.items()
        for i in range(n)
    ]


def windows(rows: Rows, length: int) -> list[tuple[str, list[Posterior]]]:
    """Return all runs of grasps of one object that follow each other."""
    return [
        (label, row[i : i + length])
        for label, row in rows.items()
        for i in range(len(row) - length + 1)
    ]


def show_dependence(rows: Rows) -> None:
    """Print shares right and log loss of fused answers, with dependence and without."""
    for length in (1, 2, 3, 5):
        runs = windows(rows, length)
        if not runs:
            continue
        texts = []
        for name, dependence in ((f"{DEPENDENCE:g}", DEPENDENCE), ("none", 0.0)):
            fused = [fuse(run, dependence=dependence) for _, run in runs]
            right = [p.best == label for p, (label, _) in zip(fused, runs, strict=True)]
            loss = -np.mean(
                [
                    np.log(p.probability[p.labels.index(label)])
                    for p, (label, _) in zip(fused, runs, strict=True)
                ]
            )
            texts.append(f"{name} {loss:.3f}")
        line(
            f"    {length} fused",
            f"{100 * np.mean(right):.1f} % of {len(runs)}; log loss " + ", ".join(texts),
        )


def ended(row: Sequence[Posterior], rule: StopRule) -> tuple[Decision, int]:
    """Return the decision with which a sequence of grasps ends, and after how many."""
    for length in range(1, len(row) + 1):
        answer = decide(row[:length], rule)
        if answer.kind is not DecisionKind.CONTINUE:
            break
    return answer, length


def show_stopping(rows: Rows) -> None:
    """Print wanted and measured rate of wrong labels among those given before the last grasp."""
    for wanted in WANTED:
        rule = StopRule(error_rate=wanted, max_grasps=MAX_GRASPS)
        wrong = given = unknown = grasps = early = early_wrong = n = 0
        for label, row in rows.items():
            for start in range(0, len(row) - MAX_GRASPS + 1):
                answer, length = ended(row[start : start + MAX_GRASPS], rule)
                n, grasps = n + 1, grasps + length
                if answer.kind is DecisionKind.UNKNOWN:
                    unknown += 1
                    continue
                given, wrong = given + 1, wrong + (answer.label != label)
                if answer.probability >= 1.0 - wanted:
                    early, early_wrong = early + 1, early_wrong + (answer.label != label)
        if n:
            line(
                f"    wanted {100 * wanted:.0f} %",
                f"got {share(early_wrong, early)} of {early} sure of {n}; all labels {wrong} of "
                f"{given} wrong, {unknown} unknown, {grasps / n:.2f} grasps",
            )


def rows_of(grasps: Sequence[Grasp], recognizer: Recognizer) -> Rows:
    return {
        label: [recognizer.posterior(g) for g in members]
        for label, members in by_label(grasps).items()
    }


def show(name: str, train: Sequence[Grasp], test: Sequence[Grasp], *, use_aperture: bool) -> None:
    """Teach with some grasps and print fused answers and decided sequences of others."""
    recognizer = make_trainer("force_ramp", use_aperture=use_aperture).fit(train)
    rows = rows_of(test, recognizer)
    line(f"  {name}", f"{len(train)} teach")
    show_dependence(rows)
    show_stopping(rows)


def main(effort: float = 1.0) -> None:
    line("compared", "fusion, stop rule")
    blind = Sensing(aperture_known=False)
    noisy = Sensing(noise=2.0, aperture_known=False)
    cases = [("paper's objects, touch alone", PAPER, blind)]
    if effort >= 0.2:
        cases += [
            ("paper's, touch alone, twice the noise", PAPER, noisy),
            ("similar objects, touch alone, twice the noise", HARD, noisy),
        ]
    n_train, n_pool = repeats(20, effort, least=8), repeats(80, effort, least=6)
    for name, shapes, sensing in cases:
        train, test = (
            posed_grasps(shapes, n_train, sensing, 0),
            posed_grasps(shapes, n_pool, sensing, 100_000),
        )
        show(name, train, test, use_aperture=sensing.aperture_known)
    grasps = recorded()
    if grasps is None:
        line(*LEFT_OUT)
        return
    taught, _ = chronological_split(grasps, 0.6)
    if effort < 1.0:
        few = sorted({g.label for g in taught})[:4]
        taught = tuple(g for g in taught if g.label in few)
    train, test = chronological_split(taught, 0.6)
    show("recorded", train, test, use_aperture=True)
    show("recorded, touch alone", train, test, use_aperture=False)
