"""Archive of many grasps: bytes and time for each, by one process, two, and a loop over files.

Grasps are recorded ones (TACTILE_CELL_DATA names their folder, else simulated ones), repeated with
noise, in data sets of a cell and day each. Each piece of work runs in a process of its own, which
prints its peak memory, and that of its largest worker. A tenth of the files shows whether memory
grows with the archive. `--grasps 1000000` takes two hours and 25 GB of disk.
"""

import argparse
import multiprocessing
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from joblib.externals.loky import get_reusable_executor

from benchmarks._measure import line, repeats, same
from benchmarks.recognition._grasps import PAPER, recorded, simulated
from cell.archive.ingest import ingest
from cell.archive.questions import ask
from cell.archive.selection import EVERYTHING
from cell.archive.store import Archive
from cell.archive.table import grasp_key
from cell.data.dataset import read_dataset, write_dataset
from cell.data.files import json_bytes
from cell.jobs.common import silent
from cell.jobs.evaluate import evaluate_recognizers
from cell.jobs.parallel import workers
from cell.jobs.selected_grasps import selected_grasps
from cell.learning.training import train
from recognition.features.groups import features_of
from recognition.grasp import Grasp
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest
from recognition.recognizers import DEFAULT_TRAINER

_GRASPS, _OF_FILE = 4000, 250
"""Grasps at effort 1, and grasps of a data set."""
_CELLS, _DAY_MS, _FIRST_MS = 10, 86_400_000, 1_800_000_000_000
_NOISE_COUNTS = 3.0
"""Standard deviation of the noise added to a repeated grasp."""
_MOST = 20
"""Grasps of each object that train and test."""


def make_files(folder: Path, n_grasps: int) -> None:
    """Write the data sets, with two processes."""
    grasps = recorded() or simulated(len(PAPER), 20)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        write = partial(_write_file, folder, grasps, n_grasps)
        pool.map(write, range(-(-n_grasps // _OF_FILE)))


def _write_file(folder: Path, grasps: Sequence[Grasp], n_grasps: int, number: int) -> None:
    rng = np.random.default_rng(number)
    n = min(_OF_FILE, n_grasps - number * _OF_FILE)
    start_ms = _FIRST_MS + (number // _CELLS) * _DAY_MS
    source = f"cell press {number % _CELLS}"
    some = [
        replace(
            noisy(grasps[(number * _OF_FILE + i * 7) % len(grasps)], rng),
            start_ms=start_ms + 20_000 * i,
            source=source,
        )
        for i in range(n)
    ]
    write_dataset(folder / f"{number:06d}.npz", some)


def noisy(grasp: Grasp, rng: np.random.Generator) -> Grasp:
    """Return a grasp with additional noise."""
    counts = grasp.counts + rng.normal(0.0, _NOISE_COUNTS, grasp.counts.shape)
    return replace(grasp, counts=np.clip(counts, 0, grasp.pads.adc_max))


def loop(files: Path) -> int:
    """Read all files one after the other, with keys and features as in the archive."""
    n = 0
    for path in sorted(files.glob("*.npz")):
        grasps = read_dataset(path)
        rest = learn_rest(grasps)
        features_of(load_levels(grasps, rest), rest, opening=True)
        n += len({grasp_key(grasp) for grasp in grasps})
    return n


def archived(files: Path, target: str, jobs: int) -> int:
    with workers(jobs) as mapper:
        return ingest(target, files.glob("*.npz"), mapper=mapper, progress=silent).n_grasps


def reported(target: str, jobs: int) -> bytes:
    with workers(jobs) as mapper:
        return json_bytes(ask(target, mapper=mapper).as_json())  # NaN equals NaN there


def trained(target: str) -> tuple[str, ...]:
    return train(
        selected_grasps([target], EVERYTHING, _MOST, _unsaid), DEFAULT_TRAINER
    ).recognizer.labels


def evaluated(target: str, jobs: int) -> float:
    grasps = selected_grasps([target], EVERYTHING, _MOST, _unsaid)
    with workers(jobs) as mapper:
        found = evaluate_recognizers(
            grasps,
            split="chronological:0.6",
            names=[DEFAULT_TRAINER],
            mapper=mapper,
            progress=silent,
        )
    return found.recognizers[DEFAULT_TRAINER].full.single_accuracy


def _unsaid(_text: str) -> None:
    pass


def measured(work: Callable[[], Any]) -> tuple[Any, float, float, float]:
    """Return result, seconds, and peak memory of this process and its largest worker in GB."""
    began_s = time.perf_counter()
    result = work()
    took_s = time.perf_counter() - began_s
    get_reusable_executor().shutdown(wait=True)
    own, worker = (
        resource.getrusage(who).ru_maxrss * 1024e-9
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return result, took_s, own, worker


def apart(name: str, n_grasps: int, work: Callable[[], Any]) -> Any:
    """Run work in its own process and print its time and memory."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as child:
        result, took_s, own, worker = child.submit(measured, work).result()
    of_worker = f", largest worker {worker:.2f} GB" if worker > 0.05 else ""
    line(
        name,
        f"{took_s:.1f} s, {1e3 * took_s / n_grasps:.2f} ms a grasp, peak {own:.2f} GB{of_worker}",
    )
    return result


def main(effort: float = 1.0, n_grasps: int | None = None) -> None:
    n = n_grasps or repeats(_GRASPS, effort, least=2 * _OF_FILE)
    line("compared", f"one process, two, and a plain loop over npz files, {n} grasps")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, few = folder / "files", folder / "few"
        files.mkdir()
        few.mkdir()
        make_files(files, n)
        for path in sorted(files.iterdir())[: max(1, n // _OF_FILE // 10)]:
            shutil.copy(path, few)
        targets = {jobs: str(folder / f"archive{jobs}") for jobs in (1, 2)}
        first = str(folder / "tenth")
        n_first = ingest(first, few.glob("*.npz"), progress=silent).n_grasps
        packed, table = _size(few, "*.npz"), _size(Path(first), "*.parquet")
        line("bytes per grasp", f"npz {packed / n_first:.0f}, archive {table / n_first:.0f}")
        apart("plain loop, npz", n, partial(loop, files))
        apart("archive a tenth", n_first, partial(archived, few, str(folder / "again"), 1))
        for jobs, target in targets.items():
            added = apart(f"archive, {jobs} processes", n, partial(archived, files, target, jobs))
            same(added == n, f"{added} of {n} grasps are in the archive")
        added = apart("archive again", n, partial(archived, files, targets[1], 1))
        same(added == 0, f"{added} grasps were added twice")
        reports = [
            apart(f"report, {jobs} processes", n, partial(reported, targets[jobs], jobs))
            for jobs in targets
        ]
        same(reports[0] == reports[1], "one process and two give different reports")
        n_labels = len(apart("train", n, partial(trained, targets[1])))
        shares = [
            apart(f"evaluate, {jobs} processes", n, partial(evaluated, targets[1], jobs))
            for jobs in targets
        ]
        same(shares[0] == shares[1], "one process and two give different figures")
        total = Archive(targets[1]).n_rows()
        line(
            "in the archive", f"{total} grasps of {n_labels} objects, {100 * shares[0]:.1f} % right"
        )


def _size(folder: Path, files: str) -> int:
    return sum(path.stat().st_size for path in folder.rglob(files))


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--grasps", type=int, default=None, help=f"default {_GRASPS}")
    main(n_grasps=arguments.parse_args().grasps)
