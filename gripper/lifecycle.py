"""Lifecycle of the gripper: allowed commands of each phase, and the response to a fault."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import StrEnum
from typing import NamedTuple

from gripper.errors import (
    BusCorrupt,
    BusTimeout,
    FeedbackImplausible,
    FingerBlocked,
    FingerSilent,
    ForceAboveCap,
    GraspStopped,
    GripperError,
    GripperStateError,
    PortLost,
    PositionContradicted,
    ServoFault,
    note_fingers,
)
from gripper.force.loop import LoopRunner
from gripper.values.state import GripperPhase, Observer, shows_nothing

_DOING = {
    GripperPhase.OPENING: "opening",
    GripperPhase.APPROACHING: "closing",
    GripperPhase.RELEASING: "letting go",
}


class Command(NamedTuple):
    """Transition of a command."""

    phases: frozenset[GripperPhase]
    """Phases in which it is possible; empty: all."""
    running: GripperPhase
    """Phase while it runs."""


_EMPTY = frozenset({GripperPhase.OFF, GripperPhase.IDLE})
_HELD = frozenset({GripperPhase.HOLDING})
COMMANDS: Mapping[str, Command] = {
    "start": Command(frozenset(), GripperPhase.OFF),
    "open": Command(_EMPTY, GripperPhase.OPENING),
    "grasp": Command(_EMPTY, GripperPhase.APPROACHING),
    "hold": Command(_HELD, GripperPhase.HOLDING),
    "hold_at": Command(_HELD, GripperPhase.BACKING_OFF),
    "squeeze": Command(_HELD, GripperPhase.RAMPING),
    "release": Command(frozenset(), GripperPhase.RELEASING),
}
"""Commands by name. Each one ends in the phase of `Lifecycle.rest`."""


class FingersLeft(StrEnum):
    """State of the fingers after a fault response, as text before "while ...".

    ONE_SIDED: one finger is silent or without torque, the other stands still. UNCONFIRMED: a servo
    did not confirm its goal, or no servo answers; the servos' own watchdog ends the motion.
    """

    STOPPED = "stopped"
    ONE_SIDED = "stopped, one of them silent or without torque,"
    LIMP = "lost their torque"
    UNCONFIRMED = "were seen last"


_GRIP_LEFT = {
    FingersLeft.ONE_SIDED: "stand still, one of them silent or without torque; a part may still be "
    "gripped",
    FingersLeft.LIMP: "have no torque any more; a part may have been dropped",
    FingersLeft.UNCONFIRMED: "do not answer; a part may still be gripped",
}
"""Notes after a fault in a grip that is not simply kept."""


def bus_is_lost(error: BaseException | None) -> bool:
    """Return whether a fault means that no servo answers on the bus any more."""
    return isinstance(error, PortLost | BusTimeout | BusCorrupt) and not isinstance(
        error, FingerSilent
    )


class Lifecycle:
    """Phase of the gripper, whether a part may be held, and the latched fault."""

    def __init__(self, runner: LoopRunner) -> None:
        self.part_possible = False
        """True from the start of an approach until the end of a release, or until nothing is found.
        """
        self.controlled = False
        """True while the force of this object's grasp can still be controlled."""
        self.fault: BaseException | None = None
        """The latched fault, None without one."""
        self.running = False
        """True while a command runs."""
        self.motion_unconfirmed = False
        """True after a fault in a motion that only a servo's bus watchdog ends."""
        self._runner = runner
        self._servos = runner.servos

    def set_phase(self, phase: GripperPhase) -> None:
        """Set the phase; from the ramp on the force can be controlled."""
        self._runner.phase = phase
        self.controlled = phase is GripperPhase.RAMPING

    def rest(self) -> None:
        """Set the phase after a command, or for frozen goals: it depends on the part."""
        if self.fault is not None or (self.part_possible and not self.controlled):
            self._runner.phase = GripperPhase.HELD_AFTER_FAULT
        elif self.part_possible:
            self._runner.phase = GripperPhase.HOLDING
        else:
            self._runner.phase = GripperPhase.IDLE

    def torque_from_before(self) -> None:
        """Set the phase for torque from before the start: a part may be held, force unknown."""
        self.part_possible, self.controlled = True, False
        self.rest()

    def switched_off(self) -> None:
        """Set the phase for torque off: nothing is held."""
        self._servos.forget()
        self.part_possible = False
        self.controlled = False
        self._runner.phase = GripperPhase.OFF

    def check_ready(self, command: str) -> None:
        """Raise GripperStateError when a command is not possible now; see `COMMANDS`."""
        if self.running:
            raise GripperStateError(f"{command} is not possible while another command runs")
        if self.fault is not None:
            raise GripperStateError(
                f"{command} is not possible while a fault is latched ({self.fault}): call "
                f"clear_fault first"
            )
        phases = COMMANDS[command].phases
        if phases and self._runner.phase not in phases:
            hint = ": release the part first" if self.part_possible else ""
            raise GripperStateError(
                f"{command} is not possible in the state {self._runner.phase.name}{hint}"
            )

    @contextmanager
    def command(self, command: str, observer: Observer | None) -> Iterator[None]:
        """Run one command in its phase; a stop freezes the goals, or stops moving fingers."""
        self._runner.stop_request.clear()
        self._runner.phase = COMMANDS[command].running
        self._runner.observer = observer
        self.running = True
        try:
            yield
        except GraspStopped as stop:
            self._stop(stop)
            raise
        except BaseException as error:
            self.latch(error)
            raise
        finally:
            self.running = False
            self._runner.observer = None
            self.rest()

    def take_over(self, carrier: "Lifecycle") -> None:
        """Take over the fault of a gripper with some of the servos, which has responded to it."""
        self.fault, self.motion_unconfirmed = carrier.fault, carrier.motion_unconfirmed
        self.rest()

    def latch(self, error: BaseException) -> None:
        """Latch an error as a fault, and keep the grip."""
        self.fault = error
        self.part_possible |= isinstance(error, FingerBlocked)
        phase, self._runner.phase = self._runner.phase, GripperPhase.HELD_AFTER_FAULT
        left = FingersLeft.UNCONFIRMED
        # The raised error names the cause; a bus that fails again adds nothing.
        with suppress(GripperError):
            left = fault_response(error, self._runner, moving=phase.moving)
        self._note_fingers(error, phase, left)
        self.motion_unconfirmed = phase.moving and left is FingersLeft.UNCONFIRMED

    def _stop(self, stop: GraspStopped) -> None:
        if not self._runner.phase.moving:
            with suppress(GripperError):
                self._servos.freeze()
            return
        with self._servos.in_loop():
            unconfirmed = self._servos.stop_motion()
        if not unconfirmed:
            self._note_fingers(stop, self._runner.phase, FingersLeft.STOPPED)
            return
        error = ServoFault(unconfirmed[0], "it did not take the goal to stand still")
        self._note_fingers(error, self._runner.phase, FingersLeft.UNCONFIRMED)
        self.fault, self.motion_unconfirmed = error, True
        raise error from stop

    def _note_fingers(self, error: BaseException, phase: GripperPhase, left: FingersLeft) -> None:
        """Note on an error of a motion: position of the fingers, and whether a part is held."""
        if not phase.moving:
            self._note_grip(error, left)
            return
        state = self._servos.feedback.last
        where = "" if state is None else f", at an opening of {state.aperture_m * 1e3:.1f} mm"
        unconfirmed = left is FingersLeft.UNCONFIRMED
        watchdog = "; the servos' bus watchdog stops them" if unconfirmed else ""
        if not self.part_possible:
            # Without a grasp it is unknown whether something is between the fingers.
            empty = shows_nothing(
                state, self._servos.goals.fresh_force, self._servos.settings.contact_force_n
            ) and not isinstance(error, FeedbackImplausible)
            part = "nothing is held" if empty else "no part was gripped"
        elif phase is GripperPhase.RELEASING:
            part = "a part may be half held"
        else:
            part = "a part may be touched"
        note_fingers(error, f"{left} while {_DOING[phase]}{where}{watchdog}; {part}")

    def _note_grip(self, error: BaseException, left: FingersLeft) -> None:
        """Note on an error of a grip: the state of the grip, and the force on the pads."""
        if left not in _GRIP_LEFT or not self.part_possible:
            return
        sample = self._servos.goals.fresh_force
        measured = "" if sample is None else f" (the pads measured {sample.grip_n:.1f} N just then)"
        note_fingers(error, f"{_GRIP_LEFT[left]}{measured}")


