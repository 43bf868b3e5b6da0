"""The taught model of a cell: its objects, its answers, and the drift that it follows."""

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.records import GraspRecord, pad_array
from cell.errors import CellError, CellStateError, ModelError
from cell.learning.model import Trained, load_model, save_model
from cell.learning.shape_reading import shape_reader
from cell.learning.teaching_summary import Separation, separation
from cell.learning.training import gaugeable, gauged, train
from cell.plugins import RECOGNIZERS
from cell.recording.dataset import read_grasps
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
    drift. One thread changes the model, others may read it. Raises ModelError if a model file
    cannot be read, or was trained on other pads.

    Parameters
    ----------
    config
        The cell.
    path
        A model file; None if nothing was taught yet.
    """

    def __init__(self, config: CellConfig, path: Path | str | None = None) -> None:
        self.config = config
        self.read_shape = shape_reader(config)
        """Reads shape and size from a grasp; None if the config has them off."""
        self._shapes: dict[str, tuple[Grasp, ShapeAnswer | None]] = {}
        self._n_trained = self._n_read = 0
        self._loaded: Path | None = None
        self._training_set: tuple[Grasp, ...] = ()
        self._reading = threading.Lock()
        self._trained: Trained | None = None
        self._drift_remarked = self._zero_remarked = False
        self._times_ns: dict[Path, int | None] = {}
        """Times of change in ns of the models that this program has read or written."""
        if path is not None:
            self._times_ns[Path(path).resolve()] = _changed_ns(Path(path))
            model = load_model(path, pad_array(layout_from_config(config.tactile)))
            self._trained = model.with_caution(config.recognition.caution)
            self._loaded = model.path

    @property
    def training_set(self) -> tuple[Grasp, ...]:
        """The grasps that trained the model, and others; those of a loaded model as `read_grasps`.

        Any thread may read it. Raises as `read_grasps`.
        """
        self.read_grasps()
        return self._training_set

    def read_grasps(self) -> None:
        """Read the grasps of the loaded model from its file, once.

        Raises DatasetError if it cannot be read, and ModelError if another program wrote the file
        since it was loaded.
        """
        with self._reading:
            if self._loaded is not None:
                grasps = read_grasps(self._loaded)
                self.check_unchanged(self._loaded)
                self._loaded, self._training_set = None, grasps

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
        self._training_set = (*self.training_set, *grasps)

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
        self._training_set = given  # after the model: `save` of another thread may come between
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
            self._trained, self._training_set = None, left
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
        """Write the model file with its training set.

        With ``followed`` the model expects the drift followed so far. Raises CellStateError if
        nothing was taught yet. Raises ModelError or DatasetError if the file cannot be written, or
        has changed since this program read or wrote it.
        """
        path, grasps, trained = Path(path), self.training_set, self.check_taught()
        self.check_unchanged(path)
        recognizer = trained.recognizer
        if followed and isinstance(recognizer, DriftFollowing):
            recognizer = recognizer.with_grid(recognizer.grid.with_unnamed_as_gauge())
        save_model(path, replace(trained, recognizer=recognizer), grasps)
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
