"""Comparison of sensors and grippers: each example config teaches and names the paper's objects.

A row is a whole simulated cell in virtual time. Each of five objects is taught with 20 grasps; ten
of each are named, with as many grasps as necessary. Errors of the held force and first touches are
true forces in the simulated world, not pad values, of the teaching grasps.

    python -m benchmarks sensors
    python -m benchmarks.recognition.sensors flexitac uskin
"""

import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from statistics import mean

import numpy as np

from benchmarks._measure import line, repeats
from cell.build import build_cell
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.learning.taught_model import TaughtModel
from cell.runtime.goals import IdentifyGoal
from cell.runtime.tasks import Collection, ModelFile, Tasks
from gripper.values.state import GripperPhase
from recognition.recognizer import UNKNOWN

DEFAULT = "default"
"""The config without a file: the paper's control unit on two XM430-W350."""
CASES = (DEFAULT, "flexitac", "uskin", "open-parallel-gripper", "rh-p12-rn")
"""Example configs in the comparison."""
_N_TEACH, _N_NAMED = 20, 10
"""Grasps to teach each object, and number of times each object is named."""
_SEED = 7000
"""Seed that was not used for tuning."""


def row(case: str, effort: float) -> str:
    """Return the figures of one case as a row of the table in the docs."""
    path = Path(__file__).resolve().parents[2] / "config" / f"{case}.yaml"
    config = CellConfig() if case == DEFAULT else load_config(path)
    config = config.model_copy(update={"seed": _SEED})
    labels = [entry.label for entry in config.simulator.objects][: None if effort >= 1.0 else 2]
    with closing(build_cell(config)) as cell:
        controller, model = cell.controller, TaughtModel(config)
        clock, world = cell.simulated.clock, cell.simulated.world
        errors_n, touches_n = list[float](), list[float]()
        before, held_n = GripperPhase.OFF, 0.0

        def look(_now_s: float) -> None:
            nonlocal before, held_n
            phase = controller.hand.phase
            if phase in (GripperPhase.RAMPING, GripperPhase.HOLDING):
                held_n = mean(world.contact_force_n())
            if phase is GripperPhase.RAMPING and before is GripperPhase.APPROACHING:
                touches_n.append(max(world.contact_force_n()))
            before = phase

        def held(so_far: Collection) -> None:
            errors_n.append(abs(held_n - so_far.records[-1].step.force_n))

        controller.start()
        if config.self_zero == "on_demand":
            controller.zeroing.measure()
        clock.on_advance.append(look)
        for seed, label in enumerate(labels):
            collection = Collection(label=label, n_planned=repeats(_N_TEACH, effort, least=6))
            collection.fill(controller, config.sequence, seed=seed, on_grasp=held)
            model.add(collection.grasps)
        model.train()
        names, took_s = Counter[str](), list[float]()
        tasks = Tasks(controller, ModelFile(model, None))
        for turn in range(repeats(_N_NAMED, effort) * len(labels)):
            label, start_s = labels[turn % len(labels)], clock.monotonic()
            answer, _ = tasks.named(IdentifyGoal(present=label, seed=1000 + turn))
            took_s.append(clock.monotonic() - start_s)
            names[{label: "right", UNKNOWN: UNKNOWN}.get(answer.label, "wrong")] += 1
        frames = controller.hand.statistics.source.frames
    return (
        f"{names['right']} | {names['wrong']} | {names[UNKNOWN]} | {{:.2f}}, {{:.2f}} N | ".format(
            *np.quantile(errors_n, (0.5, 0.95))
        )
        + "{:.2f}, {:.2f} N | ".format(*np.quantile(touches_n, (0.5, 1.0)))
        + "{:.1f}, {:.1f} s | ".format(*np.quantile(took_s, (0.5, 0.95)))
        + f"{frames.lost + frames.torn + frames.corrupt} of {frames.complete}"
    )


def main(effort: float = 1.0, cases: Sequence[str] = CASES) -> None:
    head = (
        "right | wrong | UNKNOWN | error of the held force, median and 95 % | first touch, median"
    )
    line("compared", f"{head} and largest | time to a name, median and 95 % | lost frames")
    for case in cases if effort == 1.0 else CASES[:2]:
        line(case, row(case, effort))


if __name__ == "__main__":
    main(cases=sys.argv[1:] or CASES)
