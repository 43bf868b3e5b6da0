"""Servos of one or both fingers, with their loop: prepare, move, release."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_POSITION
from gripper.dynamixel.latency import check_link
from gripper.errors import BusTimeout, GripperError, ServoFault, VerificationFailed
from gripper.force.approach.free_motion import MoveTo
from gripper.force.approach.mechanics_proof import FirstMotion, standing_rows
from gripper.force.by_current import ForceByCurrent
from gripper.force.estimates.free_motion import FreeMotion
from gripper.force.loop import LoopRunner
from gripper.lifecycle import Lifecycle
from gripper.mechanics.kinematics import Linkage, OneFinger
from gripper.servos.goal_limits import OPENING_MARGIN_RAD
from gripper.servos.group import ServoGroup
from gripper.servos.health import ServoHealth
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSensor
from gripper.values.outcome import ReleaseReport
from gripper.values.servo_checks import ServoCondition, VerificationReport, VerificationRow
from gripper.values.state import GripperPhase, Observer, ServoFeedback

CLEAR_M = 0.002
"""Way in m after which nothing touches fingers that open. [chosen]"""


class Fingers:
    """Servos with their health, their loop and their lifecycle; they open without any force.

    Parameters
    ----------
    bus, linkage, settings, clock, force_sensor
        As `gripper.gripper.Gripper`.
    """

    def __init__(
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        clock: Clock,
        force_sensor: ForceSensor | None,
    ) -> None:
        self.settings = settings
        self.health = ServoHealth(bus, settings)
        self.servos = ServoGroup(bus, linkage, settings, clock, self.health)
        sensor = force_sensor or ForceByCurrent(self.servos, linkage, settings)
        self.runner = LoopRunner(self.servos, self.health, sensor, settings, clock)
        self.life = Lifecycle(self.servos, self.runner, settings)
        self.free = FreeMotion(settings)
        """Observes each free motion."""
        self.on_torque: Callable[[], None] = lambda: None
        """Called when the torque of all servos comes on."""
        self._bus = bus
        self.linkage = linkage
        self._clock = clock
        self._force_sensor = force_sensor
        self._ids = [servo.servo_id for servo in settings.servos]
        self._link_checked = False
        self._one: Fingers | None = None

    def verify(self) -> VerificationReport:
        """Verify the servos, see `gripper.gripper.Gripper.start`."""
        held_before = self.life.phase is not GripperPhase.IDLE
        if not self.health.torque_on():
            self.life.switched_off()
            report = self.health.verify(correct=True, refuse=True)
            _check_standing(self.standing_rows())
            return report
        if held_before:
            self.life.found_held()
        return self.health.verify(correct=False, refuse=not held_before)

    def check_link(self, ids: Sequence[int]) -> None:
        """Raise LinkTooSlow if these servos answer too late for the loop."""
        check_link(self._bus, ids, self.settings.period_s)
        self._link_checked = True

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo; reads only."""
        return tuple(
            replace(one, strayed=self.servos.feedback.check.strayed.get(one.servo_id, ""))
            for one in self.health.conditions()
        )

    def standing_rows(self) -> tuple[VerificationRow, ...]:
        """Read the positions of the fingers, and compare them with the settings."""
        positions_raw = [self._bus.read(servo_id, PRESENT_POSITION) for servo_id in self._ids]
        return standing_rows(self.settings, self.linkage, positions_raw)

    def make_ready(self, *, releasing: bool = False) -> bool:
        """Prepare the servos for a command; return whether all of them were without torque."""
        limp: ServoFeedback | None = None
        if not self.servos.goals_in_force and not self.health.torque_on():
            limp = self.servos.read_patiently()
            positions_raw = [servo.position_raw for servo in limp.servos]
            _check_standing(standing_rows(self.settings, self.linkage, positions_raw))
            self.on_torque()
        self.servos.make_ready(
            part_possible=self.life.part_possible, releasing=releasing, limp=limp
        )
        return limp is not None

    def move_to(
        self, aperture_m: float, *, only_open: bool = False, first: bool = False
    ) -> ServoFeedback:
        """Move empty fingers to an opening in m; ``first`` where their torque has just come on."""
        kind = FirstMotion if first else MoveTo
        state = self.servos.read_patiently()
        move = kind(self.settings, self.linkage, state, aperture_m=aperture_m, only_open=only_open)
        return self.run_free(move, state)

    def run_free(self, move: FirstMotion | MoveTo, state: ServoFeedback) -> ServoFeedback:
        """Run a motion of empty fingers, and measure their friction."""

        def is_free(now: ServoFeedback) -> bool:
            # A part that is let go, and foam, push the fingers open at first.
            return abs(now.aperture_m - state.aperture_m) >= CLEAR_M

        return self.free.run(self.runner, move.step, is_free, needs_force=False)

    def release(self, observer: Observer | None) -> ReleaseReport:
        """Let go, see `gripper.gripper.Gripper.release`; a servo that cannot be moved is left."""
        if not self.servos.goals_in_force:
            self.health.demand_answers()
            left = self._not_able()
            if left:
                return self._open_one(left[0], observer)
        with self.life.command("release", observer):
            self.servos.feedback.check.letting_go = True
            try:
                was_limp = self.make_ready(releasing=True)
                # The force of a part that a stop leaves half held cannot be controlled.
                self.life.controlled = False
                wider = self._wider_open()
                state = self.move_to(self.settings.aperture_open_m, only_open=True, first=was_limp)
            finally:
                self.servos.feedback.check.letting_go = False
                self.health.end_release()
            self.life.part_possible = False
        return ReleaseReport(state=state, opened=tuple(self._ids), wider=wider)

    def request_stop(self) -> None:
        """Stop the running command with GraspStopped; safe from any thread."""
        self.runner.request_stop()
        if self._one is not None:
            self._one.request_stop()

    def _open_one(self, left: ServoCondition, observer: Observer | None) -> ReleaseReport:
        """Open one finger alone; do not touch the servo of the other one."""
        (servo_id,) = (servo_id for servo_id in self._ids if servo_id != left.servo_id)
        index = self._ids.index(servo_id)
        self._one = one = Fingers(
            self._bus,
            OneFinger(linkage=self.linkage, index=index),
            replace(self.settings, servos=(self.settings.servos[index],)),
            self._clock,
            self._force_sensor,
        )
        one._link_checked = self._link_checked
        self.servos.forget()
        try:
            with self.life.delegated(GripperPhase.RELEASING, one.life):
                state = one.release(observer).state
                with suppress(GripperError):
                    one.servos.switch_off()
        finally:
            self._one = None
        self.life.switched_off()
        return ReleaseReport(state=state, opened=(servo_id,), left=(left,))

    def _not_able(self) -> list[ServoCondition]:
        """Return the servos that cannot be moved; raises if no servo can be moved."""
        conditions = self.conditions()
        if not any(condition.answers for condition in conditions):
            self.health.require_present()
            raise BusTimeout(
                "the servos answer only sometimes, and nothing was moved: check cable and "
                "supply, then release again"
            )
        able = [condition.servo_id for condition in conditions if condition.able]
        if not able:
            limp = next(condition for condition in conditions if condition.answers)
            raise ServoFault(
                limp.servo_id,
                limp.error_bits,
                f"no finger can be opened: {'; '.join(map(str, conditions))}. Take the part out "
                f"by hand, or remedy the cause, clear the error with a reboot and release again",
            )
        if not self._link_checked:
            self.check_link(able)
        self.life.part_possible |= any(c.torque_on or not c.answers for c in conditions)
        return [condition for condition in conditions if not condition.able]

    def _wider_open(self) -> tuple[int, ...]:
        """Return the IDs of the servos whose fingers stand wider open than the gripper opens."""
        widest_rad = self.linkage.angles_rad(self.settings.aperture_open_m)
        servos = self.servos.read_patiently().servos
        return tuple(
            servo.servo_id
            for servo, open_rad in zip(servos, widest_rad, strict=True)
            if servo.angle_rad > open_rad + OPENING_MARGIN_RAD
        )


def _check_standing(rows: tuple[VerificationRow, ...]) -> None:
    """Raise VerificationFailed where a finger stands where the settings exclude it."""
    report = VerificationReport(rows=rows)
    if not report.ok:
        raise VerificationFailed(report, [str(row) for row in report.failed])
