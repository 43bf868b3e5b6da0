"""The clock of link and sensor: monotonic, injected."""

from typing import Protocol


class Clock(Protocol):
    """A monotonic clock that can wait; the standard module ``time`` is one."""

    def monotonic(self) -> float:
        """Return the time in s since an arbitrary start; it never goes back."""

    def sleep(self, seconds: float, /) -> None:
        """Wait for ``seconds`` s."""
