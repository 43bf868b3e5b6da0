"""Which command is possible when, and what a fault leaves behind."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from gripper.errors import GraspStopped, GripperError, GripperStateError, ServoFault, note_fingers
from gripper.reactions import Left, react
from gripper.runner import LoopRunner
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.state import GripperPhase

_DOING = {
    GripperPhase.OPENING: "opening",
    GripperPhase.APPROACHING: "closing",
    GripperPhase.RELEASING: "letting go",
}


class Lifecycle:
    """Phase of the gripper, whether a part may be held, and the latched fault.

    Parameters
    ----------
    servos, runner, settings
        Of the gripper.

    Attributes
    ----------
    phase
        What the gripper is doing.
    part_possible
        True from the beginning of an approach until a release has ended or nothing was found.
    controlled
        True while the force of a grasp of this object can be controlled further.
    fault
        The latched fault, None without one.
    running
        True while a command runs.
    left_alone
        True after a fault in a motion that nothing but a servo's bus watchdog ends.
    """

    def __init__(self, servos: ServoGroup, runner: LoopRunner, settings: GripperSettings) -> None:
        self.phase = GripperPhase.OFF
        self.part_possible = False
        self.controlled = False
        self.fault: BaseException | None = None
        self.running = False
        self.left_alone = False
        self._servos = servos
        self._settings = settings
        self._runner = runner

    def set_phase(self, phase: GripperPhase) -> None:
        """Set the phase; from the ramp on the force can be controlled."""
        self.phase = phase
        self.controlled = phase is GripperPhase.RAMPING

    def rest(self) -> None:
        """Set the phase that belongs to frozen goals."""
        if self.fault is not None or (self.part_possible and not self.controlled):
            self.phase = GripperPhase.HELD_AFTER_FAULT
        elif self.part_possible:
            self.phase = GripperPhase.HOLDING
        else:
            self.phase = GripperPhase.IDLE

    def switched_off(self) -> None:
        """Note that the torque is off: nothing is held."""
        self._servos.forget()
        self.part_possible = False
        self.controlled = False
        self.phase = GripperPhase.OFF

    def check_ready(self, command: str, *phases: GripperPhase) -> None:
        """Raise GripperStateError when a command is not possible now."""
        if self.running:
            raise GripperStateError(f"{command} is not possible while another command runs")
        if self.fault is not None:
            raise GripperStateError(
                f"{command} is not possible while a fault is latched ({self.fault}): call "
                f"clear_fault first"
            )
        if phases and self.phase not in phases:
            hint = ": release the part first" if self.part_possible else ""
            raise GripperStateError(
                f"{command} is not possible in the state {self.phase.name}{hint}"
            )

    @contextmanager
    def command(self, phase: GripperPhase) -> Iterator[None]:
        """Run one command in its phase; a stop freezes the goals, or halts fingers on their way."""
        self._runner.forget_stop()
        self.phase = phase
        self.running = True
        try:
            with self.latching():
                yield
        except GraspStopped as stop:
            self._stop(stop)
            self.rest()
            raise
        finally:
            self.running = False

    @contextmanager
    def latching(self) -> Iterator[None]:
        """Latch whatever goes wrong as a fault and keep the grip; a stop on request is none."""
        try:
            yield
        except GraspStopped:
            raise
        except BaseException as error:
            self.fault = error
            phase, self.phase = self.phase, GripperPhase.HELD_AFTER_FAULT
            left = Left.ALONE
            # The error that is on its way says what matters; a bus that fails again adds nothing.
            with suppress(GripperError):
                left = react(error, self._servos, self._settings, moving=phase.moving)
            self._tell(error, phase, left)
            self.left_alone = phase.moving and left is Left.ALONE
            raise

    def _stop(self, stop: GraspStopped) -> None:
        if not self.phase.moving:
            with suppress(GripperError):
                self._servos.standstill.calm()
            return
        with self._servos.in_loop():
            alone = self._servos.standstill.halt()
        if not alone:
            self._tell(stop, self.phase, Left.STILL)
            return
        error = ServoFault(alone[0], 0, "it did not take the goal to stand still")
        self._tell(error, self.phase, Left.ALONE)
        self.fault, self.left_alone = error, True
        self.phase = GripperPhase.HELD_AFTER_FAULT
        raise error from stop

    def _tell(self, error: BaseException, phase: GripperPhase, left: Left) -> None:
        """Note on what ends a motion where it has left the fingers, and what they may hold."""
        if not phase.moving:
            return
        aperture_m = self._servos.feedback.aperture_m
        where = "" if aperture_m is None else f", at an opening of {aperture_m * 1e3:.1f} mm"
        alone = "; the servos' bus watchdog stops them" if left is Left.ALONE else ""
        if not self.part_possible:
            part = "nothing is held"
        elif phase is GripperPhase.RELEASING:
            part = "a part may be half held"
        else:
            part = "a part may be touched"
        note_fingers(error, f"{left} while {_DOING[phase]}{where}{alone}; {part}")
