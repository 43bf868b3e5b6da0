"""Training: from labelled grasps to the content of a model file, and back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

from cell.config.model import CellConfig
from cell.errors import CellError, ModelError, RequestRefused, TooFewGrasps, raised_as
from cell.learning.blas import one_blas_thread
from cell.learning.model import Arrays, LoadedModel
from cell.plugins import RECOGNISERS
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """Result of a training: the content of a model file."""

    recognizer: Recognizer
    """The recogniser."""
    trainer_name: str
    """Its kind, one of `cell.plugins.RECOGNISERS`."""
    sections: Mapping[str, Arrays] = field(default_factory=dict)
    """Further sections of the model file."""

    def with_caution(self, caution: float) -> Self:
        """Return it with a caution, if its kind of recogniser has one."""
        if not isinstance(self.recognizer, ForceRampRecognizer):
            return self
        return replace(self, recognizer=replace(self.recognizer, caution=caution))


def may_end_early(recognizer: Recognizer) -> bool:
    """Return whether a recogniser may end ramps early: the default kind, with the opening.

    By touch alone this is not shown, and little is gained (docs/explanations/sequences.md).
    """
    return isinstance(recognizer, ForceRampRecognizer) and recognizer.both is not None


def gaugeable(model: Trained | LoadedModel, *labels: str) -> ForceRampRecognizer:
    """Return the recogniser of a model if it can be gauged with these objects.

    Raises ModelError if it is of another kind, and RequestRefused if an object was not taught.
    """
    recognizer = model.recognizer
    if not isinstance(recognizer, ForceRampRecognizer):
        raise ModelError(
            f"a model of {model.trainer_name} cannot be gauged; train a force_ramp model"
        )
    for label in labels:
        if label not in recognizer.labels:
            raise RequestRefused(
                f"{label!r:.80} was not taught: gauge with one of {', '.join(recognizer.labels)}"
            )
    return recognizer


def gauged(
    recognizer: ForceRampRecognizer, label: str, grasps: Sequence[Grasp]
) -> ForceRampRecognizer:
    """Return a recogniser gauged with new grasps of a taught object.

    Raises CellError if the object was not taught, or no grasp touched both pads.
    """
    with raised_as(CellError, ValueError, where="cannot gauge"):
        return recognizer.gauge(label, grasps)


@one_blas_thread()
def train(
    grasps: Sequence[Grasp],
    name: str,
    *,
    use_aperture: bool = True,
) -> Trained:
    """Train one kind of recogniser.

    Raises CellError if the grasps are too few or unsuitable; the message names what is missing.

    Parameters
    ----------
    name
        Kind of recogniser, one of `cell.plugins.RECOGNISERS`.
    use_aperture
        Whether the opening of the fingers is a feature.
    """
    trainer = RECOGNISERS[name](use_aperture=use_aperture)
    try:
        recognizer = trainer.fit(grasps)
    except ValueError as error:
        raise TooFewGrasps(
            f"{name} cannot be trained on these {len(grasps)} grasps: {error}"
        ) from error
    return Trained(recognizer=recognizer, trainer_name=name)


def loaded(model: LoadedModel, config: CellConfig) -> Trained:
    """Return a model file as trained, with the caution of the config."""
    trained = Trained(
        recognizer=model.recognizer,
        trainer_name=model.trainer_name,
        sections=model.sections,
    )
    return trained.with_caution(config.recognition.caution)
