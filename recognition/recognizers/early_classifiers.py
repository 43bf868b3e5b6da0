"""Early classifiers: recognisers for shortened ramps, for a decision while the ramp still runs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.errors import RecognitionError
from recognition.grasp import Grasp, keep_array
from recognition.ramp.ramp import Rest, learn_rest
from recognition.ramp.running_load import RunningLoad, load_so_far
from recognition.recognizer import Posterior, Recognizer, Trainer
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer
from recognition.statistics.array_record import without_prefix
from recognition.statistics.fusion import StopRule, fuse

_SHARES = (0.5, 0.75)
"""Parts of the usual full load at which a ramp is checked before its end. At a quarter, intervals
of the size contain it too rarely: at the usual noise in 77 % of grasps instead of 90 %."""
_MOST_UNKNOWN = 0.02
"""Largest probability of an untaught object with which a ramp ends. With that of a sequence up to
3 % more of them got a name (docs/decisions/0010-unknown-never-ends-a-ramp.md)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarlyClassifiers:
    """One recogniser for each load at which a ramp is checked before its end."""

    rest: Rest
    """The untouched pads."""
    load_counts: NDArray[np.float64]
    """(L,) float64: loads in counts, summed over the gripping pads, ascending."""
    recognizers: tuple[Recognizer, ...]
    """L recognisers, each taught with ramps cut at its load."""

    def __post_init__(self) -> None:
        loads = keep_array(self, "load_counts", self.load_counts, np.float64)
        if loads.shape != (len(self.recognizers),) or not np.all(np.diff(loads) > 0.0):
            raise ValueError(f"loads {loads} are not ascending, one for each recogniser")

    def as_wary_as(self, whole: Recognizer) -> Self:
        """Return early classifiers with drift and caution of the recogniser of whole ramps."""
        if not isinstance(whole, ForceRampRecognizer):
            return self
        early = tuple(
            replace(one, grid=whole.grid, caution=whole.caution)
            if isinstance(one, ForceRampRecognizer)
            else one
            for one in self.recognizers
        )
        return replace(self, recognizers=early)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the taught recognisers as plain arrays."""
        arrays: dict[str, NDArray[Any]] = {"load_counts": self.load_counts}
        arrays |= {f"rest.{name}": array for name, array in self.rest.to_arrays().items()}
        for number, early in enumerate(self.recognizers):
            arrays |= {f"{number}.{name}": array for name, array in early.to_arrays().items()}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], kind: type[Recognizer]) -> Self:
        """Rebuild from `to_arrays`, for one kind of recogniser.

        Raises KeyError or ValueError if an array is missing or does not fit.
        """
        return cls(
            rest=Rest.from_arrays(without_prefix(arrays, "rest.")),
            load_counts=arrays["load_counts"],
            recognizers=tuple(
                kind.from_arrays(without_prefix(arrays, f"{number}."))
                for number in range(len(arrays["load_counts"]))
            ),
        )


class EarlyDecider:
    """Decides on one ramp while it runs, with an early classifier at each load.

    Parameters
    ----------
    earlier
        Posteriors of the earlier grasps of the same object, used together with this one.
    rule
        Rule for sufficient evidence, see `StopRule.suffices`; the limit of an untaught object is
        lower here. An untaught object never ends a ramp. An object whose name would be given only
        because this is the last grasp does not end one either.
    """

    def __init__(
        self, early: EarlyClassifiers, earlier: Sequence[Posterior], rule: StopRule
    ) -> None:
        self._early = early
        self._earlier = tuple(earlier)
        self._rule = rule
        self._load = RunningLoad(early.rest)
        self._seen = 0
        self._n_checked = 0
        self.answer: Posterior | None = None
        """Posterior of this grasp alone at the check that satisfied the rule; None until then."""
        self.error: Exception | None = None
        """Error of a check. The ramp continues, because an error must not stop the force loop."""

    def add_frame(self, counts: NDArray[np.uint16], so_far: Callable[[], Grasp]) -> bool:
        """Take the next frame; return whether the evidence suffices with it, for the first time.

        Parameters
        ----------
        counts : (n_taxels,) uint16
            The frame.
        so_far
            Returns the grasp with at least all frames up to this one; called only at a check.
        """
        self._seen += 1
        load = self._load.push(counts)
        while (
            self.answer is None
            and self._n_checked < len(self._early.recognizers)
            and load >= self._early.load_counts[self._n_checked]
        ):
            classifier = self._early.recognizers[self._n_checked]
            self._n_checked += 1
            try:
                posterior = classifier.posterior(so_far().first_frames(self._seen))
            except RecognitionError:
                # Without a result the ramp continues.
                continue
            except Exception as error:
                self.error = error
                continue
            fused = fuse([*self._earlier, posterior])
            sure = self._rule.suffices(fused) and fused.unknown <= _MOST_UNKNOWN
            # A drawn size is compared with the most accurate measured one: of a whole ramp.
            if sure and not posterior.drawn_m:
                self.answer = posterior
                return True
        return False


def teach_early(
    trainer: Trainer, grasps: Sequence[Grasp], labels: tuple[str, ...]
) -> EarlyClassifiers:
    """Return early classifiers, taught with the grasps that taught whole ramps of these labels.

    Each recogniser calibrates its probabilities on ramps cut at its load; ramps that end below this
    load are used whole. If too few of the cut ramps show a touch in the noise, that load is not
    checked.
    """
    rest = learn_rest(grasps)
    loads = [load_so_far(g, rest) for g in grasps]
    full = float(np.median([load[-1] for load in loads]))
    taught: dict[float, Recognizer] = {}
    for level in (full * share for share in _SHARES):
        ends = [np.flatnonzero(load >= level) for load in loads]
        parts = [
            g.first_frames(int(end[0]) + 1) if len(end) else g
            for g, end in zip(grasps, ends, strict=True)
        ]
        try:
            early = trainer.fit(parts)
        except ValueError:
            continue
        if early.labels == labels:
            taught[level] = early
    return EarlyClassifiers(
        rest=rest, load_counts=np.array(list(taught)), recognizers=tuple(taught.values())
    )
