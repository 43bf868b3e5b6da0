"""The loops whose lateness is compared, each run as a process of its own that prints its figures.

python -m benchmarks.performance._loop_workers ours|plain RATE_HZ DURATION_S
"""

import json
import sys
import threading
import time
from contextlib import nullcontext
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

from cell.config.model import LoopConfig
from cell.hand.real_time import enter_real_time, stop_collecting
from gripper.force.loop import Action, LoopRunner, Moment
from gripper.force.timing import Histogram
from gripper.servos.goals import ServoGoal
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import GripperPhase, GripperState, ServoState

_SERVO = ServoState(
    servo_id=1,
    angle_rad=0.1,
    velocity_rad_s=0.0,
    current_a=0.1,
    position_raw=2048,
    temperature_c=30.0,
    voltage_v=12.0,
    tick_ms=0,
    alert=False,
)


_GOALS = (ServoGoal(angle_rad=0.1, current_a=0.1),)


def _state() -> GripperState:
    return GripperState(
        t_s=time.monotonic(),
        aperture_m=0.01,
        aperture_velocity_m_s=0.0,
        current_a=0.1,
        force_from_current_n=1.0,
        temperature_c=30.0,
        voltage_v=12.0,
        servos=(_SERVO, _SERVO),
    )


def _ignore(*_anything: Any) -> None:
    pass


def null_servos() -> Any:
    """Return servos that answer at once and take everything: what is left is the loop itself."""
    return SimpleNamespace(
        read=_state,
        note_force=_ignore,
        check_force=_ignore,
        write_goals=_ignore,
        goal_current_a=0.1,
        in_loop=nullcontext,
    )


def ours(rate_hz: float, duration_s: float) -> dict[str, Any]:
    """Run the gripper's loop on a null bus, as the process of the force loop is set up."""
    notes = enter_real_time(LoopConfig())
    settings = GripperSettings(
        servos=(ServoSettings(servo_id=1), ServoSettings(servo_id=2)),
        loop_rate_hz=rate_hz,
        stall_max_s=5.0,
        overruns_max=1000,
    )
    sensor = SimpleNamespace(latest_force=lambda: None)
    health = SimpleNamespace(poll=_ignore)
    runner = LoopRunner(null_servos(), health, sensor, settings, time)  # type: ignore[arg-type]
    stop_collecting()
    end_s = time.monotonic() + duration_s

    def step(moment: Moment) -> Action:
        return Action(goals=_GOALS, done=moment.now_s >= end_s)

    runner.run(GripperPhase.HOLDING, step, None, needs_force=False)
    return {"statistics": asdict(runner.statistics), "notes": notes}


def plain(rate_hz: float, duration_s: float) -> dict[str, Any]:
    """Run a thread that sleeps from one period to the next, beside a main thread that computes."""
    period_s = 1.0 / rate_hz
    histogram = Histogram()
    late = 0
    over = threading.Event()

    def loop() -> None:
        nonlocal late
        due_s = time.monotonic()
        end_s = due_s + duration_s
        while due_s < end_s:
            due_s += period_s
            left_s = due_s - time.monotonic()
            if left_s > 0.0:
                time.sleep(left_s)
            late_s = max(0.0, time.monotonic() - due_s)
            histogram.add(late_s)
            late += late_s > 0.5 * period_s
            due_s += late_s
        over.set()

    threading.Thread(target=loop).start()
    total = 0
    while not over.is_set():
        total += sum(range(1000))
    found = histogram.distribution()
    return {"statistics": {"lateness": asdict(found), "late": late, "cycles": found.n}, "notes": ()}


if __name__ == "__main__":
    run = {"ours": ours, "plain": plain}[sys.argv[1]]
    print(json.dumps(run(float(sys.argv[2]), float(sys.argv[3]))))
