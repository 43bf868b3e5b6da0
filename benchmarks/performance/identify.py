"""Times of the simulated cell: of a start, and from the command to a named part.

The part is released or kept, with ramps that end early and with whole ramps. Computing takes no
virtual time. Its CPU time is added if it is longer than the motion during which a real-time cell
computes.
"""

import statistics
import time
from collections import Counter
from contextlib import closing

from benchmarks._measure import line, repeats
from benchmarks.recognition.other_cell import NEVER_TAUGHT
from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.plan import Keep
from cell.learning.taught_model import TaughtModel
from cell.runtime.goals import IdentifyGoal, SortGoal, TeachGoal
from cell.runtime.tasks import ModelFile, Tasks, simulated_feed
from cell.runtime.worker import Report
from recognition.recognizer import UNKNOWN

WAYS = (
    ("let go", Keep.NEVER, False, ("releasing",)),
    ("let go, whole ramps", Keep.NEVER, True, ("releasing",)),
    ("kept", Keep.ALWAYS, False, ("backing_off", "holding")),
    ("kept, whole ramps", Keep.ALWAYS, True, ("backing_off", "holding")),
)
"""Ways to identify, whether ramps are whole, and the phases beside which the answer is computed."""


def starts() -> None:
    """Print the times of a start of the cell without and with a self-zero."""
    for when in ("never", "daily"):
        with closing(build_cell(changed_config(CellConfig(), {"self_zero": when}))) as cell:
            began_s = cell.simulated.clock.monotonic()
            cell.controller.start()
            line(f"start, self-zero {when}", f"{cell.simulated.clock.monotonic() - began_s:.1f} s")


def from_the_command(n_teach: int, rounds: int) -> None:
    """Print the times of a cell from the command to the end of its work, by phase."""
    config = CellConfig()
    labels = [entry.label for entry in config.simulator.objects]
    new = [{"label": label, "shape": text} for label, text in NEVER_TAUGHT.items()]
    objects = [entry.model_dump() for entry in config.simulator.objects] + new
    config = changed_config(config, {"simulator.objects": objects})
    with closing(build_cell(config)) as cell:
        controller, model = cell.controller, TaughtModel(config)
        clock, spent_s = cell.simulated.clock, Counter[str]()
        tasks, unshown = (
            Tasks(controller, ModelFile(model, None)),
            Report(0, lambda **_fields: None),
        )
        controller.start()
        for seed, label in enumerate(labels):
            goal = TeachGoal(label=label, grasps=n_teach, seed=seed, train=False)
            tasks.teach(goal, unshown)
        model.train()
        last_s = [clock.monotonic()]

        def look(now_s: float) -> None:
            spent_s[controller.hand.phase.value] += now_s - last_s[0]
            last_s[0] = now_s

        def answering_s(answer: Identification) -> float:
            began_s = time.process_time()
            for record in answer.records:
                model.recognizer.posterior(record.grasp)
                model.shape_of(record.grasp)
            return time.process_time() - began_s

        clock.on_advance.append(look)
        for what, keep, whole, phases in WAYS:
            totals_s, phases_s, n_grasps = list[float](), dict[str, list[float]](), 0
            names = Counter[str]()
            for turn, held in enumerate(labels * rounds):
                spent_s.clear()
                how = {"seed": 1000 + turn, "keep": keep.value, "whole_ramps": whole}
                answer, _ = tasks.named(IdentifyGoal(present=held, **how))
                motion_s = dict(spent_s)
                if answer.in_grip:
                    controller.release()
                computing_s = answering_s(answer)
                alone_s = computing_s - sum(motion_s.get(name, 0.0) for name in phases)
                totals_s.append(sum(motion_s.values()) + max(0.0, alone_s))
                for name, value_s in (*motion_s.items(), ("computing", computing_s)):
                    phases_s.setdefault(name, []).append(value_s)
                names[{held: "right", UNKNOWN: UNKNOWN}.get(answer.label, "wrong")] += 1
                n_grasps += len(answer.records)
            line(
                what,
                f"from the command median {statistics.median(totals_s):.2f} s, largest "
                f"{max(totals_s):.2f} s, n = {len(totals_s)}, {n_grasps} grasps, {dict(names)}",
            )
            for name, values_s in phases_s.items():
                line(f"  {name}", f"{statistics.median(values_s):.3f} s, {max(values_s):.3f} s")
        feed = simulated_feed(CellConfig(), 5 * rounds)
        started_s = clock.monotonic()
        count = tasks.sort(SortGoal(parts=len(feed), feed=tuple(feed), seed=0), unshown)
        part_s = (clock.monotonic() - started_s) / max(1, count.n_parts)
        line("sort", f"{3600.0 / part_s:.0f} parts an hour, {part_s:.2f} s a part, n = {len(feed)}")
        # At the end: fingers that have met a wider part slow down earlier.
        for what, keep, whole, _ in WAYS[:2]:
            names = Counter[str]()
            for turn, held in enumerate([*NEVER_TAUGHT] * rounds):
                how = {"seed": 2000 + turn, "keep": keep.value, "whole_ramps": whole}
                names[tasks.named(IdentifyGoal(present=held, **how))[0].label] += 1
            line(f"  {what}, never taught", f"{names[UNKNOWN]} of {names.total()} {UNKNOWN}")


def main(effort: float = 1.0) -> None:
    line("compared", "times of the simulated cell")
    starts()
    from_the_command(repeats(20, effort, least=3), repeats(8, effort))
