"""State, latched fault and requested stop of a cell, and their effect on the grip."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from cell.control.journal import Journal
from cell.control.states import (
    COMPLETIONS,
    OF_PHASE,
    TRANSITIONS,
    CellState,
    CellStatus,
    Command,
    Event,
    GraspState,
    grasp_state,
    is_allowed,
    next_state,
    refusal,
)
from cell.errors import CellStateError, CellStopped, HandLost, NoPartFound, PositionerError
from cell.fault_catalogue import error_text, fault_number
from cell.hand.interface import FRESH_S, Hand
from gripper.clock import Clock
from gripper.errors import (
    GraspStopped,
    GripperError,
    PartLost,
    PartSlipped,
    ServoFault,
    fingers_left,
)
from gripper.values.outcome import GraspResult
from gripper.values.state import shows_nothing

NO_GRIP = ("no part was gripped", "nothing is held")
"""Message when no grip is kept: unconfirmed, and confirmed by pads and current."""

UNTIL_RELEASED = "until it is released on purpose"
"""How long a part is kept after a stop, as text."""

ON_REQUEST = "on request"
"""Reason of a stop that a person or host requested."""


@dataclass(frozen=True, slots=True)
class LatchedFault:
    """A latched fault; one value, because other threads read it."""

    text: str
    number: int
    """Number in `cell.fault_catalogue`."""
    since_s: float = field(default_factory=time.time)
    """Unix time in s."""


@dataclass
class CellLifecycle:
    """Walks through the states of `cell.control.states`; keeps the grip on every error.

    Any thread may call `cancel` and read; all else belongs to the thread that runs the sequences.
    A fault keeps the grip and latches; then a person or host calls `clear` and `reset`.
    """

    hand: Hand
    journal: Journal
    """Gets stops, faults and each change of state."""
    clock: Clock
    contact_force_n: float
    """Force in N on both pads from which on something is held."""
    state: CellState = CellState.STOPPED
    """The present state; only `go` changes it."""
    result: GraspResult | None = None
    """How the last grasp ended; None before the first one and after a release."""
    latched: LatchedFault | None = None
    """The latched fault."""
    state_since_s: float = field(default_factory=time.time)
    """Unix time in s of the last change of the state."""
    progressed_s: float = 0.0
    """Monotonic time in s of the newest period of a motion, or of the newest move."""
    faults: Counter[int] = field(default_factory=Counter)
    """Faults so far, by their numbers."""
    cancelled: bool = False
    """Whether a requested stop is pending."""
    interrupted: bool = False
    """Whether the program ends: each sequence is stopped."""
    stop_reason: str = ON_REQUEST
    """Who or what requested the last stop."""
    _keep_began: tuple[float, str] | None = None
    _part_lost: bool = False

    @property
    def holding(self) -> bool:
        """Whether a part may be in the grip."""
        return OF_PHASE[self.hand.phase] in (GraspState.GRIPPING, GraspState.HOLDING)

    @property
    def fault(self) -> str | None:
        """The latched fault as text; None without a fault."""
        latched = self.latched
        return None if latched is None else latched.text

    @property
    def grasp_state(self) -> GraspState:
        """State of the grip."""
        return grasp_state(
            self.hand.phase,
            result=self.result,
            fault=self.latched is not None,
            part_lost=self._part_lost,
        )

    @property
    def status(self) -> CellStatus:
        """States of cell and grip with their numbers, and faults."""
        n_faults, state, grasp = self.faults.total(), self.state, self.grasp_state
        latched = self.latched  # read once, and after the count that it raises
        return CellStatus(
            state=state.value,
            state_number=state.number,
            needs_reset=state.needs_reset,
            grasp=grasp.value,
            grasp_number=grasp.number,
            holding=self.holding,
            fault=None if latched is None else latched.text,
            fault_number=0 if latched is None else latched.number,
            since_s=self.state_since_s,
            fault_since_s=None if latched is None else latched.since_s,
            n_faults=n_faults,
        )

    @property
    def shows_nothing(self) -> bool:
        """Whether the newest pad forces and current both show that nothing is held."""
        latest, since_s = self.hand.latest, self.clock.monotonic() - FRESH_S
        cycle, force = latest.cycle, latest.force
        if cycle is None or force is None or min(cycle.t_s, force.t_s) < since_s:
            return False
        return shows_nothing(cycle.state, force, self.contact_force_n)

    def allows(self, event: Event) -> bool:
        """Whether the event is allowed in the present state."""
        return (self.state, event) in TRANSITIONS

    def check(self, command: Command) -> None:
        """Raise CellStateError if the command is not allowed in the present state."""
        if not is_allowed(self.state, command):
            raise self._refused(refusal(self.state, command))

    def go(self, event: Event) -> None:
        """Go to the state that follows. Raises CellStateError if the event is not allowed now."""
        try:
            self.state = next_state(self.state, event)
        except ValueError as error:
            raise self._refused(str(error)) from None
        self.state_since_s = time.time()
        if event in (Event.RELEASE, Event.RELEASE_HELD, Event.START):
            self._keep_began = None
        self.journal.states(self.state, self.grasp_state)

    def _refused(self, text: str) -> CellStateError:
        return CellStateError(text + (f"; fault: {self.fault}" if self.fault else ""))

    def complete(self) -> None:
        """Leave the acting state with the event of its success."""
        self.go(COMPLETIONS[self.state])

    def keep(self, *, since: str) -> None:
        """Leave EXECUTE with the part held for the host.

        A later fault names the time since ``since``, e.g. the answer. A kept part stays kept.
        """
        self._keep_began = self._keep_began or (self.clock.monotonic(), since)
        self.go(Event.KEPT)

    def tick(self) -> None:
        """Serve and supervise both links while no sequence runs; call once a period.

        The force of a kept part is controlled; its slip or loss is a fault.
        """
        if self.state in (CellState.IDLE, CellState.HELD, CellState.COMPLETE):
            with self.latching_faults():
                self.hand.tick()

    def cancel(self, reason: str = ON_REQUEST) -> None:
        """Stop the running sequence, or else the next one, and keep the grip.

        Safe from any thread. It stays pending until a sequence obeys it, so that a cancel between
        two parts of a job is not lost. Its message has the ``reason``.
        """
        self.stop_reason = reason
        self.cancelled = True
        self.hand.request_stop()

    def interrupt(self) -> None:
        """Stop the running sequence and each later one, before the program ends.

        Safe from any thread and in signal handlers.
        """
        self.interrupted = True
        self.cancel()

    def forget_cancel(self) -> None:
        """Withdraw a pending `cancel`: the sequence that it was meant for is over."""
        self.cancelled = False

    def check_cancelled(self) -> None:
        """Raise GraspStopped if a stop was requested, during a motion of the hand."""
        if self.cancelled or self.interrupted:
            raise GraspStopped("stopped on request")

    def obey_cancel(self, when: str) -> None:
        """Raise CellStopped if a stop was requested while the hand does not move."""
        if self.cancelled or self.interrupted:
            self.forget_cancel()
            raise CellStopped(f"stopped {self.stop_reason} {when}")

    def obey_cancel_between(self) -> None:
        """Raise CellStopped if a stop was requested between two grasps."""
        if self.state is CellState.IDLE:
            self.obey_cancel("between two grasps; the fingers are open")

    def clear(self, *, reboot: bool = False) -> None:
        """Acknowledge the fault, or before the start the torque left by an earlier run.

        The grip stays as it is. `reset` is the next step.

        Parameters
        ----------
        reboot
            True to restart servos that report a hardware error. This is needed after a servo has
            switched its torque off. If the servo still holds a part, the part drops.

        Raises
        ------
        gripper.errors.GripperError
            If a servo does not answer or is still at fault; the fault stays latched.
        """
        self.go(Event.CLEAR)
        try:
            self.hand.clear_fault(reboot=reboot)
        except BaseException as error:
            # A latched servo error needs other steps than the fault before it.
            if self.fault is None or isinstance(error, ServoFault):
                newest, _, first = (self.fault or "").partition(" (first: ")
                first = first.removesuffix(")") or newest
                before = f" (first: {first})" if first else ""
                self.latched = LatchedFault(error_text(error) + before, fault_number(error))
            self.go(Event.FAULT)
            self.go(Event.ABORTED)
            raise
        self.latched = None
        self._part_lost = False
        self.complete()

    def reset(self) -> None:
        """Leave the cleared fault behind; the next start verifies everything anew."""
        self.go(Event.RESET)
        self.hand.stop_sensor()

    @contextmanager
    def executing(self, event: Event) -> Iterator[None]:
        """Run a command of the hand; latch its faults and record the timing of the loop."""
        self.go(event)
        try:
            with self.latching_faults():
                yield
        finally:
            self.journal.loop(self.hand.statistics)

    @contextmanager
    def latching_faults(self) -> Iterator[None]:
        """Keep the grip on every error.

        A requested stop holds. With empty fingers, a missing part or an unreached pose ends the
        command. All else latches a fault.
        """
        try:
            try:
                yield
            except GraspStopped:
                self._hold()
                raise
        except GraspStopped as stop:
            self.forget_cancel()
            raise CellStopped(f"stopped {self.stop_reason}; {self._left(stop)}") from stop
        except (PositionerError, NoPartFound) as error:
            # An unreached pose is no fault of the cell: its fingers are open and empty.
            if self.state is not CellState.EXECUTE or self.holding:
                self._latch(error)
            else:
                kind = "no part" if isinstance(error, NoPartFound) else "positioner"
                self.journal.note(kind, str(error), fault_number(error))
                self.go(Event.DONE)
            raise
        except BaseException as error:
            self._latch(error)
            raise

    def _latch(self, error: BaseException) -> None:
        """Keep the grip and latch the fault; a second error does not hide the first."""
        fault = LatchedFault(error_text(error) + self._carried_for(), fault_number(error))
        self.latched = fault
        self.faults[fault.number] += 1
        # A kept part that slips is no longer where the host expects it.
        lost = (PartLost, PartSlipped) if self._keep_began else PartLost
        self._part_lost = isinstance(error, lost)
        self.go(Event.FAULT)
        try:
            self.journal.note("fault", fault.text, fault.number)
            self.hand.keep_grip()
        except (GripperError, HandLost) as second:
            text = f"the grip could not be confirmed: {second}"
            self.journal.note("fault", text, fault_number(second))
        finally:
            self.complete()
        # Until the next start nobody reads what it sends.
        with suppress(HandLost):
            self.hand.stop_sensor()

    def _carried_for(self) -> str:
        """Return as text how long a kept part was held until now; empty without one."""
        if self._keep_began is None:
            return ""
        since_s, since = self._keep_began
        return f"; {self.clock.monotonic() - since_s:.1f} s after the {since}"

    def _left(self, stop: GraspStopped) -> str:
        """Return the state after a stop as text: fingers between positions, a grip, or nothing."""
        moved = fingers_left(stop)
        if not self.holding:
            return moved or NO_GRIP[self.shows_nothing]
        return f"{moved or 'the grip is kept'} {UNTIL_RELEASED}"

    def _hold(self) -> None:
        """Go to the state that follows a requested stop, and keep the grip."""
        if self.state is CellState.STARTING:
            self.go(Event.STOP)
            self.hand.stop_sensor()
        elif self.state is CellState.EXECUTE:
            self.go(Event.HOLD)
            self.journal.note("held", f"stopped {self.stop_reason}", 0)
        self.hand.keep_grip()
        if self.state.acting:
            self.complete()
