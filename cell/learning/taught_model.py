"""The taught model of a cell: its objects, its answers, and the drift that it follows."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.records import GraspRecord, pad_array
from cell.errors import (
    CellError,
    CellStateError,
    DatasetError,
    ModelError,
    TrainingSetMissing,
    raised_as,
)
from cell.files import free_name
from cell.learning.model import LoadedModel, Trained, check_pads, load_model, save_model
from cell.learning.shape_reading import shape_reader
from cell.learning.teaching_summary import Separation, separation
from cell.learning.training import gaugeable, gauged, train
from cell.plugins import RECOGNIZERS
from cell.recording.dataset import read_grasps, write_dataset
from gripper.values.outcome import GraspResult
from recognition.drift.drift import Drift, DriftFollowing, DriftGrid, drift_text
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.shape.answer import ShapeAnswer, fuse_shapes

_N_SHAPES = 3
"""Newest grasps of an object whose fused shape is shown: one of eight may have another kind."""


class TaughtModel:
    """A recognizer of taught objects with its data in a running cell.

    These are its training set and the shapes of the taught objects. The recognizer follows the
    drift. One thread changes the model, others may read it. Raises ModelError if the model was
    trained on other pads, or has another training set.

    Parameters
    ----------
    config
        The cell.
    model
        A loaded model file; None if nothing was taught yet.
    training_set
        The grasps that trained the model; empty if they are not available.
    """

    def __init__(
        self,
        config: CellConfig,
        model: LoadedModel | None = None,
        *,
        training_set: Sequence[Grasp] = (),
    ) -> None:
        self.config = config
        self.training_set = tuple(training_set)
        self.read_shape = shape_reader(config)
        """Reads shape and size from a grasp; None if the config has them off."""
        self._shapes: dict[str, tuple[Grasp, ShapeAnswer | None]] = {}
        self._n_trained = self._n_read = 0
        self._pads = pad_array(layout_from_config(config.tactile))
        self._trained: Trained | None = None
        self._written: tuple[tuple[Grasp, ...], Path] = ((), Path())
        self._drift_remarked = self._zero_remarked = False
        self._times_ns: dict[Path, int | None] = {}
        """Times of change in ns of the models, and of the data sets beside them, that this program
        has read or written."""
        if model is not None:
            self._times_ns[model.path.resolve()] = _changed_ns(model.path)
            beside = training_set_file(model.path)
            if str(model.training_set.get("file")) == beside.name:
                self._times_ns[beside.resolve()] = _changed_ns(beside)
            check_pads(model, self._pads)
            if not _has_trained(model, self.training_set):
                own, labels = model.training_set.get("file", "its own"), ", ".join(model.labels)
                raise ModelError(
                    f"{model.path} ({labels}) was trained with another training set than these "
                    f"{len(self.training_set)} grasps: name {own}, or none"
                )
            self._trained = model.with_caution(config.recognition.caution)

    @classmethod
    def load(
        cls,
        config: CellConfig,
        path: Path | str,
        *,
        training_set: Path | str | None = None,
        note: Callable[[str], None] = lambda _text: None,
    ) -> Self:
        """Read a model file, and its training set if there is one.

        ``training_set`` has the grasps that trained it, and perhaps others. By default, and with a
        note instead of a wrong one, it is the file beside it that the model names; it is left out
        with a note if it is damaged. Raises ModelError or DatasetError if another file cannot be
        read, or does not fit the config.
        """
        model = load_model(path, pad_array(layout_from_config(config.tactile)))
        grasps = (
            _saved_training_set(model, note) if training_set is None else read_grasps(training_set)
        )
        file = str(model.training_set.get("file"))
        # People change a file that `save` did not write; one of `save` is checked below.
        of_save = file == training_set_file(model.path).name
        if of_save and training_set is None:
            return cls(config, model, training_set=grasps)
        # A model may be trained on some objects of a file.
        own = tuple(grasp for grasp in grasps if of_save or grasp.label in model.labels)
        if own and _has_trained(model, own):
            grasps = own
        elif not _has_trained(model, grasps):
            if training_set is None:
                note(f"{file} is no longer what trained {path}: it is not used")
                grasps = ()
            else:
                note(f"{training_set} did not train {path}: takes the data set beside it, if there")
                grasps = _saved_training_set(model, note) or grasps
        return cls(config, model, training_set=grasps)

    def check_taught(self) -> Trained:
        """Return the last training, with the followed drift. Raises CellStateError before it."""
        if self._trained is None:
            raise CellStateError("nothing was taught; teach an object or load a model first")
        return self._trained

    @property
    def recognizer(self) -> Recognizer:
        """The recognizer with the followed drift. Raises CellStateError before teaching."""
        return self.check_taught().recognizer

    @property
    def ends_early(self) -> bool:
        """Whether ramps end early. Raises CellStateError before teaching."""
        recognizer = self.recognizer
        may = isinstance(recognizer, DriftFollowing) and recognizer.ends_early
        return self.config.decides_early and may

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return () if self._trained is None else self._trained.labels

    @property
    def drift(self) -> DriftGrid | None:
        """The drift since teaching; None if drift is not followed."""
        recognizer = None if self._trained is None else self._trained.recognizer
        return recognizer.grid if isinstance(recognizer, DriftFollowing) else None

    # -- teaching ------------------------------------------------------------------------------

    def check_extendable(self) -> None:
        """Raise TrainingSetMissing if teaching would lose the objects of a loaded model."""
        if self._trained is not None and not self.training_set:
            raise TrainingSetMissing(
                "name the data set that trained the model when it is loaded, or begin without a "
                f"model: teaching alone would lose {', '.join(self.labels)}"
            )

    def add(self, grasps: Sequence[Grasp]) -> None:
        """Add labelled grasps to the training set; `train` is to follow.

        A drift that is likely by now is taken off them. So all grasps of the training set are as
        the sensors were when the first of them were taught.
        """
        grid = self.drift
        if grid and grasps and (grid := grid.at(grasps[0].start_ms)).likely:
            drift = grid.drift
            grasps = [g if g.zero is not None else drift.undo(g) for g in grasps]
            # The grasps are as before the drift, but of today: the drift belongs to the model now.
            self._with_grid(grid.with_unnamed_as_gauge())
        self.training_set += tuple(grasps)

    def train(self, needed: str = "", given: tuple[Grasp, ...] | None = None) -> list[str]:
        """Train on the training set, or on what is ``given`` as such; the followed drift is kept.

        Objects with too few grasps are left out, except the ``needed`` one, and returned. Raises
        CellError if there are too few grasps for any training; they are kept.
        """
        settings, grid = self.config.recognition, self.drift
        given = self.training_set if given is None else given
        few = self._too_few(given, needed)
        grasps = [grasp for grasp in given if grasp.label not in few]
        try:
            trained = train(
                grasps or given, settings.recognizer, use_aperture=settings.use_aperture
            ).with_caution(settings.caution)
        except CellError as error:
            raise CellError(f"{error}; the grasps are kept for the next teaching") from error
        if grid is not None and isinstance(trained.recognizer, DriftFollowing):
            trained = replace(trained, recognizer=trained.recognizer.with_grid(grid))
        self._trained = trained
        self.training_set = given  # after the model: `save` of another thread may come between
        self._n_trained += 1
        return few

    def _too_few(self, grasps: Sequence[Grasp], needed: str) -> list[str]:
        """Return the objects with too few grasps for the recognizer, without the needed one."""
        least = getattr(RECOGNIZERS[self.config.recognition.recognizer], "min_grasps", 1)
        counts = Counter(grasp.label for grasp in grasps)
        return [label for label, n in counts.items() if n < least and label != needed]

    def forget(self, label: str, *, last: bool = False) -> None:
        """Forget an object, or with ``last`` only its newest grasp, and train without it.

        Raises CellError if ``last`` leaves too few of it; nothing is forgotten then.
        """
        before = self.training_set
        taught = [index for index, grasp in enumerate(before) if grasp.label == label]
        gone = set(taught[-1:] if last else taught)
        needed = label if last and label in self.labels else ""
        left = tuple(g for index, g in enumerate(before) if index not in gone)
        few = self._too_few(left, needed)
        if all(grasp.label in few for grasp in left):
            self._trained, self.training_set = None, left
            self._drift_remarked = self._zero_remarked = False
            self._n_trained += 1
            return
        try:
            self.train(needed, left)
        except CellError as error:
            raise CellError(
                f"{label!r} is unchanged, because too few grasps would remain: "
                f"{error.__cause__ or error}; teach more first, or forget the whole object"
            ) from error

    def separation(self, label: str) -> Separation:
        """Return how well a taught object differs from the others; runs two small trainings."""
        settings = self.config.recognition
        trainer = RECOGNIZERS[settings.recognizer](use_aperture=settings.use_aperture)
        grasps = [grasp for grasp in self.training_set if grasp.label in self.labels]
        return separation(grasps, label, trainer)

    # -- taught objects ------------------------------------------------------------------------

    def objects(self) -> dict[str, tuple[int, ShapeAnswer | None]]:
        """Return the taught objects with their number of grasps, and the shape of the newest three.

        Only available grasps count. No shape is known before `read_shapes`.
        """
        counts, unread = Counter(grasp.label for grasp in self.training_set), self.unread
        return {
            label: (
                counts[label],
                None if label in unread else self._shapes.get(label, (None, None))[1],
            )
            for label in dict.fromkeys((*self.labels, *counts))
        }

    def read_shapes(self) -> None:
        """Read the missing shapes of `objects`: some tenths of a second for each."""
        for label, grasp in self.unread.items():
            newest = [g for g in self.training_set if g.label == label][-_N_SHAPES:]
            shapes = [shape for g in newest if (shape := self.shape_of(g))]
            self._shapes[label] = grasp, fuse_shapes(shapes) if shapes else None
            self._n_read += 1

    def shape_of(self, grasp: Grasp) -> ShapeAnswer | None:
        """Return shape and size from one grasp; None if it does not show them."""
        try:
            return None if self.read_shape is None else self.read_shape(grasp)
        except ValueError:
            return None

    @property
    def revision(self) -> int:
        """Number of changes of the taught objects; each summand is counted by one thread."""
        return self._n_trained + self._n_read

    @property
    def unread(self) -> dict[str, Grasp]:
        """The newest grasps of the objects whose shape `read_shapes` has not read from them yet."""
        newest = {grasp.label: grasp for grasp in self.training_set}
        return {k: g for k, g in newest.items() if self._shapes.get(k, (None,))[0] is not g}

    # -- drift ---------------------------------------------------------------------------------

    def check_gauge(self, *labels: str) -> DriftFollowing:
        """Return the recognizer if it can be gauged with these objects; see `gaugeable`."""
        return gaugeable(self.check_taught(), *labels)

    def gauge(self, label: str, grasps: Sequence[Grasp]) -> tuple[Drift, Drift]:
        """Measure the drift since teaching with grasps of a taught object.

        Returns the drift before and after it. Every gauge starts from the teaching: corrections do
        not accumulate. Raises as `check_gauge` and `gauged`; nothing changes then.
        """
        taught = self.check_gauge(label)
        recognizer = gauged(taught.without_gauges(), label, grasps)
        self._trained = replace(self.check_taught(), recognizer=recognizer)
        self._drift_remarked = False
        return taught.grid.drift, recognizer.grid.drift

    def forget_drift(self) -> None:
        """Reset the drift, also that of a gauge, e.g. after work on the sensors."""
        if isinstance(recognizer := self._trained and self._trained.recognizer, DriftFollowing):
            self._with_grid(recognizer.without_gauges().grid)
        self._drift_remarked = False

    def remark_on(self, records: Sequence[GraspRecord]) -> str:
        """Follow the drift with the grasps of an answer; return a remark for the operator, or "".

        Grasps whose ramp ended below its force, or that held nothing, are omitted. It remarks once
        that the drift has become likely, that it is gone, or that the model uses no self-zero.
        """
        recognizer = self.recognizer
        if not isinstance(recognizer, DriftFollowing):
            return ""
        # One object alone gets the names of others: their sizes are no drift.
        if self.config.recognition.follow_drift and len(self.labels) > 1:
            for record in records:
                outcome = record.outcome
                if outcome.result is GraspResult.FORCE_REACHED and not outcome.ended_early:
                    recognizer = recognizer.follow(record.grasp)
            self._with_grid(grid := recognizer.grid)
            # It is gone when that is likelier than not: no remark alternates with the other.
            if grid.unchanged >= 0.5 if self._drift_remarked else grid.likely:
                self._drift_remarked = not self._drift_remarked
                if self._drift_remarked:
                    return f"the sensors have drifted since teaching: {drift_text(grid.drift)}"
                return "the sensors are again as at the teaching"
        zeroed = any(record.grasp.zero is not None for record in records)
        if self._zero_remarked or recognizer.zero is not None or not zeroed:
            return ""
        self._zero_remarked = True
        return (
            "the model was taught without a self-zero, so today's self-zero is not used and "
            "answers allow for any drift: teach a new model after a self-zero, or gauge"
        )

    def _with_grid(self, grid: DriftGrid) -> None:
        recognizer = self.recognizer
        assert isinstance(recognizer, DriftFollowing)
        self._trained = replace(self.check_taught(), recognizer=recognizer.with_grid(grid))

    # -- files ---------------------------------------------------------------------------------

    def save(self, path: Path | str, *, followed: bool = False) -> None:
        """Write the model file, and its training set if it is available and not written yet.

        The training set goes to ``NAME.grasps.npz`` beside the model; a data set of another
        model there is renamed. With ``followed`` the model expects the drift followed so far.
        Raises CellStateError if nothing was taught yet, and ModelError or DatasetError if a file
        cannot be written, or has changed since this program read or wrote it.
        """
        path, grasps, trained = Path(path), self.training_set, self.check_taught()
        self.check_unchanged(path)
        recognizer, training_set = trained.recognizer, trained.training_set
        if grasps:
            if self._written != (grasps, dataset := training_set_file(path)):
                there_ns = _changed_ns(dataset)
                if there_ns is not None and there_ns != self._times_ns.get(dataset.resolve()):
                    with raised_as(DatasetError, OSError, where=f"{dataset} cannot be renamed"):
                        dataset.rename(free_name(dataset))  # it has grasps of another model
                write_dataset(dataset, grasps)
                self._written = (grasps, dataset)
                self._times_ns[dataset.resolve()] = _changed_ns(dataset)
            training_set = training_set_section(dataset, grasps)
        if followed and isinstance(recognizer, DriftFollowing):
            recognizer = recognizer.with_grid(recognizer.grid.with_unnamed_as_gauge())
        trained = replace(trained, recognizer=recognizer, training_set=training_set)
        save_model(path, trained, self._pads)
        self._times_ns[path.resolve()] = _changed_ns(path)

    def check_unchanged(self, path: Path) -> None:
        """Raise ModelError if another program wrote the model file since this one did."""
        known_ns, now_ns = self._times_ns.get(path.resolve()), _changed_ns(path)
        if known_ns is not None and now_ns not in (None, known_ns):
            raise ModelError(
                f"another program wrote {path} since this one did: one cell, one model file. Move "
                "that file away, or save under another name"
            )


def _changed_ns(path: Path) -> int | None:
    return path.stat().st_mtime_ns if path.is_file() else None


def training_set_file(model: Path) -> Path:
    """Return the data set that `TaughtModel.save` writes beside a model file."""
    return model.with_name(f"{model.stem}.grasps.npz")


def training_set_section(file: Path, grasps: Sequence[Grasp]) -> dict[str, NDArray[Any]]:
    """Return what a model file has of the data set that trained it, in the same folder."""
    return {
        "file": np.array(file.name),
        "sha256": np.array(_checksum(grasps)),
        "grasps": np.array(len(grasps)),
    }


def _saved_training_set(model: LoadedModel, note: Callable[[str], None]) -> tuple[Grasp, ...]:
    """Return the training set that was saved with a model, if it is still beside it and sound."""
    name = str(model.training_set.get("file", ""))
    path = model.path.parent / name
    try:
        return read_grasps(path) if Path(name).name == name and os.path.isfile(path) else ()
    except DatasetError as error:
        note(f"{error}: it is not used, and nothing can be taught or forgotten without it")
        return ()


def _has_trained(model: LoadedModel, grasps: Sequence[Grasp]) -> bool:
    """Return whether the model was trained on the first of these grasps, by labels and checksum.

    True without grasps. Further grasps are accepted: the data set is written first, and the program
    may have ended before the model was written.
    """
    if not grasps:
        return True
    labels = {grasp.label for grasp in grasps}
    section = model.training_set
    checksum, count = section.get("sha256"), str(section.get("grasps", len(grasps)))
    n_trained = int(count) if count.isdecimal() and len(count) < 10 else len(grasps)
    return (
        labels.issuperset(model.labels)
        and grasps[0].pads.same_as(model.pads)
        and (checksum is None or str(checksum) == _checksum(grasps[:n_trained]))
    )


def _checksum(grasps: Sequence[Grasp]) -> str:
    """Return the SHA-256 of labels, times and frames, which a data set keeps exactly."""
    digest = hashlib.sha256()
    for grasp in grasps:
        digest.update(f"{grasp.label}|{grasp.start_ms}|{grasp.counts.shape}|".encode())
        digest.update(np.asarray(grasp.counts, dtype="<u2").tobytes())
    return digest.hexdigest()
