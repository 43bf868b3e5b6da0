"""How late the periods of the force loop begin over pseudo-terminals, on a free and a busy machine.

The loop has its own process, as in operation. The simulated cell has another one, with real-time
priority if the system grants it, because real servos need no processor of this machine. It is
measured on the machine as it is, and with as many busy processes as processors.

A period counts as late if it begins more than half a period late.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks._measure import line
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.errors import CellError
from cell.hand.client import HandProcess
from cell.pytest_plugin.process import CellProcess
from gripper.errors import GripperError
from gripper.force.ramp import ForceRamp
from gripper.force.timing import LoopStatistics
from tactile.errors import TactileError

_RATES_HZ = (200, 500)


@contextlib.contextmanager
def running(programs: Sequence[subprocess.Popen[Any]]) -> Iterator[None]:
    """End other programs with the block."""
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def busy(n_processes: int) -> contextlib.AbstractContextManager[None]:
    """Keep processors busy with other programs of ordinary priority."""
    burner = [sys.executable, "-c", "while True: pass"]
    return running([subprocess.Popen(burner) for _ in range(n_processes)])


def figures(loop: LoopStatistics) -> str:
    late = loop.lateness
    return (
        f"p50 {1e3 * late.p50_s:.3f}, p99 {1e3 * late.p99_s:.3f}, "
        f"p99.9 {1e3 * late.p999_s:.3f}, max {1e3 * late.max_s:.3f} ms; "
        f"{loop.late} of {loop.cycles} late"
    )


@contextlib.contextmanager
def real_time_cell(**changes: Any) -> Iterator[tuple[CellProcess, CellConfig]]:
    """Run the simulated cell in a process of its own; give it, and a config that reaches it."""
    process = CellProcess(CellConfig())
    try:
        yield process, changed_config(load_config(process.config_path), changes)
    finally:
        process.end()


def whole_path(rate_hz: int, hold_s: float) -> str:
    """Grasp and hold over pseudo-terminals; return the figures, or why there are none."""
    with real_time_cell(**{"gripper.loop_rate_hz": float(rate_hz)}) as (cell, config):
        hand = HandProcess(config)
        try:
            hand.start()
            hand.start_sensor()
            hand.open(lambda _cycle, _frames: None)
            hand.tare(50)
            cell.ask(place="box")
            hand.grasp(ForceRamp.linear(4.0, 5.0, hold_s), lambda _cycle, _frames: None)
            hand.release()
        except (CellError, GripperError, TactileError) as error:
            return f"ended early: {error}"
        finally:
            with contextlib.suppress(CellError):
                hand.shutdown()
            hand.close()
        loop = hand.statistics.loop
        read = loop.transaction
        return (
            f"{figures(loop)}, {loop.overruns} overruns; servos read in p50 "
            f"{1e3 * read.p50_s:.2f}, p99 {1e3 * read.p99_s:.2f} ms; force at most "
            f"{1e3 * loop.sensor_age.max_s:.0f} ms old"
        )


def main(effort: float = 1.0) -> None:
    processors = os.cpu_count() or 1
    duration_s = max(0.2, 5.0 * effort)
    short = effort < 0.1
    line("compared", f"grasps with a hold of {duration_s:g} s, {processors} processors")
    line("load before", f"{os.getloadavg()[0]:.1f} (others' programs count as well)")
    for n_busy in (0,) if short else (0, processors):
        with busy(n_busy):
            for rate_hz in _RATES_HZ[:1] if short else _RATES_HZ:
                line(f"  {rate_hz} Hz, {n_busy} busy", whole_path(rate_hz, duration_s))
