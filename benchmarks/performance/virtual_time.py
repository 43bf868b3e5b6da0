"""How much faster than real time the simulated cell runs, and what its parts cost."""

import time

from benchmarks._measure import line, repeats
from cell.build import build_cell
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from simulator.cell import SimulatedCell
from simulator.world.shapes import ObjectPose


def main(effort: float = 1.0) -> None:
    n_grasps = repeats(20, effort, least=1)
    cell = build_cell(CellConfig())
    cell.controller.start()
    cell.controller.present("ball")
    clock = cell.simulated.clock
    virtual_s, start_s = clock.monotonic(), time.process_time()
    frames = 0
    for i in range(n_grasps):
        frames += cell.controller.grasp(
            GraspStep(pose=Pose(rotation_rad=0.1 * i), force_n=5.0)
        ).grasp.n_frames
    spent_s, passed_s = time.process_time() - start_s, clock.monotonic() - virtual_s
    cell.close()
    line("compared", f"{n_grasps} grasps of the whole cell, drivers and protocols included")
    line("  grasp", f"{spent_s / n_grasps:.3f} s CPU for {passed_s / n_grasps:.2f} s of the cell")
    line("  ratio", f"{passed_s / spent_s:.1f} times as fast as real time")
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
