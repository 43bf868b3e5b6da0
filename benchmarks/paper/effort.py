"""How many trials the page about the paper rests on, and how they are spread over processes."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

Spread = Callable[[Callable[[Any], Any], list[Any]], list[Any]]
"""Does a piece of work for each task of a list, in order, in one process or in several."""


def _trials(usual: int, least: int) -> Any:
    """Return a number of trials with the least one, at any effort."""
    return field(default=usual, metadata={"least": least})


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """How many trials."""

    n_taught: int = _trials(20, least=4)
    """Grasps that teach each object."""
    table_lessons: int = _trials(10, least=1)
    table_tested: int = _trials(100, least=4)
    """Teachings behind Table 1, and trials of each object in each."""
    curve_lessons: int = _trials(4, least=1)
    curve_tested: int = _trials(50, least=3)
    """The same for each noise of the accuracy curve."""
    repeats: int = _trials(1000, least=10)
    """Trials of each object in which nothing but the noise is new."""
    other_lessons: int = _trials(3, least=1)
    other_tested: int = _trials(100, least=4)
    """As for Table 1, for the recognisers that are put beside it."""
    iterations: int = _trials(10, least=4)
    """Recordings of each touch at each noise of figure 4: the paper's ten."""
    every: int = 1
    """1 for all noise levels of figure 4 and of the accuracy curve, n for every n-th."""
    seed: int = 2008
    """Of all that is random."""

    def scaled(self, effort: float) -> "Effort":
        """Return the same with fewer trials for an effort below 1."""
        if effort >= 1.0:
            return self
        few = {
            one.name: max(one.metadata["least"], round(getattr(self, one.name) * effort))
            for one in fields(self)
            if one.metadata
        }
        return replace(self, every=4, **few)
