"""Sequences that decide: dependence, wanted and got errors, an early end.

Simulated grasps; with TACTILE_CELL_DATA also the recorded ones, of which only the first 60 % of
each object in time are used: 60 % of these teach, the rest test.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._posed_grasps import GraspCommand, Sensing, draw_placing, posed_grasp
from cell.data.dataset import read_dataset
from recognition.evaluation.metrics import expected_calibration_error, wilson_interval
from recognition.evaluation.splits import chronological_split
from recognition.grasp import Grasp, by_label
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.recognizers.early_classifiers import EarlyTrainer
from recognition.statistics.fusion import Decision, DecisionKind, StopRule, decide, fuse
from simulator.world.shapes import PAPER_OBJECTS

HARD = {
    "ball 9.5": "sphere:diameter=9.5mm",
    "ball 10.5": "sphere:diameter=10.5mm",
    "rod 6": "cylinder:diameter=6mm,length=20mm",
    "rod 7": "cylinder:diameter=7mm,length=20mm",
}
PAPER = {name: name for name in PAPER_OBJECTS}
WANTED = (0.1, 0.05, 0.02, 0.01)
EARLY_WANTED = (0.05, 0.01)
MAX_GRASPS = 5

Rows = dict[str, list[Posterior]]
Posed = list[tuple[Grasp, GraspCommand]]


def posed(shapes: dict[str, str], n: int, sensing: Sensing, seed: int) -> Posed:
    """Return n grasps of each shape with how they were taken."""
    rng = np.random.default_rng(seed)
    found = []
    for label, shape in shapes.items():
        for i in range(n):
            command = draw_placing(rng)
            found.append((posed_grasp(label, shape, command, seed + i, sensing), command))
    return found


def windows(rows: Rows, length: int) -> list[tuple[str, list[Posterior]]]:
    """Return all runs of grasps of one object that follow each other."""
    return [
        (label, row[i : i + length])
        for label, row in rows.items()
        for i in range(len(row) - length + 1)
    ]


def show_dependence(rows: Rows) -> None:
    """Print log loss and calibration of fused answers: learnt, 0.2 and no dependence."""
    for length in (1, 2, 3, 5):
        runs = windows(rows, length)
        if not runs:
            continue
        texts = []
        for name, dependence in (("learnt", None), ("0.2", 0.2), ("none", 0.0)):
            fused = [fuse(run, dependence=dependence) for _, run in runs]
            right = [p.best == label for p, (label, _) in zip(fused, runs, strict=True)]
            loss = -np.mean(
                [
                    np.log(p.probability[p.labels.index(label)])
                    for p, (label, _) in zip(fused, runs, strict=True)
                ]
            )
            ece = expected_calibration_error([float(p.probability.max()) for p in fused], right)
            texts.append(f"{name} {loss:.3f}/{ece:.3f}")
        line(
            f"    {length} fused",
            f"{100 * np.mean(right):.1f} % of {len(runs)}; log loss/ECE " + ", ".join(texts),
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
            low, high = wilson_interval(early_wrong, early)
            line(
                f"    wanted {100 * wanted:.0f} %",
                f"got {100 * early_wrong / max(early, 1):.1f} % ({100 * low:.1f} to "
                f"{100 * high:.1f}) of {early} sure of {n}; all labels {wrong} of {given} wrong, "
                f"{unknown} unknown, {grasps / n:.2f} grasps",
            )


def show_early(train: Sequence[Grasp], test: Sequence[Grasp], use_aperture: bool) -> None:
    """Print time to decision and accuracy of decisions during the ramp."""
    early = EarlyTrainer(base=make_trainer("force_ramp", use_aperture=use_aperture)).fit(train)
    whole = [early.whole.posterior(g).best == g.label for g in test]
    full_s = float(np.mean([g.t_s[-1] for g in test]))
    line("    whole ramp", f"{100 * np.mean(whole):.1f} % right after {full_s:.2f} s")
    for wanted in EARLY_WANTED:
        found = [early.answer(g, StopRule(error_rate=wanted)) for g in test]
        right = [a.posterior.best == g.label for a, g in zip(found, test, strict=True)]
        seconds = [g.t_s[a.n_frames - 1] for a, g in zip(found, test, strict=True)]
        sure = [a.decided for a in found]
        wrong = [not r for r, s in zip(right, sure, strict=True) if s]
        line(
            f"    wanted {100 * wanted:.0f} %",
            f"{100 * np.mean(right):.1f} % right after {np.mean(seconds):.2f} s; "
            f"{100 * np.mean(sure):.0f} % sure, {sum(wrong)} of {len(wrong)} of these wrong",
        )
    line("  ratio", f"the last takes {np.mean(seconds) / full_s:.2f} x the time of whole ramps")


def rows_of(grasps: Sequence[Grasp], recognizer: object) -> Rows:
    return {
        label: [recognizer.posterior(g) for g in members]  # type: ignore[attr-defined]
        for label, members in by_label(grasps).items()
    }


def simulated(name: str, shapes: dict[str, str], sensing: Sensing, effort: float) -> None:
    n_train, n_pool = repeats(20, effort, least=8), repeats(80, effort, least=6)
    train = posed(shapes, n_train, sensing, 0)
    test = posed(shapes, n_pool, sensing, 100_000)
    recognizer = make_trainer("force_ramp", use_aperture=sensing.aperture_known).fit(
        [g for g, _ in train]
    )
    rows = rows_of([g for g, _ in test], recognizer)
    dependence = next(iter(rows.values()))[0].dependence
    line(f"  {name}", f"{n_train} grasps of each teach; dependence learnt: {dependence:.2f}")
    show_dependence(rows)
    show_stopping(rows)
    show_early([g for g, _ in train], [g for g, _ in test], sensing.aperture_known)


def recorded(path: Path, effort: float) -> None:
    taught, _ = chronological_split(read_dataset(path), 0.6)
    if effort < 1.0:
        few = sorted({g.label for g in taught})[:4]
        taught = tuple(g for g in taught if g.label in few)
    train, test = chronological_split(taught, 0.6)
    for use_aperture in (True, False):
        rows = rows_of(test, make_trainer("force_ramp", use_aperture=use_aperture).fit(train))
        dependence = next(iter(rows.values()))[0].dependence
        what = "recorded" if use_aperture else "recorded, touch alone"
        line(f"  {what}", f"{len(train)} teach; dependence learnt: {dependence:.2f}")
        show_dependence(rows)
        show_stopping(rows)
        show_early(train, test, use_aperture)


def main(effort: float = 1.0) -> None:
    line("compared", "fusion, stop rule, decision during the ramp")
    blind = Sensing(aperture_known=False)
    noisy = Sensing(noise=2.0, aperture_known=False)
    seeing = Sensing(noise=2.0)
    cases = [("paper's objects, touch alone", PAPER, blind)]
    if effort >= 0.2:
        cases += [
            ("paper's, touch alone, twice the noise", PAPER, noisy),
            ("similar objects, touch alone, twice the noise", HARD, noisy),
            ("similar objects, opening too, twice the noise", HARD, seeing),
        ]
    for name, shapes, sensing in cases:
        simulated(name, shapes, sensing, effort)
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        line("  recorded", "left out, TACTILE_CELL_DATA names no folder with pinch36.npz")
        return
    recorded(Path(folder) / "pinch36.npz", effort)


if __name__ == "__main__":
    main()
