"""Tables of what was held and what was named, of a cell and of the paper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recognition.evaluation.evaluation import wilson_interval
from recognition.recognizer import UNKNOWN, Posterior

BASELINE = "level_check"
"""The paper's classifier: the likeliest object by one grasp, never UNKNOWN, as in its Table 1."""
TABLE_1_LABELS = ("oval", "cylinder", "box", "ball", "dumbbell")
"""Objects of the paper's Table 1, in its order (section 4)."""
TABLE_1 = (
    (100, 0, 0, 0, 0),
    (0, 90, 0, 10, 0),
    (0, 0, 100, 0, 0),
    (0, 10, 0, 90, 0),
    (0, 0, 0, 0, 100),
)
"""Table 1 in per cent of ten trials for each object; row: held, column: named.

The paper prints only the errors; the diagonal is the rest of each row's ten trials.
"""
TABLE_1_TRIALS = 10
"""Trials of each object in Table 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConfusionTable:
    """Counts of held objects and answers."""

    name: str
    """Source of the answers, as text."""
    labels: tuple[str, ...]
    columns: tuple[str, ...]
    """Objects held (rows) and answers (columns)."""
    counts: NDArray[np.int64]
    """(n_labels, n_columns) int64: trials."""
    caption: str = ""
    """Description of the trials."""

    @property
    def n(self) -> int:
        """Number of trials."""
        return int(self.counts.sum())

    @property
    def n_right(self) -> int:
        """Right answers."""
        same = np.array(self.labels)[:, None] == np.array(self.columns)
        return int(self.counts[same].sum())

    @property
    def accuracy(self) -> float:
        """Share of right answers; NaN without a trial."""
        return self.n_right / self.n if self.n else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval (Wilson)."""
        return wilson_interval(self.n_right, self.n)

    @property
    def text(self) -> str:
        """The counts as text: right, UNKNOWN and wrong answers."""
        taught = np.array(self.labels) != UNKNOWN
        n_unknown = int(self.counts[taught][:, np.array(self.columns) == UNKNOWN].sum())
        unknown = f", {n_unknown} {UNKNOWN}" if n_unknown else ""
        wrong = self.n - self.n_right - n_unknown
        return f"{self.n_right} of {self.n} right{unknown}, {wrong} wrong"

    def without_empty(self) -> "ConfusionTable":
        """Return it without answers that are no label and were never given."""
        used = self.counts.any(axis=0) | np.isin(self.columns, self.labels)
        columns = tuple(c for c, is_used in zip(self.columns, used, strict=True) if is_used)
        return replace(self, columns=columns, counts=self.counts[:, used])


def score(
    name: str, truths: Sequence[str], answers: Sequence[str], labels: Sequence[str]
) -> ConfusionTable:
    """Count answers against the truth; answers that are not a label count as UNKNOWN."""
    columns = tuple(dict.fromkeys((*labels, UNKNOWN)))
    counts = np.zeros((len(labels), len(columns)), dtype=np.int64)
    for truth, answer in zip(truths, answers, strict=True):
        if truth in labels:
            place = columns.index(answer if answer in columns else UNKNOWN)
            counts[labels.index(truth), place] += 1
    return ConfusionTable(name=name, labels=tuple(labels), columns=columns, counts=counts)


def score_tables(
    trials: Sequence[tuple[str, str, Mapping[str, Posterior]]], labels: Sequence[str], default: str
) -> dict[str, ConfusionTable]:
    """Return the tables of identifications, by recognizer; empty without trials.

    Parameters
    ----------
    trials
        Held object, answer, and the answer of each recognizer to the first grasp only.
    labels
        The objects, in the order of the rows.
    default
        Name of the recognizer that answered.
    """
    if not trials:
        return {}
    truths, answers, first = zip(*trials, strict=True)
    scores = {default: score("This cell, all grasps", truths, answers, labels)}
    for name in first[0]:
        posteriors = [by_name[name] for by_name in first]
        named = [p.best if name == BASELINE else p.name for p in posteriors]
        key = f"{name}_one_grasp" if name == default else name
        whose = "This cell" if name == default else "The paper's method"
        scores[key] = score(f"{whose}, first grasp only", truths, named, labels)
    return scores


def paper_table() -> ConfusionTable:
    """Return Table 1 of the paper: ten trials of each of five objects."""
    return ConfusionTable(
        name="Paper, Table 1",
        labels=TABLE_1_LABELS,
        columns=TABLE_1_LABELS,
        counts=np.array(TABLE_1) * TABLE_1_TRIALS // 100,
        caption=f"Petchartee et al. 2008, {TABLE_1_TRIALS} trials of each object",
    )
