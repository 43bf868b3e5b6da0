"""Tasks of a host's jobs: teach, identify, grip, verify and sort, with progress as plain data."""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cell.config.model import CellConfig
from cell.control.answer import Answer, SortAnswer, Verification
from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.control.keeping import Keep
from cell.control.plan import Pose
from cell.control.records import GraspRecord
from cell.control.self_zero import zero_text
from cell.errors import CellError, ModelError, NoPartFound, raised_as
from cell.learning.taught_model import TaughtModel, training_set_file
from cell.runtime.collection import Collection, teach
from cell.runtime.goals import (
    GaugeGoal,
    GripGoal,
    IdentifyGoal,
    SortGoal,
    TeachGoal,
    VerifyGoal,
    ZeroGoal,
)
from cell.runtime.identify import identify
from cell.runtime.part_report import PartReporter
from cell.runtime.sort import Places, Tally, sort_parts
from cell.runtime.worker import Report
from recognition.drift.drift import Drift
from recognition.grasp import SelfZero
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import fuse

__all__ = ["ModelFile", "Places", "Tasks"]

_SORTED = ("number", "label", "probability", "place", "n_grasps", "changed")
"""Values of the newest part in the progress of a sort; ``was`` is its true object."""
_SHOWN_GRASPS = 100
"""Number of newest grasps in the progress of a teaching."""


class ModelFile:
    """The file that each teaching writes, if there is one; a failed write is tried again.

    Only a model replaces it, and only `forget` removes it.
    """

    def __init__(self, model: TaughtModel, path: Path | None) -> None:
        self.model = model
        self._path = path
        self.due = self._emptied = False

    def write(self) -> None:
        """Write the model if it changed since the last write.

        Raises ModelError or DatasetError if a file cannot be written; the write stays pending.
        """
        if self._path is not None and self.due:
            if self.model.labels:
                self.model.save(self._path)
            elif self._emptied:  # the next start must not find what was forgotten
                with raised_as(ModelError, OSError, where=f"{self._path} cannot be removed"):
                    self._path.unlink(missing_ok=True)
                    training_set_file(self._path).unlink(missing_ok=True)
        self.due = self._emptied = False

    def forget(self, label: str, *, last: bool, forgotten: Callable[[], None]) -> None:
        """Forget a taught object, or its newest grasp with ``last``, and write the model.

        Raises CellError as `TaughtModel.forget`, and if the model cannot be written; the write is
        tried again.
        """
        self.model.forget(label, last=last)
        if label not in self.model.objects():
            forgotten()
        self.due, self._emptied = True, not self.model.labels
        self.write()


