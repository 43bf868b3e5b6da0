"""Rows of the fault campaign: the simulated cell that they run on, and what was observed."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.performance.force_cap import trial
from cell.build import build_cell
from cell.config.file import changed_config, parse_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.control.records import GraspCollector, GraspRecord
from cell.control.states import CellState
from cell.errors import CellError, CellStateError, NoPartFound
from cell.fault_catalogue import BY_NUMBER
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JobFailed
from gripper.errors import GripperError
from gripper.values.state import GripperPhase
from pytest_tactile_cell.process import CellProcess
from pytest_tactile_cell.virtual import VirtualCell
from simulator.can.drive import SimulatedDrive
from tactile.errors import TactileError
from tests.cell.cells import Bench, once, quick_config
from tests.faults.invariants import InvariantMonitor
from tests.hil.program import CONFIG, SEQUENCE, child_of, ended, first
from tests.values import raising
from tests.waiting import LIMIT_S, until

JOB_BOUND_S = 60.0
"""Every job has to be over within so many s of simulated time; the longest takes 15 s."""
LATER_S = 1.0
"""So many s after a fault the grip is looked at again, with no host."""
CARRY_S = 1.5
"""A part is carried for so long in s."""
_CHAIN = 3
"""Faults in a row whose steps are taken: what is mended may show the next one."""
PRODUCT_ERRORS = (CellError, GripperError, TactileError)


@dataclass(frozen=True, slots=True)
class Observed:
    """What the cell did about a fault."""

    reaction: str
    """One of `tests.faults.table.REACTIONS`, or a word for what must not be, as ``LOST``."""
    detected_after_s: float | None
    """From the beginning of the fault until the cell detected it, in s; None where there is no such
    time."""
    outcome: str
    """One line: the message to the operator, and what became of the grip."""


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One variant of a kind of fault."""

    row: int
    """Number of its kind."""
    variant: str
    """What makes it differ from the other variants of this kind; may be empty."""
    injected: str
    """Text of the simulator's vocabulary of faults, or how else it is brought about."""
    reaction: str
    """What the cell has to do."""
    limit_s: float | None
    """Within which time in s the cell has to detect it; None where no time applies."""
    number: int | tuple[int, ...] = 0
    """Number of the latched fault, or of those that race for it; 0 where none is required."""
    scenario: "Callable[[FaultRow], Observed] | None" = None
    """Brings the fault about; None for `grasp_with_fault`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the config for it, see `campaign_config`."""
    real_time: bool = False
    """Whether it runs real processes in real time."""
    long: bool = False
    """Whether it takes more than a second, and runs before a release alone."""

    @property
    def name(self) -> str:
        """Number and variant, to find the row by."""
        return "-".join((f"{self.row:02d}", *self.variant.split()))

    def run(self) -> Observed:
        """Bring the fault about; raises InvariantBroken where the cell did what it never may."""
        return (self.scenario or grasp_with_fault)(self)

    def complaint(self, observed: Observed) -> str:
        """Return in what an observation differs from what the row requires; empty for nothing."""
        if observed.reaction != self.reaction:
            return f"reaction {observed.reaction}, required is {self.reaction}"
        if self.limit_s is None:
            return ""
        if observed.detected_after_s is None:
            return f"never detected, the limit is {1e3 * self.limit_s:.0f} ms"
        if observed.detected_after_s > self.limit_s:
            after_ms, limit_ms = 1e3 * observed.detected_after_s, 1e3 * self.limit_s
            return f"detected after {after_ms:.0f} ms, limit {limit_ms:.0f} ms"
        return ""


def campaign_config(changes: Mapping[str, Any] | None = None) -> CellConfig:
    """Return a config with coarse pads and short jobs; changes by dotted path."""
    short_jobs = {
        "gripper.aperture_open_mm": 11.0,
        "sequence.ramp.rate_n_s": 10.0,
        "sequence.ramp.hold_s": 0.3,
        "simulator.noise_level": 0.5,
    }
    return changed_config(quick_config(), short_jobs | dict(changes or {}))


@dataclass(frozen=True, kw_only=True)
class CampaignCell(Bench):
    """A simulated cell in virtual time, its controller, and the monitor that watches both."""

    monitor: InvariantMonitor
    """The invariants."""

    @property
    def now_s(self) -> float:
        return self.clock.monotonic()

    @property
    def grip(self) -> str:
        """State of the cell and what is held, in words."""
        held = "the grip is kept" if self.controller.life.holding else "nothing is held"
        return f"{self.controller.life.state.value}, {held} ({self.grip_n:.1f} N)"

    def start(self, present: str | None = "ball") -> VirtualCell:
        return super().start(present)

    @contextmanager
    def first_time(self, happens: Callable[[], bool]) -> Iterator[list[float]]:
        """Give a list that gets the time in s at which something is so first in the block."""
        reported_s = once(self.clock, happens, lambda: None)
        look = self.clock.on_advance[-1]
        try:
            yield reported_s
        finally:
            self.clock.on_advance.remove(look)


