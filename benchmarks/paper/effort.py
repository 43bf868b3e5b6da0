"""How many trials the page about the paper rests on, and how they are spread over processes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

Spread = Callable[[Callable[[Any], Any], list[Any]], list[Any]]
"""Does a piece of work for each task of a list, in order, in one process or in several."""


_LEAST = {
    "n_taught": 4,
    "table_lessons": 1,
    "table_tested": 4,
    "curve_lessons": 1,
    "curve_tested": 3,
    "repeats": 10,
    "other_lessons": 1,
    "other_tested": 4,
    "iterations": 4,
}
"""Least numbers, at any effort."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """How many trials."""

    n_taught: int = 20
    """Grasps that teach each object."""
    table_lessons: int = 10
    table_tested: int = 100
    """Teachings behind Table 1, and trials of each object in each."""
    curve_lessons: int = 4
    curve_tested: int = 50
    """The same for each noise of the accuracy curve."""
    repeats: int = 1000
    """Trials of each object in which nothing but the noise is new."""
    other_lessons: int = 3
    other_tested: int = 100
    """As for Table 1, for the recognisers that are put beside it."""
    iterations: int = 10
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
            name: max(least, round(getattr(self, name) * effort)) for name, least in _LEAST.items()
        }
        return replace(self, every=4, **few)
