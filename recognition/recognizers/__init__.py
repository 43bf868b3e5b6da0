"""Recognisers by name: the default, a plain reference, the paper's method, and comparators.

Each is one entry in `RECOGNIZERS`: name, module, and maker of its trainer. `force_ramp` is the
default, `shrinkage_lda` a plain discriminant for comparison, `level_check` the paper's method.
`comparators` has methods that the paper names, and plain present ones. `early_classifiers`
teaches recognisers that answer during the ramp.
"""

from collections.abc import Mapping
from pkgutil import resolve_name
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recognition.recognizer import Trainer

DEFAULT_TRAINER = "force_ramp"
"""The recogniser that is taught by default."""

_METHODS = "recognition.recognizers.comparators.methods"
"""Module of the comparators."""

RECOGNIZERS: Mapping[str, str] = MappingProxyType(
    {
        "force_ramp": "recognition.recognizers.force_ramp.recognizer:ForceRampTrainer",
        "level_check": "recognition.recognizers.level_check:LevelCheckTrainer",
        "shrinkage_lda": f"{_METHODS}:ShrinkageLda.trainer",
        "radius_vector": f"{_METHODS}:RadiusVector.trainer",
        "contour_network": f"{_METHODS}:ContourNetwork.trainer",
        "contact_invariants": f"{_METHODS}:ContactInvariants.trainer",
        "extra_trees": f"{_METHODS}:ExtraTrees.trainer",
        "raw_neighbours": f"{_METHODS}:RawNeighbours.trainer",
    }
)
"""All kinds of recogniser by name, in the order of tables. The value is the module of trainer and
recogniser, imported for the first trainer, and a callable in it that takes ``use_aperture``."""

TRAINERS = ("force_ramp", "level_check", "shrinkage_lda")
"""Names of the kinds that are compared by default."""

COMPARATORS = tuple(name for name in RECOGNIZERS if name not in TRAINERS)
"""Names of those that are used only on request; some are taught by scikit-learn."""


def trainer_names() -> tuple[str, ...]:
    """Return the names of all kinds."""
    return tuple(RECOGNIZERS)


def make_trainer(name: str = DEFAULT_TRAINER, *, use_aperture: bool = True) -> "Trainer":
    """Return the trainer of that name. Raises ValueError, listing the names, for an unknown one."""
    if name not in RECOGNIZERS:
        raise ValueError(f"no recogniser is named {name!r}; there are {', '.join(RECOGNIZERS)}")
    trainer: Trainer = resolve_name(RECOGNIZERS[name])(use_aperture=use_aperture)
    return trainer