@contextmanager
def campaign_cell(changes: Mapping[str, Any] | None = None) -> Iterator[CampaignCell]:
    """Give a cell that is not started yet; at the end its invariants are checked.

    Raises
    ------
    InvariantBroken
        If the cell did what none may ever do.
    """
    config = campaign_config(changes)
    cell = build_cell(config)
    monitor = InvariantMonitor(cell.simulated, config.gripper)
    monitor.attach(cell)
    try:
        yield CampaignCell(config=config, cell=cell, simulated=cell.simulated, monitor=monitor)
    finally:
        monitor.close()
        cell.close()
    monitor.check()


def grasp_job(cell: CampaignCell, *, force_n: float = 3.0) -> None:
    cell.start()
    cell.grasp(force_n)


def carry_job(cell: CampaignCell) -> None:
    """Start, grip the ball, keep it and look at it."""
    cell.start()
    cell.controller.grip(3.0, Pose())
    cell.idle(CARRY_S)
    cell.controller.kept_part.verify()


def carry_with_fault(row: FaultRow) -> Observed:
    """Bring a fault about while a part is carried; its text has the time since the grip."""
    with campaign_cell(row.changes) as cell:
        seen = later(cell, observe(cell, row.injected, carry_job))
        fault = cell.controller.life.fault
        if fault is not None and not fault.endswith(" s after the grip"):
            return replace(seen, reaction="NO TIME", outcome=fault)
        return recovered(cell, row, seen)


def grasp_with_fault(row: FaultRow, *, look_again: bool = True, force_n: float = 3.0) -> Observed:
    """Inject what a row names, grasp, and look again later: nobody may have let go.

    The detection of the first fault of the row counts. A fault that goes on without an end shows
    nothing later: it is not looked at again. At last a person does what the catalogue says.
    """
    first, *more = row.injected.split(", ")
    with campaign_cell(row.changes) as cell:
        cell.monitor.limp_allowed = row.reaction == "LIMP"
        for text in more:
            cell.simulated.inject(text)
        seen = observe(cell, first, partial(grasp_job, force_n=force_n))
        return recovered(cell, row, later(cell, seen) if look_again else seen)


def observe(
    cell: CampaignCell,
    fault: str | Callable[[], Any] = "",
    job: Callable[[CampaignCell], Any] = grasp_job,
) -> Observed:
    """Inject a fault, run a job, and return what became of both.

    The fault is a text of the vocabulary, or a function that brings it about at once; empty where
    the job itself does.
    """
    monitor = cell.monitor
    injected = cell.simulated.inject(fault) if isinstance(fault, str) and fault else None
    if callable(fault):
        fault()
    began_s = cell.now_s
    monitor.watch_from()
    error: BaseException | None = None
    try:
        with monitor.bounded(JOB_BOUND_S):
            job(cell)
    except PRODUCT_ERRORS as caught:
        error = caught
    known_s = cell.now_s if monitor.latched_s is None else monitor.latched_s
    if injected is not None:
        if injected.began_s is None:
            raise RuntimeError(f"{injected.text} has not begun when the job was over")
        began_s = injected.began_s
    if error is not None:
        text = f"{type(error).__name__}: {error}; {cell.grip}"
        return Observed(_reaction(cell), max(0.0, known_s - began_s), text)
    if monitor.noted_s is not None:
        after_s = max(0.0, monitor.noted_s - began_s)
        return Observed("NOTE", after_s, f"counted; the job was done; {cell.grip}")
    return Observed("NOTHING", None, f"the job was done; {cell.grip}")


def _reaction(cell: CampaignCell) -> str:
    """Name what an error has done: refused a start, kept the grip, or found it gone."""
    if not cell.monitor.states & {CellState.IDLE, CellState.EXECUTE, CellState.HELD}:
        return "REJECT"
    servos = cell.simulated.devices.servo_bus.servos
    if any(servo.latched or servo.silent_until_s > 0.0 for servo in servos):
        return "ABORT"
    return "HOLD" if all(servo.torque_on for servo in servos) else "LIMP"


