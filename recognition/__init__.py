"""Object recognition by touch: from the record of a grasp to probabilities of what was held.

A `Grasp` goes in, a `Posterior` comes out; `make_trainer` finds trainers by name, `fuse` joins
several grasps of one object. Chapters: `ramp` reduces a grasp to levels of load, `features`
describes these, `statistics` classifies, fuses grasps and chooses the next one, `recognizers` holds
the kinds of recogniser, `drift` corrects for changed sensors, `evaluation` gives figures. `quadric`
is the paper's method, `shape` fits shape and size. No file, clock, thread or bus is used: numbers
in, numbers out.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recognition.grasp import Grasp as Grasp, GraspCommand as GraspCommand, PadArray as PadArray
    from recognition.recognizer import (
        UNKNOWN as UNKNOWN,
        Posterior as Posterior,
        Recognizer as Recognizer,
        Trainer as Trainer,
    )
    from recognition.recognizers import make_trainer as make_trainer, trainer_names as trainer_names
    from recognition.statistics.fusion import (
        Decision as Decision,
        StopRule as StopRule,
        decide as decide,
        fuse as fuse,
    )

_FACE = {
    "recognition.grasp": "Grasp GraspCommand PadArray",
    "recognition.recognizer": "UNKNOWN Posterior Recognizer Trainer",
    "recognition.recognizers": "make_trainer trainer_names",
    "recognition.statistics.fusion": "Decision StopRule decide fuse",
}
"""Names by module, which is imported when one of them is first used."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
