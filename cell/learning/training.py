"""Training: from labelled grasps to the content of a model file, and its optional parts back.

Beside the recogniser a model may have early classifiers, which answer while a ramp still runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

from cell.config.model import CellConfig
from cell.errors import CellError, ModelError, RequestRefused, TooFewGrasps, raised_as
from cell.learning.blas import one_blas_thread
from cell.learning.model import Arrays, LoadedModel, made_up_grasp, rehearse
from cell.plugins import RECOGNISERS
from recognition.grasp import Grasp
from recognition.ramp.running_load import load_so_far
from recognition.recognizer import Recognizer
from recognition.recognizers.early_classifiers import EarlyClassifiers, teach_early
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer

EARLY_SECTION = "early"
"""Section of a model file with the early classifiers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """Result of a training: the content of a model file."""

    recognizer: Recognizer
    """The recogniser of whole ramps."""
    trainer_name: str
    """Its kind, one of `cell.plugins.RECOGNISERS`."""
    early: EarlyClassifiers | None = None
    """Classifiers for ramps that end early; None if not requested."""
    sections: Mapping[str, Arrays] = field(default_factory=dict)
    """Further sections of the model file, including the optional parts."""

    def with_caution(self, caution: float) -> Self:
        """Return it with a caution, if its kind of recogniser has one."""
        if not isinstance(self.recognizer, ForceRampRecognizer):
            return self
        return replace(self, recognizer=replace(self.recognizer, caution=caution))


def may_end_early(recognizer: Recognizer) -> bool:
    """Return whether early classifiers suit a recogniser: the default kind, with the opening.

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
    early: bool = False,
) -> Trained:
    """Train one kind of recogniser.

    Raises CellError if the grasps are too few or unsuitable; the message names what is missing.

    Parameters
    ----------
    name
        Kind of recogniser, one of `cell.plugins.RECOGNISERS`.
    use_aperture
        Whether the opening of the fingers is a feature.
    early
        Whether to train early classifiers too, if `may_end_early`.
    """
    trainer = RECOGNISERS[name](use_aperture=use_aperture)
    try:
        recognizer = trainer.fit(grasps)
    except ValueError as error:
        raise TooFewGrasps(
            f"{name} cannot be trained on these {len(grasps)} grasps: {error}"
        ) from error
    trained = Trained(recognizer=recognizer, trainer_name=name)
    if not early or not may_end_early(recognizer):
        return trained
    cut = teach_early(trainer, grasps, recognizer.labels)
    return replace(trained, early=cut, sections={EARLY_SECTION: cut.to_arrays()})


def loaded(model: LoadedModel, config: CellConfig) -> Trained:
    """Return a model file as trained, with the parts that the config uses. See `load_early`."""
    trained = Trained(
        recognizer=model.recognizer,
        trainer_name=model.trainer_name,
        early=load_early(model) if config.decides_early else None,
        sections=model.sections,
    )
    return trained.with_caution(config.recognition.caution)


def load_early(model: LoadedModel) -> EarlyClassifiers | None:
    """Return the early classifiers of a model file, or None.

    Raises ModelError if they do not fit its recogniser.
    """
    if not may_end_early(model.recognizer):
        return None
    kind = type(model.recognizer)

    def build(arrays: Arrays) -> EarlyClassifiers:
        heads = EarlyClassifiers.from_arrays(arrays, kind)
        grasp = made_up_grasp(model.pads)
        load_so_far(grasp, heads.rest)
        for head in heads.recognizers:
            if head.labels != model.recognizer.labels:
                raise ValueError(f"the early classifiers have the labels {head.labels}")
            rehearse(head, grasp)
        return heads

    return model.section(EARLY_SECTION, build)
