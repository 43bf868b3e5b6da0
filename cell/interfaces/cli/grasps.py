"""Labelled grasps that commands take, from data sets (.npz) and recordings (.mcap) alike."""

from pathlib import Path

from cell.interfaces.cli.terminal import print_line
from cell.jobs.teach import labelled
from recognition.grasp import Grasp


def labelled_grasps(path: Path) -> tuple[Grasp, ...]:
    """Return the grasps with a label, and print how many have none and are left out.

    Raises
    ------
    CellError
        If the file cannot be read, or none of its grasps has a label.
    """
    grasps, n_without = labelled(path)
    if n_without:
        print_line(f"{path}: {n_without} grasps without a label are left out")
    return grasps
