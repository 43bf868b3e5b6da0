"""The kinds of recogniser by name: the default, a plain reference, the paper's own, comparators."""

import importlib
from collections.abc import Callable, Mapping
from types import MappingProxyType

from recognition.recognizer import Trainer

DEFAULT_TRAINER = "force_ramp"
"""The recogniser that is taught where no other is asked for."""


def _force_ramp(use_aperture: bool) -> Trainer:
    from recognition.recognizers.force_ramp import ForceRampTrainer  # noqa: PLC0415

    return ForceRampTrainer(use_aperture=use_aperture)


def _shrinkage_lda(use_aperture: bool) -> Trainer:
    from recognition.recognizers.shrinkage_lda import ShrinkageLdaTrainer  # noqa: PLC0415

    return ShrinkageLdaTrainer(use_aperture=use_aperture)


def _level_check(use_aperture: bool) -> Trainer:
    from recognition.recognizers.level_check import LevelCheckTrainer  # noqa: PLC0415

    return LevelCheckTrainer(use_aperture=use_aperture)


TRAINERS: Mapping[str, Callable[[bool], Trainer]] = MappingProxyType(
    {
        "force_ramp": _force_ramp,
        "level_check": _level_check,
        "shrinkage_lda": _shrinkage_lda,
    }
)
"""Name -> factory; the argument says whether the opening between the fingers is used."""


def _comparator(name: str) -> Callable[[bool], Trainer]:
    def make(use_aperture: bool) -> Trainer:
        module = importlib.import_module(f"recognition.recognizers.{name}")
        trainer: Trainer = getattr(module, f"{name}_trainer")(use_aperture)
        return trainer

    return make


COMPARATORS: Mapping[str, Callable[[bool], Trainer]] = MappingProxyType(
    {
        name: _comparator(name)
        for name in (
            "radius_vector",
            "contour_network",
            "contact_invariants",
            "extra_trees",
            "raw_neighbours",
        )
    }
)
"""Methods that the paper names, and today's plain choices; some are taught by scikit-learn.

They are made and evaluated by name, and never part of what is done without asking for them.
"""


def trainer_names() -> tuple[str, ...]:
    """Return the names of all kinds that can be made."""
    return (*TRAINERS, *COMPARATORS)


def make_trainer(name: str, *, use_aperture: bool = True) -> Trainer:
    """Return the trainer of that name. Raises ValueError, listing the names, for an unknown one."""
    make = TRAINERS.get(name) or COMPARATORS.get(name)
    if make is None:
        raise ValueError(f"no recogniser is named {name!r}; there are {', '.join(trainer_names())}")
    return make(use_aperture)
