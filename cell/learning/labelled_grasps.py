"""Labelled grasps of data sets and recordings, and the data sets to which they are added."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from cell.errors import CellError
from cell.files import alone_in
from cell.learning.model import what_differs
from cell.recording.dataset import read_dataset, read_grasps, write_dataset
from recognition.grasp import Grasp, PadArray


def name_recorded(source: Path, label: str, dataset: Path, series: str = "") -> tuple[int, int]:
    """Add the grasps of a recording or data set that have no label to a data set, under a label.

    Grasps that the data set has are left out. Raises CellError if a file cannot be read or written,
    or no grasp is left.

    Returns
    -------
    (added, before)
        Number of added grasps, and of grasps in the data set before.
    """
    grasps = [grasp for grasp in read_grasps(source) if not grasp.label]
    if not grasps:
        raise CellError(
            f"{source}: each of its grasps has a label; use it with `model train` directly"
        )
    with _extending(dataset, grasps[0].pads) as before:
        new = distinct_grasps(grasps, before)
        if not new:
            raise CellError(f"{source}: {dataset} has each of its grasps without a label already")
        named = (replace(grasp, label=label, series=series) for grasp in new)
        write_dataset(dataset, [*before, *named])
    return len(new), len(before)


def read_labelled_grasps(path: Path, note: Callable[[str], None]) -> tuple[Grasp, ...]:
    """Return the labelled grasps of a data set or recording; a note gives the number of others.

    Raises CellError if no grasp has a label: they can be neither taught nor tested.
    """
    grasps = read_grasps(path)
    named = tuple(grasp for grasp in grasps if grasp.label)
    if not named:
        raise CellError(
            f"{path}: its {len(grasps)} grasps have no label; "
            f"`tactile-cell teach LABEL --from {path} -o DATASET` adds them to a data set with one"
        )
    if n_without := len(grasps) - len(named):
        note(f"{path}: {n_without} grasps without a label are left out")
    return named


def distinct_grasps(grasps: Sequence[Grasp], before: Sequence[Grasp] = ()) -> list[Grasp]:
    """Return the grasps without those that repeat an earlier one: same time, same frames."""

    def key(grasp: Grasp) -> tuple[int, int]:
        return grasp.start_ms, hash(grasp.counts.tobytes())

    known, first = set(map(key, before)), dict[tuple[int, int], Grasp]()
    for grasp in grasps:
        first.setdefault(key(grasp), grasp)
    return [grasp for identity, grasp in first.items() if identity not in known]


def dataset_to_extend(path: Path, pads: PadArray) -> tuple[Grasp, ...]:
    """Return the present grasps of a data set, to which grasps of these pads will be added.

    Raises CellError if it cannot be read, or holds grasps on other pads.
    """
    before = read_dataset(path) if path.exists() else ()
    if before and not (there := before[0].pads).same_as(pads):
        raise CellError(
            f"{path} holds grasps on other pads: {there.n_taxels} taxels in {there.n_pads} pads, "
            f"these have {pads.n_taxels} in {pads.n_pads}{what_differs(there, pads)}; choose "
            "another file"
        )
    return before


@contextmanager
def _extending(path: Path, pads: PadArray) -> Iterator[tuple[Grasp, ...]]:
    """Give the present grasps of a data set; other commands cannot add to it meanwhile."""
    if not path.parent.is_dir():
        raise CellError(f"{path}: the folder {path.parent} does not exist; make it first")
    with alone_in(path.parent):
        yield dataset_to_extend(path, pads)


def append_to_dataset(path: Path, new: Sequence[Grasp], series: str = "") -> int:
    """Rewrite a data set with further grasps of one series at its end; return the number before.

    Raises as `dataset_to_extend` and `write_dataset`; the file does not change then.
    """
    with _extending(path, new[0].pads) as before:
        write_dataset(path, [*before, *(replace(grasp, series=series) for grasp in new)])
    return len(before)
