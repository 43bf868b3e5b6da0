"""What must hold whatever happens to a cell, of its force, torque and grip, and of its data."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path

import numpy as np

from cell.build import Cell
from cell.config.gripper import GripperConfig
from cell.control.controller import CellController
from cell.control.states import CellState
from cell.errors import CellError
from cell.recording.reader import read_recording
from gripper.values.state import GripperPhase
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from simulator.cell import SimulatedCell
from simulator.faults.vocabulary import Fault
from simulator.world.world import PhysicalWorld

CONTACT_N = 0.02
"""Force in N above which a pad touches the part."""
HELD_N = 0.3
"""Force in N that a part has felt that counts as held: half of a contact."""
TOLERANCE = 0.01
"""Share of the cap by which the true force may exceed it."""
_FALL_S = 0.5
"""So long after something trapped has gone, the fingers may still fall on the part, in s."""
_ERROR = 70
"""Address of the register Hardware Error Status (XM430 manual)."""
_RESTING = (GripperPhase.IDLE, GripperPhase.HOLDING, GripperPhase.HELD_AFTER_FAULT)
_OPENING = (GripperPhase.OPENING, GripperPhase.RELEASING)
_BRAKING_M, _LOST_ANSWER_M = 0.001, 0.0003
"""How far in m fingers may open after the gripper has ended a motion: their inertia, one period.
And in a period more at 60 mm/s, where the servo line was disturbed at the stop."""
_LOST_REQUESTS = "servos.lost_requests"
"""Fault under which a stop may be lost: then the fingers go on to the goal of their opening."""
_BEYOND_M = 0.004
"""How far in m that goal lies beyond the opening, so that friction does not stop short of it."""
_BRAKING_S = 0.1
"""How long that may take, in s."""
_WATCHDOG_S = 0.02
"""What a servo's bus watchdog may take longer than it is set to, in s."""
_SILENT = (101, 102, 103, 105, 106, 115)
"""Numbers of faults in which a servo may hear nothing: its bus watchdog alone stops it."""
_GOAL_LOST = "did not take the goal"
"""Words of a fault 109 in which it has not heard the stop."""
_FAULTED = (CellState.ABORTING, CellState.ABORTED, CellState.CLEARING, CellState.RESETTING)
_COUNTERS = (
    attrgetter("lost", "torn", "duplicate", "reordered", "stale", "short", "corrupt"),
    attrgetter("foreign", "malformed", "error_frames"),
    attrgetter("lost", "repeated", "late", "damaged"),
    attrgetter("bad_taxels", "saturated_frames", "void_frames"),
    attrgetter("retries", "timeouts", "corrupt", "late"),
)
"""Counters of frames, CAN link, force messages, sensor and servo bus that move only when something
is wrong."""
_FIRST_CHUNK_BYTES = 1024
"""A recording of a host that was killed before its first chunk is smaller."""
_SPOILING = ("taxels.off", "taxels.stuck", "taxels.saturated")
_SPOILED_SHARE = 0.4
"""Share of the taxels that is enough to give no label."""
_KNOWN_AFTER_S = 0.4
"""Time in s after which the sensor has found taxels that repeat themselves."""
_FROZEN_FRAMES = 15
"""So many identical frames in a row cannot be a grip that changes."""


class InvariantBroken(AssertionError):
    """A cell did what none may ever do; the message says what and when."""


class Overrun(BaseException):
    """A command did not end within its time; no `Exception`, so that nothing catches it."""


