"""How late the periods of the force loop begin, against a plain thread with `time.sleep`.

Ours on a null bus: the gripper's loop in a process of its own, as the product sets it up, with
servos that answer at once. Plain: a thread that sleeps from deadline to deadline, in an interpreter
whose main thread computes, as a program that classifies does. In turns, on the machine as it is and
with as many busy processes as there are processors. Then the whole path: our process on
pseudo-terminals against the simulated cell in a process of its own, which gets real-time priority
where the system grants it (real servos wait for no processor).

Late is a period that begins more than half a period late.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks._measure import in_turns, line, repeats
from cell.config.file import changed_config, load_config
from cell.control.plan import Pose
from cell.control.positioner import SocketPlacer
from cell.errors import CellError
from cell.hand.client import HandProcess
from gripper.errors import GripperError
from gripper.force.ramp import ForceRamp
from gripper.force.timing import Distribution, LoopStatistics
from tactile.errors import TactileError

_RATES_HZ = (200, 500)
_PROGRAM = (sys.executable, "-c", "from cell.interfaces.cli import main; main()")


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


def worker(kind: str, rate_hz: float, duration_s: float) -> tuple[LoopStatistics, list[str]]:
    """Run one loop in a process of its own; return its figures, and what was refused to it."""
    program = [sys.executable, "-m", "benchmarks.performance._loop_workers"]
    done = subprocess.run(
        [*program, kind, str(rate_hz), str(duration_s)],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    found = json.loads(done.stdout)
    plain = found["statistics"]
    lateness = Distribution(**plain["lateness"])
    loop = LoopStatistics(cycles=plain["cycles"], late=plain["late"], lateness=lateness)
    return loop, found["notes"]


def figures(loop: LoopStatistics) -> str:
    late = loop.lateness
    return (
        f"p50 {1e3 * late.p50_s:.3f}, p99 {1e3 * late.p99_s:.3f}, "
        f"p99.9 {1e3 * late.p999_s:.3f}, max {1e3 * late.max_s:.3f} ms; "
        f"{loop.late} of {loop.cycles} late"
    )


def middle(runs: Sequence[LoopStatistics]) -> LoopStatistics:
    """Return medians over the rounds, sums of what was counted, the largest maximum."""
    late = [run.lateness for run in runs]
    return LoopStatistics(
        cycles=sum(run.cycles for run in runs),
        late=sum(run.late for run in runs),
        lateness=Distribution(
            p50_s=median(one.p50_s for one in late),
            p99_s=median(one.p99_s for one in late),
            p999_s=median(one.p999_s for one in late),
            max_s=max(one.max_s for one in late),
        ),
    )


def compare(rates_hz: Sequence[int], duration_s: float, rounds: int) -> list[str]:
    """Print both loops on one machine as it is now; return what was refused to ours."""
    notes: list[str] = []
    for rate_hz in rates_hz:
        kinds = {"ours, null bus": "ours", "plain thread": "plain"}
        cases = {name: partial(worker, kind, rate_hz, duration_s) for name, kind in kinds.items()}
        for name, found in in_turns(cases, rounds).items():
            line(f"  {name}, {rate_hz} Hz", figures(middle([loop for loop, _ in found])))
            notes = notes or found[0][1]
    return notes


@contextlib.contextmanager
def simulated_cell() -> Iterator[dict[str, Any]]:
    """Run the simulated cell in a process of its own; give what it announces."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [*_PROGRAM, "simulate", "--out", folder],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()
            process.communicate()


def whole_path(rate_hz: int, hold_s: float) -> str:
    """Grasp and hold over pseudo-terminals; return the figures, or why there are none."""
    with simulated_cell() as hello:
        config = load_config(Path(hello["config"]))
        config = changed_config(config, {"gripper.loop_rate_hz": float(rate_hz)})
        placer = SocketPlacer(hello["positioner_socket"])
        hand = HandProcess(config)
        try:
            hand.start()
            hand.start_sensor()
            hand.open(lambda _cycle, _frames: None)
            hand.tare(50)
            placer.place("box", Pose())
            hand.grasp(ForceRamp.linear(4.0, 5.0, hold_s), lambda _cycle, _frames: None)
            hand.release()
        except (CellError, GripperError, TactileError) as error:
            return f"ended early: {error}"
        finally:
            with contextlib.suppress(CellError):
                hand.shutdown()
            hand.close()
            placer.close()
        loop = hand.statistics.loop
        read = loop.transaction
        return (
            f"{figures(loop)}, {loop.overruns} overruns; servos read in p50 "
            f"{1e3 * read.p50_s:.2f}, p99 {1e3 * read.p99_s:.2f} ms; force at most "
            f"{1e3 * loop.sensor_age.max_s:.0f} ms old"
        )


def main(effort: float = 1.0) -> None:
    processors = os.cpu_count() or 1
    rounds = repeats(3, effort)
    duration_s = max(0.2, 5.0 * effort)
    short = effort < 0.1
    rates_hz = _RATES_HZ[:1] if short else _RATES_HZ
    begin_s = time.monotonic()
    line("compared", f"{rounds} rounds in turns of {duration_s:g} s each, {processors} processors")
    line("load before", f"{os.getloadavg()[0]:.1f} (others' programs count as well)")
    line("machine as it is", "")
    notes = compare(rates_hz, duration_s, rounds)
    with busy(processors):
        line(f"{processors} busy processes beside", "")
        compare(rates_hz, duration_s, rounds)
    for note in notes:
        line("  NOTE", note)
    line("over pseudo-terminals", "our process against the simulated cell in another")
    for n_busy in (0,) if short else (0, processors):
        with busy(n_busy):
            for rate_hz in rates_hz:
                line(f"  {rate_hz} Hz, {n_busy} busy", whole_path(rate_hz, duration_s))
    line("seconds", f"{time.monotonic() - begin_s:.0f}")


if __name__ == "__main__":
    main()
