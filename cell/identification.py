"""One grasp-then-classify sequence: grasp, ask the recogniser, stop or go on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from cell.collect import GraspRecord
from cell.sequence import GraspStep
from cell.shapes import ReadShape
from recognition.drift_following import DriftBelief
from recognition.early import EarlyHeads, RampLooks, looking
from recognition.fusion import Decision, DecisionKind, StopRule, decide, fuse
from recognition.recognizer import Posterior, Recognizer
from recognition.shape_answer import ShapeAnswer
from recognition.shape_fusion import fuse_shapes
from recognition.shift import Following


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """The answer of one grasp-then-classify sequence.

    Attributes
    ----------
    label
        A taught label, or ``UNKNOWN``.
    probability
        Probability of the label after all grasps.
    decision
        Why the sequence ended.
    posteriors
        What each grasp told by itself, in order.
    fused
        What all grasps tell together.
    records
        The grasps.
    drift
        What was believed of the drift when the answer was given; None for a recogniser that does
        not follow it.
    complaints
        What went wrong in whoever was told of the grasps, or read their shape; the label is not
        touched by it.
    shapes
        Shape and size that each grasp told by itself, in order; None where its pads do not tell.
        Empty where nobody asked.
    shape
        Shape and size that all grasps tell together; None where none of them tells.
    """

    label: str
    probability: float
    decision: Decision
    posteriors: tuple[Posterior, ...]
    fused: Posterior
    records: tuple[GraspRecord, ...]
    drift: DriftBelief | None = None
    complaints: tuple[str, ...] = ()
    shapes: tuple[ShapeAnswer | None, ...] = ()
    shape: ShapeAnswer | None = None


class StepChooser(Protocol):
    """Says which grasp comes next, given what the grasps so far have told."""

    def next_step(self, posteriors: Sequence[Posterior], planned: GraspStep, /) -> GraspStep:
        """Return the step to take: the planned one, or another within the cell's limits."""
        ...


OnGrasp = Callable[[int, GraspRecord, Posterior, ShapeAnswer | None], None]
"""Told after each grasp: its number from 1, its record, what it tells by itself, and its shape.

What it raises does not end the sequence, whose answer does not depend on it; it is kept among the
`Identification.complaints`.
"""


def grasp_and_classify(
    grasp: Callable[[GraspStep, RampLooks | None], GraspRecord],
    recognizer: Recognizer,
    plan: Sequence[GraspStep],
    *,
    error_rate: float,
    early: EarlyHeads | None = None,
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
        Says what a grasp tells.
    plan
        Steps in order, at least one; with a ``chooser`` each is a proposal that it may replace.
    error_rate
        Wanted rate of wrong answers at which the sequence stops early.
    read_shape
        Says shape and size of a grasp, which the label does not depend on. It is asked between two
        grasps, while the fingers are open.
    early
        Looks at each ramp while it runs: together with the earlier grasps it may decide before the
        ramp is at its end, which then tells what was known at that moment. None: whole ramps only.
    """
    rule = StopRule(error_rate=error_rate, max_grasps=len(plan))
    posteriors: list[Posterior] = []
    records: list[GraspRecord] = []
    complaints: list[str] = []
    shapes: list[ShapeAnswer | None] = []
    heads = None if early is None else early.expecting(recognizer)
    for number, step in enumerate(plan, start=1):
        record = grasp(
            step if chooser is None else chooser.next_step(posteriors, step),
            None if heads is None else RampLooks(heads, posteriors, looking(rule)),
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
        drift=recognizer.belief if isinstance(recognizer, Following) else None,
        complaints=tuple(complaints),
        shapes=tuple(shapes),
        shape=shape,
    )


def _fused(shapes: Sequence[ShapeAnswer | None], complaints: list[str]) -> ShapeAnswer | None:
    """Return shape and size by all grasps; what goes wrong is a complaint, never the label's."""
    told = [shape for shape in shapes if shape is not None]
    try:
        return fuse_shapes(told) if told else None
    except Exception as error:
        complaints.append(f"shape of all grasps: {type(error).__name__}: {error}")
        return None
