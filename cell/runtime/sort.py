"""Sorting: the places of parts, and the counts at each."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cell.config.model import CellConfig
from cell.config.positioner import PlacePoseConfig
from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.positioner import Destination
from cell.errors import ConfigError
from recognition.recognizer import UNKNOWN


class Places:
    """Places of a sort by the label of a part.

    Raises ConfigError if the config names places, but a part has no place.
    """

    def __init__(self, config: CellConfig, labels: Iterable[str]) -> None:
        sort = config.sort
        self._reject = (sort.reject, _pose(sort.reject_pose))
        self._places = {entry.label: (entry.place, _pose(entry.pose)) for entry in sort.places}
        if not self._places:
            self._places = {label: (label, None) for label in labels}
        missing = [label for label in labels if label not in self._places]
        if missing:
            raise ConfigError(
                f"sort.places has no place for {', '.join(missing)}: add a place for each"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the places, that of the rejects last."""
        return (*dict.fromkeys(name for name, _ in self._places.values()), self._reject[0])

    def of(self, label: str) -> Destination:
        """Return the place of a part; `UNKNOWN` has that of the rejects."""
        place, pose = self._places.get(label, self._reject)
        return Destination(label=label, place=place, pose=pose)

    @property
    def reject(self) -> Destination:
        """The place of the rejects."""
        return self.of(UNKNOWN)


def _pose(config: PlacePoseConfig | None) -> Pose | None:
    return None if config is None else Pose.of_mm(**config.model_dump())


@dataclass(slots=True, kw_only=True)
class SortAnswer:
    """Counts of a sort so far, also if it ends early."""

    targets: Places
    """The places by label."""
    placed: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of parts by their true object (empty if not known) and by place."""
    mistakes: list[dict[str, Any]] = field(default_factory=list)
    """``number``, true object and ``place`` of each part at the place of another kind (simulated
    cell); rejects do not count."""
    n_missed: int = 0
    """Number of turns without a part."""

    def add(self, part: Part) -> None:
        """Count a part that was released at its place."""
        self.placed[part.presented, str(part.place)] += 1
        right = (self.targets.of(part.presented).place, self.targets.reject.place)
        if part.presented and part.place not in right:
            mistake = {"number": part.number, "was": part.presented, "place": part.place}
            self.mistakes.append(mistake)

    @property
    def n_parts(self) -> int:
        """Parts that were released at a place."""
        return self.placed.total()

    @property
    def n_rejected(self) -> int:
        """Parts at the place of the rejects: never taught, or changed since they were named."""
        return self.places[self.targets.reject.place]

    @property
    def places(self) -> dict[str, int]:
        """Number of parts at each place."""
        return {
            name: sum(n for (_, place), n in self.placed.items() if place == name)
            for name in self.targets.names
        }

    @property
    def share_named(self) -> float:
        """Share of the parts that have a name, the yield; NaN without a part."""
        return 1.0 - self.n_rejected / self.n_parts if self.placed else float("nan")

    def matrix(self) -> dict[str, dict[str, int]]:
        """Return how many parts of each true kind lie at each place; empty on a real cell."""
        truths = dict.fromkeys(truth for truth, _ in self.placed if truth)
        return {
            truth: {place: self.placed[truth, place] for place in self.targets.names}
            for truth in truths
        }

    def as_json(self) -> dict[str, Any]:
        """Return the counts as plain data."""
        names = ("n_parts", "n_missed", "n_rejected", "places")
        return {name: getattr(self, name) for name in names} | {
            "share_named": self.share_named if self.placed else None,
            "matrix": self.matrix(),
            "mistakes": [*self.mistakes],
        }


def simulated_feed(config: CellConfig, n_parts: int) -> list[str]:
    """Return a mixed feed of the simulated objects, each kind equally often."""
    kinds = [entry.label for entry in config.simulator.objects]
    feed = [kinds[number % len(kinds)] for number in range(n_parts)]
    np.random.default_rng(config.seed).shuffle(feed)
    return feed


def drawn_object(config: CellConfig) -> str | None:
    """Return the object that a simulated cell draws by its seed; None if it cannot choose."""
    objects = [entry.label for entry in config.simulator.objects]
    draw = np.random.default_rng(config.seed)
    return str(draw.choice(objects)) if config.brings_objects else None
