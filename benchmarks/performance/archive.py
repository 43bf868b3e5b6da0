"""Archive of many grasps: bytes and time for each, by one process, two, and a loop over files.

Grasps are recorded ones (TACTILE_CELL_DATA names their folder, else simulated ones), repeated with
noise, in data sets of a cell and day each. Each piece of work runs in a process of its own. Prints
its time, its peak memory, and that of its largest worker. A tenth of the files shows whether memory
grows with the archive. `--grasps 1000000` takes two hours and 25 GB of disk.
"""

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import in_own_process, line, repeats, same
from benchmarks.recognition._grasps import grasps_at_hand
from cell.archive.ingest import ingest
from cell.archive.questions import ask
from cell.archive.store import grasp_key
from cell.files import json_bytes
from cell.learning.parallel import silent, workers
from cell.recording.dataset import read_dataset, write_dataset
from recognition.features import features_of
from recognition.grasp import Grasp
from recognition.ramp.ramp import learn_rest, load_levels

_GRASPS, _OF_FILE = 4000, 250
"""Grasps at effort 1, and of a data set."""
_CELLS, _DAY_MS, _FIRST_MS = 10, 86_400_000, 1_800_000_000_000
_NOISE_COUNTS = 3.0
"""Standard deviation of the noise added to a repeated grasp."""


def write_file(folder: Path, grasps: Sequence[Grasp], n_grasps: int, number: int) -> None:
    """Write one of the data sets."""
    rng = np.random.default_rng(number)
    some = []
    for i in range(min(_OF_FILE, n_grasps - number * _OF_FILE)):
        grasp = grasps[(number * _OF_FILE + i * 7) % len(grasps)]
        counts = grasp.counts + rng.normal(0.0, _NOISE_COUNTS, grasp.counts.shape)
        counts = np.clip(counts, 0, grasp.pads.adc_max)
        start_ms = _FIRST_MS + (number // _CELLS) * _DAY_MS + 20_000 * i
        source = f"cell press {number % _CELLS}"
        some.append(replace(grasp, counts=counts, start_ms=start_ms, source=source))
    write_dataset(folder / f"{number:06d}.npz", some)


def loop(files: Sequence[Path]) -> None:
    """Read all files one after the other, with keys and features as in the archive."""
    for path in files:
        grasps = read_dataset(path)
        rest = learn_rest(grasps)
        features_of(load_levels(grasps, rest), rest, opening=True)
        {grasp_key(grasp) for grasp in grasps}


def archived(files: Sequence[Path], target: str, jobs: int) -> int:
    with workers(jobs) as mapper:
        return ingest(target, files, mapper=mapper, progress=silent).n_grasps


def reported(target: str) -> bytes:
    return json_bytes(ask(target).as_json())  # NaN equals NaN there


def apart(name: str, n_grasps: int, work: Callable[..., Any], *arguments: Any) -> Any:
    """Run work in its own process and print its time and memory."""
    result, took_s, (own, worker) = in_own_process(partial(work, *arguments))
    each = f"{took_s:.1f} s, {1e3 * took_s / n_grasps:.2f} ms a grasp"
    line(name, f"{each}, peak {own:.2f} GB, largest worker {worker:.2f} GB")
    return result


def main(effort: float = 1.0, n_grasps: int | None = None) -> None:
    n = n_grasps or repeats(_GRASPS, effort, least=2 * _OF_FILE)
    line("compared", f"one process, two, and a plain loop over npz files, {n} grasps")
    with tempfile.TemporaryDirectory() as folder:
        grasps, n_files = grasps_at_hand(20), -(-n // _OF_FILE)
        for number in range(n_files):
            write_file(Path(folder), grasps, n, number)
        files = sorted(Path(folder).glob("*.npz"))
        few, (tenth, one, two) = files[: max(1, n_files // 10)], (f"{folder}/{i}" for i in range(3))
        apart("plain loop, npz", n, loop, files)
        n_few = apart("archive a tenth", min(n, _OF_FILE * len(few)), archived, few, tenth, 1)
        packed = sum(path.stat().st_size for path in few)
        table = sum(path.stat().st_size for path in Path(tenth).rglob("*.parquet"))
        line("bytes per grasp", f"npz {packed / n_few:.0f}, archive {table / n_few:.0f}")
        targets = {1: one, 2: two}
        for jobs, target in targets.items():
            added = apart(f"archive, {jobs} processes", n, archived, files, target, jobs)
            same(added == n, f"{added} of {n} grasps are in the archive")
        added = apart("archive again", n, archived, files, one, 1)
        same(added == 0, f"{added} grasps were added twice")
        reports = [apart("report", n, reported, target) for target in targets.values()]
        same(reports[0] == reports[1], "archives by one process and two give different reports")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--grasps", type=int, default=None, help=f"default {_GRASPS}")
    main(n_grasps=arguments.parse_args().grasps)
