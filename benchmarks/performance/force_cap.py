"""Random configs against the cap of the force: the true force on the pads in each step of a grasp.

The keys that make the fingers fast, strong or late are drawn from their whole ranges; with each
valid config the simulated cell grasps a random part once, its torque figures and friction wrong by
a random share. In half of them all pads fail: from the start, or at a random time of the approach
or the grip. The cap is broken where the true force is more than `ALLOWED_N` above it, and that is
silent where the grasp ends without a fault. The limits were tuned on the seeds from 9000 on.
"""

import random
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from typing import Any, NamedTuple

from benchmarks._measure import line, repeats
from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.errors import CellError
from cell.simulation import simulation_of
from gripper.dynamixel.models import MODELS
from gripper.errors import ForceAboveCap, GripperError
from gripper.settings import largest_setpoint_n
from tactile.errors import TactileError

ALLOWED_N = 0.3
"""True force above the cap in N that does not count: less than the noise of a sample."""
_FIRST_SEED = 20_000
_KT_ERROR, _FRICTION_ERROR = 0.1, 0.2
"""Largest shares by which torque constant and friction of a servo differ from its model's."""
_PAD = {"face": "inner", "rows": 11, "columns": 4, "pitch_x_mm": 5.0, "pitch_y_mm": 5.0}
_PADS = [_PAD | {"finger": finger} for finger in (0, 1)]
"""Pads of 55 x 20 mm as the paper's, of fewer taxels: less to compute."""
_PARTS = {
    "ball": "sphere:diameter=9.5mm",
    "box": "box:length=15.9mm,width=10mm,height=10mm",
    "pin": "cylinder:diameter=6mm,length=20mm",
    "rod": "cylinder:diameter=3mm,length=12mm",
    "plate": "box:length=60mm,width=25mm,height=8mm",
}
"""Parts from one that sinks in and then meets the bottom to one that presses all of the pads."""
_MODELS = ("XM430-W350", "XM430-W210", "XL330-M288", "XC330-M288")
_LINKAGES = [
    {"kind": "parallel_linkage", "link_mm": mm} for mm in (20.0, 30.0, 45.0, 60.0, 60.0, 90.0)
]
_LINKAGES += [{"kind": "rack_pinion", "pinion_radius_mm": mm} for mm in (8.0, 12.0, 20.0)]
_BLIND = ("unit.pads_empty", "taxels.off=1")
"""Faults that let all pads read zero."""
_FAILED_PADS = (_BLIND, _BLIND, ("unit.stuck",), ("unit.off",))
"""Ways in which all pads fail: twice as often disconnected as frozen or silent."""


def drawn_changes(seed: int) -> dict[str, Any]:
    """Return changes of the config by dotted path, drawn with a seed."""
    draw = random.Random(seed)
    cap_n = draw.choice((3.0, 5.0, 5.0, 8.0, 15.0, 15.0, 30.0, 30.0, 50.0))
    limit_n = largest_setpoint_n(cap_n)
    contact_n = min(draw.choice((0.3, 0.6, 0.6, 1.0, 2.0)), 0.5 * limit_n)
    force_n = max(draw.uniform(0.3, 1.0) * limit_n, contact_n, 0.5)
    rate_n_s = draw.choice((2.0, 5.0, 10.0, 20.0, 40.0, 50.0))
    model = draw.choice(_MODELS)
    return {
        "tactile.layout": {"name": "coarse", "adc_max": 255, "pads": _PADS},
        "tactile.tare_frames": 10,
        "tactile.force_period_ms": draw.choice((0, 0, 2, 2, 3, 5, 10, 20)),
        "tactile.sync_period_ms": draw.choice((10.0, 20.0, 20.0, 30.0)),
        "simulator.objects": [{"label": name, "shape": text} for name, text in _PARTS.items()],
        "simulator.noise_level": draw.choice((0.5, 1.0)),
        "gripper.servos": [
            {"id": i, "model": model} for i in draw.choice(((1,), (1, 2), (1, 2), (1, 2)))
        ],
        "gripper.linkage": draw.choice(_LINKAGES),
        "gripper.loop_rate_hz": draw.choice((100.0, 100.0, 200.0, 200.0, 400.0)),
        "gripper.aperture_open_mm": draw.choice((12.0, 14.0, 18.0, 25.0)),
        "gripper.approach_speed_mm_s": draw.choice((5.0, 20.0, 40.0, 60.0, 100.0, 200.0)),
        "gripper.contact_force_n": contact_n,
        "gripper.contact.samples": draw.choice((1, 3, 3, 6)),
        "gripper.contact.approach_force_n": draw.choice((0.3, 1.0, 1.0, 2.0, 5.0)),
        "gripper.force_max_n": cap_n,
        "gripper.current_max_a": draw.choice((0.35, 0.5, 0.7, 0.95))
        * MODELS[model].stall_current_a,
        "sequence.force_n": [force_n, force_n],
        "sequence.carry_force_n": force_n,
        "sequence.ramp.rate_n_s": rate_n_s,
        "sequence.ramp.hold_s": 0.1,
    }


