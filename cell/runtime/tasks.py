"""Tasks of a host's jobs: teach, gauge, zero, identify, grip, verify, sort.

Their progress is plain data.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.config.model import CellConfig
from cell.config.positioner import PlacePoseConfig
from cell.config.sequence import SequenceConfig
from cell.control.controller import CellController
from cell.control.identification import Identification, OnGrasp
from cell.control.part import Part, Verification
from cell.control.plan import Keep, Pose, plan
from cell.control.positioner import CallbackPositioner, Destination
from cell.control.records import GraspRecord
from cell.control.zeroing import zero_text
from cell.errors import CellError, ConfigError, ModelError, NoPartFound, raised_as
from cell.learning.parallel import one_blas_thread
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import zero_note
from cell.runtime.goals import (
    GaugeGoal,
    GripGoal,
    IdentifyGoal,
    SortGoal,
    TeachGoal,
    VerifyGoal,
    ZeroGoal,
)
from cell.runtime.parts import PartLog
from cell.runtime.worker import Report
from recognition.drift.drift import Drift
from recognition.grasp import Grasp, SelfZero
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import fuse


class Places:
    """Places of a sort by the label of a part.

    Raises ConfigError if the config names places, but a part has no place.
    """

    def __init__(self, config: CellConfig, labels: Iterable[str]) -> None:
        sort = config.sort
        self._reject = (sort.reject, _pose(sort.reject_pose))
        self._places = {entry.label: (entry.place, _pose(entry.pose)) for entry in sort.places}
        if not self._places:
            self._places = {label: (label, None) for label in labels}
        missing = [label for label in labels if label not in self._places]
        if missing:
            raise ConfigError(
                f"sort.places has no place for {', '.join(missing)}: add a place for each"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the places, that of the rejects last."""
        return (*dict.fromkeys(name for name, _ in self._places.values()), self._reject[0])

    def of(self, label: str) -> Destination:
        """Return the place of a part; `UNKNOWN` has that of the rejects."""
        place, pose = self._places.get(label, self._reject)
        return Destination(label=label, place=place, pose=pose)

    @property
    def reject(self) -> Destination:
        """The place of the rejects."""
        return self.of(UNKNOWN)


def _pose(config: PlacePoseConfig | None) -> Pose | None:
    return None if config is None else Pose.of_mm(**config.model_dump())