@dataclass(frozen=True, slots=True)
class Tasks:
    """The tasks of a cell, by their names in goals; each runs in the thread of the cell."""

    controller: CellController
    file: ModelFile
    """The model and its file."""
    places: Callable[[], Places] = lambda: Places(CellConfig(), ())
    """Returns the places of a sort for the objects taught now."""
    reporter: Callable[[], PartReporter] = lambda: lambda answer, _found=None: answer
    """Starts the reports of the parts of a task, as `part_reporter`; by default no reports."""

    @property
    def model(self) -> TaughtModel:
        """The taught model."""
        return self.file.model

    def teach(self, goal: TeachGoal, report: Report) -> int:
        """Grasp an object, train the model, write it, and return the object's number of grasps.

        Raises
        ------
        cell.errors.NoPartFound, cell.errors.CellStopped, and errors of the devices
            As `cell.learning.labelled_grasps.teach`; the next teaching uses the grasps until then.
        CellError
            If there are too few taught grasps for a training; they are kept too.
        ModelError, DatasetError
            If the model cannot be written; it is in use.
        """
        each: deque[dict[str, Any]] = deque(maxlen=_SHOWN_GRASPS)

        def progress(now: Collection) -> None:
            if goal.train and len(now.records) > shown["grasps"]:
                each.append(_felt(now.records[-1], self.model))
            shown.update(grasps=len(now.records), missed=now.n_missed, short=now.short)
            shown["each"] = list(each)
            report(dict(shown))

        shown: dict[str, Any] = {"task": "teach", "label": goal.label, "grasps": 0, "missed": 0}
        shown |= {"of": goal.grasps, "each": []}
        collection = Collection(label=goal.label, n_planned=goal.grasps, present=goal.present)
        report(dict(shown))
        self.file.due |= goal.train
        teach(self.controller, self.model, collection, seed=goal.seed, on_grasp=progress)
        if not goal.train:
            return len(collection.records)
        self.model.train()
        apart = self.model.told_apart(goal.label)
        n_grasps = self.model.objects()[goal.label][0]
        taught = {"label": goal.label, "n_grasps": n_grasps} | asdict(apart)
        report(shown | {"taught": taught})
        try:
            self.file.write()
        except CellError as error:
            raise type(error)(
                f"{goal.label} is taught and in use, but not saved: {error}; it is tried again "
                "with the next job and at the end"
            ) from error
        return len(collection.records)

    def gauge(self, goal: GaugeGoal, report: Report) -> Drift:
        """Grasp a taught object, measure the drift, correct it from now on, and return it.

        Raises as `Collection.fill`; nothing changes then. Raises CellError if the grasps show no
        drift, or if the model cannot be written; it is then in use.
        """
        shown: dict[str, Any] = {"task": "gauge", "label": goal.label, "grasps": 0, "missed": 0}

        def progress(now: Collection) -> None:
            shown.update(grasps=len(now.records), missed=now.n_missed)
            report(dict(shown))

        shown["of"] = goal.grasps
        collection = Collection(label=goal.label, n_planned=goal.grasps, present=goal.present)
        self.model.check_gauge(goal.label)
        sequence = self.model.config.sequence
        collection.fill(self.controller, sequence, seed=goal.seed, on_grasp=progress)
        found = self.model.gauge(goal.label, collection.grasps)
        drifts = {
            when: {"gain": drift.gain, "opening_mm": 1e3 * drift.aperture_offset_m}
            for when, drift in zip(("before", "after"), found, strict=True)
        }
        report(shown | {"gauged": {"label": goal.label} | drifts})
        self.file.due = True
        self.file.write()
        return found[1]

    def zero(self, _goal: ZeroGoal, report: Report) -> SelfZero:
        """Close the empty fingers on each other and return the self-zero.

        Raises as `cell.control.zeroing.Zeroing.measure`.
        """
        report({"task": "zero"})
        before = self.controller.zeros.newest
        found = self.controller.zeroing.measure()
        moved_mm = None if before is None else 1e3 * (found.zero.opening_m - before.opening_m)
        values = asdict(found.zero) | {"moved_mm": moved_mm}
        report({"task": "zero", "zero": values, "text": zero_text(found)})
        return found.zero

    def identify(self, goal: IdentifyGoal, report: Report) -> Answer:
        """Grasp an object until its name is sure enough, and return the answer.

        ``goal.keep`` decides whether the part stays in the grip. Raises as
        `cell.runtime.identify.identify`.
        """
        seen, posteriors = self.reporter(), list[Posterior]()

        def progress(number: int, record: GraspRecord, posterior: Posterior, shape: Any) -> None:
            posteriors.append(posterior)
            answer = fuse(posteriors)
            report(
                {
                    "task": "identify",
                    "grasps": number,
                    "of": goal.max_grasps or self.model.config.sequence.max_grasps,
                    "best": answer.name,
                    "probability": answer.name_probability,
                    "force_n": record.step.force_n,
                    "shape": None if shape is None else str(shape),
                    "ended_early": record.early is not None,
                    "short": record.outcome.short,
                }
            )

        try:
            found = identify(
                self.controller,
                self.model,
                presented=goal.present,
                seed=goal.seed,
                max_grasps=goal.max_grasps,
                force_n=goal.force_n,
                keep=Keep(goal.keep),
                whole_ramps=goal.whole_ramps,
                on_grasp=progress,
            )
        except NoPartFound:
            seen(Answer())
            raise
        answer = seen(replace(found.answer, rejected=found.label == UNKNOWN), found)
        if found.remark:
            report({"task": "identify", "remark": found.remark})
        return answer

    def grip(self, goal: GripGoal, report: Report) -> Verification:
        """Grip a part and keep it; return its measurement.

        Raises as `CellController.grip`.
        """
        controller = self.controller
        carry_n = controller.kept.wanted_force_n
        gripped = {"task": "grip", "force_n": goal.force_n, "held_with_n": carry_n}
        report(gripped)
        controller.moves.present(goal.present)
        record = controller.grip(goal.force_n, None if goal.present is None else Pose())
        found = self.verify(None, report)
        report(gripped | {"short": record.outcome.short})
        return found

    def verify(self, _goal: VerifyGoal | None, report: Report) -> Verification:
        """Measure whether the part in the grip is still the kept one.

        Raises as `cell.control.kept_part.KeptPart.verify`.
        """
        report({"task": "verify"})
        return self.controller.kept.verify()

    def sort(self, goal: SortGoal, report: Report) -> SortAnswer:
        """Name parts and release each at its place; return the counts.

        Raises as `cell.runtime.sort.sort_parts`; the part is then kept, and the progress has the
        counts so far.
        """
        seen, tally = self.reporter(), Tally(places=self.places())

        def progress(part: dict[str, Any]) -> None:
            counts = {"task": "sort", "of": goal.parts, "parts": tally.n_parts} | tally.as_json()
            report(counts | part)

        def sorted_part(part: Answer, found: Identification) -> None:
            seen(part, found)
            progress(
                {name: getattr(part, name) for name in _SORTED} | {"was": part.presented or None}
            )

        progress({})
        feed = goal.feed
        sort_parts(
            self.controller,
            self.model,
            tally,
            n_parts=goal.parts,
            feed=lambda turn: feed[turn % len(feed)] if feed else None,
            seed=goal.seed,
            max_grasps=goal.max_grasps,
            force_n=goal.force_n,
            on_part=sorted_part,
            on_missed=lambda: seen(Answer(task="sort")),
        )
        return SortAnswer(
            n_parts=tally.n_parts,
            n_missed=tally.n_missed,
            n_rejected=tally.n_rejected,
            places=tally.counts,
        )


def _felt(record: GraspRecord, model: TaughtModel) -> dict[str, Any]:
    """Return force, opening and size of one taught grasp as plain data."""
    shape = model.shapes.read(record.grasp)
    return {
        "force_n": record.outcome.final_force_n,
        "opening_mm": 1e3 * record.outcome.final_aperture_m,
        "size_mm": None if shape is None else 1e3 * shape.size_m,
    }
