"""Model files: a trained recognizer and its training set as plain arrays in one npz archive.

A JSON header names kind and checksum. The training set is read only to teach further.
Nothing in a model file is ever executed. A model is refused before any hardware is used if its
format, its pads or the version of its features differ from this program.
"""

import hashlib
import importlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray

from cell.errors import ConfigError, ModelError, reason_text
from cell.files import (
    DAMAGE,
    MODEL,
    PROGRAM,
    array_names,
    check_text,
    read_npz,
    savez,
    write_atomically,
)
from cell.plugins import RECOGNIZERS
from cell.recording.dataset import IN_MODEL, dataset_arrays
from recognition.drift.drift import DriftFollowing
from recognition.errors import RecognitionError
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import Recognizer

_REHEARSED_FRAMES = 40
"""Frames of the artificial grasp, about as many as in a short ramp."""
_REHEARSED_FORCE_N = 8.0
"""Force in N at the end of its ramp: the largest of the default sequence."""


def _made_up_grasp(pads: PadArray) -> Grasp:
    """Return a round part in the middle of all pads, with growing force at a known opening."""
    share = np.linspace(0.0, 1.0, _REHEARSED_FRAMES)
    offset_m = pads.taxel_xy_m - pads.taxel_xy_m.mean(axis=0)
    extent_m = max(float(np.abs(offset_m).max()), 1e-6)
    print_ = np.maximum(0.0, 1.0 - np.sum((offset_m / (0.6 * extent_m)) ** 2, axis=1))
    return Grasp(
        pads=pads,
        counts=(0.6 * pads.adc_max * share[:, None] * print_).astype(np.uint16),
        t_s=np.linspace(0.0, 2.0, _REHEARSED_FRAMES),
        aperture_m=np.linspace(0.03, 0.02, _REHEARSED_FRAMES),
        force_n=_REHEARSED_FORCE_N * share,
        label="",
    )


def _rehearse(recognizer: Recognizer, grasp: Grasp) -> None:
    """Classify a grasp with and without its opening, so that wrong arrays fail now.

    A RecognitionError, with which a recognizer refuses the grasp itself, is no failure.
    """
    for variant in (grasp, replace(grasp, aperture_m=np.array(np.nan))):
        with suppress(RecognitionError):
            posterior = recognizer.posterior(variant)
            if posterior.labels != recognizer.labels:
                raise ValueError("its answers have other labels")
            if not np.all(np.isfinite([*posterior.probability, posterior.unknown])):
                raise ValueError("its probabilities are not finite")


LAST_MODEL = "tactile-cell.model.txt"
"""File beside the models of a folder: the name of the one that the last `model train` wrote."""
MODEL_LIMIT_BYTES = 256 << 20
"""Largest unpacked size in bytes of a model without its grasps; real ones have a few MB."""

Arrays = Mapping[str, NDArray[Any]]
"""Plain arrays by name."""

_UNSUITABLE = (*DAMAGE, AttributeError, RuntimeWarning)
"""Errors of arrays with other shapes, types or values than a recognizer expects."""
_HEADER = "model"
_DATASET = "grasp_offsets"
"""Array of a data set, never of a model."""
_PREFIX = "learnt."
_PADS = "pads."
"""Names of arrays in the archive: the header, and prefixes of recognizer and pads; the grasps have
the prefix `IN_MODEL`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """Result of a training: the content of a model file, without its training set."""

    recognizer: Recognizer
    """The recognizer, ready to answer."""
    trainer_name: str
    """Its kind, one of `cell.plugins.RECOGNIZERS`."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return self.recognizer.labels

    def with_caution(self, caution: float) -> Self:
        """Return it with a caution, if its kind of recognizer has one."""
        if not isinstance(self.recognizer, DriftFollowing):
            return self
        return replace(self, recognizer=self.recognizer.with_caution(caution))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedModel(Trained):
    """Content of a model file that fits this program."""

    pads: PadArray
    """The pads that it was taught on."""
    path: Path
    """The file."""