def later(cell: CampaignCell, seen: Observed) -> Observed:
    """Let a second pass without a host and add what is left of the grip.

    A device that is back again changes nothing: the cell goes on by a person alone.
    """
    if seen.reaction in {"NOTE", "NOTHING", "REJECT"}:
        return seen
    state = cell.controller.life.state
    cell.simulated.clock.sleep(LATER_S)
    cell.controller.life.tick()
    if cell.controller.life.state is not state:
        return replace(seen, reaction=f"went from {state} to {cell.controller.life.state}")
    return replace(seen, outcome=f"{seen.outcome}; {LATER_S:g} s later {cell.grip_n:.1f} N")


def recovered(
    cell: CampaignCell, row: FaultRow, seen: Observed, next_job: Callable[[], Any] = lambda: None
) -> Observed:
    """Look at the number of the fault that is latched, and take its steps: they lead back to IDLE.

    An encoder that leapt needs a person who pushes the finger: nobody does so here. At last the
    next job is done.
    """
    number = cell.controller.life.status.fault_number
    numbers = row.number if isinstance(row.number, tuple) else (row.number,)
    if 0 not in numbers and number not in numbers:
        return replace(seen, reaction=f"FAULT {number}")
    if not number or ".jump=" in row.injected:
        return seen
    for _ in range(_CHAIN):
        if number := cell.controller.life.status.fault_number:
            with cell.monitor.release_asked(), suppress(*PRODUCT_ERRORS):
                take_steps(cell, number)
    if cell.controller.life.state is CellState.IDLE:
        next_job()
        return seen
    life = cell.controller.life
    return replace(seen, reaction=f"STAYS {life.state}: {life.fault}")


def take_steps(cell: VirtualCell, number: int) -> None:
    """Do what the catalogue says after a fault; the cause of a simulated one can be mended."""
    controller = cell.controller
    for step in BY_NUMBER[number].steps:
        match step:
            case "mend" | "free_pads":
                cell.simulated.injector.clear_all()
            case "clear" | "clear_reboot":
                controller.life.clear(reboot=step == "clear_reboot")
            case "release" if controller.life.state is CellState.RESETTING:
                controller.release_held()
            case "release":
                controller.release()
            case "reset":
                controller.life.reset()
                controller.start()


# -- Axes that carry the part: the motion stops, the grip is not touched ---------------------------

X_AXIS = {
    "kind": "cia402", "moves": "x", "node_id": 11, "increments": 1000.0, "low": -6.0,
    "high": 6.0, "homing": "negative_switch", "home": -7.0, "homing_velocity": 20.0,
}  # fmt: skip
ROTATION_AXIS = {
    "kind": "cia402", "moves": "rotation", "node_id": 12, "increments": 100.0, "low": -10.0,
    "high": 100.0, "homing": "here", "home": 0.0, "velocity": 45.0,
}  # fmt: skip
WRIST = {"kind": "dynamixel", "moves": "roll", "zero_pulse": 1024, "low": -10.0, "high": 100.0}
CHANGES: dict[str, Any] = {
    "positioner": {"kind": "axes", "axes": [X_AXIS, ROTATION_AXIS, WRIST]},
    "sequence.y_mm": [0.0, 0.0],
    "sequence.rotation_deg": [0.0, 90.0],
    "sequence.roll_deg": [0.0, 90.0],
}
"""A cell with axis 1, a drive along x, axis 2, a drive that turns, and axis 3, a wrist."""
STOPPED_S = 0.6
"""So long after the fault all axes that can be stopped have to stand."""
STEP = GraspStep(pose=Pose(x_m=2e-3, rotation_rad=0.5, roll_rad=0.5), force_n=3.0)


def axis_fails(row: FaultRow) -> Observed:
    """Inject while the axes move to the second pose; then take the steps of the fault.

    It is detected when another drive than that of the axis that fails is in its quick stop.
    """
    with campaign_cell(CHANGES | dict(row.changes)) as cell:
        cell.start()
        cell.grasp()
        axes = cell.simulated.devices.axes
        drives = [axis for axis in axes.values() if isinstance(axis, SimulatedDrive)]
        failing = list(axes.values())[int(row.injected[len("axis")]) - 1]
        began_s = once(
            cell.clock,
            lambda: all(axis.moving for axis in axes.values()),
            lambda: cell.simulated.inject(row.injected),
        )

        def stopped() -> bool:
            others = [drive for drive in drives if drive is not failing]
            return any(drive.state == "QUICK STOP ACTIVE" for drive in others)

        with cell.first_time(stopped) as known_s:
            observed = observe(cell, job=lambda one: one.controller.grasp(STEP))
        cell.simulated.clock.sleep(STOPPED_S)
        silent = [drive for drive in drives if drive.dead]
        if any(axis.moving for axis in axes.values() if axis not in silent):
            return replace(observed, reaction="MOVES")
        cell.simulated.injector.clear_all()
        seen = replace(observed, detected_after_s=known_s[0] - began_s[0])
        return recovered(cell, row, seen, partial(cell.controller.grasp, STEP))


