"""The objects that a cell was taught: grasped to be learnt, and told apart by touch."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from cell.choosing import ActiveChooser, memory_for, memory_sections, remember_grasps
from cell.collect import GraspRecord
from cell.config import CellConfig
from cell.controller import CellController
from cell.early_heads import heads_sections, loaded_heads, wanted_heads
from cell.errors import CellError
from cell.goals import IdentifyGoal, TeachGoal
from cell.model import Arrays, LoadedModel
from cell.pad_knowledge import PadKnowledge
from cell.sequence import plan
from cell.shapes import FeltShape, shape_reader
from cell.shift import Shift
from cell.worker import Report
from recognition.drift import NO_DRIFT
from recognition.drift_following import DriftBelief
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What an identification says.

    Attributes
    ----------
    label
        A taught label, or ``UNKNOWN``.
    probability
        Probability of the label.
    probabilities
        Probability of each taught label, given that the object was taught.
    unknown
        Probability that the object was never taught.
    n_grasps
        Grasps that it took.
    shape
        Shape and size, also of an object that was never taught; None where the pads do not tell,
        or the config has ``recognition.shape`` off.
    n_ended_early
        Grasps whose ramp ended early, because it sufficed.
    drift
        What was believed of the drift of the sensors; None where it is not followed.
    remark
        What an operator must know, as that the sensors have drifted; said once, empty otherwise.
    """

    label: str
    probability: float
    probabilities: Mapping[str, float] = field(hash=False)
    unknown: float
    n_grasps: int
    shape: FeltShape | None = None
    n_ended_early: int = 0
    drift: DriftBelief | None = None
    remark: str = ""


class TaughtObjects:
    """Recognizer of the taught objects, and the grasps that it was trained with.

    Parameters
    ----------
    config
        Of the cell.
    model
        A model file, which has no grasps; None when nothing was taught yet.
    known
        What is known of foam and sensor, for shape and size; by default what is usual.

    Attributes
    ----------
    shift
        The present recogniser and what it has followed; None when nothing was taught yet.
    early
        Heads for ramps that end early; None where the config does not want it.
    memory
        Where the taught grasps were taken and what they told; None where the config does not want
        it.

    Raises
    ------
    ModelError
        If the model lacks what the config wants.
    """

    def __init__(
        self,
        config: CellConfig,
        model: LoadedModel | None,
        known: PadKnowledge | None = None,
    ) -> None:
        self.early = None if model is None else loaded_heads(model, config.sequence)
        self.memory = None if model is None else memory_for(config.sequence, model)
        self._config = config
        self.shift = None if model is None else self._begin(model.recognizer)
        self._read_shape = shape_reader(config, known)
        self._lock = threading.Lock()
        self._taught: list[GraspRecord] = []

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return self.shift.taught.labels if self.shift is not None else ()

    @property
    def sections(self) -> dict[str, Arrays]:
        """What a model file keeps beside the recogniser."""
        return {**heads_sections(self.early), **memory_sections(self.memory)}

    @property
    def loaded(self) -> bool:
        """Whether the recognizer is a loaded one, whose grasps are not at hand."""
        return self.shift is not None and not self._taught

    def teach(self, controller: CellController, goal: TeachGoal, report: Report) -> int:
        """Grasp an object as the goal says, train anew, and return the number of grasps.

        A drift that is likely by now is taken off the new grasps, so that all grasps are as the
        sensors were when the first of them were taught; it is followed further.

        Raises
        ------
        CellError
            If all taught grasps together are too few to train with; they are kept for the next
            time.
        """
        steps = plan(self._config.sequence, goal.grasps, seed=goal.seed)
        taught = []
        for record in controller.collect(goal.label, steps):
            taught.append(record)
            report({"task": "teach", "label": goal.label, "grasps": len(taught), "of": len(steps)})
        with self._lock:
            self._taught.extend(self._undrifted(taught))
            trainer = make_trainer(
                self._config.recognition.recognizer,
                use_aperture=self._config.recognition.use_aperture,
            )
            grasps = [record.grasp for record in self._taught]
            try:
                whole = trainer.fit(grasps)
            except ValueError as error:
                raise CellError(
                    f"the taught grasps make no recogniser yet, and are kept: {error}"
                ) from error
            if self._config.sequence.kind == "active":
                self.memory = remember_grasps(trainer, grasps)
            self.early = wanted_heads(grasps, whole, self._config)
            self.shift = self._begin(whole) if self.shift is None else self.shift.retaught(whole)
        return len(taught)

    def identify(
        self,
        controller: CellController,
        goal: IdentifyGoal,
        shift: Shift,
        report: Report,
    ) -> Answer:
        """Grasp an object until its name is sure enough, follow the drift, return the answer."""
        controller.present(goal.present)
        n_grasps = goal.max_grasps or self._config.sequence.max_grasps
        found = controller.identify(
            shift.recognizer,
            plan(self._config.sequence, n_grasps, seed=goal.seed),
            early=self.early,
            chooser=None
            if self.memory is None
            else ActiveChooser(self.memory, self._config.sequence, seed=goal.seed),
            read_shape=self._read_shape,
            on_grasp=lambda number, record, posterior, shape: report(
                {
                    "task": "identify",
                    "grasps": number,
                    "of": n_grasps,
                    "best": posterior.best,
                    "probability": float(posterior.probability.max()),
                    "force_n": record.step.force_n,
                    "shape": None if shape is None else str(shape),
                    "ended_early": record.early is not None,
                }
            ),
        )
        remark = shift.answered(found.records)
        if remark:
            controller.remark("drift", remark)
            report({"task": "identify", "remark": remark})
        return Answer(
            label=found.label,
            probability=found.probability,
            probabilities=dict(
                zip(found.fused.labels, map(float, found.fused.probability), strict=True)
            ),
            unknown=found.fused.unknown,
            n_grasps=len(found.records),
            shape=None if found.shape is None else FeltShape.of(found.shape),
            n_ended_early=sum(record.early is not None for record in found.records),
            drift=found.drift,
            remark=remark,
        )

    def _begin(self, recognizer: Recognizer) -> Shift:
        return Shift(recognizer, follow=self._config.recognition.follow_drift)

    def _undrifted(self, records: Sequence[GraspRecord]) -> list[GraspRecord]:
        drift = NO_DRIFT if self.shift is None else self.shift.drift
        if drift == NO_DRIFT:
            return list(records)
        return [replace(record, grasp=drift.undo(record.grasp)) for record in records]
