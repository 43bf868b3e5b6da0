"""How much faster than real time the simulated cell runs, and what its parts cost."""

import signal
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from benchmarks._measure import line, repeats
from cell.build import build_cell
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from simulator.cell import SimulatedCell
from simulator.world.shapes import ObjectPose

_ROOT = Path(__file__).parents[2]
_LOOK_S = 0.002
"""Time of the processor in s from one look at the program to the next."""
_LEAST_SHARE = 0.02
"""Chapters with a smaller share are summed up."""


class Shares:
    """Looks at the running program: the chapter of the innermost function that is ours."""

    def __init__(self) -> None:
        self.looks: Counter[str] = Counter()

    def _look(self, _signal: int, frame: FrameType | None) -> None:
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(_ROOT) and "site-packages" not in path.parts:
                self.looks["/".join(path.relative_to(_ROOT).parts[:2]).removesuffix(".py")] += 1
                return
            frame = frame.f_back

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Look while the block runs; in the main thread only."""
        before = signal.signal(signal.SIGPROF, self._look)
        signal.setitimer(signal.ITIMER_PROF, _LOOK_S, _LOOK_S)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.signal(signal.SIGPROF, before)


def main(effort: float = 1.0) -> None:
    n_grasps = repeats(20, effort, least=1)
    cell = build_cell(CellConfig())
    cell.controller.start()
    cell.controller.present("ball")
    assert cell.simulated is not None
    clock, shares = cell.simulated.clock, Shares()
    virtual_s, start_s = clock.monotonic(), time.process_time()
    with shares.taken():
        for i in range(n_grasps):
            cell.controller.grasp(GraspStep(pose=Pose(rotation_rad=0.1 * i), force_n=5.0))
    spent_s, passed_s = time.process_time() - start_s, clock.monotonic() - virtual_s
    cell.close()
    line("compared", f"{n_grasps} grasps of the whole cell, drivers and protocols included")
    line("  grasp", f"{spent_s / n_grasps:.3f} s CPU for {passed_s / n_grasps:.2f} s of the cell")
    line("  ratio", f"{passed_s / spent_s:.1f} simulated s for 1 s of processor")
    n_looks = max(1, shares.looks.total())
    rest = 1.0
    for chapter, n in shares.looks.most_common():
        if n / n_looks >= _LEAST_SHARE:
            rest -= n / n_looks
            line(f"  {chapter}", f"{n / n_looks:.0%}")
    line("  all others", f"{rest:.0%}")
    with SimulatedCell() as world:
        world.place("cylinder", ObjectPose(rotation_rad=0.3))
        start_s = time.process_time()
        seconds = repeats(5, effort, least=1)
        world.clock.sleep(float(seconds))
        step_us = 1e6 * (time.process_time() - start_s) / (1000 * seconds)
        line("  world and servos", f"{step_us:.1f} us a step of 1 ms")
        n_scans = repeats(2000, effort, least=10)
        start_s = time.process_time()
        for _ in range(n_scans):
            world.world.scan()
        line("  scan", f"{1e6 * (time.process_time() - start_s) / n_scans:.0f} us for 408 taxels")


if __name__ == "__main__":
    main()