class InvariantMonitor:
    """Watches a simulated cell and its controller from outside.

    - Force: no pad is pressed with more than ``gripper.force_max_n`` unless the world does it.
    - Release: while a part is held, neither do the fingers leave it nor is torque switched off,
      but by a release that was asked for, or the end of a grasp that has found the part.
    - Stop: fingers that a fault or a cancel stops open no farther than it takes to brake them, or
      their bus watchdog to trip where they hear nothing.
    - Torque: none is switched on between a fault and the reset, but for a release asked for.
    - Push: while a fault is latched no servo under torque gets a higher goal current.
    - End: a command is over within its time, in a state that is none in passing.
    """

    def __init__(self, simulated: SimulatedCell, gripper: GripperConfig) -> None:
        self.broken: list[str] = []
        self.latched_s: float | None = None
        """When a fault was latched first since `watch_from`, in s; None before."""
        self.noted_s: float | None = None
        """When a counter of the links moved first since `watch_from`, in s; None before, and
        where a fault was latched first."""
        self.states: set[CellState] = set()
        """States of the cell that were seen since `watch_from`."""
        self.world_pushes = False
        """Whether something in the world presses, so that the force is not the gripper's."""
        self.limp_allowed = False
        """Whether torque may go off with a part in the grip: force or position is unknown."""
        self._simulated = simulated
        self._force_max_n = gripper.force_max_n
        self._contact_force_n = gripper.contact_force_n
        self._watchdog_s = 1e-3 * gripper.watchdog_ms + _WATCHDOG_S
        self._open_speed_m_s = 1e-3 * gripper.open_speed_mm_s
        self._cell: Cell | None = None
        self._asked = self._torque_asked = False
        self._moving_s, self._motion = -math.inf, GripperPhase.OFF
        self._phase_before: GripperPhase | None = None
        self._stood_m: float | None = None
        self._braking_m, self._silent = _BRAKING_M, False
        self._frozen_raw: list[int] | None = None
        self._pushed_s = -math.inf
        self._most_n = 0.0
        self._deadline_s = float("inf")
        self._counters: list[tuple[int, ...]] = []
        self._torque = self._torques()
        self._blame = self._self_inflicted()
        self._touching = False
        simulated.clock.on_advance.append(self._look)

    def attach(self, cell: Cell | None) -> None:
        """Watch this host from now on; None while no host program runs."""
        if cell is None and self._on_their_way():
            # Nobody stops the fingers of a host that was killed but the servos' watchdogs.
            self._moving_s = self._simulated.clock.monotonic() + self._watchdog_s
        self._cell = cell

    def watch_from(self) -> None:
        """Take times from now on, and look for counters that move and states passed through."""
        self.latched_s = self.noted_s = None
        self.states = set() if self._cell is None else {self._cell.controller.life.state}
        self._counters = [] if self._cell is None else link_counters(self._cell)

    @contextmanager
    def release_asked(self, *, motion: bool = True) -> Iterator[None]:
        """Allow the fingers to let go: somebody asked for it, by a motion or by a reboot."""
        self._asked, self._torque_asked = True, motion
        try:
            yield
        finally:
            self._asked = self._torque_asked = False

    @contextmanager
    def bounded(self, seconds: float) -> Iterator[None]:
        """Break off what lasts longer than so many s of simulated time, with `Overrun`."""
        self._deadline_s = self._simulated.clock.monotonic() + seconds
        try:
            yield
        finally:
            self._deadline_s = float("inf")
        # A fault that the next command clears at once must be seen too.
        self._look(self._simulated.clock.monotonic())
        state = None if self._cell is None else self._cell.controller.life.state
        if state is not None and state.acting:
            self._break(f"a command is over and the cell is still {state.value}")

    def check(self) -> None:
        if self.broken:
            raise InvariantBroken("; ".join(self.broken[:3]))

    def close(self) -> None:
        if self._look in self._simulated.clock.on_advance:
            self._simulated.clock.on_advance.remove(self._look)

    # Inside

    def _break(self, text: str) -> None:
        self.broken.append(f"at {self._simulated.clock.monotonic():.3f} s: {text}")

    def _torques(self) -> tuple[bool, ...]:
        return tuple([s.torque_on for s in self._simulated.devices.servo_bus.servos])

    def _self_inflicted(self) -> tuple[object, ...]:
        """Return what changes when a servo switches its torque off by itself."""
        return tuple(
            [
                (s.registers.data[_ERROR], s.silent_until_s)
                for s in self._simulated.devices.servo_bus.servos
            ]
        )

    def _look(self, now_s: float) -> None:
        world = self._simulated.world
        force_n = world.contact_force_n()
        # Empty pads that press on each other hold nothing.
        empty = isinstance(world, PhysicalWorld) and world.placed is None
        part_n = 0.0 if empty else min(force_n)
        controller = None if self._cell is None else self._cell.controller
        phase = self._phase()
        if phase in _OPENING and phase is not self._phase_before:
            self._look_at_opening(now_s, part_n)
        self._phase_before = phase
        if phase is not None and phase.moving:
            self._moving_s, self._motion = now_s, phase
        pushed = self._world_pushes(now_s)
        if max(force_n) > self._force_max_n * (1.0 + TOLERANCE) and not pushed:
            self._break(f"force {max(force_n):.2f} N, the cap is {self._force_max_n:g} N")
        touching = part_n > CONTACT_N
        self._most_n = max(self._most_n, part_n) if self._touching else 0.0
        torque, blame = self._torques(), self._self_inflicted()
        if torque != self._torque:
            self._torque_changed(torque, blame, controller)
        elif self._touching and not touching:
            self._contact_lost(controller)
        self._torque, self._blame, self._touching = torque, blame, touching
        if controller is not None:
            self._note_times(now_s, controller)
            self._look_at_goals(controller)
            self._look_at_rest(controller, disturbed=pushed, touching=touching)
        if now_s > self._deadline_s:
            self._break("a command did not end within its time")
            self._deadline_s = float("inf")
            raise Overrun(self.broken[-1])

    def pushed(self) -> None:
        """Note that the world moves a finger now: a horn that slips back sends it to its goal."""
        self._pushed_s = self._simulated.clock.monotonic()

    def _world_pushes(self, now_s: float) -> bool:
        """Return whether something trapped presses, or has just gone and let the fingers fall.

        A horn that has just slipped sends its finger to the goal from elsewhere. So does an encoder
        that jumps while a start reads the registers, not the positions.
        """
        starts = self._cell is not None and self._cell.controller.life.state is CellState.STARTING
        for fault in self._simulated.injector.faults:
            began_s = fault.began_s
            if began_s is not None and fault.entry.name == "object.trapped":
                self._pushed_s = now_s
            elif began_s is not None and (
                fault.entry.name == "servoN.horn" or (starts and fault.entry.name == "servoN.jump")
            ):
                self._pushed_s = max(self._pushed_s, began_s)
        return self.world_pushes or now_s - self._pushed_s < _FALL_S

    def _look_at_opening(self, now_s: float, force_n: float) -> None:
        """Judge that fingers which begin to open by themselves have found the part, or hold none.

        What is judged is the world: what the cell has measured may be wrong. Fingers without torque
        hold nothing.
        """
        free = self._asked or not all(self._torque) or self._world_pushes(now_s)
        if free or self._cell is None or force_n < self._contact_force_n:
            return
        if not self._cell.controller.hand.gripper._life.part_possible:
            self._break(f"the fingers open by themselves on a part pressed with {force_n:.2f} N")

    def _look_at_goals(self, controller: CellController) -> None:
        """Judge that nothing pushes harder while a fault is latched."""
        if controller.life.state is not CellState.ABORTED:
            self._frozen_raw = None
            return
        goals_raw = [
            abs(servo.registers.get("goal_current")) if servo.torque_on else 0
            for servo in self._simulated.devices.servo_bus.servos
        ]
        before_raw = self._frozen_raw
        if before_raw is not None and any(map(int.__gt__, goals_raw, before_raw)):
            self._break(f"goal currents from {before_raw} to {goals_raw} while ABORTED")
        self._frozen_raw = goals_raw

    def _torque_changed(
        self, torque: tuple[bool, ...], blame: tuple[object, ...], controller: CellController | None
    ) -> None:
        state = None if controller is None else controller.life.state
        for number, (before, after) in enumerate(zip(self._torque, torque, strict=True)):
            faulted = state is None or state in _FAULTED
            if after and not before and faulted and not self._torque_asked:
                self._break(f"torque of servo {number + 1} on while {state}, without a reset")
            by_itself = blame[number] != self._blame[number]
            if (
                before
                and not after
                and self._touching
                and not (by_itself or self._asked or self.limp_allowed)
                and not self._was_letting_go()
            ):
                self._break(f"torque of servo {number + 1} off with a part in the grip")

    def _contact_lost(self, controller: CellController | None) -> None:
        """Judge that the fingers have left the part, while all torque is as it was."""
        if self._asked or self.limp_allowed or not all(self._torque) or self._on_their_way():
            return
        if self._most_n < HELD_N:
            return
        if controller is None or self._part_gone():
            return
        self._break(f"the part was let go while {controller.life.state}, {self._phase()}")

    def _part_gone(self) -> bool:
        return self._simulated.devices.world.placed is None or self._has_fault("object.slips")

    def _has_fault(self, name: str) -> bool:
        return any(fault.entry.name == name for fault in self._simulated.injector.faults)

    def _phase(self) -> GripperPhase | None:
        return None if self._cell is None else self._cell.controller.hand.phase

    def _on_their_way(self) -> bool:
        """Return whether the fingers move, or were stopped just now and may touch the part."""
        patience_s = _BRAKING_S + (self._watchdog_s if self._hears_nothing() else 0.0)
        return self._simulated.clock.monotonic() <= self._moving_s + patience_s

    def _was_letting_go(self) -> bool:
        """Return whether a release has just ended, or the last motion opened empty fingers."""
        if self._motion is GripperPhase.RELEASING:
            return self._on_their_way()
        return self._motion is GripperPhase.OPENING

    def _hears_nothing(self) -> bool:
        """Return whether a servo hears nothing, so that its watchdog alone stops it."""
        latched = None if self._cell is None else self._cell.controller.life.latched
        if latched is None:
            return False
        return latched.number in _SILENT or _GOAL_LOST in latched.text

    def _look_at_rest(self, controller: CellController, *, disturbed: bool, touching: bool) -> None:
        """Judge that fingers at rest stay where they were when their motion ended.

        On a part they follow the foam as the force falls: `_contact_lost` judges them.
        """
        phase = controller.hand.phase
        # A fault that is cleared leaves the fingers on their way.
        self._silent = phase in _RESTING and (self._silent or self._hears_nothing())
        free = disturbed or self.limp_allowed or self._asked or not all(self._torque)
        if free or phase not in _RESTING:
            self._stood_m = None
            return
        if self._silent and self._has_fault("servoN.watchdog_off"):
            self._stood_m = None
            return
        opening_m = self._simulated.devices.mechanics.aperture_m
        if self._stood_m is None:
            self._stood_m = opening_m
            faults = [fault.entry.name for fault in self._simulated.injector.faults]
            disturbed_line = any(name.startswith("servos.") for name in faults)
            self._braking_m = _BRAKING_M + (_LOST_ANSWER_M if disturbed_line else 0.0)
        allowed_m = self._braking_m
        if self._silent:
            allowed_m += self._open_speed_m_s * self._watchdog_s
        if self._has_fault(_LOST_REQUESTS):
            allowed_m += _BEYOND_M
        if opening_m > self._stood_m + allowed_m and not touching:
            self._break(
                f"the fingers went on from {1e3 * self._stood_m:.2f} to {1e3 * opening_m:.2f} mm "
                f"after their stop, {controller.life.state}, {phase}"
            )
            self._stood_m = opening_m

    def _note_times(self, now_s: float, controller: CellController) -> None:
        self.states.add(controller.life.state)
        if self.latched_s is None and controller.life.fault is not None:
            self.latched_s = now_s
        known = self.noted_s is not None or self.latched_s is not None
        if known or not self._counters or self._cell is None:
            return
        if link_counters(self._cell) != self._counters:
            self.noted_s = now_s


