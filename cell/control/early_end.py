"""Early end of a ramp: as soon as the data so far suffice for a name."""

from collections.abc import Callable, Sequence

from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from recognition.recognizer import Posterior, Recognizer
from recognition.statistics.fusion import StopRule, fuse

_SHARES = (0.5, 0.75)
"""Shares of its force at which a ramp is checked."""
_MOST_UNKNOWN = 0.02
"""Largest probability of an untaught object with which a ramp ends. With that of a sequence up to
3 % more of them got a name (docs/decisions/0010-unknown-never-ends-a-ramp.md)."""


class EarlyDecider:
    """Decides on one ramp while it runs, with the recognizer of whole ramps.

    Its levels are shares of the load that is reached, so it also answers for a part of a ramp.

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
        self, recognizer: Recognizer, earlier: Sequence[Posterior], rule: StopRule
    ) -> None:
        self._recognizer = recognizer
        self._earlier = tuple(earlier)
        self._rule = rule
        self._shares = list(_SHARES)
        self.answer: Posterior | None = None
        """Posterior of this grasp alone at the check that satisfied the rule; None until then."""
        self.error: Exception | None = None
        """Error of a check. The ramp continues, because an error must not stop the force loop."""

    def suffices(self, share: float, so_far: Callable[[], Grasp]) -> bool:
        """Return whether the evidence suffices at a share of the ramp's force, for the first time.

        ``so_far`` returns the grasp up to now; it is called only at a check.
        """
        if self.answer is not None or not self._shares or share < self._shares[0]:
            return False
        self._shares = [later for later in self._shares if later > share]
        try:
            posterior = self._recognizer.posterior(so_far())
        except RecognitionError:
            # Without a result the ramp continues.
            return False
        except Exception as error:
            self.error = error
            return False
        fused = fuse([*self._earlier, posterior])
        # A drawn size is compared with the most accurate measured one: of a whole ramp.
        if self._rule.suffices(fused) and fused.unknown <= _MOST_UNKNOWN and not posterior.drawn_m:
            self.answer = posterior
        return self.answer is not None
