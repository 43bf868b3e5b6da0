"""Recognisers by name: the default, a plain reference, the paper's method, and comparators.

Each is one entry in `RECOGNIZERS`: name, module, and what makes its trainer. `force_ramp` is the
default, `shrinkage_lda` a plain discriminant to compare with, `level_check` the paper's method;
`comparators` holds methods that the paper names and plain choices of today. `early_classifiers`
teaches recognisers that answer already during the ramp.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recognition.recognizer import Trainer

DEFAULT_TRAINER = "force_ramp"
"""The recogniser that is taught where no other is asked for."""

_METHODS = "recognition.recognizers.comparators.methods"
"""Module of the comparators."""


@dataclass(frozen=True, slots=True)
class RecognizerEntry:
    """One kind of recogniser."""

    name: str
    """Name in tables, models and on the command line."""
    module: str
    """Module of its trainer and its recogniser; imported when a trainer is made."""
    trainer: str
    """Name in that module of what makes a trainer when called with ``use_aperture``."""
    comparator: bool = False
    """Whether it is used only where it is asked for; some are taught by scikit-learn."""


RECOGNIZERS: tuple[RecognizerEntry, ...] = (
    RecognizerEntry(
        "force_ramp", "recognition.recognizers.force_ramp.recognizer", "ForceRampTrainer"
    ),
    RecognizerEntry("level_check", "recognition.recognizers.level_check", "LevelCheckTrainer"),
    RecognizerEntry("shrinkage_lda", _METHODS, "ShrinkageLda.trainer"),
    RecognizerEntry("radius_vector", _METHODS, "RadiusVector.trainer", comparator=True),
    RecognizerEntry("contour_network", _METHODS, "ContourNetwork.trainer", comparator=True),
    RecognizerEntry("contact_invariants", _METHODS, "ContactInvariants.trainer", comparator=True),
    RecognizerEntry("extra_trees", _METHODS, "ExtraTrees.trainer", comparator=True),
    RecognizerEntry("raw_neighbours", _METHODS, "RawNeighbours.trainer", comparator=True),
)
"""All kinds of recogniser; names are in the order of tables."""

_BY_NAME: Mapping[str, RecognizerEntry] = MappingProxyType(
    {entry.name: entry for entry in RECOGNIZERS}
)

TRAINERS: tuple[str, ...] = tuple(entry.name for entry in RECOGNIZERS if not entry.comparator)
"""Names of the kinds that are compared where none is asked for."""

COMPARATORS: tuple[str, ...] = tuple(entry.name for entry in RECOGNIZERS if entry.comparator)
"""Names of the comparators."""


def trainer_names() -> tuple[str, ...]:
    """Return the names of all kinds."""
    return tuple(_BY_NAME)


def recognizer_module(name: str) -> str:
    """Return the module of the trainer and recogniser of that name; raises ValueError."""
    if name not in _BY_NAME:
        raise ValueError(f"no recogniser is named {name!r}; there are {', '.join(_BY_NAME)}")
    return _BY_NAME[name].module


def make_trainer(name: str = DEFAULT_TRAINER, *, use_aperture: bool = True) -> "Trainer":
    """Return the trainer of that name. Raises ValueError, listing the names, for an unknown one."""
    module = importlib.import_module(recognizer_module(name))
    maker = attrgetter(_BY_NAME[name].trainer)(module)
    trainer: Trainer = maker(use_aperture=use_aperture)
    return trainer
