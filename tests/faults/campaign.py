"""A row of the fault campaign, the simulated cell that it runs on, and what was observed."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.control.states import CellState
from cell.errors import CellError
from cell.fault_catalogue import BY_NUMBER
from gripper.errors import GripperError, fingers_left
from pytest_tactile_cell.virtual import VirtualCell
from tactile.errors import TactileError
from tests.cell.conftest import COARSE_PADS, Bench, once
from tests.faults.invariants import InvariantMonitor

JOB_BOUND_S = 60.0
"""Every job has to be over within so many s of simulated time; the longest takes 15 s."""
LATER_S = 1.0
"""So many s after a fault the grip is looked at again, with no host."""
CARRY_S = 1.5
"""A part is carried for so long in s."""
_CHAIN = 3
"""Faults in a row whose steps are taken: what is mended may show the next one."""
OUTCOME_CHARACTERS = 160
"""Longest text of an error on the page."""
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
    fault: str
    """The fault in plain words."""
    injected: str
    """Text of the simulator's vocabulary of faults, or how else it is brought about."""
    reaction: str
    """What the cell has to do."""
    limit_s: float | None
    """Within which time in s the cell has to detect it; None where no time applies."""
    scenario: "Callable[[FaultRow], Observed] | None" = None
    """Brings the fault about; None for `grasp_with_fault`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the config for it, see `campaign_config`."""
    number: int | tuple[int, ...] = 0
    """Number of the latched fault, or of those that race for it; 0 where none is required."""
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
        "self_zero": "on_demand",
        "gripper.aperture_open_mm": 11.0,
        "tactile.layout": COARSE_PADS,
        "tactile.tare_frames": 10,
        "sequence.ramp": {"kind": "linear", "rate_n_s": 10.0, "hold_s": 0.3},
        "simulator.objects": [
            {"label": "ball", "shape": "sphere:diameter=9.5mm"},
            {"label": "box", "shape": "box:length=15.9mm,width=10mm,height=10mm"},
        ],
        "simulator.noise_level": 0.5,
    }
    return changed_config(CellConfig(), short_jobs | dict(changes or {}))


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
        found_s = once(self.clock, happens, lambda: None)
        look = self.clock.on_advance[-1]
        try:
            yield found_s
        finally:
            self.clock.on_advance.remove(look)

    def idle(self, seconds: float) -> None:
        """Let time pass while the cell supervises its links, once a period."""
        end_s = self.now_s + seconds
        due_s = self.now_s
        while self.now_s < end_s:
            due_s = max(due_s + self.controller.hand.period_s, self.now_s)
            self.simulated.clock.sleep(due_s - self.now_s)
            self.controller.life.tick()


@contextmanager
def campaign_cell(
    changes: Mapping[str, Any] | None = None, *, folder: Path | None = None
) -> Iterator[CampaignCell]:
    """Give a cell that is not started yet; at the end its invariants are checked.

    Raises
    ------
    InvariantBroken
        If the cell did what none may ever do.
    """
    config = campaign_config(changes)
    cell = build_cell(config, folder=folder)
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
        text = f"{type(error).__name__}: {error}"
        if len(text) > OUTCOME_CHARACTERS:
            text = f"{text[: OUTCOME_CHARACTERS - 3]}..."
        left = fingers_left(error)
        state = cell.controller.life.state.value
        grip = f"{state}, {left} ({cell.grip_n:.1f} N)" if left else cell.grip
        return Observed(_reaction(cell), max(0.0, known_s - began_s), f"{text}; {grip}")
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
    """Let a second pass without a host and add what is left of the grip."""
    if seen.reaction in {"NOTE", "NOTHING", "REJECT"}:
        return seen
    cell.simulated.clock.sleep(LATER_S)
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
