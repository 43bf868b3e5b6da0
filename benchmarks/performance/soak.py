"""Ten thousand grasps in virtual time, in which memory stays flat and files and threads stay few.

    python -m benchmarks.performance.soak [--grasps N] [--report OUT.json]        (make soak)

Two kinds of work alternate in one process, because they can leak in different ways. One cell is
built once and grasps all the time. In each shift a new cell records, teaches, identifies, is
cancelled in mid-grasp, latches a fault, is cleared, reset and closed. After each block memory,
files and threads are measured. The first fifth of the blocks is left out: interpreter, allocator
and recogniser fill their caches then.
"""

import argparse
import gc
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._measure import line
from cell.build import Cell, build_cell
from cell.config.model import CellConfig
from cell.control.plan import plan
from cell.control.states import CellState
from cell.errors import CellStopped
from cell.jobs.collection import grasps_of
from cell.learning.training import train
from gripper.values.state import GripperPhase
from recognition.recognizer import Recognizer
from tactile.errors import LinkFault

BLOCK = 20
"""Grasps of one block: half of them by the long-lived cell, half by a shift of its own."""
WARM_UP = 0.2
"""Share of the blocks that is left out of the slopes."""
LIMITS = {"rss_kib": 1.0, "objects": 0.5, "descriptors": 0.001, "threads": 0.001}
"""Growth allowed for each grasp."""
_PAGE_KIB = os.sysconf("SC_PAGE_SIZE") // 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class ResourceUse:
    """Resources of the process after a number of grasps or connections."""

    done: int
    """How many."""
    virtual_s: float
    """Time that has passed in the simulated cells, in s."""
    rss_kib: int
    """Resident memory in KiB."""
    objects: int
    """Objects that the garbage collector keeps track of, after a collection."""
    descriptors: int
    threads: int
    """Open file descriptors and threads of the process."""


def look(done: int, virtual_s: float) -> ResourceUse:
    """Collect garbage and measure this process."""
    gc.collect()
    resident = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return ResourceUse(
        done=done,
        virtual_s=virtual_s,
        rss_kib=resident * _PAGE_KIB,
        objects=len(gc.get_objects()),
        descriptors=len(os.listdir("/proc/self/fd")),
        threads=len(os.listdir("/proc/self/task")),
    )


def _cell(config: CellConfig, folder: Path | None = None) -> Cell:
    cell = build_cell(config, folder=folder)
    cell.controller.start()
    return cell


def _now_s(cell: Cell) -> float:
    return cell.simulated.clock.monotonic()


def steady(cell: Cell, config: CellConfig, n: int, seed: int) -> int:
    """Let a cell grasp one object ``n`` times; the number of grasps."""
    labels = [entry.label for entry in config.simulator.objects]
    label = labels[seed % len(labels)]
    return len(grasps_of(cell.controller, config.sequence, [label], n, seed=seed))


def shift(config: CellConfig, recognizer: Recognizer, n: int, seed: int) -> tuple[int, float]:
    """Let a new cell record, grasp ``n`` times and more, and meet a fault; grasps, virtual s."""
    with tempfile.TemporaryDirectory() as folder, closing(_cell(config, Path(folder))) as cell:
        controller, simulated = cell.controller, cell.simulated
        done = steady(cell, config, n - 2, seed)
        found = controller.identify(recognizer, plan(config.sequence, 2, seed=seed))
        done += len(found.records)
        _cancelled_in(cell, GripperPhase.RAMPING, config, seed)
        controller.release()
        simulated.inject("unit.off")
        try:
            while True:
                controller.life.tick()
                cell.simulated.clock.sleep(0.005)
        except LinkFault:
            simulated.injector.clear("unit.off")
        controller.life.clear()
        controller.life.reset()
        controller.start()
        if controller.life.state is not CellState.IDLE:
            raise SystemExit(
                f"the cell is {controller.life.state.value} after clear, reset and start"
            )
        return done, _now_s(cell)