@dataclass(slots=True, kw_only=True)
class SortAnswer:
    """Counts of a sort so far, also if it ends early."""

    targets: Places
    """The places by label."""
    placed: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of parts by their true object (empty if not known) and by place."""
    mistakes: list[dict[str, Any]] = field(default_factory=list)
    """``number``, true object and ``place`` of each part at the place of another kind (simulated
    cell); rejects do not count."""
    n_missed: int = 0
    """Number of turns without a part."""

    def add(self, part: Part) -> None:
        """Count a part that was released at its place."""
        self.placed[part.presented, str(part.place)] += 1
        right = (self.targets.of(part.presented).place, self.targets.reject.place)
        if part.presented and part.place not in right:
            mistake = {"number": part.number, "was": part.presented, "place": part.place}
            self.mistakes.append(mistake)

    @property
    def n_parts(self) -> int:
        """Parts that were released at a place."""
        return self.placed.total()

    @property
    def n_rejected(self) -> int:
        """Parts at the place of the rejects: never taught, or changed since they were named."""
        return self.places[self.targets.reject.place]

    @property
    def places(self) -> dict[str, int]:
        """Number of parts at each place."""
        return {
            name: sum(n for (_, place), n in self.placed.items() if place == name)
            for name in self.targets.names
        }

    @property
    def share_named(self) -> float:
        """Share of the parts that have a name, the yield; NaN without a part."""
        return 1.0 - self.n_rejected / self.n_parts if self.placed else float("nan")

    def matrix(self) -> dict[str, dict[str, int]]:
        """Return how many parts of each true kind lie at each place; empty on a real cell."""
        truths = dict.fromkeys(truth for truth, _ in self.placed if truth)
        return {
            truth: {place: self.placed[truth, place] for place in self.targets.names}
            for truth in truths
        }

    def as_json(self) -> dict[str, Any]:
        """Return the counts as plain data."""
        names = ("n_parts", "n_missed", "n_rejected", "places")
        return {name: getattr(self, name) for name in names} | {
            "share_named": self.share_named if self.placed else None,
            "matrix": self.matrix(),
            "mistakes": [*self.mistakes],
        }


def simulated_feed(config: CellConfig, n_parts: int) -> list[str]:
    """Return a mixed feed of the simulated objects, each kind equally often."""
    kinds = [entry.label for entry in config.simulator.objects]
    feed = [kinds[number % len(kinds)] for number in range(n_parts)]
    np.random.default_rng(config.seed).shuffle(feed)
    return feed


def drawn_object(config: CellConfig) -> str | None:
    """Return the object that a simulated cell draws by its seed; None if it cannot choose."""
    objects = [entry.label for entry in config.simulator.objects]
    draw = np.random.default_rng(config.seed)
    return str(draw.choice(objects)) if config.brings_objects else None


MISSES_IN_A_ROW = 3
"""Grasps in a row without a part after which a known object counts as absent."""
_LISTED_GRASPS = 100
"""Number of newest grasps in the progress of a teaching."""


class ModelFile:
    """The file that each teaching writes, if there is one; a failed write is tried again.

    Only a model replaces it, and only `forget` removes it.
    """

    def __init__(self, model: TaughtModel, path: Path | None) -> None:
        self.model = model
        self._path = path
        self.due = self._emptied = False

    def write(self, unsaved: str = "") -> None:
        """Write the model if it changed since the last write.

        Raises ModelError or DatasetError if it cannot be written; the write stays pending.
        Their text begins with ``unsaved``, which says what counts although the file lacks it.
        """
        try:
            if self._path is not None and self.due:
                self._write(self._path)
        except CellError as error:
            if not unsaved:
                raise
            raise type(error)(
                f"{unsaved}: {error}; it is tried again with the next job and at the end"
            ) from error
        self.due = self._emptied = False

    def _write(self, path: Path) -> None:
        if self.model.labels:
            self.model.save(path)
        elif self._emptied:  # the next start must not find what was forgotten
            self.model.check_unchanged(path)
            with raised_as(ModelError, OSError, where=f"{path} cannot be removed"):
                path.unlink(missing_ok=True)

    def forget(self, label: str, *, last: bool) -> None:
        """Forget a taught object, or its newest grasp with ``last``, and write the model.

        Raises CellError as `TaughtModel.forget`, and if the model cannot be written; the write is
        tried again.
        """
        before = self.model.labels
        self.model.forget(label, last=last)
        self.due, self._emptied = True, before != () and not self.model.labels
        self.write(f"{label} is forgotten, but its file still has it")


@dataclass(slots=True, kw_only=True)
class Collection:
    """Grasps of one known object so far."""

    label: str
    """Name of the object."""
    n_planned: int
    """Number of planned grasps."""
    present: str | None = None
    """Object to place if its name differs from the label (simulated cell)."""
    records: list[GraspRecord] = field(default_factory=list)
    """Grasps that held the object, in order."""
    n_missed: int = 0
    """Number of grasps without a part; they are not in the records."""

    @property
    def grasps(self) -> list[Grasp]:
        """The recorded grasps."""
        return [record.grasp for record in self.records]

    @property
    def unreached(self) -> str:
        """Number of ramps that ended with another force, and the last of them; or empty."""
        texts = [text for record in self.records if (text := record.outcome.unreached)]
        return (
            f"{len(texts)} of {self.n_planned} ramps missed their force: {texts[-1]}"
            if texts
            else ""
        )

    @one_blas_thread()
    def fill(
        self,
        controller: CellController,
        sequence: SequenceConfig,
        *,
        seed: int,
        on_grasp: Callable[["Collection"], None] = lambda _now: None,
    ) -> None:
        """Grasp the object at different poses and forces until the plan ends.

        A grasp that finds no part is only counted. After an error the earlier grasps stay in the
        records. ``on_grasp`` is called with this collection after each grasp, also a missed one.
        Raises NoPartFound if several grasps in a row, or all grasps, find no part. Raises
        cell.errors.CellStopped, gripper.errors.GripperError or tactile.errors.TactileError as
        `CellController.grasp`.
        """
        steps = plan(sequence, self.n_planned, seed=seed)
        controller.check_plan(steps, self.label)
        controller.moves.present(self.present or self.label)
        missed, in_a_row = None, 0
        for step in steps:
            try:
                self.records.append(controller.grasp(step, label=self.label))
                in_a_row = 0
            except NoPartFound as error:
                missed, in_a_row = error, in_a_row + 1
                if in_a_row == MISSES_IN_A_ROW:
                    raise
                self.n_missed += 1
            on_grasp(self)
        if missed is not None and not self.records:
            raise missed


class Tasks:
    """The tasks of a cell, by their names in goals; each runs in the thread of the cell.

    Parameters
    ----------
    file
        The model and its file.
    """

    def __init__(self, controller: CellController, file: ModelFile) -> None:
        self.controller, self.file, self.model = controller, file, file.model
        self.parts = PartLog(controller, file.model)
        """Makes the parts."""
        self._names: dict[str | None, str] = {}
        """Name under which each object was last taught, by its name when it was presented."""

    def teach(self, goal: TeachGoal, report: Report) -> int:
        """Grasp an object, train the model, write it, and return the object's number of grasps.

        Raises
        ------
        cell.errors.NoPartFound, cell.errors.CellStopped, and errors of the devices
            As `Collection.fill`; the next teaching uses the grasps until then.
        CellError
            If there are too few taught grasps for a training; they are kept too.
        ModelError, DatasetError
            If the model cannot be written; it is in use. If the grasps of the loaded model cannot
            be read; nothing has moved then.
        """
        self.model.read_grasps()
        self.file.due = True
        collection = Collection(label=goal.label, n_planned=goal.grasps, present=goal.present)
        try:
            values = self._fill(collection, goal, report)
        finally:
            self.model.add(collection.grasps)
        self._names[goal.present or goal.label] = goal.label
        if not goal.train:
            return len(collection.records)
        left_out = self.model.train(needed=goal.label)
        n_grasps = self.model.objects()[goal.label][0]
        taught = {"label": goal.label, "n_grasps": n_grasps, "left_out": left_out}
        taught |= asdict(self.model.separation(goal.label))
        report(values | {"taught": taught | {"zero_note": zero_note(self.model.training_set)}})
        self.file.write(f"{goal.label} is taught and in use, but not saved")
        return len(collection.records)

    def gauge(self, goal: GaugeGoal, report: Report) -> Drift:
        """Grasp a taught object, measure the drift, correct it from now on, and return it.

        Raises as `Collection.fill`; nothing changes then. Raises CellError if the grasps show no
        drift, or if the model cannot be written; it is then in use.
        """
        collection = Collection(label=goal.label, n_planned=goal.grasps, present=goal.present)
        values = self._fill(collection, goal, report)
        gauged = self.model.gauge(goal.label, collection.grasps)
        drifts = {
            when: {"gain": drift.gain, "opening_mm": 1e3 * drift.aperture_offset_m}
            for when, drift in zip(("before", "after"), gauged, strict=True)
        }
        report(values | {"gauged": {"label": goal.label} | drifts})
        self.file.due = True
        self.file.write()
        return gauged[1]

    def _fill(
        self, collection: Collection, goal: TeachGoal | GaugeGoal, report: Report
    ) -> dict[str, Any]:
        """Grasp a known object, report each grasp, and return the last report."""
        values: dict[str, Any] = {"task": goal.task, "label": goal.label, "of": goal.grasps}
        values |= {"grasps": 0, "missed": 0, "each": []}
        each: deque[dict[str, Any]] = deque(maxlen=_LISTED_GRASPS)

        def progress(now: Collection) -> None:
            if getattr(goal, "train", False) and len(now.records) > values["grasps"]:
                each.append(_grasp_values(now.records[-1], self.model))
            values.update(grasps=len(now.records), missed=now.n_missed, unreached=now.unreached)
            values["each"] = list(each)
            report(dict(values))

        report(dict(values))
        sequence, seed = self.model.config.sequence, goal.plan_seed(report.number)
        collection.fill(self.controller, sequence, seed=seed, on_grasp=progress)
        return values

    def zero(self, _goal: ZeroGoal, report: Report) -> SelfZero:
        """Close the empty fingers on each other and return the self-zero.

        Raises as `cell.control.zeroing.Zeroing.measure`.
        """
        report({"task": "zero"})
        before = self.controller.zeros.newest
        measured = self.controller.zeroing.measure()
        moved_mm = None if before is None else 1e3 * (measured.zero.opening_m - before.opening_m)
        values = asdict(measured.zero) | {"moved_mm": moved_mm}
        report({"task": "zero", "zero": values, "text": zero_text(measured)})
        return measured.zero

    def identify(self, goal: IdentifyGoal, report: Report) -> Part:
        """Grasp an object until its name is sure enough, and return the part.

        ``goal.keep`` decides whether the part stays in the grip. Raises as `named`.
        """
        posteriors = list[Posterior]()
        self.parts.begin(report.number, goal.task)

        def progress(number: int, record: GraspRecord, posterior: Posterior, shape: Any) -> None:
            posteriors.append(posterior)
            answer = fuse(posteriors)
            report(
                {
                    "task": goal.task,
                    "grasps": number,
                    "of": goal.max_grasps or self.model.config.sequence.max_grasps,
                    "best": answer.name,
                    "probability": answer.name_probability,
                    "force_n": record.step.force_n,
                    "shape": None if shape is None else str(shape),
                    "ended_early": record.early is not None,
                    "unreached": record.outcome.unreached,
                },
                part=Part(job=report.number, task=goal.task, label=answer.name, n_grasps=number),
            )

        try:
            seeded = goal.model_copy(update={"seed": goal.plan_seed(report.number)})
            identification, remark = self.named(seeded, progress)
        except NoPartFound:
            self.parts.add(None)
            raise
        rejected = identification.label == UNKNOWN
        part = self.parts.last = self.parts.add(
            identification, remark, in_grip=identification.in_grip, rejected=rejected
        )
        return part

    @one_blas_thread()
    def named(
        self, goal: IdentifyGoal, on_grasp: OnGrasp | None = None
    ) -> tuple[Identification, str]:
        """Grasp an object until its name is sure enough, then follow the drift that it shows.

        Returns the answer with all grasps, and a remark on the drift or an empty text. Raises
        CellStateError if nothing was taught yet. Else it raises as `CellController.identify`.
        """
        controller, model = self.controller, self.model
        recognizer, sequence = model.recognizer, model.config.sequence
        if goal.force_n is not None:
            sequence = sequence.with_force(goal.force_n)
        controller.moves.present(goal.present)
        if (name := self._names.get(goal.present)) in model.labels:
            controller.journal.brought = name
        identification = controller.identify(
            recognizer,
            plan(sequence, goal.max_grasps or sequence.max_grasps, seed=goal.seed or 0),
            early=model.ends_early and not goal.whole_ramps,
            read_shape=model.read_shape,
            on_grasp=on_grasp,
            keep=Keep(goal.keep),
        )
        remark = model.remark_on(identification.records)
        if remark:
            controller.journal.note("drift", remark)
        return identification, remark

    def grip(self, goal: GripGoal, report: Report) -> Verification:
        """Grip a part and keep it; return its measurement.

        Raises as `CellController.grip`.
        """
        controller, carry_n = self.controller, self.model.config.sequence.carry_force_n
        force_n = goal.force_n or carry_n
        gripped = {"task": "grip", "force_n": force_n, "carry_force_n": min(force_n, carry_n)}
        report(gripped)
        controller.moves.present(goal.present)
        record = controller.grip(force_n, None if goal.present is None else Pose())
        verification = self.verify(None, report)
        report(gripped | {"unreached": record.outcome.unreached})
        return verification

    def verify(self, _goal: VerifyGoal | None, report: Report) -> Verification:
        """Measure whether the part in the grip is still the kept one.

        Raises as `cell.control.kept_part.KeptPart.verify`.
        """
        report({"task": "verify"})
        return self.controller.kept_part.verify()

    def sort(self, goal: SortGoal, report: Report) -> SortAnswer:
        """Name parts, keep each, bring it to its place, verify it there, and let it go.

        A part that has changed in the grip on the way goes to the rejects: its name may be wrong. A
        fault, a stop or a place that is refused ends the sort with the part kept; the progress has
        the counts so far.

        Raises
        ------
        NoPartFound
            If no part was found in `MISSES_IN_A_ROW` turns in a row.
        PositionerError
            If a place was refused or cannot be reached.
        cell.errors.CellStopped, and errors of the devices
            As `CellController.identify` and `cell.control.moves.Moves.carry_to`.
        """
        answer = SortAnswer(targets=self.places())
        self.parts.begin(report.number, goal.task)
        feed, misses = goal.feed, 0

        def progress(**part: Any) -> None:
            counts = {"task": goal.task, "of": goal.parts, "parts": answer.n_parts}
            report(counts | answer.as_json(), **part)

        progress()
        for turn in range(goal.parts):
            part_goal = IdentifyGoal(
                max_grasps=goal.max_grasps,
                seed=(goal.plan_seed(report.number) + turn) % 2**32,
                present=feed[turn % len(feed)] if feed else None,
                keep="always",
                force_n=goal.force_n,
            )
            try:
                identification, remark = self.named(part_goal)
            except NoPartFound:
                answer.n_missed += 1
                misses += 1
                self.parts.add(None)
                progress()
                if misses == MISSES_IN_A_ROW:
                    raise
                continue
            misses = 0
            label, n_grasps = identification.label, len(identification.records)
            progress(
                part=Part(
                    job=report.number, task=goal.task, label=label, n_grasps=n_grasps, in_grip=True
                )
            )
            brought = self._brought(answer.targets, label)
            try:
                self.controller.put_down()
            finally:
                # A zero that has drifted is found after the part was let go.
                if not self.controller.life.holding:
                    part = self.parts.add(identification, remark, **brought)
                    answer.add(part)
                    progress(part=part)
        return answer

    def places(self) -> Places:
        """Return the places of a sort.

        Raises ConfigError if a taught object has no place, or nothing brings parts to places.
        """
        if isinstance(self.controller.moves.positioner, CallbackPositioner):
            raise ConfigError(
                "a sort needs the callback `places` of a Python host; else identify with `keep`, "
                "go to the place and release"
            )
        return Places(self.model.config, self.model.labels)

    def _brought(self, places: Places, label: str) -> dict[str, Any]:
        """Bring the kept part to its place; return what becomes of it there."""
        controller, destination = self.controller, places.of(label)
        controller.moves.carry_to(destination)
        check = controller.kept_part.verify()
        if not check.same and destination.place != places.reject.place:
            destination = places.reject
            controller.moves.carry_to(destination)
        return {
            "place": destination.place,
            "place_id": places.names.index(destination.place) + 1,
            "changed": check.reasons,
            "rejected": destination.place == places.reject.place,
        }


def _grasp_values(record: GraspRecord, model: TaughtModel) -> dict[str, Any]:
    """Return force, opening and size of one taught grasp as plain data."""
    shape = model.shape_of(record.grasp)
    return {
        "force_n": record.outcome.final_force_n,
        "opening_mm": 1e3 * record.outcome.final_aperture_m,
        "size_mm": None if shape is None else 1e3 * shape.size_m,
    }
