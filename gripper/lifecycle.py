"""Lifecycle of the gripper: allowed commands of each phase, and the response to a fault."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import StrEnum
from math import inf
from operator import gt
from statistics import fmean
from typing import NamedTuple

from gripper import errors
from gripper.clock import Clock
from gripper.dynamixel.drive import SIGMAS
from gripper.mechanics.impact import most_peak_n
from gripper.mechanics.transmission import mean_yielding_n
from gripper.servos.goal_limits import standing
from gripper.servos.group import Servos
from gripper.values.force_sensor import ForceSensor
from gripper.values.state import GripperPhase, Observer, shows_nothing

_LOWERING_S, _LONGEST_LOWERING = 0.1, 4.0
"""Time in s in which the currents of too much force fall to 0. The force has followed after this
multiple of it at the latest. [chosen]"""
_FOLLOWS_SHARE, _UNSEEN_STEPS = 0.95, 2.0
"""Share of the force below which samples have followed fingers that opened, and way in
steps of the opening after which they must have. [chosen]"""

_DOING = {
    GripperPhase.OPENING: "opening",
    GripperPhase.APPROACHING: "closing",
    GripperPhase.RELEASING: "letting go",
}


class Command(NamedTuple):
    """Transition of a command."""

    phases: frozenset[GripperPhase]
    """Phases in which it is possible."""
    running: GripperPhase
    """Phase while it runs."""


_EMPTY = frozenset({GripperPhase.OFF, GripperPhase.IDLE})
_HELD = frozenset({GripperPhase.HOLDING})
COMMANDS: Mapping[str, Command] = {
    "start": Command(frozenset(GripperPhase), GripperPhase.OFF),
    "open": Command(_EMPTY, GripperPhase.OPENING),
    "measure_friction": Command(_EMPTY, GripperPhase.OPENING),
    "grasp": Command(_EMPTY, GripperPhase.APPROACHING),
    "press_pads_together": Command(_EMPTY, GripperPhase.APPROACHING),
    "hold": Command(_HELD, GripperPhase.HOLDING),
    "measure_load": Command(_HELD, GripperPhase.HOLDING),
    "hold_at": Command(_HELD, GripperPhase.BACKING_OFF),
    "squeeze": Command(_HELD, GripperPhase.RAMPING),
    "release": Command(frozenset(GripperPhase), GripperPhase.RELEASING),
}
"""Commands by name. Each one ends in the phase of `Lifecycle.rest`."""


class FingersLeft(StrEnum):
    """State of the fingers after a fault response, as text before "while ...".

    ONE_SIDED: one finger is silent or without torque, the other stands still. UNCONFIRMED: a servo
    did not confirm its goal, or no servo answers; the servos' own watchdog ends the motion.
    """

    STOPPED = "stopped"
    ONE_SIDED = "stopped, at least one silent or without torque,"
    LIMP = "lost their torque"
    UNCONFIRMED = "were seen last"


_GRIP_LEFT = {
    FingersLeft.ONE_SIDED: "stand still, at least one silent or without torque; a part may "
    "still be gripped",
    FingersLeft.LIMP: "have no torque any more; a part may have been dropped",
    FingersLeft.UNCONFIRMED: "do not answer; a part may still be gripped",
}
"""Notes after a fault in a grip that is not simply kept."""


def bus_is_lost(error: BaseException | None) -> bool:
    """Return whether a fault means that no servo answers on the bus any more."""
    lost = isinstance(error, errors.PortLost | errors.BusTimeout | errors.BusCorrupt)
    return lost and not isinstance(error, errors.FingerSilent)


class Lifecycle:
    """Phase of the gripper, whether a part may be held, and the latched fault with its response.

    Parameters
    ----------
    servos, sensor, clock
        Of the gripper.
    """

    def __init__(self, servos: Servos, sensor: ForceSensor, clock: Clock) -> None:
        self.phase = GripperPhase.OFF
        """Phase of the gripper."""
        self.observer: Observer | None = None
        """Called once a period of the running command; None without one."""
        self.stop_request = threading.Event()
        """Set from any thread to stop the running command with GraspStopped."""
        self.part_possible = False
        """True from the start of an approach until the end of a release, or until nothing is found.
        """
        self.controlled = False
        """True while the force on the held part can still be controlled."""
        self.fault: BaseException | None = None
        """The latched fault, None without one."""
        self.running = False
        """True while a command runs."""
        self.motion_unconfirmed = False
        """True after a fault in a motion that only a servo's bus watchdog ends."""
        self._servos, self._sensor, self._clock = servos, sensor, clock

    def set_phase(self, phase: GripperPhase) -> None:
        """Set the phase; from the ramp on the force can be controlled."""
        self.phase = phase
        self.controlled = phase is GripperPhase.RAMPING

    def rest(self) -> None:
        """Set the phase after a command, or for frozen goals: it depends on the part."""
        if self.fault is not None or (self.part_possible and not self.controlled):
            self.phase = GripperPhase.HELD_AFTER_FAULT
        elif self.part_possible:
            self.phase = GripperPhase.HOLDING
        else:
            self.phase = GripperPhase.IDLE

    def torque_from_before(self) -> None:
        """Set the phase for torque from before the start: a part may be held, force unknown."""
        self.part_possible, self.controlled = True, False
        self.rest()

    def switched_off(self) -> None:
        """Set the phase for torque off; the friction of the gearing may still hold a part."""
        self._servos.forget()
        self.controlled = False
        self.phase = GripperPhase.HELD_AFTER_FAULT if self.part_possible else GripperPhase.OFF

    def check_ready(self, command: str) -> None:
        """Raise GripperStateError when a command is not possible now; see `COMMANDS`."""
        if self.running:
            raise errors.GripperStateError(f"{command} is not possible while another command runs")
        if self.fault is not None:
            raise errors.GripperStateError(
                f"{command} is not possible while a fault is latched ({self.fault}): call "
                f"clear_fault first"
            )
        if self.phase not in COMMANDS[command].phases:
            hint = ": release the part first" if self.part_possible else ""
            raise errors.GripperStateError(
                f"{command} is not possible in the state {self.phase.name}{hint}"
            )

    @contextmanager
    def command(self, command: str, observer: Observer | None) -> Iterator[None]:
        """Run one command in its phase; a stop freezes the goals, or stops moving fingers."""
        self.stop_request.clear()
        self.phase = COMMANDS[command].running
        self.observer = observer
        self.running = True
        try:
            yield
        except errors.GraspStopped as stop:
            self._stop(stop)
            raise
        except BaseException as error:
            self.latch(error)
            raise
        finally:
            self.running = False
            self.observer = None
            self.rest()

    def take_over(self, carrier: "Lifecycle") -> None:
        """Take over the fault of a gripper with some of the servos, which has responded to it."""
        self.fault, self.motion_unconfirmed = carrier.fault, carrier.motion_unconfirmed
        self.rest()

    def latch(self, error: BaseException) -> None:
        """Latch an error as a fault, and keep the grip."""
        self.fault = error
        self.part_possible |= isinstance(error, errors.FingerBlocked)
        phase, self.phase = self.phase, GripperPhase.HELD_AFTER_FAULT
        left = FingersLeft.UNCONFIRMED
        # The raised error names the cause; a bus that fails again adds nothing.
        with suppress(errors.GripperError):
            left = self._respond(error, moving=phase.moving)
        self._note_fingers(error, phase, left)
        self.motion_unconfirmed = phase.moving and left is FingersLeft.UNCONFIRMED

    def _stop(self, stop: errors.GraspStopped) -> None:
        if not self.phase.moving:
            with suppress(errors.GripperError):
                self._servos.freeze()
            return
        with self._servos.in_loop():
            unconfirmed = self._servos.stop_motion()
        if not unconfirmed:
            self._note_fingers(stop, self.phase, FingersLeft.STOPPED)
            return
        error = errors.ServoFault(unconfirmed[0], "it did not take the goal to stand still")
        self._note_fingers(error, self.phase, FingersLeft.UNCONFIRMED)
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
            ) and not isinstance(error, errors.FeedbackImplausible)
            part = "nothing is held" if empty else "no part was gripped"
        elif phase is GripperPhase.RELEASING:
            part = "a part may still touch the pads"
        else:
            part = "a part may touch the pads"
        errors.note_fingers(error, f"{left} while {_DOING[phase]}{where}{watchdog}; {part}")

    def _note_grip(self, error: BaseException, left: FingersLeft) -> None:
        """Note on an error of a grip: the state of the grip, and the force on the pads."""
        if left not in _GRIP_LEFT or not self.part_possible:
            return
        sample = self._servos.goals.fresh_force
        measured = "" if sample is None else f" (the pads measured {sample.grip_n:.1f} N just then)"
        errors.note_fingers(error, f"{_GRIP_LEFT[left]}{measured}")

    def _respond(self, error: BaseException, *, moving: bool) -> FingersLeft:
        """Write the goals of a fault response; the grip is kept whenever possible.

        ================================== =====================================================
        fault                              response
        ================================== =====================================================
        the bus is lost                    nothing is written: the servos' own watchdog acts
        position unknown                   the torque goes off
        force above its cap                currents that can make it are lowered until it is below
        one finger silent or without       both hold their positions: none pushes alone; a motion
        torque                             without a part was stopped before, without current
        the part is lost                   the fingers hold their positions: a frozen goal would
                                           close them
        any other, moving fingers          they stop, and this is read back; without current where
                                           their positions are contradicted, or one does not open
        any other                          the goals are frozen
        ================================== =====================================================

        Parameters
        ----------
        moving
            True if the fingers moved without a part in their grip.
        """
        servos = self._servos
        if bus_is_lost(error):
            return FingersLeft.UNCONFIRMED
        # Short time-outs: a silent servo must not delay the others.
        with servos.in_loop():
            if isinstance(error, errors.FeedbackImplausible):
                servos.go_limp()
                return FingersLeft.LIMP
            # With current a servo follows its own position, which may drift: a finger that counts
            # as stuck on its way open would close.
            drifts = isinstance(error, errors.PositionContradicted) or (
                isinstance(error, errors.FingerBlocked) and error.opens
            )
            unconfirmed = servos.stop_motion(0.0 if drifts else 1.0) if moving else []
            one_sided = isinstance(error, errors.FingerSilent) or (
                isinstance(error, errors.ServoFault) and error.torque_lost
            )
            with suppress(errors.GripperError):
                if isinstance(error, errors.ForceAboveCap) or servos.goals.force_is_too_high():
                    self._lower_force()
                elif one_sided or isinstance(error, errors.PartLost):
                    servos.hold_position()
                elif not moving:
                    servos.freeze()
                if servos.heats:
                    servos.freeze()
            with suppress(errors.GripperError):
                servos.disarm_watchdog(but=unconfirmed)
        if unconfirmed:
            return FingersLeft.UNCONFIRMED
        return FingersLeft.ONE_SIDED if one_sided else FingersLeft.STOPPED

    def _lower_force(self) -> None:
        """Lower the currents evenly until the force is below its cap.

        A spring between the fingers would throw them open after one large step: once they open,
        they hold their positions until the next sample, and at the end. Where friction alone
        holds the force, they are driven open, as long as the samples follow: no signal alone lets a
        part go. One pad that shows the force alone may be at fault: then ``over_force_share`` of
        the currents is left. Currents that cannot hold the cap are not lowered: the pads' zero has
        drifted, or something else presses. Raises as `Servos.read`.
        """
        servos, settings = self._servos, self._servos.settings
        most_n, share = most_peak_n(settings), settings.over_force_share
        unseen_m = _UNSEEN_STEPS * max(servos.mechanics.opening_steps_m())
        goals = [goal.lasting for goal in servos.goals.last]
        # Goals that were written may brake.
        asked = [goal.lasting for goal in servos.goals.asked]
        try:
            left, least_n, state = 1.0, inf, servos.read_patiently()
        except errors.GripperError:
            servos.hold_position(share)  # the others obey also while one is silent
            raise
        from_m, opened_s, end_s = inf, -inf, state.t_s + _LONGEST_LOWERING * _LOWERING_S
        while goals and (newest := servos.goals.newest_force) and state.t_s < end_s:
            forces_n = servos.goals.newest_forces_n
            if max(forces_n) < _FOLLOWS_SHARE * least_n:
                least_n, from_m = max(forces_n), state.aperture_m
            least = -1.0 if min(forces_n) > most_n else share
            follows = state.aperture_m - from_m < unseen_m
            if max(forces_n) <= most_n or left <= least or not follows:
                break
            paths = servos.mechanics.transmissions(state.angles_rad)
            pairs = zip(goals, paths, strict=True)
            drive_n = left * fmean([goal.current_a * path.n_per_a for goal, path in pairs])
            sd_n = max([path.force_sd_n(most_n) for path in paths])
            if drive_n + SIGMAS * sd_n < mean_yielding_n(paths, most_n):
                servos.lower(goals, max(0.0, left), state)
                break
            if newest.t_s >= opened_s:
                left = max(least, left - settings.period_s / _LOWERING_S)
                servos.lower(goals, left, state)
            else:
                servos.goals.write(standing(asked, state, share), state)
            self._clock.sleep(settings.period_s)
            before = state
            # The last feedback counts for bus_loss_s.
            with suppress(errors.BusTimeout, errors.BusCorrupt):
                state = servos.read()
            if any(map(gt, state.angles_rad, before.angles_rad)):
                opened_s = state.t_s
            servos.goals.note_force(self._sensor.latest_force())
        if opened_s > -inf:
            servos.goals.write(standing(asked, state, share), state)
