"""The table of states, its page, and a cell that does in each state what the table says."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle, LatchedFault
from cell.control.plan import Pose
from cell.control.states import (
    COMPLETIONS,
    OF_PHASE,
    TRANSITIONS,
    CellState,
    Command,
    Event,
    GraspState,
    grasp_state,
    is_allowed,
    next_state,
)
from cell.errors import CellStateError, CellStopped, HandLost, PositionerError
from cell.recording.reader import read_recording
from docs.tools.states_page import command_path
from gripper.errors import BusTimeout, ServoFault
from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase
from tactile.errors import BusOff
from tests.cell.cells import MakeBench, once
from tests.fuzz.harness import Clock
from tests.values import command_of, raising

LEAST_N = 0.5


class Walk:
    """Brings a cell into any state, acting ones too, and does something there once."""

    def __init__(self, bench: Any) -> None:
        self.bench = bench
        self.controller = bench.controller

    def there(self, state: CellState, act: Callable[[], object]) -> None:
        if not state.acting:
            self._wait_in(state)
            act()
            return
        done_s = once(self.bench.clock, lambda: self.controller.life.state is state, act)
        self._pass_through(state)
        assert done_s, f"{state} was not seen"

    def _wait_in(self, state: CellState) -> None:
        if state is not CellState.STOPPED:
            self.bench.ready()
        if state is CellState.COMPLETE:
            self.controller.grip(3.0, Pose())
        elif state is CellState.HELD:
            self._grasp_until(self.controller.life.cancel)
        elif state in (CellState.ABORTED, CellState.RESETTING):
            self._grasp_until(lambda: self.bench.simulated.inject("can.unplugged"))
            if state is CellState.RESETTING:
                self.bench.simulated.injector.clear("can.unplugged")
                self.controller.life.clear()
        assert self.controller.life.state is state

    def _pass_through(self, state: CellState) -> None:
        if state is CellState.STARTING:
            with suppress(CellStopped):
                self.controller.start()
        elif state is CellState.STOPPING:
            self._wait_in(CellState.IDLE)
            self.controller.shutdown()
        elif state is CellState.CLEARING:
            self._wait_in(CellState.ABORTED)
            self.controller.life.clear()
        elif state is CellState.ABORTING:
            self._wait_in(CellState.ABORTED)
        else:
            self.bench.ready()
            if state is CellState.HOLDING:
                self._grasp_until(self.controller.life.cancel)
            else:
                with suppress(CellStopped):
                    self.bench.grasp(6.0)

    def _grasp_until(self, act: Callable[[], object]) -> None:
        self.bench.once_in(GripperPhase.RAMPING, act, 0.3)
        with pytest.raises((CellStopped, BusOff)):
            self.bench.grasp(6.0)

    def give(self, command: Command) -> None:
        if command is Command.GRASP:
            self.bench.grasp(3.0)
        elif command is Command.GRIP:
            self.controller.grip(3.0, Pose())
        else:
            command_of(self.controller, command)()

    def seen(self) -> tuple[Any, ...]:
        """All that a refused command must leave alone; no packet may have been sent either."""
        return (
            self.controller.life.state,
            self.controller.life.grasp_state,
            self.controller.life.fault,
            self.controller.hand.phase,
            self.controller.life.cancelled,
            repr(self.bench.cell.controller.hand.bus.statistics),
            self.bench.simulated.clock.monotonic(),
        )


# -- the table -------------------------------------------------------------------------------


def test_every_state_can_fault_and_leaving_a_fault_takes_clear_and_reset() -> None:
    state = CellState.ABORTED
    for sound in set(CellState) - {state, CellState.ABORTING}:
        assert next_state(sound, Event.FAULT) is CellState.ABORTING
    assert [e for (s, e) in TRANSITIONS if s is state] == [Event.CLEAR]
    for event in (Event.CLEAR, Event.CLEARED, Event.RESET):
        state = next_state(state, event)
    assert state is CellState.STOPPED


# -- the cell does as the table says ---------------------------------------------------------


ACCEPTED = [(s, c) for s in CellState for c in Command if is_allowed(s, c)]


@pytest.mark.parametrize(("state", "command"), ACCEPTED)
def test_a_refused_command_changes_nothing_and_an_accepted_one_goes_the_way_of_the_table(
    state: CellState, command: Command, make_bench: MakeBench, tmp_path: Path
) -> None:
    walk = Walk(make_bench(folder=tmp_path))
    refused = [other for other in Command if not is_allowed(state, other)]
    left: list[Command] = []

    def give_all() -> None:
        before = walk.seen()
        for other in refused:
            with pytest.raises(CellStateError, match=f"the cell is {state.value}"):
                walk.give(other)
            assert walk.seen() == before, other
            left.append(other)
        walk.give(command)

    held = state in (CellState.COMPLETE, CellState.HELD, CellState.ABORTED, CellState.RESETTING)
    walk.there(state, give_all)
    assert left == refused != []
    if held:
        released = command in (Command.RELEASE, Command.RELEASE_HELD)
        assert (walk.bench.grip_n == 0.0) if released else (walk.bench.grip_n > LEAST_N)
    path = command_path(state, command)
    if state.acting and not path:
        path = (next_state(state, COMPLETIONS[state]),)
    way = [state, *path]
    assert walk.controller.life.state is way[-1]
    way += command_path(walk.controller.life.state, Command.SHUTDOWN)
    walk.bench.cell.close()
    recorded = [entry["state"] for entry in read_recording(tmp_path / "recording.mcap").states]
    assert [name for name, _ in groupby([CellState.STOPPED, *recorded])][-len(way) :] == way


# -- the grip --------------------------------------------------------------------------------


def test_the_state_of_the_grip_follows_a_grasp(bench: Any) -> None:
    bench.ready()
    seen: dict[GraspState, None] = {}
    bench.clock.on_advance.append(lambda _now_s: seen.setdefault(bench.life.grasp_state))
    bench.grasp()
    ways = [GraspState.POSITIONING, GraspState.GRIPPING, GraspState.RELEASING]
    assert [state for state in seen if state is not GraspState.IDLE] == ways
    assert bench.life.grasp_state is GraspState.IDLE


def test_what_a_failed_grasp_leaves_is_shown_while_the_fingers_rest() -> None:
    assert set(OF_PHASE) == set(GripperPhase)
    for phase in (GripperPhase.OFF, GripperPhase.IDLE):
        for result, state in (
            (None, GraspState.IDLE),
            (GraspResult.FORCE_REACHED, GraspState.IDLE),
            (GraspResult.NO_CONTACT, GraspState.NO_PART_FOUND),
            (GraspResult.PART_LOST, GraspState.PART_LOST),
        ):
            assert grasp_state(phase, result=result, fault=False, part_lost=False) is state
    moving = grasp_state(
        GripperPhase.APPROACHING, result=GraspResult.NO_CONTACT, fault=False, part_lost=False
    )
    assert moving is GraspState.GRIPPING
    for lost, state in ((False, "ERROR"), (True, "PART LOST")):
        for phase in GripperPhase:
            assert grasp_state(phase, result=None, fault=True, part_lost=lost).value == state


# -- The lifecycle without a cell ------------------------------------------------------------------


def life_of(state: CellState, phase: GripperPhase, **hand: Any) -> CellLifecycle:
    return CellLifecycle(
        SimpleNamespace(phase=phase, **hand),  # type: ignore[arg-type]
        Journal(None),
        Clock(),
        0.2,
        state=state,
    )


@pytest.mark.parametrize(
    ("phase", "state", "held"),
    [
        (GripperPhase.IDLE, CellState.IDLE, []),
        (GripperPhase.HOLDING, CellState.ABORTED, ["kept", "sensor off"]),
    ],
)
def test_a_pose_that_is_not_reached_is_a_fault_beside_a_part_alone(phase, state, held) -> None:
    calls: list[str] = []
    acts = {"keep_grip": "kept", "stop_sensor": "sensor off"}
    life = life_of(
        CellState.EXECUTE, phase, **{name: partial(calls.append, act) for name, act in acts.items()}
    )
    with pytest.raises(PositionerError), life.latching_faults():
        raise PositionerError("the arm stands")
    assert (life.state, calls, life.faults.total()) == (state, held, bool(held))


def test_a_grip_that_cannot_be_confirmed_does_not_hide_the_fault() -> None:
    unplugged = raising(BusTimeout("the cable is out"))
    lost = raising(HandLost("gone"))
    life = life_of(CellState.EXECUTE, GripperPhase.RAMPING, keep_grip=unplugged, stop_sensor=lost)
    with pytest.raises(ServoFault), life.latching_faults():
        raise ServoFault(1, "overload", bits=0x20)
    assert (life.state, life.status.fault_number) == (CellState.ABORTED, 109)


def test_a_clear_that_fails_keeps_the_first_fault_or_names_it_beside_that_of_a_servo() -> None:
    life = life_of(CellState.ABORTED, GripperPhase.HELD_AFTER_FAULT)
    life.latched = LatchedFault("no frame for 0.2 s", 401)
    for error, number in (
        (BusTimeout("the cable is out"), 401),
        *[(ServoFault(1, "hot", bits=32), 109)] * 2,
    ):
        life.hand.clear_fault = raising(error)  # type: ignore[method-assign]
        with pytest.raises(type(error)):
            life.clear(reboot=False)
        assert (life.state, life.status.fault_number) == (CellState.ABORTED, number)
    assert str(life.fault).endswith("(first: no frame for 0.2 s)")
    assert str(life.fault).count("first: ") == 1