def drifts_between_grasps(row: FaultRow) -> Observed:
    """Inject while the cell is started and waits, then grasp."""
    with campaign_cell(row.changes) as cell:
        cell.start()
        fault = row.injected.partition(" ")[0]
        return observe(cell, fault, lambda one: (one.idle(0.2), one.grasp()))


# -- The host program: a slow loop, errors in its code, the wall clock -----------------------------


def loop_held_up(row: FaultRow, *, stall_s: float, times: int = 1) -> Observed:
    """Hold up the force loop of a grasp for so long, in so many periods in a row."""
    add, stalls_s = GraspCollector.add, list[float]()

    def held_up(collector: GraspCollector, cycle: Any, frames: Any) -> None:
        add(collector, cycle, frames)
        if cycle.setpoint_n > 2.0 and len(stalls_s) < times:
            stalls_s.append(cell.now_s)
            cell.simulated.clock.sleep(stall_s)

    with campaign_cell(row.changes) as cell, mock.patch.object(GraspCollector, "add", held_up):
        seen = observe(cell)
        latched_s = cell.monitor.latched_s
        after_s = None if latched_s is None else latched_s - stalls_s[0]
        return replace(seen, detected_after_s=after_s)


def error_in_the_loop(row: FaultRow) -> Observed:
    """Let what collects the periods of the loop raise in the ramp."""

    def broken(_collector: GraspCollector, cycle: Any, _frames: Any) -> None:
        if cycle.setpoint_n > 1.0:
            raise RuntimeError("sink broken")

    def job(cell: CampaignCell) -> None:
        cell.start()
        try:
            cell.grasp()
        except RuntimeError as error:
            raise CellStateError(str(error)) from error

    with campaign_cell(row.changes) as cell, mock.patch.object(GraspCollector, "add", broken):
        seen = observe(cell, job=job)
        after_s = None if cell.monitor.latched_s is None else 0.0
        return Observed(seen.reaction if cell.grip_n > 0.2 else "LOST", after_s, seen.outcome)


def error_in_the_mover(row: FaultRow) -> Observed:
    """Teach through the plugin with a robot whose driver raises."""
    broken = raising(ZeroDivisionError("robot driver"))
    with TactileCellPlugin(campaign_config(row.changes), mover=broken) as plugin:
        with suppress(JobFailed):
            plugin.result(plugin.start(TeachGoal(label="ball", grasps=3)), 30.0)
        status = plugin.status()
        latched = status.state == CellState.ABORTED and status.fault is not None
        return Observed("HOLD" if latched else "NOTHING", 0.0, f"{status.state}: {status.fault}")


def wall_clock_jumps(_row: FaultRow, *, step_s: float) -> Observed:
    """Grasp without and with a jump of the wall clock in the ramp, and compare all values."""
    before, before_s = _grasp_with_clock(0.0)
    jumped, jumped_s = _grasp_with_clock(step_s)
    same = (
        np.array_equal(before.grasp.counts, jumped.grasp.counts)
        and before.cycles == jumped.cycles
        and before_s == jumped_s
    )
    return Observed("NOTHING" if same else "DIFFERENT", None, "compared frame by frame")


@cache
def _grasp_with_clock(step_s: float) -> tuple[GraspRecord, float]:
    """Return a grasp during which the wall clock jumps, and how long it took in s."""
    offset_s = [0.0]
    now, now_ns = time.time, time.time_ns
    with (
        mock.patch("time.time", side_effect=lambda: now() + offset_s[0]),
        mock.patch("time.time_ns", side_effect=lambda: now_ns() + int(offset_s[0] * 1e9)),
        campaign_cell() as cell,
    ):
        jumped = cell.once_in(
            GripperPhase.RAMPING, lambda: offset_s.__setitem__(0, step_s), after_s=0.1
        )
        cell.start()
        record = cell.grasp()
        assert jumped
        return record, cell.now_s


# -- The process that commands a cell ends by an error --------------------------------------------