def save_model(path: Path | str, trained: Trained, grasps: Sequence[Grasp]) -> None:
    """Write a taught recognizer and the grasps that it was taught with, whole or not at all.

    An older model stays until the new one is whole. Raises ModelError if the kind is unknown, the
    path is a data set, or the write fails, and DatasetError as `dataset_arrays`.
    """
    path, trainer_name = Path(path), trained.trainer_name
    kind = type(trained.recognizer)
    if _class_of(path, trainer_name, kind.__name__) is not kind:
        raise ModelError(
            f"cannot write model {path}: the trainer {trainer_name!r} did not make this "
            "recognizer; name the one that did"
        )
    if _DATASET in array_names(path):
        raise ModelError(
            f"{path} is a data set; a model would replace its grasps: choose another name for -o"
        )
    taught_with = _prefixed(IN_MODEL, dataset_arrays(path, grasps))
    arrays = grasps[0].pads.to_arrays(_PADS) | _prefixed(_PREFIX, trained.recognizer.to_arrays())
    header = {
        "format": str(MODEL),
        "trainer": trainer_name,
        "class": kind.__name__,
        "sha256": _digest(arrays),
    }
    arrays = {_HEADER: np.array(json.dumps(header)), **arrays, **taught_with}
    write_atomically(path, lambda file: savez(file, arrays), error=ModelError, what="model")


def load_model(path: Path | str, expected_pads: PadArray | None = None) -> LoadedModel:
    """Read a model file without its training set, which `read_grasps` reads.

    By default for its own pads. Raises ModelError if the file is damaged, not a model, of another
    version, or was taught on other pads.
    """
    path = Path(path)
    arrays = read_npz(
        path,
        error=ModelError,
        what="model",
        limit_bytes=MODEL_LIMIT_BYTES,
        wanted=lambda name: not name.startswith(IN_MODEL),
    )
    header = _header(path, arrays)
    trainer_name = str(header.get("trainer"))
    kind = _class_of(path, trainer_name, str(header.get("class")))
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"), catch_warnings():
            simplefilter("error", RuntimeWarning)
            pads = PadArray.from_arrays(arrays, _PADS)
            learnt = {
                k.removeprefix(_PREFIX): a for k, a in arrays.items() if k.startswith(_PREFIX)
            }
            recognizer = kind.from_arrays(learnt)
            for label in recognizer.labels:
                check_text("label", label)
            _rehearse(recognizer, _made_up_grasp(pads))
    except _UNSUITABLE as cause:
        raise ModelError(
            f"{path} does not fit {PROGRAM} ({reason_text(cause)}); {MODEL.remedy}"
        ) from cause
    model = LoadedModel(recognizer=recognizer, trainer_name=trainer_name, pads=pads, path=path)
    check_pads(model, pads if expected_pads is None else expected_pads)
    return model


def check_pads(model: LoadedModel, pads: PadArray) -> None:
    """Raise ModelError for a model that was trained on other pads."""
    taught = model.pads
    if not taught.same_as(pads):
        raise ModelError(
            f"{model.path} was taught on {taught.n_taxels} taxels in {taught.n_pads} pads, these "
            f"are {pads.n_taxels} in {pads.n_pads}{what_differs(taught, pads)}; teach again on "
            "these pads, or name the right layout in the config"
        )


def what_differs(taught: PadArray, pads: PadArray) -> str:
    """Return the difference of two pad arrays with the same number of pads, as text."""
    if (taught.n_taxels, taught.n_pads) != (pads.n_taxels, pads.n_pads):
        return ""
    if taught.adc_max != pads.adc_max:
        return f", but a full scale of {pads.adc_max} instead of {taught.adc_max}"
    return " at other places"


def _prefixed(prefix: str, arrays: Arrays) -> dict[str, NDArray[Any]]:
    return {prefix + name: np.asarray(array) for name, array in arrays.items()}


def _header(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    text = arrays.get(_HEADER)
    if _DATASET in arrays:
        raise ModelError(
            f"{path} is a data set: `tactile-cell model train {path}` makes a model of it"
        )
    if text is None or text.dtype.kind != "U" or text.shape != ():
        raise ModelError(f"{path} is not a model file: it has no header; train a model first")
    header = MODEL.read(str(text), path, ModelError)
    rest = {name: array for name, array in arrays.items() if name != _HEADER}
    if header.get("sha256") != _digest(rest):
        raise ModelError(f"{path}: its arrays do not have its checksum; take another copy of it")
    return header


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _class_of(path: Path, trainer_name: str, class_name: str) -> type[Recognizer]:
    """Return a recognizer's class; a file can only name the classes of this program."""
    try:
        module = importlib.import_module(RECOGNIZERS.entry(trainer_name).module)
    except (ConfigError, ImportError) as error:
        raise ModelError(f"{path} is of the kind {trainer_name!r}: {error}") from error
    kind = getattr(module, class_name, None)
    if not isinstance(kind, type) or not hasattr(kind, "from_arrays"):
        raise ModelError(f"{path}: {trainer_name} has no recognizer named {class_name!r}")
    return cast("type[Recognizer]", kind)
