"""Progress of long work."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called after each step with a task, its finished steps, and all steps; the command line draws a
bar from it."""


def silent(task: str, done: int, total: int) -> None:
    """Show no progress."""
