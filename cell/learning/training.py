"""Training: from labelled grasps to all that a model file keeps, and its optional parts back again.

Beside the recogniser a model may keep early classifiers, which answer while a ramp still runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cell.config.model import RecognitionConfig
from cell.errors import CellError, ModelError
from cell.installation import extra
from cell.learning.blas import one_blas_thread
from cell.learning.model import Arrays, LoadedModel, made_up_grasp, rehearse
from recognition.grasp import Grasp
from recognition.ramp.running_load import load_so_far
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer
from recognition.recognizers.early_classifiers import EarlyClassifiers, teach_early
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer

EARLY_SECTION = "early"
"""Section of a model file that holds the early classifiers."""


def with_caution(recognizer: Recognizer, config: RecognitionConfig) -> Recognizer:
    """Return the recogniser with the caution of the config, where it is of a kind that has one."""
    if isinstance(recognizer, ForceRampRecognizer):
        return replace(recognizer, caution=config.caution)
    return recognizer


def may_end_early(recognizer: Recognizer) -> bool:
    """Return whether ramps cut short name as whole ones do: by the default one, with the opening.

    By touch alone that is not shown, and little is gained (docs/explanations/sequences.md).
    """
    return isinstance(recognizer, ForceRampRecognizer) and recognizer.both is not None


def gaugeable(recognizer: Recognizer, trainer_name: str) -> ForceRampRecognizer:
    """Return a recogniser that can be gauged. Raises ModelError for one of another kind."""
    if not isinstance(recognizer, ForceRampRecognizer):
        raise ModelError(f"a model of {trainer_name} cannot be gauged; train one of force_ramp")
    return recognizer


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """Result of a training."""

    recognizer: Recognizer
    """The recogniser of whole ramps."""
    trainer_name: str
    """Its kind, one of `recognition.recognizers.trainer_names`."""
    early: EarlyClassifiers | None = None
    """Classifiers for ramps that end early; None where they were not asked for."""

    @property
    def sections(self) -> dict[str, Arrays]:
        """Sections of a model file that keep the optional parts."""
        return {} if self.early is None else {EARLY_SECTION: self.early.to_arrays()}


@one_blas_thread()
def train(
    grasps: Sequence[Grasp],
    name: str,
    *,
    use_aperture: bool = True,
    early: bool = False,
) -> Trained:
    """Train one kind of recogniser.

    Raises CellError if the grasps do not suffice; the message names what is missing.

    Parameters
    ----------
    name
        Kind of recogniser, one of `recognition.recognizers.trainer_names`.
    use_aperture
        Whether the opening of the fingers is a feature.
    early
        Whether ramps cut short train early classifiers too, where `may_end_early`.
    """
    trainer = make_trainer(name, use_aperture=use_aperture)
    try:
        with extra("comparators", needed_by=f"teaching {name}"):
            recognizer = trainer.fit(grasps)
    except ValueError as error:
        raise CellError(
            f"{name} cannot be trained on these {len(grasps)} grasps: {error}"
        ) from error
    cut = None
    if early and may_end_early(recognizer):
        cut = teach_early(trainer, grasps, recognizer.labels)
    return Trained(recognizer=recognizer, trainer_name=name, early=cut)


def load_early(model: LoadedModel) -> EarlyClassifiers | None:
    """Return the early classifiers of a model file; None where it has none to go by.

    Raises ModelError where they do not fit its recogniser.
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
                raise ValueError(f"ramps cut short name {head.labels}")
            rehearse(head, grasp)
        return heads

    return model.section(EARLY_SECTION, build)
