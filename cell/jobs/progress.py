"""How a long job tells how far it is."""

from typing import Protocol


class Progress(Protocol):
    """Told by a job about its steps; the command line draws a bar from it."""

    def __call__(self, task: str, done: int, total: int) -> None:
        """Note that ``done`` of ``total`` steps of ``task`` are over."""
        ...


def silent(task: str, done: int, total: int) -> None:
    """Tell nobody."""