def fault_response(error: BaseException, runner: LoopRunner, *, moving: bool) -> FingersLeft:
    """Write the goals of a fault response; the grip is kept whenever possible.

    ================================== ==========================================================
    fault                              response
    ================================== ==========================================================
    the bus is lost                    nothing is written: the servos' own watchdog acts
    position unknown                   the torque goes off
    force above its cap                the currents are lowered until the force is below it
    one finger silent or without       both hold their positions: none pushes alone
    torque
    any other, moving fingers          they stop, and this is read back; without current where
                                       their positions are contradicted, or one does not open
    any other                          the goals are frozen
    ================================== ==========================================================

    Parameters
    ----------
    moving
        True if the fingers moved without a part in their grip.
    """
    servos = runner.servos
    if bus_is_lost(error):
        return FingersLeft.UNCONFIRMED
    # Short time-outs: a silent servo must not delay the others.
    with servos.in_loop():
        if isinstance(error, FeedbackImplausible):
            servos.go_limp()
            return FingersLeft.LIMP
        # With current a servo follows its own position, which may drift: a finger that counts as
        # stuck on its way open would close.
        drifts = isinstance(error, PositionContradicted) or (
            isinstance(error, FingerBlocked) and error.opens
        )
        share = 0.0 if drifts else 1.0
        unconfirmed = servos.stop_motion(share) if moving else []
        one_sided = isinstance(error, FingerSilent) or (
            isinstance(error, ServoFault) and error.torque_lost
        )
        with suppress(GripperError):
            if isinstance(error, ForceAboveCap) or servos.goals.force_is_too_high():
                runner.lower_force()
            elif one_sided:
                servos.hold_position()
            elif not moving:
                servos.freeze()
            if servos.heats:
                servos.freeze()
        with suppress(GripperError):
            servos.disarm_watchdog(but=unconfirmed)
    if unconfirmed:
        return FingersLeft.UNCONFIRMED
    return FingersLeft.ONE_SIDED if one_sided else FingersLeft.STOPPED
