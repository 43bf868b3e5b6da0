"""Time from the last frame of one grasp to its label, against the time that the grasp itself takes.

What is timed is what a cell does after the last frame: the record is made from the frames that were
collected, the recogniser says what it tells, and that becomes a decision. Five objects are grasped
by 408 simulated taxels; with the folder of recorded grasps in TACTILE_CELL_DATA, 36 real objects
are named too, taught with the first 60 % of each object's grasps. The alternatives are the plain
shrinkage discriminant on the same grasps and the paper's level check.

At last: where the time of the simulated cell goes from the command to a part that is named, and
let go or kept. Computing takes none of the cell's virtual time; its CPU time is added where it
lasts longer than the motion beside which a real-time cell computes.
"""

import os
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks._measure import in_turns, line, quantile, ratio, repeats, same, timed
from benchmarks.recognition._made_grasps import made_grasp
from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.keeping import Keep
from cell.data.dataset import read_dataset
from cell.jobs.sort import Places, Tally, simulated_feed, sort_parts
from cell.learning.collection import Collection
from cell.learning.taught_model import TaughtModel
from recognition.evaluation.splits import chronological_split
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers import DEFAULT_TRAINER, TRAINERS, make_trainer
from simulator.world.shapes import PAPER_OBJECTS

_RECORDED = "pinch36.npz"


@dataclass(frozen=True, slots=True, kw_only=True)
class Collected:
    """The frames of one grasp as they came in, one by one."""

    grasp: Grasp
    frames: tuple[np.ndarray, ...]


def collected(grasp: Grasp) -> Collected:
    return Collected(grasp=grasp, frames=tuple(np.array(frame) for frame in grasp.counts))


def label_of(recognizer: Recognizer, one: Collected) -> str:
    """Make the record of a grasp and name it."""
    known = one.grasp
    grasp = Grasp(
        pads=known.pads,
        counts=np.stack(one.frames),
        t_s=known.t_s,
        aperture_m=known.aperture_m,
        force_n=known.force_n,
    )
    return recognizer.posterior(grasp).name


def one_round(
    recognizer: Recognizer, tests: Sequence[Collected], labels: list[tuple[str, ...]]
) -> list[float]:
    """Name all grasps once; the s that each took."""
    walls_s, found = [], []
    for one in tests:
        start_s = time.perf_counter()
        found.append(label_of(recognizer, one))
        walls_s.append(time.perf_counter() - start_s)
    labels.append(tuple(found))
    return walls_s


def compare(title: str, train: Sequence[Grasp], test: Sequence[Grasp], rounds: int) -> None:
    """Teach all recognisers, let them take turns, and print their figures."""
    line(
        title,
        f"{len({g.label for g in train})} objects, {len(train)} grasps teach, "
        f"{len(test)} are named {rounds} times, in turns",
    )
    taught: dict[str, Recognizer] = {}
    training_s: dict[str, float] = {}
    for name in sorted(TRAINERS, key=lambda name: name != DEFAULT_TRAINER):
        training_s[name] = timed(
            lambda name=name: taught.update({name: make_trainer(name).fit(train)})
        ).wall_s
    tests = [collected(grasp) for grasp in test]
    truth = np.array([grasp.label for grasp in test])
    labels: dict[str, list[tuple[str, ...]]] = {name: [] for name in taught}
    for name, recognizer in taught.items():
        one_round(recognizer, tests[:1], [])
        same(recognizer.labels == taught[DEFAULT_TRAINER].labels, f"{name} knows other objects")
    walls_s = in_turns(
        {n: partial(one_round, recognizer, tests, labels[n]) for n, recognizer in taught.items()},
        rounds,
    )
    for name, runs in walls_s.items():
        same(len(set(labels[name])) == 1, f"{name} names the same grasps differently")
        each_s = [wall_s for run in runs for wall_s in run]
        p50, p99 = (1e3 * quantile(each_s, share) for share in (0.5, 0.99))
        right = int(np.sum(np.array(labels[name][0]) == truth))
        line(
            f"  {name}",
            f"{p50:.2f} ms a grasp, p99 {p99:.2f} ms, taught in {training_s[name]:.2f} s, "
            f"{right} of {len(test)} named right",
        )
    medians = {name: [statistics.median(run) for run in runs] for name, runs in walls_s.items()}
    ours = medians[DEFAULT_TRAINER]
    for name, other in medians.items():
        if name != DEFAULT_TRAINER:
            line(
                "  ratio", f"{DEFAULT_TRAINER} takes {ratio(ours, other):.1f} x the time of {name}"
            )
    grasp_s = statistics.median(float(grasp.t_s[-1]) for grasp in test)
    share = 100.0 * statistics.median(ours) / grasp_s
    line("  ratio", f"the label takes {share:.2f} % of the {grasp_s:.1f} s that the grasp takes")