class CapTrial(NamedTuple):
    """Grasp under one config."""

    seed: int
    """Of config, part and truth."""
    part: str
    """What was between the fingers."""
    harm: tuple[str, ...]
    """Faults of the pads; empty: they work."""
    cap_n: float
    true_n: float = 0.0
    """Cap of the force, and largest true force on a pad, in N."""
    phase: str = ""
    """Phase of the gripper at that force."""
    error: str = ""
    """Kind and text of the error that ended the grasp; empty where it was done."""
    refused: bool = False
    """Whether the config was refused, so that nothing moved."""

    @property
    def broken(self) -> bool:
        """Whether the true force was above the cap."""
        return self.true_n > self.cap_n + ALLOWED_N


def drawn_harm(seed: int) -> tuple[str, ...]:
    """Return the faults of the pads, drawn with a seed: none in half of the seeds."""
    draw = random.Random(f"pads {seed}")
    faults = draw.choice(_FAILED_PADS)
    begin = draw.choice(("", "moving", "contact") if faults is _BLIND else ("moving", "contact"))
    begin = begin and f"@{begin}+{draw.uniform(0.0, 1.0):.3f}s"
    return tuple(fault + begin for fault in faults) if seed % 2 else ()


def trial(seed: int, harm: tuple[str, ...] = ()) -> CapTrial:
    """Grasp once with a config that is drawn and some faults of the pads."""
    draw, drawn = random.Random(-seed), drawn_changes(seed)
    result = CapTrial(seed, draw.choice(tuple(_PARTS)), harm, float(drawn["gripper.force_max_n"]))
    try:
        config = changed_config(CellConfig(), drawn)
    except CellError as error:
        return result._replace(error=str(error), refused=True)
    with simulation_of(config) as simulated:
        for motor in simulated.devices.mechanics.motors:
            motor.kt_factor = 1.0 + draw.uniform(-_KT_ERROR, _KT_ERROR)
            motor.friction_factor = 1.0 + draw.uniform(-_FRICTION_ERROR, _FRICTION_ERROR)

        def look(_now_s: float) -> None:
            nonlocal result
            if (true_n := max(simulated.world.contact_force_n())) > result.true_n:
                result = result._replace(true_n=true_n, phase=cell.controller.hand.phase.value)

        simulated.clock.on_advance.append(look)
        for fault in harm:
            simulated.inject(fault)
        with closing(build_cell(config, simulated=simulated)) as cell:
            try:
                cell.controller.start()
                cell.controller.moves.present(result.part)
                cell.controller.grasp(GraspStep(pose=Pose(), force_n=config.sequence.forces_n[1]))
            except (CellError, GripperError, TactileError) as error:
                result = result._replace(error=f"{type(error).__name__}: {error}")
    return result


def main(effort: float = 1.0) -> None:
    n = repeats(500, effort, least=5)
    seeds = range(_FIRST_SEED, _FIRST_SEED + n)
    with ProcessPoolExecutor() as workers:
        trials = list(workers.map(trial, seeds, map(drawn_harm, seeds)))
    gripped = [run for run in trials if not run.refused]
    broken = sorted((run for run in gripped if run.broken), key=lambda run: run.cap_n - run.true_n)
    errors = [run.error for run in gripped if run.error]
    above = sum(error.startswith(ForceAboveCap.__name__) for error in errors)
    harmed = sum(bool(run.harm) for run in gripped)
    line("compared", f"{n} configs from seed {_FIRST_SEED} on, {n - len(gripped)} refused")
    line("", f"all pads fail in {harmed} of {len(gripped)}")
    line("not done", f"{len(errors)} ended with an error, {above} with the force above its cap")
    silent = sum(not run.error for run in broken)
    line("above the cap", f"{len(broken)} by more than {ALLOWED_N} N, {silent} without a fault")
    for run in broken:
        line("", str(run))
    highest = max((run.true_n / run.cap_n for run in gripped), default=0.0)
    line("  ratio", f"the largest true force is {highest:.2f} of its cap")
