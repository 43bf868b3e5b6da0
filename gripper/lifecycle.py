"""Which command is possible when, and what a fault leaves behind."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from gripper.errors import GraspStopped, GripperError, GripperStateError
from gripper.reactions import react
from gripper.runner import LoopRunner
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.state import GripperPhase


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
    """

    def __init__(self, servos: ServoGroup, runner: LoopRunner, settings: GripperSettings) -> None:
        self.phase = GripperPhase.OFF
        self.part_possible = False
        self.controlled = False
        self.fault: BaseException | None = None
        self.running = False
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
        """Run one command in its phase; on a stop the goals stay frozen."""
        self._runner.forget_stop()
        self.phase = phase
        self.running = True
        try:
            with self.latching():
                yield
        except GraspStopped:
            with suppress(GripperError):
                self._servos.calm()
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
            self.phase = GripperPhase.HELD_AFTER_FAULT
            # The error that is on its way says what matters; a bus that fails again adds nothing.
            with suppress(GripperError):
                react(error, self._servos, self._settings)
            raise