def link_counters(cell: Cell) -> list[tuple[int, ...]]:
    """Return the counters of both links; `Cell.health` gives the same, too slowly for each step."""
    hand = cell.controller.hand
    link = hand.sensor.source.statistics
    owners = (link.frames, link, link.forces, hand.sensor.statistics, hand.bus.statistics)
    return [read(owner) for read, owner in zip(_COUNTERS, owners, strict=True)]


# Data


class FrameWitness:
    """A recognizer that is always sure, and looks whether its grasps are what the unit scanned.

    Faults may have spoiled the scans themselves for a while.
    """

    name, labels, uses_aperture = "witness", ("ball", "box"), False

    def __init__(self, scanned: Callable[[], set[bytes]], spoiled: Callable[[], list[str]]) -> None:
        self._scanned = scanned
        self._spoiled = spoiled

    def posterior(self, grasp: Grasp) -> Posterior:
        """Answer with certainty; InvariantBroken for data that no answer may come from."""
        scanned = self._scanned()
        frames = [counts.astype(np.uint8).tobytes() for counts in grasp.counts]
        strange = sum(frame not in scanned for frame in frames)
        if strange:
            raise InvariantBroken(f"{strange} of {len(frames)} frames of grasps were never scanned")
        alike = longest = 1
        for before, frame in itertools.pairwise(frames):
            alike = alike + 1 if frame == before else 1
            longest = max(longest, alike)
        if longest >= _FROZEN_FRAMES:
            raise InvariantBroken(f"a label from a grasp with {longest} identical frames in a row")
        if self._spoiled():
            raise InvariantBroken(f"a label in spite of {', '.join(self._spoiled())}")
        return Posterior(labels=self.labels, probability=np.array([0.999, 0.001]), unknown=0.001)


def spoiling(faults: Sequence[Fault], now_s: float) -> list[str]:
    """Return the faults that have made so many taxels wrong for so long that no label may come."""
    return [
        fault.text
        for fault in faults
        if fault.entry.name in _SPOILING
        and fault.began_s is not None
        and now_s - fault.began_s > _KNOWN_AFTER_S
        and (fault.entry.name == "taxels.saturated" or fault.value >= _SPOILED_SHARE)
    ]


def recording_faults(path: Path, *, whole: bool) -> list[str]:
    """Return what is wrong with a recording: one that was closed, or what a kill has left."""
    try:
        recording = read_recording(path)
    except CellError as error:
        small = path.stat().st_size <= _FIRST_CHUNK_BYTES
        return [] if small and not whole else [f"the recording cannot be read: {error}"]
    if whole and not recording.complete:
        return [f"a recording that was closed is not complete: {recording.lost_reason}"]
    return []