def made(n_objects: int, n_train: int, n_test: int) -> tuple[list[Grasp], list[Grasp]]:
    """Return simulated grasps that teach, and others that test, of the paper's first objects."""
    train, test = [], []
    for number, label in enumerate(list(PAPER_OBJECTS)[:n_objects]):
        grasps = [made_grasp(label, 1000 * number + i) for i in range(n_train + n_test)]
        train += grasps[:n_train]
        test += grasps[n_train:]
    return train, test


def from_the_command(n_teach: int, rounds: int) -> None:
    """Print the times of a cell from the command to the end of its work, by phase."""
    config = changed_config(CellConfig(), {"self_zero": "never"})
    labels = [entry.label for entry in config.simulator.objects]
    with closing(build_cell(config)) as cell:
        controller, model = cell.controller, TaughtModel(config)
        assert cell.simulated is not None
        clock, spent_s = cell.simulated.clock, Counter[str]()
        controller.start()
        for seed, label in enumerate(labels):
            one = Collection(label=label, n_planned=n_teach)
            model.collect(controller, one, seed=seed, on_grasp=lambda _so_far: None)
        model.train()
        last_s = [clock.monotonic()]

        def look(now_s: float) -> None:
            spent_s[controller.hand.phase.value] += now_s - last_s[0]
            last_s[0] = now_s

        def answers(found: Identification) -> float:
            grasps = [record.grasp for record in found.records]
            return timed(
                lambda: [(model.recognizer.posterior(g), model.read_shape(g)) for g in grasps]
            ).cpu_s

        clock.on_advance.append(look)
        for keep, beside in (
            (Keep.NEVER, ("releasing",)),
            (Keep.ALWAYS, ("backing_off", "holding")),
        ):
            totals_s, phases_s, n_grasps, right = [], dict[str, list[float]](), 0, 0
            for turn in range(rounds * len(labels)):
                spent_s.clear()
                held = labels[turn % len(labels)]
                found = model.identify(controller, held=held, seed=1000 + turn, keep=keep)
                took_s = dict(spent_s) | {"computing": answers(found)}
                alone_s = max(0.0, took_s["computing"] - sum(spent_s[name] for name in beside))
                totals_s.append(sum(spent_s.values()) + alone_s)
                for name, value_s in took_s.items():
                    phases_s.setdefault(name, []).append(value_s)
                right += found.label == held
                n_grasps += len(found.records)
                if found.kept:
                    controller.release()
            line(
                "kept" if keep is Keep.ALWAYS else "let go",
                f"from the command median {statistics.median(totals_s):.2f} s, largest "
                f"{max(totals_s):.2f} s, n = {len(totals_s)}, {right} right, {n_grasps} grasps",
            )
            for name, values_s in phases_s.items():
                line(f"  {name}", f"{statistics.median(values_s):.3f} s, {max(values_s):.3f} s")
        tally, feed = Tally(places=Places(config, labels)), simulated_feed(config, 5 * rounds)
        started_s = clock.monotonic()
        sort_parts(controller, model, tally, n_parts=len(feed), feed=feed.__getitem__)
        part_s = (clock.monotonic() - started_s) / max(1, len(tally.parts))
        line("sort", f"{3600.0 / part_s:.0f} parts an hour, {part_s:.2f} s a part, n = {len(feed)}")


def many(n_labels: int) -> None:
    """Print how long so many labels take to teach, each with five grasps dealt from made ones."""
    names = list(PAPER_OBJECTS)
    some = [made_grasp(names[i % len(names)], i) for i in range(n_labels // 2)]
    dealt = [
        replace(some[7 * i % len(some)], label=f"label {i // 5:03d}", start_ms=i)
        for i in range(5 * n_labels)
    ]
    start_s = time.perf_counter()
    recognizer = make_trainer(DEFAULT_TRAINER).fit(dealt)
    taught_s = time.perf_counter() - start_s
    answers_s = [timed(partial(recognizer.posterior, grasp)).wall_s for grasp in some[:50]]
    line(
        f"{n_labels} labels",
        f"{len(dealt)} grasps taught in {taught_s:.1f} s, {1e3 * quantile(answers_s, 0.5):.2f} ms "
        "an answer",
    )


def main(effort: float = 1.0) -> None:
    rounds = repeats(9, effort)
    n_objects = repeats(len(PAPER_OBJECTS), effort, least=2)
    train, test = made(n_objects, repeats(8, effort, least=3), repeats(4, effort))
    compare(f"{test[0].pads.n_taxels} simulated taxels", train, test, rounds)
    many(repeats(500, effort, least=6))
    from_the_command(repeats(20, effort, least=3), repeats(8, effort))
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        line(
            "recorded grasps",
            f"left out, TACTILE_CELL_DATA names no folder with {_RECORDED}",
        )
        return
    taught, rest = chronological_split(read_dataset(Path(folder) / _RECORDED), 0.6)
    if effort < 1.0:
        few = sorted({grasp.label for grasp in taught})[:4]
        taught, rest = (tuple(g for g in part if g.label in few) for part in (taught, rest))
    compare(f"{rest[0].pads.n_taxels} recorded taxels", taught, rest, repeats(3, effort))


if __name__ == "__main__":
    main()
