"""The taught model of a cell: it teaches, answers, follows the drift of the sensors, and is saved.

The main job, the identification at the command line and the plugin all work with a `TaughtModel`.
"""

import hashlib
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.controller import CellController
from cell.control.identification import Identification, OnGrasp
from cell.control.keeping import Keep
from cell.control.plan import plan
from cell.control.records import GraspRecord, pad_array
from cell.data.dataset import read_dataset, write_dataset
from cell.errors import CellError, CellStateError, ModelError, TrainingSetMissing
from cell.learning.blas import one_blas_thread
from cell.learning.collection import Collection
from cell.learning.model import Arrays, LoadedModel, check_pads, load_model, save_model
from cell.learning.pad_knowledge import PadKnowledge
from cell.learning.shape_reading import shape_reader
from cell.learning.teaching_summary import ToldApart, told_apart
from cell.learning.training import (
    gaugeable,
    load_early,
    may_end_early,
    train,
    with_caution,
)
from gripper.values.outcome import GraspResult
from recognition.drift.drift import Drift, drift_text
from recognition.drift.grid import DriftFollowing, DriftGrid
from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer
from recognition.recognizers.early_classifiers import EarlyClassifiers
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer
from recognition.shape.answer import ShapeAnswer

TRAINING_SECTION = "training_set"
"""Section of a model file that names the data set of its training set, and its checksum."""


