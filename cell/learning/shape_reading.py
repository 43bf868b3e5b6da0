"""Shape and size in the cell: read from a grasp, and written as text."""

from cell.config.model import CellConfig
from cell.control.identification import ReadShape
from cell.errors import ConfigError
from cell.learning.blas import one_blas_thread
from cell.learning.pad_knowledge import PadKnowledge, usual_foam
from recognition.errors import ContactError
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
