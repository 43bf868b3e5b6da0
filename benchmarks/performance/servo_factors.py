"""The main job on cells whose servos differ from the catalogue, and that have never measured them.

Five objects are taught with six grasps each, and each is identified four times. Friction is 0.5 to
3 times, torque and back-EMF are 0.7 to 1.3 times those of the catalogue, on both fingers or on the
first one alone. A fault ends a run. Times are those of the simulated cell without the first three
grasps.

``--warm-up`` starts cold servos instead, whose temperature then changes ten times as fast as real
ones. The cell grips, holds and releases one part for six minutes, as for an hour of warming up.
Forces are the true ones on both pads, in each period of the holds.

    python -m benchmarks.performance.servo_factors [--gearing NAME] [--warm-up]
"""

import argparse
from contextlib import closing
from dataclasses import dataclass
from statistics import fmean

from benchmarks._measure import line, repeats
from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.control.records import GraspRecord
from cell.errors import CellError
from cell.jobs.collection import Collection
from cell.jobs.identify import identify
from cell.jobs.teach import teach
from cell.learning.taught_model import TaughtModel
from cell.simulation import simulation_of
from gripper.errors import GripperError
from simulator.servo.gearing import GEARINGS
from simulator.servo.motor import AMBIENT_C, THERMAL_TIME_CONSTANT_S
from tactile.errors import TactileError

FRICTIONS, KTS = (0.5, 1.0, 1.5, 2.0, 3.0), (0.7, 1.0, 1.3)
TAUGHT, IDENTIFIED, FIRST = 6, 4, 3
"""Grasps taught and identifications of each object, and grasps whose time does not count."""

