"""Selected grasps: those of archives, data sets and recordings that teach or test."""

from collections.abc import Callable, Sequence
from pathlib import Path

from cell.archive.selection import Selection, cell_of, day_of, is_archive
from cell.errors import CellError
from cell.installation import extra
from cell.learning.labelled_grasps import read_labelled_grasps
from recognition.evaluation.splits import TrainTest, left_out_parts, series_names
from recognition.grasp import Grasp

_MOST = 400
"""Grasps of each object that are taken of an archive at most, at random."""
LEFT_OUT = ("days", "cells", "series")
"""What can be left out in turn."""


def selected_grasps(
    places: Sequence[str], selection: Selection, note: Callable[[str], None]
) -> list[Grasp]:
    """Return the selected labelled grasps of archives, data sets and recordings.

    ``note`` gets what is left out. Raises CellError where one cannot be read, or none is selected.
    """
    grasps: list[Grasp] = []
    for place in places:
        if is_archive(place):
            with extra("archive", needed_by="an archive"):
                from cell.archive.store import Archive  # noqa: PLC0415  slow to load
            here = list(Archive(place).grasps(selection, most=_MOST))
            note(f"{place}: {len(here)} grasps, of each object {_MOST} at most")
        else:
            every = read_labelled_grasps(Path(place), note)
            here = [grasp for grasp in every if selection.fits(grasp)]
        grasps += here
    if not grasps:
        raise CellError(f"no labelled grasp of {', '.join(places)} is selected")
    return grasps


def left_out_in_turn(grasps: Sequence[Grasp], what: str) -> list[TrainTest]:
    """Return grasps to train and to test, for each of `LEFT_OUT`; ValueError with a single one."""
    if what == "series":
        return left_out_parts(grasps, series_names(grasps))
    day = what == "days"
    return left_out_parts(grasps, [day_of(g.start_ms) if day else cell_of(g) for g in grasps])
