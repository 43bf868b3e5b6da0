"""Shape and size: read from a grasp, written as text, and those of the taught objects."""

from collections.abc import Mapping

import numpy as np

from cell.config.model import CellConfig
from cell.config.tactile import PaperCalibrationConfig, layout_from_config, make_calibration
from cell.control.identification import ReadShape
from cell.learning.blas import one_blas_thread
from recognition.errors import ContactError, RecognitionError
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN
from recognition.shape.answer import UNCLEAR, ShapeAnswer, shape_of
from recognition.shape.foam import FoamModel

NO_SHAPE = "no shape: it needs two facing pads of 2 x 2 taxels or more, both pressed"
"""Text instead of shape and size if the pads of a grasp do not show them."""

_NOUNS = {
    "sphere": "a sphere",
    "oval": "an oval",
    "cylinder": "a cylinder",
    "flat": "a flat object",
    "dumbbell": "a dumbbell",
    UNCLEAR: "an unclear shape",
}


def usual_foam(config: CellConfig) -> FoamModel:
    """Return the usual foam on a sensor with the config's law from force to counts."""
    layout, law = layout_from_config(config.tactile), config.tactile.calibration
    if isinstance(law, PaperCalibrationConfig):
        return FoamModel(gain=1.0 / law.gain)
    one_law = config.tactile.model_copy(update={"pad_gains": (1.0, 1.0)})
    counts = np.unique([0.0, *getattr(law, "counts", ()), layout.adc_max])
    counts = counts[counts <= layout.adc_max]
    force_n = make_calibration(one_law, layout).force_n(counts)
    return FoamModel(nodes=(tuple(force_n), tuple(counts / layout.adc_max)))


def shape_reader(config: CellConfig) -> ReadShape | None:
    """Return the function that reads shape and size on a cell; None if the config has them off."""
    if not config.recognition.shape:
        return None
    foam = usual_foam(config)

    @one_blas_thread()
    def read(grasp: Grasp) -> ShapeAnswer | None:
        try:
            return shape_of(grasp, foam)
        except ContactError:
            return None

    return read


def in_words(shape: ShapeAnswer) -> str:
    """Return shape and size of an object without a name: ``a cylinder of 6.1 mm (...)``."""
    sizes = " and ".join(map(str, shape.thicknesses))
    return f"{_NOUNS.get(shape.kind, shape.kind)} of {sizes}"


def beside(label: str, shape: ShapeAnswer | None) -> str:
    """Return shape and size as text after a label; empty without a shape."""
    if shape is None:
        return ""
    return f": {in_words(shape)}" if label == UNKNOWN else f"; {shape}"


class TaughtShapes:
    """Shape and size of the taught objects read so far."""

    def __init__(self, config: CellConfig) -> None:
        self.reader = shape_reader(config)
        """Reads shape and size from a grasp; None if the config has them off."""
        self._read: dict[str, tuple[Grasp, ShapeAnswer | None]] = {}
        self.n_read = 0
        """Number of shapes read so far."""

    def read(self, grasp: Grasp) -> ShapeAnswer | None:
        """Return shape and size from one grasp; None if it does not show them."""
        try:
            return None if self.reader is None else self.reader(grasp)
        except (RecognitionError, ValueError):
            return None

    def of(self, label: str, newest: Grasp | None) -> ShapeAnswer | None:
        """Return the shape of an object from its newest grasp; None if not read yet."""
        read_from, shape = self._read.get(label, (None, None))
        return shape if read_from is newest else None

    def unread(self, newest: Mapping[str, Grasp]) -> list[str]:
        """Return the objects whose newest grasps were not read yet."""
        return [one for one in newest if self._read.get(one, (None,))[0] is not newest[one]]

    def read_newest(self, newest: Mapping[str, Grasp]) -> None:
        """Read the missing shapes, some tenths of a second for each."""
        for label in self.unread(newest):
            self._read[label] = (newest[label], self.read(newest[label]))
            self.n_read += 1
