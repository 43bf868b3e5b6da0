"""Object recognition by touch: from the record of a grasp to probabilities of the objects.

A recogniser makes a `Posterior` from a `Grasp`. `make_trainer` finds trainers by name, `fuse` joins
several grasps of one object. Sub-packages: `ramp` reduces a grasp to levels of load, and `features`
describes these. `statistics` classifies and fuses grasps, and `recognizers` has the kinds of
recogniser. `drift` corrects for changed sensors, and `evaluation` computes figures. `quadric` is
the paper's method, `shape` fits shape and size. The package uses no file, clock, thread or bus.
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
"""Names by module; a module is imported at the first use of one of its names."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
