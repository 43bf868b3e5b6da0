"""Recognizers by name: `force_ramp` is the default, `level_check` the paper's method."""

from collections.abc import Mapping
from pkgutil import resolve_name
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recognition.recognizer import Trainer

DEFAULT_TRAINER = "force_ramp"
"""The recognizer that is taught by default."""

RECOGNIZERS: Mapping[str, str] = MappingProxyType(
    {
        "force_ramp": "recognition.recognizers.force_ramp.recognizer:ForceRampTrainer",
        "level_check": "recognition.recognizers.level_check:LevelCheckTrainer",
    }
)
"""All kinds of recognizer by name, in the order of tables. The value is the module of trainer and
recognizer, imported for the first trainer, and the trainer in it."""


def trainer_names() -> tuple[str, ...]:
    """Return the names of all kinds."""
    return tuple(RECOGNIZERS)


def make_trainer(name: str = DEFAULT_TRAINER, *, use_aperture: bool = True) -> "Trainer":
    """Return the trainer of that name. Raises ValueError, listing the names, for an unknown one."""
    if name not in RECOGNIZERS:
        raise ValueError(f"no recognizer is named {name!r}; there are {', '.join(RECOGNIZERS)}")
    trainer: Trainer = resolve_name(RECOGNIZERS[name])(use_aperture=use_aperture)
    return trainer
