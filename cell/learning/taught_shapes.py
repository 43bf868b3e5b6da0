"""Shapes of the taught objects: read once from the newest grasp of each."""

from collections.abc import Mapping

from cell.config.model import CellConfig
from cell.learning.pad_knowledge import PadKnowledge
from cell.learning.shape_reading import shape_reader
from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from recognition.shape.answer import ShapeAnswer


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
