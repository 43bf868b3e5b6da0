"""The kinds of recogniser by name: the default, a plain reference, and the paper's own."""

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


def make_trainer(name: str, *, use_aperture: bool = True) -> Trainer:
    """Return the trainer of that name. Raises ValueError, listing the names, for an unknown one."""
    if name not in TRAINERS:
        raise ValueError(f"no recogniser is named {name!r}; there are {', '.join(TRAINERS)}")
    return TRAINERS[name](use_aperture)