COLD_C, FASTER = 5.0, 10.0
"""Temperature of cold servos in degrees Celsius, and factor on the speed of its changes."""
GRIPPED_N, HELD_S, SETTLED_S = 5.0, 2.0, 0.3
"""Force of each grip in N, and time in s for which the part is held then with the force of a carry,
which counts after a part of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRun:
    """One main job."""

    right: int
    asked: int
    """Identifications with the right answer, and all that were to be made."""
    grasp_s: float
    """Mean time in s of the grasps of the parts done, without the first ones; 0 without any."""
    true_n: float
    cap_n: float
    """Largest true force on a pad, and cap of the force, in N."""
    error: Exception | None
    """What ended the job; None where it was done."""

    def __str__(self) -> str:
        end = "" if self.error is None else f"; {type(self.error).__name__}: {self.error}"
        return (
            f"{self.right:2d} of {self.asked} right, {self.grasp_s:.2f} s a grasp, "
            f"{self.true_n:5.2f} N of {self.cap_n:g} N{end:.110}"
        )


def job(
    friction: tuple[float, float],
    kt: tuple[float, float],
    *,
    gearing: str = "ideal",
    n_objects: int = 5,
) -> JobRun:
    """Teach and identify on a new cell whose two servos have these factors."""
    keys = {"friction": list(friction), "kt": list(kt), "gearing": gearing}
    config = changed_config(CellConfig(), {f"simulator.servos.{key}": keys[key] for key in keys})
    labels = [entry.label for entry in config.simulator.objects][:n_objects]
    records: list[GraspRecord] = []
    true_n, right, error = 0.0, 0, None
    with simulation_of(config) as simulated:

        def look(_now_s: float) -> None:
            nonlocal true_n
            true_n = max(true_n, *simulated.world.contact_force_n())

        simulated.clock.on_advance.append(look)
        with closing(build_cell(config, simulated=simulated)) as cell:
            controller, model = cell.controller, TaughtModel(config)
            try:
                controller.start()
                for seed, label in enumerate(labels):
                    one = Collection(label=label, n_planned=TAUGHT)
                    teach(controller, model, one, seed=seed, on_grasp=lambda _so_far: None)
                    records += one.records
                model.train()
                for seed in range(IDENTIFIED * len(labels)):
                    held = labels[seed % len(labels)]
                    found = identify(controller, model, presented=held, seed=1000 + seed)
                    right += found.label == held
                    records += found.records
            except (CellError, GripperError, TactileError) as caught:
                error = caught
    times_s = [record.duration_s for record in records[FIRST:]]
    return JobRun(
        right=right,
        asked=IDENTIFIED * len(labels),
        grasp_s=sum(times_s) / max(1, len(times_s)),
        true_n=true_n,
        cap_n=config.gripper.force_max_n,
        error=error,
    )


def warm_up(*, gearing: str = "ideal", duration_s: float = 3600.0) -> None:
    """Print the temperature and the force of grips of a cell whose servos start cold."""
    keys = {"servos.gearing": gearing, "faults": [f"servos.cold={COLD_C:g}degC"]}
    config = changed_config(CellConfig(), {f"simulator.{key}": keys[key] for key in keys})
    held_n, last_s, worst_n = config.sequence.carry_force_n, 0.0, 0.0
    with simulation_of(config) as simulated:
        motors = simulated.devices.mechanics.motors

        def heat(now_s: float) -> None:
            nonlocal last_s
            share = (FASTER - 1.0) * (now_s - last_s) / THERMAL_TIME_CONSTANT_S
            last_s = now_s
            for motor in motors:
                motor.temperature_c += share * (AMBIENT_C - motor.temperature_c)

        simulated.clock.on_advance.append(heat)
        with closing(build_cell(config, simulated=simulated)) as cell:
            controller = cell.controller
            controller.start()
            while last_s < duration_s / FASTER:
                controller.moves.present(config.simulator.objects[0].label)
                begin_c = motors[0].temperature_c
                controller.grip(GRIPPED_N, Pose())
                begin_s, forces_n = last_s, []
                while last_s < begin_s + HELD_S:
                    controller.life.tick()
                    if last_s > begin_s + SETTLED_S:
                        forces_n.append(fmean(simulated.world.contact_force_n()))
                controller.release()
                worst_n = max(worst_n, *(abs(force_n - held_n) for force_n in forces_n))
                where = f"{FASTER * begin_s / 60.0:4.1f} min, {begin_c:.1f} C"
                line(where, f"{min(forces_n):.2f} to {max(forces_n):.2f} N of {held_n:g}")
    line("warm-up", f"largest error of the force {worst_n:.2f} N")


def main(effort: float = 1.0, *, gearing: str = "ideal") -> None:
    n_objects = repeats(5, effort, least=2)
    cases = [(f, kt, both) for both in (True, False) for f in FRICTIONS for kt in KTS]
    cases = cases[:: max(1, round(0.1 / effort))]
    line("compared", f"{len(cases)} main jobs of {n_objects} objects, gearing {gearing}")
    runs: list[JobRun] = []
    for friction, kt, both in cases:
        others = (friction, kt) if both else (1.0, 1.0)
        runs.append(
            job((friction, others[0]), (kt, others[1]), gearing=gearing, n_objects=n_objects)
        )
        where = "both fingers" if both else "one finger"
        line(f"{where} {friction:g}, kt {kt:g}", str(runs[-1]))
    done = [run for run in runs if run.error is None]
    right, asked = (sum(getattr(run, name) for run in runs) for name in ("right", "asked"))
    line(
        "all", f"{len(runs) - len(done)} of {len(runs)} ended by a fault, {right} of {asked} right"
    )
    slowest_s, most = max(run.grasp_s for run in runs), max(run.true_n / run.cap_n for run in runs)
    line("", f"slowest {slowest_s:.2f} s a grasp, largest true force {most:.2f} of its cap")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The main job with servos off the catalogue.")
    parser.add_argument("--warm-up", action="store_true", help="an hour of cold servos instead")
    parser.add_argument("--gearing", default="ideal", choices=tuple(GEARINGS))
    given = parser.parse_args()
    (warm_up if given.warm_up else main)(gearing=given.gearing)