def _cancelled_in(cell: Cell, phase: GripperPhase, config: CellConfig, seed: int) -> None:
    """Cancel a grasp in one of its phases; the part stays in the grip."""
    controller, advances = cell.controller, cell.simulated.clock.on_advance

    def cancel(_now_s: float) -> None:
        if controller.hand.phase is phase:
            controller.life.cancel()
            advances.remove(cancel)

    advances.append(cancel)
    try:
        controller.grasp(plan(config.sequence, 1, seed=seed)[0])
    except CellStopped:
        return
    raise SystemExit("a cancelled grasp went on to its end")


def soak(n_grasps: int, config: CellConfig | None = None) -> Iterator[ResourceUse]:
    """Do at least ``n_grasps`` grasps and yield a sample after each block."""
    config = config or CellConfig()
    with closing(_cell(config)) as cell:
        labels = [entry.label for entry in config.simulator.objects]
        taught = grasps_of(cell.controller, config.sequence, labels, 3)
        recognizer = train(taught, "shrinkage_lda").recognizer
        grasps, virtual_s, seed = 0, 0.0, 1000
        while grasps < n_grasps:
            seed += 1
            grasps += steady(cell, config, BLOCK // 2, seed)
            done, passed_s = shift(config, recognizer, BLOCK // 2, seed)
            grasps, virtual_s = grasps + done, virtual_s + passed_s
            # The messages of a frame that is on its way now are no leak.
            cell.simulated.can_bus.flush()
            yield look(grasps, virtual_s + _now_s(cell))


def slopes(samples: Sequence[ResourceUse]) -> dict[str, float]:
    """Return the growth for each grasp after the warm-up: the median slope of all pairs.

    The median (Theil and Sen) does not follow single steps, as an allocator makes them.
    """
    kept = samples[int(WARM_UP * len(samples)) :]
    if len(kept) < 2:
        raise ValueError(f"{len(samples)} blocks are too few for a slope; let it run longer")
    # A slope needs no more than some hundred points, and has a pair for each two of them.
    thinned = kept[:: max(1, len(kept) // 400)]
    done = np.array([float(sample.done) for sample in thinned])
    first, second = np.triu_indices(len(thinned), k=1)
    found = {}
    for name in LIMITS:
        values = np.array([float(getattr(sample, name)) for sample in thinned])
        rises = (values[second] - values[first]) / (done[second] - done[first])
        found[name] = float(np.median(rises))
    return found


def grown(samples: Sequence[ResourceUse], limits: Mapping[str, float] = LIMITS) -> list[str]:
    """Return what grows faster than its limit."""
    return [
        f"{name} grow by {slope:.4f} each, allowed are {limits[name]:g}"
        for name, slope in slopes(samples).items()
        if slope > limits[name]
    ]


def show_growth(samples: Sequence[ResourceUse], limits: Mapping[str, float] = LIMITS) -> list[str]:
    """Print what grew after the warm-up; return what grows faster than its limit."""
    kept = samples[int(WARM_UP * len(samples)) :]
    for name, slope in slopes(samples).items():
        start, end = getattr(kept[0], name), getattr(kept[-1], name)
        highest = max(getattr(sample, name) for sample in kept)
        line(
            f"  {name}",
            f"{start} after {kept[0].done}, {end} at the end, {highest} at most; {slope:+.5f} "
            f"each, allowed {limits[name]:g}",
        )
    return grown(samples, limits)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.performance.soak", description=__doc__
    )
    parser.add_argument("--grasps", type=int, default=10_000)
    wanted = parser.parse_args(arguments)
    samples: list[ResourceUse] = []
    start_s = next_row_s = time.monotonic()
    for sample in soak(wanted.grasps):
        samples.append(sample)
        if time.monotonic() >= next_row_s:
            line("  so far", str(sample))
            next_row_s = time.monotonic() + 30.0
    last, wall_s = samples[-1], time.monotonic() - start_s
    line("soak", f"{last.done} grasps, {last.virtual_s / 3600:.1f} h of the cell")
    line("  took", f"{wall_s / 60:.1f} min, {1e3 * wall_s / last.done:.0f} ms a grasp")
    if len(threading.enumerate()) != 1:
        sys.exit(f"threads are left: {threading.enumerate()}")
    if bad := show_growth(samples):
        sys.exit("; ".join(bad))


if __name__ == "__main__":
    main()