_GRIPPED_N = 1.0
"""Force in N at which a part counts as gripped."""
_HELD_N = 0.6
"""Force in N with which a part counts as still held."""
_HOST = f"""
import sys
from {TactileCellPlugin.__module__} import TactileCellPlugin
plugin = TactileCellPlugin(sys.argv[1])
plugin.start(dict(task="teach", label="box", grasps=50))
sys.stdin.readline()
raise RuntimeError("the host's own error")
"""
"""A host program that ends by an error of its own while a job runs, and closes nothing. Its main
module, which stands without `if __name__ == "__main__"`, is not run in the process of the loop."""


def host_ends_by_an_error(_row: FaultRow) -> Observed:
    """End a host program; the process of its force loop is left, and ends by itself.

    Host and simulated cell are processes, in real time.
    """
    with contextlib.ExitStack() as undo:
        cell = CellProcess(parse_config(CONFIG + SEQUENCE, source="campaign"))
        undo.callback(cell.end)
        first(cell.pid)
        program = Path(undo.enter_context(tempfile.TemporaryDirectory()), "host.py")
        program.write_text(_HOST)
        command = [sys.executable, "-P", str(program), str(cell.config_path)]
        pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        host = undo.enter_context(subprocess.Popen(command, **pipes))
        undo.callback(host.kill)
        cell.wait_for_grip(_GRIPPED_N, timeout_s=LIMIT_S)
        loop = child_of(host.pid)
        os.kill(loop, signal.SIGINT)  # the business of the program, as Ctrl-C goes to both
        threading.Event().wait(0.1)
        if ended(loop):
            return Observed("LOST", None, "the process of the force loop ends by SIGINT")
        host.communicate(timeout=LIMIT_S)
        began_s = time.monotonic()
        until(lambda: ended(loop))
        after_s, grip_n = time.monotonic() - began_s, cell.grip_n()
        return Observed("HOLD" if grip_n > _HELD_N else "LOST", after_s, f"{grip_n:.1f} N")


# -- Servos and part -------------------------------------------------------------------------------


CAP_N = 4.4
"""Cap of the force in N in the rows of something trapped. The law follows an object that grows, so
the cap is close to the set-points."""
_SEARCHED = range(20_000, 20_012)
"""Seeds of the configs that a row of the campaign grasps with."""
_WITH_THE_PART = frozenset({GripperPhase.APPROACHING, GripperPhase.RAMPING})


def part_leaves(row: FaultRow) -> Observed:
    """Grasp while the part goes; time runs until the fingers press no more."""
    with campaign_cell(row.changes) as cell:
        injected = cell.simulated.inject(row.injected)
        refusals: list[str] = []

        def job(cell: CampaignCell) -> None:
            try:
                grasp_job(cell)
            except NoPartFound as error:
                refusals.append(str(error))

        closed: set[bool] = set()

        def stopped() -> bool:
            """Tell whether the grasp has begun to close and closes no more."""
            closed.add(closing := cell.controller.hand.phase in _WITH_THE_PART)
            return True in closed and not closing

        with cell.first_time(stopped) as known_s:
            seen = observe(cell, job=job)
        if not refusals or not known_s or injected.began_s is None:
            return seen
        after_s = known_s[0] - injected.began_s
        return Observed(cell.controller.life.grasp_state.value, after_s, refusals[0])


def something_pushes(row: FaultRow) -> Observed:
    """Grasp while something pushes back; time counts from the moment the cap is passed."""
    with campaign_cell(row.changes) as cell:
        cell.monitor.world_pushes = True
        cell.monitor.limp_allowed = row.reaction == "LIMP"
        world = cell.simulated.world
        with cell.first_time(lambda: max(world.contact_force_n()) > CAP_N) as over_s:
            seen = observe(cell, row.injected)
        latched_s = cell.monitor.latched_s
        if latched_s is None or not over_s:
            return seen
        return later(cell, replace(seen, detected_after_s=latched_s - over_s[0]))


def fast_approach(row: FaultRow) -> Observed:
    """Grasp with a config that asks for more speed than can be stopped."""
    with campaign_cell(row.changes) as cell:
        return observe(cell)


def random_configs(_row: FaultRow) -> Observed:
    """Grasp once with each of some configs that were drawn; the true force stays below the cap."""
    trials = [trial(seed) for seed in _SEARCHED]
    broken = [one for one in trials if one.broken]
    if broken:
        return Observed("ABOVE THE CAP", None, str(broken[0]))
    highest = max(one.true_n / one.cap_n for one in trials if not one.refused)
    return Observed("NOTHING", None, f"the largest true force was {highest:.2f} of its cap")