class TaughtModel:
    """A recogniser of taught objects with all that belongs to it in a running cell.

    Beside the recogniser, which follows the drift, these are its training set, and early
    classifiers where the config uses them. Raises ModelError if the model was trained on other
    pads or lacks what the config needs, or the training set is not that of the model.

    Parameters
    ----------
    model
        A model file that was read; None where nothing was taught yet.
    training_set
        The grasps that trained the model; empty where they are not at hand.
    known
        Foam and sensor, for shape and size; by default the usual ones.
    """

    def __init__(
        self,
        config: CellConfig,
        model: LoadedModel | None = None,
        *,
        training_set: Sequence[Grasp] = (),
        known: PadKnowledge | None = None,
    ) -> None:
        self._config = config
        self._trainer_name: str = config.recognition.recognizer
        self._training_set = list(training_set)
        self._training_file: Path | None = None
        self._sections: dict[str, Arrays] = {}
        self._early: EarlyClassifiers | None = None
        self._recognizer: Recognizer | None = None
        self._remarked = False
        self._told: set[str] = set()
        self.revision = 0
        """Changes of what is taught so far."""
        self._pads = pad_array(layout_from_config(config.tactile))
        if model is not None:
            check_pads(model, self._pads)
            self._trainer_name = model.trainer_name
            self._sections = dict(model.sections)
            self._early = load_early(model) if config.decides_early else None
            self._recognizer = with_caution(model.recognizer, config.recognition)
            _check_training_set(model, self._training_set)
        self._read_shape = shape_reader(config, known)
        self._looks: dict[str, tuple[Grasp, ShapeAnswer | None]] = {}
        self._lock = threading.Lock()

    @classmethod
    def load(
        cls,
        config: CellConfig,
        path: Path | str,
        *,
        training_set: Path | str | None = None,
        known: PadKnowledge | None = None,
    ) -> Self:
        """Read a model file, and its training set where there is one.

        ``training_set`` is the data set of the grasps that trained it, by default the one that
        `save` wrote with it, where that still stands beside it. Raises ModelError or DatasetError
        if a file cannot be read, or does not suit the config.
        """
        model = load_model(path, pad_array(layout_from_config(config.tactile)))
        if training_set is None:
            training_set = _saved_with(model)
        grasps = () if training_set is None else read_dataset(training_set)
        return cls(config, model, training_set=grasps, known=known)

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return () if self._recognizer is None else self._recognizer.labels

    @property
    def trainer_name(self) -> str:
        """Kind of the recogniser, one of `recognition.recognizers.trainer_names`."""
        return self._trainer_name

    @property
    def recognizer(self) -> Recognizer:
        """The recogniser with the followed drift. Raises CellStateError before teaching."""
        return self.check_taught()

    @property
    def max_grasps(self) -> int:
        """Most grasps of an identification, as the config wants."""
        return self._config.sequence.max_grasps

    @property
    def drift(self) -> DriftGrid | None:
        """The drift since teaching; None where it is not followed."""
        recognizer = self._recognizer
        return recognizer.grid if isinstance(recognizer, DriftFollowing) else None

    @property
    def extendable(self) -> bool:
        """Whether teaching keeps the objects of before: their grasps are at hand."""
        return self._recognizer is None or bool(self._training_set)

    # -- teaching ------------------------------------------------------------------------------

    def collect(
        self,
        controller: CellController,
        collection: Collection,
        *,
        seed: int,
        on_grasp: Callable[[Collection], None],
    ) -> None:
        """Grasp a known object and add its grasps to the training set; `train` is to follow.

        A drift that is likely by now is taken off the new grasps, so that all grasps of the
        training set are as the sensors were when the first of them were taught. What was grasped
        before an error stays in the training set. Raises CellStateError if the training set of the
        loaded model is not at hand: its objects would be lost. Else it raises as `Collection.fill`.
        """
        self.check_extendable()
        grid = self.drift
        try:
            collection.fill(controller, self._config.sequence, seed=seed, on_grasp=on_grasp)
        finally:
            grasps = collection.grasps
            if grid is not None and grid.likely:
                drift = grid.drift
                grasps = [g if g.zero is not None else drift.undo(g) for g in grasps]
            with self._lock:
                self._training_set += grasps
                self._training_file = None

    def check_extendable(self) -> None:
        """Raise TrainingSetMissing where teaching would lose the objects of a loaded model."""
        if not self.extendable:
            raise TrainingSetMissing(
                "name the data set that trained the model when it is loaded, or begin without a "
                f"model: teaching alone would lose {', '.join(self.labels)}"
            )

    def train(self) -> None:
        """Train anew on the whole training set; the drift followed so far stays followed.

        Raises CellError if the grasps do not suffice; they are kept.
        """
        wanted = self._config.recognition
        try:
            trained = train(
                self._training_set,
                wanted.recognizer,
                use_aperture=wanted.use_aperture,
                early=self._config.decides_early,
            )
        except CellError as error:
            raise CellError(f"{error}; the grasps are kept for the next teaching") from error
        recognizer, grid = with_caution(trained.recognizer, wanted), self.drift
        if grid is not None and isinstance(recognizer, DriftFollowing):
            recognizer = recognizer.with_grid(grid)
        with self._lock:
            self._trainer_name = trained.trainer_name
            self._early = trained.early
            self._sections = trained.sections
            self._recognizer = recognizer
            self.revision += 1

    def check_gauge(self, label: str) -> ForceRampRecognizer:
        """Return the recogniser, without a gauged or followed drift, that can be gauged.

        Raises CellStateError if the object was not taught, and ModelError if the recogniser is of a
        kind that cannot be gauged.
        """
        taught = gaugeable(self.recognizer, self._trainer_name).without_gauges()
        if label not in taught.labels:
            raise CellStateError(
                f"{label!r:.80} was not taught: gauge with one of {', '.join(taught.labels)}"
            )
        return taught

    def gauge(
        self,
        controller: CellController,
        collection: Collection,
        seed: int,
        on_grasp: Callable[[Collection], None],
    ) -> tuple[Drift, Drift]:
        """Grasp a taught object, and learn from it what has drifted since teaching.

        Returns the drift before and after it. Every gauge begins at the teaching: corrections do
        not add up.

        Raises
        ------
        CellStateError, ModelError
            As `check_gauge`.
        cell.errors.NoPartFound, cell.errors.CellStopped, and what the devices raise
            As `Collection.fill`; nothing changes then.
        CellError
            If no grasp touched both pads; nothing changes then.
        """
        taught = self.check_gauge(collection.label)
        before = gaugeable(self.recognizer, self._trainer_name).grid.drift
        collection.fill(controller, self._config.sequence, seed=seed, on_grasp=on_grasp)
        try:
            found = taught.gauge(collection.label, collection.grasps)
        except ValueError as error:
            raise CellError(f"cannot gauge: {error}") from error
        with self._lock:
            self._recognizer, self._remarked = found, False
        return before, found.grid.drift

    def forget(self, label: str, *, last: bool = False) -> None:
        """Forget an object and train anew without it; with ``last`` its newest grasp alone.

        Raises CellStateError if it was not taught, or its grasps are not at hand, and CellError if
        the grasps that are left do not suffice; nothing is forgotten then.
        """
        self.check_extendable()
        with self._lock:
            before = list(self._training_set)
        taught = [index for index, grasp in enumerate(before) if grasp.label == label]
        if not taught:
            raise CellStateError(f"{label!r} is not taught; {', '.join(self.labels) or 'nothing'}")
        gone = set(taught[-1:] if last else taught)
        kept = [grasp for index, grasp in enumerate(before) if index not in gone]
        self._use(kept)
        if not kept:
            self._recognizer = self._early = None
            self.revision += 1
            return
        try:
            self.train()
        except CellError as error:
            self._use(before)
            raise CellError(
                f"{label!r} stays as it is taught, because too little would be left: "
                f"{error.__cause__ or error}; teach more first, or forget the whole object"
            ) from error

    def _use(self, grasps: list[Grasp]) -> None:
        with self._lock:
            self._training_set = grasps
            self._training_file = None

    def told_apart(self, label: str) -> ToldApart:
        """Return how well a taught object is told from the others; takes two small trainings."""
        wanted = self._config.recognition
        trainer = make_trainer(wanted.recognizer, use_aperture=wanted.use_aperture)
        return told_apart(list(self._training_set), label, trainer)

    def objects(self) -> dict[str, tuple[int, ShapeAnswer | None]]:
        """Return the taught objects with their number of grasps, and the shape by the newest one.

        A grasp that is not at hand counts for none. No shape is known before `look_at_newest`.
        """
        newest, counts = self._newest()
        found: dict[str, tuple[int, ShapeAnswer | None]] = {}
        for label in dict.fromkeys((*self.labels, *newest)):
            grasp, shape = self._looks.get(label, (None, None))
            found[label] = (counts[label], shape if grasp is newest.get(label) else None)
        return found

    @property
    def looked_at(self) -> bool:
        """Whether `look_at_newest` has nothing to do."""
        newest, _ = self._newest()
        return all(self._looks.get(label, (None,))[0] is grasp for label, grasp in newest.items())

    def look_at_newest(self) -> None:
        """Read the shapes of `objects` that are not known yet: some tenths of a second for each."""
        newest, _ = self._newest()
        for label, grasp in newest.items():
            if self._looks.get(label, (None,))[0] is not grasp:
                self._looks[label] = (grasp, self.read_shape(grasp))
                self.revision += 1

    def _newest(self) -> tuple[dict[str, Grasp], Counter[str]]:
        """Return the newest grasp of each object, and how many it has."""
        with self._lock:
            grasps = list(self._training_set)
        return {grasp.label: grasp for grasp in grasps}, Counter(grasp.label for grasp in grasps)

    def read_shape(self, grasp: Grasp) -> ShapeAnswer | None:
        """Return shape and size by one grasp; None where it does not show them."""
        try:
            return None if self._read_shape is None else self._read_shape(grasp)
        except (RecognitionError, ValueError):
            return None

    # -- answering -----------------------------------------------------------------------------

    def check_taught(self) -> Recognizer:
        """Return the recogniser. Raises CellStateError where nothing was taught yet."""
        if self._recognizer is None:
            raise CellStateError("nothing was taught; teach an object or load a model first")
        return self._recognizer

    @one_blas_thread()
    def identify(
        self,
        controller: CellController,
        *,
        held: str | None,
        seed: int,
        max_grasps: int | None = None,
        force_n: float | None = None,
        keep: Keep = Keep.NEVER,
        whole_ramps: bool = False,
        on_grasp: OnGrasp | None = None,
    ) -> Identification:
        """Grasp an object until its name is sure enough, then follow the drift that it shows.

        Raises CellStateError if nothing was taught yet. Else it raises as
        `CellController.identify`.

        Parameters
        ----------
        held
            Object that the positioner is to bring; None: the one that is there.
        max_grasps
            Most grasps; None: as many as the config allows.
        force_n
            Force at the end of each ramp in N; None: those of the plan.
        keep
            When the part stays in the grip.
        whole_ramps
            Whether no ramp ends early, whatever the config says.
        """
        recognizer, sequence = self.recognizer, self._config.sequence
        if force_n is not None:
            sequence = sequence.with_force(force_n)
        controller.present(held)
        found = controller.identify(
            recognizer,
            plan(sequence, max_grasps or self.max_grasps, seed=seed),
            early=None if whole_ramps else self._early,
            read_shape=self._read_shape,
            on_grasp=on_grasp,
            keep=keep,
        )
        remark = self._follow(found.records)
        for lack in () if remark else self._lacks(found.records):
            if lack not in self._told:
                self._told.add(lack)
                remark = lack
                break
        if remark:
            controller.remark("drift", remark)
        return replace(found, remark=remark)

    def forget_drift(self) -> None:
        """Begin following the drift anew, as after work on the sensors."""
        recognizer = self._recognizer
        if isinstance(recognizer, DriftFollowing):
            self._recognizer = recognizer.with_grid(recognizer.grid.without_unnamed())
        self._remarked = False

    def _follow(self, records: Sequence[GraspRecord]) -> str:
        """Follow the drift by whole grasps; return a remark for the operator, once, or nothing.

        Grasps whose ramp ended before its force, or that held nothing, are left out: classifiers of
        ramps cut short judge a drift in other ways, and both together let more new objects pass.
        """
        recognizer = self.recognizer
        if not self._config.recognition.follow_drift or not isinstance(recognizer, DriftFollowing):
            return ""
        for record in records:
            outcome = record.outcome
            if outcome.result is GraspResult.FORCE_REACHED and not outcome.ended_early:
                recognizer = recognizer.follow(record.grasp)
        self._recognizer = recognizer
        if recognizer.grid.likely == self._remarked:
            return ""
        self._remarked = recognizer.grid.likely
        if self._remarked:
            return f"the sensors have drifted since teaching: {drift_text(recognizer.grid.drift)}"
        return "the sensors are as they were taught again"

    def _lacks(self, records: Sequence[GraspRecord]) -> Iterator[str]:
        """Yield what the model lacks of what the cell would use."""
        recognizer = self.recognizer
        if not isinstance(recognizer, ForceRampRecognizer):
            return
        if recognizer.zero is None and any(one.grasp.zero is not None for one in records):
            yield (
                "the model was taught without a self-zero, so that today's changes nothing and "
                "answers allow for any drift: teach again after a self-zero, or gauge"
            )
        if self._config.decides_early and self._early is None and may_end_early(recognizer):
            yield (
                "the model was taught without ramps cut short, so that none ends early: train it "
                "again, or set sequence.decide_early to false"
            )

    # -- files ---------------------------------------------------------------------------------

    def save_training_set(self, path: Path) -> None:
        """Write the training set as a data set. Raises DatasetError."""
        with self._lock:
            grasps = list(self._training_set)
        write_dataset(path, grasps)
        self._training_file = path

    def save(self, path: Path | str, *, followed: bool = False) -> None:
        """Write the model file, and its training set where it is at hand and not written yet.

        The training set goes to ``NAME.grasps.npz`` beside the model. With ``followed`` the model
        expects the drift that was followed so far. Raises CellStateError if nothing was taught yet,
        and ModelError or DatasetError if a file cannot be written.
        """
        path = Path(path)
        with self._lock:
            recognizer, grasps = self.recognizer, list(self._training_set)
            trainer_name, sections = self._trainer_name, dict(self._sections)
        if grasps:
            file = self._training_file
            if file is None or file.parent != path.parent:
                file = path.with_name(f"{path.stem}.grasps.npz")
                self.save_training_set(file)
            sections[TRAINING_SECTION] = {
                "file": np.array(file.name),
                "sha256": np.array(_checksum(grasps)),
                "grasps": np.array(len(grasps)),
            }
        if followed and isinstance(recognizer, DriftFollowing):
            recognizer = recognizer.with_grid(recognizer.grid.with_unnamed_kept())
        save_model(
            path,
            recognizer,
            trainer_name=trainer_name,
            pads=self._pads,
            sections=sections,
        )


