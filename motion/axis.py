"""One axis in m and rad: settings, limits, and what its drive or servo does."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import degrees

from motion.bus import Watch
from motion.errors import AxisLimitExceeded, PositionImplausible

POLL_S = 0.005
"""Period in s of the polls of moving axes."""
_TIME_FACTOR, _TIME_S = 2.0, 2.0
"""Longest time of a travel: factor on its time by velocity and acceleration, and s to add."""


@dataclass(frozen=True, kw_only=True)
class AxisSettings:
    """One axis in m or rad."""

    name: str
    """Part of the pose that it moves."""
    increments: float
    """Increments of the device in one m or rad; negative if it counts the other way."""
    low: float
    high: float
    """Limits in m or rad."""
    velocity: float
    acceleration: float
    """Of its profile in m/s and m/s², or rad/s and rad/s²."""
    window: float
    """Largest distance of a reached target in m or rad."""
    lag: float
    """Largest distance to the position of the profile in m or rad."""
    linear: bool
    """Whether it moves along a line, so that messages have mm, or turns."""

    def counts(self, value: float) -> int:
        """Return a distance, speed or acceleration in increments, at least 1."""
        return max(1, abs(round(value * self.increments)))

    @property
    def limits(self) -> tuple[int, int]:
        """The limits in increments, the smaller one first."""
        low, high = sorted(round(end * self.increments) for end in (self.low, self.high))
        return low, high

    def in_words(self, position: float) -> str:
        """Return a position with its unit."""
        return f"{position * 1e3:.2f} mm" if self.linear else f"{degrees(position):.2f} deg"

    @property
    def limits_in_words(self) -> str:
        """The limits with their unit."""
        return f"its limits are {self.in_words(self.low)} to {self.in_words(self.high)}"

    def longest_s(self, way: float) -> float:
        """Return the longest time in s for a travel in m or rad."""
        time_s = abs(way) / self.velocity + self.velocity / self.acceleration
        return _TIME_FACTOR * time_s + _TIME_S


class Axis(ABC):
    """One axis with its drive or servo.

    Parameters
    ----------
    device
        The device in words.
    home
        Position where the axis may stand beyond its limits, in m or rad.
    """

    def __init__(
        self, settings: AxisSettings, device: str, watch: Watch, home: float | None = None
    ) -> None:
        self.name = settings.name
        self.label = f"axis {settings.name} ({device})"
        """Axis and device in words."""
        self.settings: AxisSettings = settings
        self._watch = watch
        ends = [settings.low, settings.high, *([] if home is None else [home])]
        slack = settings.window + settings.lag
        self._plausible = min(ends) - slack, max(ends) + slack

    @property
    def position(self) -> float:
        """Present position in m or rad.

        Raises PositionImplausible if the axis cannot be there.
        """
        settings, (low, high) = self.settings, self._plausible
        position = self.read_increments() / settings.increments
        if not low <= position <= high:
            raise PositionImplausible(
                f"{self.label} reads a position of {settings.in_words(position)}, "
                f"{settings.limits_in_words}: the reading has jumped, or the axis was moved beyond "
                "its limits. Check encoder and homing, bring the axis back between its limits"
            )
        return position

    def target(self, position: float) -> int:
        """Return a position in increments.

        Raises AxisLimitExceeded if it is not a number or outside the limits of the axis.
        """
        settings = self.settings
        if not settings.low <= position <= settings.high:
            raise AxisLimitExceeded(
                f"axis {self.name} was asked for {settings.in_words(position)}, "
                f"{settings.limits_in_words}; nothing has moved"
            )
        return round(position * settings.increments)

    @abstractmethod
    def identify(self) -> str:
        """Return state and position in words; nothing is changed and nothing moves.

        Raises AxisMissing without an answer, or for another device than configured.
        """

    @abstractmethod
    def prepare(self, *, reset: bool) -> None:
        """Set up, enable, find the home; the axis may move. A fault is cleared with ``reset``."""

    @abstractmethod
    def clear_fault(self, *, reboot: bool) -> None:
        """Clear a fault; a device that must restart for it does so with ``reboot`` only.

        The device is not enabled and does not move. Raises MotionError if it is missing, or its
        fault stays.
        """

    @abstractmethod
    def wake(self) -> None:
        """Check that the device still answers, is enabled and has no fault."""

    @abstractmethod
    def go_to(self, position: float) -> None:
        """Begin to move to a position in m or rad; the only place where a target is written.

        Raises AxisLimitExceeded as `target`.
        """

    @abstractmethod
    def arrived(self) -> bool:
        """Return whether the target is reached. Raises MotionError for a device at fault."""

    @abstractmethod
    def rest(self) -> None:
        """End a motion that has arrived: the device needs no supervision now."""

    @abstractmethod
    def read_increments(self) -> int:
        """Return the present position in increments."""

    @abstractmethod
    def stop(self) -> None:
        """Send a stop without a wait."""

    @abstractmethod
    def standing(self) -> bool:
        """Return whether the axis stands still after a stop."""
