"""Shape and size in the cell: what reads them from a grasp, and how they are told to people."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

from cell.config import CellConfig
from cell.errors import ConfigError
from cell.pad_knowledge import PadKnowledge, usual_foam
from recognition.errors import ContactError
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN
from recognition.shape_answer import UNCLEAR, ShapeAnswer, shape_of

ReadShape = Callable[[Grasp], ShapeAnswer | None]
"""Says shape and size of a grasp; None where its pads do not tell."""

NO_SHAPE = "no shape: not both pads were pressed"
"""What is printed where the pads of a grasp do not tell."""

_NOUNS = {
    "sphere": "a sphere",
    "oval": "an oval",
    "cylinder": "a cylinder",
    "flat": "a flat object",
    "dumbbell": "a dumbbell",
    UNCLEAR: "an unclear shape",
}


def shape_reader(config: CellConfig, known: PadKnowledge | None = None) -> ReadShape | None:
    """Return what reads shape and size on a cell; None where the config wants none.

    Parameters
    ----------
    config
        The cell.
    known
        What is known of foam and sensor; by default what is usual, under the config's law.

    Raises
    ------
    ConfigError
        If there is a gauge, and the config wants no shapes.
    """
    if not config.recognition.shape:
        if known is not None and known.fit is not None:
            raise ConfigError("a gauge serves shape and size, which recognition.shape leaves out")
        return None
    return reader_under(known or PadKnowledge(foam=usual_foam(config)))


def reader_under(known: PadKnowledge) -> ReadShape:
    """Return what reads shape and size, given what is known of foam and sensor."""
    foam, trust = known.foam, known.trust

    def read(grasp: Grasp) -> ShapeAnswer | None:
        try:
            return shape_of(grasp, foam=foam, trust=trust)
        except ContactError:
            return None

    return read


def in_words(shape: ShapeAnswer) -> str:
    """Return shape and size as of an object without a name: ``a cylinder of 6.1 mm (...)``."""
    sizes = " and ".join(map(str, shape.thicknesses))
    return f"{_NOUNS.get(shape.kind, shape.kind)} of {sizes}"


def beside(label: str, shape: ShapeAnswer | None) -> str:
    """Return what stands behind a label: of an object without a name, what it is."""
    if shape is None:
        return ""
    return f": {in_words(shape)}" if label == UNKNOWN else f"; {shape}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FeltShape:
    """Shape and size as a host program gets them, lengths in mm.

    Attributes
    ----------
    kind
        ``sphere``, ``oval``, ``cylinder``, ``flat``, ``dumbbell``, or ``unclear``.
    probability
        Probability of the likeliest kind, given that it is one of them.
    probabilities
        Probability of each kind.
    size_mm, interval_mm
        Thickness along the closing axis (the diameter of what is round), and the interval that
        holds it with 90 % probability.
    thicknesses_mm
        All thicknesses that were met: size, and both ends of the interval.
    dimensions_mm
        Dimensions of the likeliest kind by their names, without interval.
    n_grasps
        Grasps that tell it.
    """

    kind: str
    probability: float
    probabilities: Mapping[str, float] = field(hash=False)
    size_mm: float
    interval_mm: tuple[float, float]
    thicknesses_mm: tuple[tuple[float, float, float], ...]
    dimensions_mm: Mapping[str, float] = field(hash=False)
    n_grasps: int

    def __str__(self) -> str:
        sizes = (f"{at:.1f} mm ({low:.1f} to {high:.1f})" for at, low, high in self.thicknesses_mm)
        return f"{self.kind}, {' and '.join(sizes)}"

    @classmethod
    def of(cls, shape: ShapeAnswer) -> Self:
        """Return what an answer says."""
        return cls(
            kind=shape.kind,
            probability=shape.probability[shape.likeliest],
            probabilities=dict(shape.probability),
            size_mm=1e3 * shape.size_m,
            interval_mm=(1e3 * shape.low_m, 1e3 * shape.high_m),
            thicknesses_mm=tuple(
                (1e3 * t.size_m, 1e3 * t.low_m, 1e3 * t.high_m) for t in shape.thicknesses
            ),
            dimensions_mm={name: 1e3 * value for name, value in shape.dimensions_m.items()},
            n_grasps=shape.n_grasps,
        )
