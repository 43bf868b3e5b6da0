"""Progress and folders of jobs."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from cell.errors import CellError

Progress = Callable[[str, int, int], None]
"""Called by a job after each step with a task, its finished steps, and all steps; the command line
draws a bar from it."""


def silent(task: str, done: int, total: int) -> None:
    """Show no progress."""


def job_folder(directory: Path, job: str) -> Path:
    """Make a new folder for one job, named by job and time; never use an existing one.

    Raises CellError if it cannot be made.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    for attempt in range(100):
        folder = directory / (f"{job}-{stamp}" if attempt == 0 else f"{job}-{stamp}-{attempt}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise CellError(
                f"{folder} cannot be made: {error}; name another folder with --out"
            ) from error
        return folder
    raise CellError(f"{directory} has 100 folders of {job}-{stamp}; name another folder with --out")
