"""Shape and size: read from a grasp, and written as text."""

from statistics import fmean

import numpy as np

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config, make_calibration
from cell.control.identification import ReadShape
from cell.learning.parallel import one_blas_thread
from recognition.errors import ContactError
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
    gain = 1.0 / fmean(config.tactile.pad_gains)
    if not law.counts:
        return FoamModel(gain=gain)
    counts = np.unique([0.0, *law.counts, layout.adc_max])
    counts = counts[counts <= layout.adc_max]
    force_n = make_calibration(config.tactile, layout, with_gains=False).force_n(counts)
    return FoamModel(gain=gain, nodes=(tuple(force_n), tuple(counts / layout.adc_max)))


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


def after_label(label: str, shape: ShapeAnswer | None) -> str:
    """Return shape and size as text after a label; empty without a shape."""
    if shape is None:
        return ""
    return f": {in_words(shape)}" if label == UNKNOWN else f"; {shape}"
