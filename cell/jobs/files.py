"""Where a job puts what it makes."""

from datetime import datetime
from pathlib import Path

from cell.errors import CellError


def job_folder(directory: Path, job: str) -> Path:
    """Make a new folder for one job, named by job and time; an existing one is never used.

    Raises
    ------
    CellError
        If it cannot be made.
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
