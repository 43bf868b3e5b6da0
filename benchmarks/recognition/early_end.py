"""Ramps of the simulated cell that end early, compared with whole ones.

Both identify the paper's objects, and objects never taught, in the same poses and with the same
forces. Times are those of the cell. A grasp lasts from the first move of the closing fingers to the
end of its ramp, an identification from the first pose to the last release.
`benchmarks.recognition.sequences` has more sequences, replayed from single grasps.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._answers import JudgedAnswer, figures, shape_figures
from benchmarks.recognition.other_cell import NEVER_TAUGHT
from cell.build import Cell, build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.plan import plan
from cell.jobs.collection import grasps_of
from cell.learning.shape_reading import shape_reader
from cell.learning.training import train
from recognition.recognizer import Recognizer
from recognition.recognizers.early_classifiers import EarlyClassifiers

NOISES = (1.0, 2.0)
SHAPES = {
    "oval": ("oval", 11.7),
    "cylinder": ("cylinder", 6.0),
    "box": ("flat", 10.0),
    "ball": ("sphere", 9.5),
    "dumbbell": ("dumbbell", 10.0),
    "ball 7": ("sphere", 7.0),
    "cylinder 8": ("cylinder", 8.0),
    "oval 8": ("oval", 8.0),
    "cube": ("flat", 12.0),
}
"""Kind and thickness in mm of each object: the configured ones, and those never taught."""
_PER_OBJECT = 6
_TAUGHT = 10
_FEW_OBJECTS = 2


@dataclass
class IdentifiedParts:
    """Times and answers of a row of identifications."""

    found: list[Identification] = field(default_factory=list)
    truths: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def text(self) -> str:
        """Return the figures in words."""
        records = [record for one in self.found for record in one.records]
        grasp_s = np.mean([record.duration_s for record in records])
        contacts_s = [
            (record.outcome.contact_t_s or record.cycles[0].t_s) - record.cycles[0].t_s
            for record in records
        ]
        force_n = np.mean([record.cycles[-1].setpoint_n for record in records])
        ended = np.mean([record.early is not None for record in records])
        return (
            f"{np.mean(self.seconds):.2f} s, {len(records) / len(self.found):.2f} grasps; a grasp "
            f"{grasp_s:.2f} s ({np.mean(contacts_s):.2f} s to the contact) to {force_n:.1f} N, "
            f"{100 * ended:.0f} % ended early"
        )

    def answers(self, labels: Sequence[str]) -> list[JudgedAnswer]:
        """Return the answers of a bench that was taught these labels."""
        return [
            JudgedAnswer(truth, truth in labels, one.fused.best, one.label)
            for truth, one in zip(self.truths, self.found, strict=True)
        ]

    def shape_text(self) -> str:
        """Return the shares of right shapes and sizes in words."""
        told = [
            (*SHAPES[truth], one.shape)
            for one, truth in zip(self.found, self.truths, strict=True)
            if one.shape is not None
        ]
        return shape_figures(told)


class TaughtCell:
    """A simulated cell and its taught recognisers."""

    def __init__(self, cell: Cell, config: CellConfig, labels: Sequence[str], n_taught: int):
        self.cell = cell
        self.config = config
        self.labels = labels
        self.read_shape = shape_reader(config)
        cell.controller.start()
        self.taught = grasps_of(cell.controller, config.sequence, labels, n_taught)

    def train(self) -> tuple[Recognizer, EarlyClassifiers]:
        """Return the recogniser of whole ramps and the heads."""
        trained = train(self.taught, self.config.recognition.recognizer, early=True)
        assert trained.early is not None
        return trained.recognizer, trained.early

    def identify(
        self,
        tally: IdentifiedParts,
        label: str,
        seed: int,
        whole: Recognizer,
        early: EarlyClassifiers | None,
    ) -> None:
        """Present an object and identify it."""
        assert self.cell.simulated is not None
        clock, sequence = self.cell.simulated.clock, self.config.sequence
        self.cell.controller.moves.present(label)
        begin_s = clock.monotonic()
        steps = plan(sequence, sequence.max_grasps, seed=seed)
        found = self.cell.controller.identify(whole, steps, early=early, read_shape=self.read_shape)
        tally.found.append(found)
        tally.seconds.append(clock.monotonic() - begin_s)
        tally.truths.append(label)


@contextmanager
def bench_of(noise: float, effort: float) -> Iterator[TaughtCell]:
    config = CellConfig()
    labels = [entry.label for entry in config.simulator.objects]
    if effort < 0.1:
        labels = labels[:_FEW_OBJECTS]
    new = [{"label": label, "shape": text} for label, text in NEVER_TAUGHT.items()]
    objects = [entry.model_dump() for entry in config.simulator.objects] + new
    config = changed_config(config, {"simulator.noise_level": noise, "simulator.objects": objects})
    cell = build_cell(config)
    try:
        yield TaughtCell(cell, config, labels, repeats(_TAUGHT, effort, least=3))
    finally:
        cell.close()


def compare(bench: TaughtCell, effort: float) -> None:
    """Print whole and ended ramps."""
    whole, heads = bench.train()
    objects = {"taught": bench.labels, "never taught": list(NEVER_TAUGHT)}
    ways = {"whole ramps": None, "ended early": heads}
    tallies = {way: {what: IdentifiedParts() for what in objects} for way in ways}
    for what, labels in objects.items():
        for number, label in enumerate(labels):
            for turn in range(repeats(_PER_OBJECT, effort)):
                for way, early in ways.items():
                    seed = 1000 + 100 * turn + number
                    bench.identify(tallies[way][what], label, seed, whole, early)
    for way, found in tallies.items():
        answers = [one for tally in found.values() for one in tally.answers(bench.labels)]
        line(f"    {way}", figures(answers))
        for what, tally in found.items():
            line(f"      {what}", tally.text())
            line("        shapes", tally.shape_text())


def main(effort: float = 1.0) -> None:
    line("compared", "identifications on the simulated cell, ramps whole and ended early")
    for noise in NOISES if effort >= 0.1 else NOISES[:1]:
        with bench_of(noise, effort) as bench:
            taught = f"{len(bench.taught)} grasps teach {len(bench.labels)} objects"
            line(f"  noise {noise:g} x", taught)
            compare(bench, effort)