def _saved_with(model: LoadedModel) -> Path | None:
    """Return the data set that was saved with a model, where it still stands beside it."""
    section = model.sections.get(TRAINING_SECTION, {})
    name = str(section.get("file", ""))
    if not name or Path(name).name != name:
        return None
    path = model.path.with_name(name)
    return path if path.exists() else None


def _check_training_set(model: LoadedModel, grasps: Sequence[Grasp]) -> None:
    """Raise ModelError for grasps that cannot have trained a model.

    Further grasps after those of the model are no fault: the data set is written first, and the
    program may have ended before the model.
    """
    if not grasps:
        return
    labels = {grasp.label for grasp in grasps}
    section = model.sections.get(TRAINING_SECTION, {})
    kept, count = section.get("sha256"), str(section.get("grasps", len(grasps)))
    n_trained = int(count) if count.isdecimal() and len(count) < 10 else len(grasps)
    if (
        not labels.issuperset(model.labels)
        or not grasps[0].pads.same_as(model.pads)
        or (kept is not None and str(kept) != _checksum(grasps[:n_trained]))
    ):
        raise ModelError(
            f"the training set, {len(grasps)} grasps of {', '.join(sorted(labels))}, is not the "
            f"one that trained {model.path} ({', '.join(model.labels)}): name that one"
        )


def _checksum(grasps: Sequence[Grasp]) -> str:
    """Return the SHA-256 of labels, times and frames, which a data set keeps as they are."""
    digest = hashlib.sha256()
    for grasp in grasps:
        digest.update(f"{grasp.label}|{grasp.start_ms}|{grasp.counts.shape}|".encode())
        digest.update(np.asarray(grasp.counts, dtype="<u2").tobytes())
    return digest.hexdigest()
