"""Shape and size: read from a grasp, written as text, and those of the taught objects."""

from collections.abc import Mapping

from cell.config.model import CellConfig
from cell.control.identification import ReadShape
from cell.errors import ConfigError
from cell.learning.blas import one_blas_thread
from cell.learning.pad_knowledge import PadKnowledge, usual_foam
from recognition.errors import ContactError, RecognitionError
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN
from recognition.shape.answer import UNCLEAR, ShapeAnswer, shape_of

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


def shape_reader(config: CellConfig, known: PadKnowledge | None = None) -> ReadShape | None:
    """Return the function that reads shape and size on a cell; None if the config has them off.

    Foam and sensor are by default the usual ones, under the config's law. Raises ConfigError if
    there is a gauge although ``recognition.shape`` is off.
    """
    if not config.recognition.shape:
        if known is not None and known.fit is not None:
            raise ConfigError("a gauge serves shape and size, but recognition.shape is off")
        return None
    return reader_under(known or PadKnowledge(foam=usual_foam(config)))


def reader_under(known: PadKnowledge) -> ReadShape:
    """Return the function that reads shape and size on pads with this foam and sensor."""
    foam, trust = known.foam, known.trust

    @one_blas_thread()
    def read(grasp: Grasp) -> ShapeAnswer | None:
        try:
            return shape_of(grasp, foam=foam, uncertainty=trust)
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
    """Shape and size of the taught objects read so far.

    Raises ConfigError as `shape_reader`.

    Parameters
    ----------
    known
        Foam and sensor; by default the usual ones.
    """

    def __init__(self, config: CellConfig, known: PadKnowledge | None = None) -> None:
        self.reader = shape_reader(config, known)
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
