"""The grasp-then-classify sequence: grasp, classify, stop or go on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from cell.control.plan import GraspStep
from cell.control.records import GraspRecord
from recognition.drift.estimate import DriftEstimate, DriftTracking
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior, Recognizer
from recognition.recognizers.early_classifiers import (
    EarlyClassifiers,
    EarlyDecider,
    rule_during_ramp,
)
from recognition.shape.answer import ShapeAnswer
from recognition.shape.fusion import fuse_shapes
from recognition.statistics.fusion import Decision, DecisionKind, StopRule, decide, fuse

ReadShape = Callable[[Grasp], ShapeAnswer | None]
"""Function from a grasp to its shape and size; None where its pads do not show them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """The answer of one grasp-then-classify sequence.

    Attributes
    ----------
    label
        A taught label, or ``UNKNOWN``.
    probability
        Probability of the label after all grasps, given that the object was taught; of ``UNKNOWN``
        the probability that it was not. The stop rule goes by it; see also `probabilities`.
    decision
        Why the sequence ended.
    posteriors
        Answer to each grasp by itself, in order.
    fused
        Answer to all grasps together.
    records
        The grasps.
    drift
        Estimate of the drift with which the answer was given; None for a recogniser that does not
        follow it.
    complaints
        Errors of the callback and of the fits of shape; the label does not depend on these.
    shapes
        Shape and size by each grasp, in order; None where its pads do not show them. Empty where
        none was asked for.
    shape
        Shape and size by all grasps together; None where none of them shows it.
    remark
        Message for the operator, as that the sensors have drifted; empty where there is none.
    """

    label: str
    probability: float
    decision: Decision
    posteriors: tuple[Posterior, ...]
    fused: Posterior
    records: tuple[GraspRecord, ...]
    drift: DriftEstimate | None = None
    complaints: tuple[str, ...] = ()
    shapes: tuple[ShapeAnswer | None, ...] = ()
    shape: ShapeAnswer | None = None
    remark: str = ""

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each taught label and, last, of ``UNKNOWN``; they sum to 1."""
        known = (1.0 - self.fused.unknown) * self.fused.probability
        return {
            **dict(zip(self.fused.labels, known.tolist(), strict=True)),
            UNKNOWN: self.fused.unknown,
        }


class StepChooser(Protocol):
    """Chooses the next grasp by the answers to the grasps so far."""

    def next_step(self, posteriors: Sequence[Posterior], planned: GraspStep, /) -> GraspStep:
        """Return the step to take: the planned one, or another within the cell's limits."""
        ...


OnGrasp = Callable[[int, GraspRecord, Posterior, ShapeAnswer | None], None]
"""Callback after each grasp: its number from 1, its record, its own answer, and its shape.

What it raises does not end the sequence, whose answer does not depend on it; it is kept among the
`Identification.complaints`.
"""


def grasp_and_classify(
    grasp: Callable[[GraspStep, EarlyDecider | None], GraspRecord],
    recognizer: Recognizer,
    plan: Sequence[GraspStep],
    *,
    error_rate: float,
    early: EarlyClassifiers | None = None,
    chooser: StepChooser | None = None,
    read_shape: ReadShape | None = None,
    on_grasp: OnGrasp | None = None,
) -> Identification:
    """Grasp until the stop rule is satisfied or the plan is at its end.

    Parameters
    ----------
    grasp
        Carries one step out, and ends its ramp where the looks at it decide.
    recognizer
        Answers a grasp.
    plan
        Steps in order, at least one; with a ``chooser`` each is a proposal that it may replace.
    error_rate
        Wanted rate of wrong answers at which the sequence stops early.
    read_shape
        Reads shape and size of a grasp, which the label does not depend on. It is called between
        two grasps, while the fingers are open.
    early
        Looks at each ramp while it runs: together with the earlier grasps it may decide before the
        ramp is at its end, whose answer is then the one of that moment. None: whole ramps only.
    """
    rule = StopRule(error_rate=error_rate, max_grasps=len(plan))
    posteriors: list[Posterior] = []
    records: list[GraspRecord] = []
    complaints: list[str] = []
    shapes: list[ShapeAnswer | None] = []
    heads = None if early is None else early.with_drift_of(recognizer)
    for number, step in enumerate(plan, start=1):
        record = grasp(
            step if chooser is None else chooser.next_step(posteriors, step),
            None if heads is None else EarlyDecider(heads, posteriors, rule_during_ramp(rule)),
        )
        posterior = (
            recognizer.posterior(record.grasp) if record.early is None else record.early.posterior
        )
        records.append(record)
        posteriors.append(posterior)
        shape: ShapeAnswer | None = None
        if read_shape is not None:
            try:
                shape = read_shape(record.grasp)
            except Exception as error:
                complaints.append(f"shape of grasp {number}: {type(error).__name__}: {error}")
            shapes.append(shape)
        if on_grasp is not None:
            try:
                on_grasp(number, record, posterior, shape)
            except Exception as error:
                complaints.append(f"after grasp {number}: {type(error).__name__}: {error}")
        decision = decide(posteriors, rule)
        if decision.kind is not DecisionKind.CONTINUE:
            break
    shape = _fused(shapes, complaints)
    return Identification(
        label=decision.label,
        probability=decision.probability,
        decision=decision,
        posteriors=tuple(posteriors),
        fused=fuse(posteriors),
        records=tuple(records),
        drift=recognizer.drift_estimate if isinstance(recognizer, DriftTracking) else None,
        complaints=tuple(complaints),
        shapes=tuple(shapes),
        shape=shape,
    )


def _fused(shapes: Sequence[ShapeAnswer | None], complaints: list[str]) -> ShapeAnswer | None:
    """Return shape and size by all grasps; what goes wrong is a complaint, never the label's."""
    read = [shape for shape in shapes if shape is not None]
    try:
        return fuse_shapes(read) if read else None
    except Exception as error:
        complaints.append(f"shape of all grasps: {type(error).__name__}: {error}")
        return None
