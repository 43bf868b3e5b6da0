"""Zeros of the hand: of the taxels, and with empty fingers that of opening, gains and foam."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from cell.config.model import CellConfig
from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle
from cell.control.records import GraspCollector
from cell.control.self_zero import (
    SelfZeros,
    dead_taxels_text,
    drive_text,
    part_between,
    unsound,
    zero_text,
)
from cell.control.states import Event
from cell.control.watch import MotionWatch
from cell.errors import ZeroRefused
from cell.hand.interface import Hand, OnPeriod
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.errors import PartBetweenFingers
from gripper.force.ramp import ForceRamp
from gripper.mechanics.kinematics import opening_steps_m
from gripper.values.outcome import GraspOutcome
from gripper.values.state import Cycle, TimeSpan
from recognition.drift.self_zero import ZeroMeasurement, measure_zero, shows_part
from tactile.sensor.tare import TareResult
from tactile.source import TactileFrame

BORNE_SHARE = 0.9
"""Share of the force of the whole current that the fingers press with: the rest is for control."""
_ZERO_FORCE_N, _ZERO_RATE_N_S = 10.0, 5.0
"""Force in N with which the empty fingers press on each other, and its rate in N/s. Two pads of 55
x 20 mm yield 0.36 mm together, and a ramp of two seconds shows this on each taxel."""
_LOOK_FRAMES, _LOOKS_UP_TO_N = 3, 5.0
"""Frames between two checks for a part between the fingers, up to that set-point in N."""


@dataclass
class Zeroing:
    """Takes the zeros of the hand, and measures the drives of its servos with the self-zero."""

    config: CellConfig
    hand: Hand
    life: CellLifecycle
    journal: Journal
    watch: MotionWatch
    zeros: SelfZeros
    """The newest self-zero."""
    taxels: TareResult | None = None
    """Newest zero of the taxels; None before the first start."""
    homing: dict[int, int] = field(default_factory=dict)
    """Homing offset of each servo, by its ID, as of the last start."""
    missed: str = ""
    """Why the last start measured no self-zero; else empty."""

    @property
    def note(self) -> str:
        """Why there is no self-zero, or why it was not saved for other programs; else empty."""
        return self.missed or self.zeros.unkept or self.zeros.refused

    @property
    def drives(self) -> dict[int, DriveCharacteristic]:
        """Newest measured drive characteristic of each servo that is there, by its ID."""
        return self.zeros.stored_drives(self.homing)

    def open(self) -> None:
        """Open the fingers; take the zero of a drifting sensor before each approach."""
        self.hand.open(self.watch.motion)
        if n_frames := self.config.tactile.sensor.fresh_zero_frames:
            self.taxels = self.hand.tare(n_frames)

    def start(self) -> None:
        """Open the fingers and take the zero of the taxels; a self-zero follows if it is due.

        If a daily one finds a part, the fingers open again, and `missed` has the reason.
        """
        self.hand.open(self.watch.motion)
        self.taxels = self.hand.tare(self.config.tactile.tare_frames)
        self.life.check_cancelled()
        self.missed = ""
        if not self.zeros.due:
            return
        try:
            self._measure(asked=self.zeros.wanted)
        except ZeroRefused as error:
            if self.zeros.wanted:
                raise
            self._note_each_drive()
            self.missed = (
                f"no self-zero today, answers allow for any drift: {error}. The fingers are open. "
                f"Take everything out of the grip, then `tactile-cell hand zero`; with `self_zero: "
                f"on_demand` no start closes the fingers"
            )
            self.journal.note("note", self.missed)

    def measure(self) -> ZeroMeasurement:
        """Close the empty fingers on each other and measure the zero of the opening, gains, foam.

        The grasps that follow include it, so that changes since teaching are corrected.

        Raises
        ------
        PlanRefused
            If the config allows no self-zero for these fingers; nothing has moved.
        gripper.errors.PartBetweenFingers
            If something is between them; the grip is kept.
        ZeroRefused
            If a pad or a finger is out of bounds; the fingers are open.
        CellStopped
            If it was cancelled. The fingers press on each other until a release.
        """
        self.zeros.check()
        self.life.obey_cancel_between()
        self.journal.begin()
        with self.life.executing(Event.EXECUTE):
            zeroed = self._measure(asked=True)
            self.missed = ""
            self.life.complete()
        return zeroed

    def keep_drives(self) -> DriveReport:
        """Save the measured drive characteristics; return them."""
        report = self.note_drives()
        self.zeros.keep_drives(report.drives, self.homing)
        return report

    def note_drives(self) -> DriveReport:
        """Note unusual drive characteristics; return all of them."""
        report = self.hand.read_drives()
        for text in report.notes:
            self.journal.note("note", text)
        return report

    def _measure(self, *, asked: bool) -> ZeroMeasurement:
        """Close the empty fingers, measure, and open them again; else raise.

        ``asked``: somebody has checked that the fingers are empty. A part between them is then
        kept; else it is released, and a zero far off may be a flat part.
        """
        self.open()
        collector, collect = self.watch.collecting()
        outcome, zeroed, refused = self._meet(collector, collect)
        between = part_between(outcome, zeroed)
        if between and asked:
            raise PartBetweenFingers(
                f"{between}. The grip is kept. Look at the fingers; clear the fault and release"
            )
        if zeroed is not None:
            refused = unsound(zeroed) or ("" if asked else self.zeros.far_off(zeroed.zero))
        alone: Sequence[TimeSpan] = ()
        if not (between or refused):
            alone = self.hand.measure_load(collect)
        self.hand.release(self.watch.motion)
        if zeroed is None or between or refused:
            raise ZeroRefused(between or refused)
        if alone:
            zeroed = self._zeroed(collector, alone)
        self.hand.measure_friction(self.watch.motion)
        self._note_each_drive()
        self.zeros.keep(zeroed.zero)
        self.journal.note("self_zero", zero_text(zeroed))
        if self.zeros.unkept:
            self.journal.note("note", self.zeros.unkept)
        if dead := dead_taxels_text(zeroed, self.hand.layout):
            self.journal.note("taxels", dead)
        return zeroed

    def _meet(
        self, collector: GraspCollector, collect: OnPeriod
    ) -> tuple[GraspOutcome, ZeroMeasurement | None, str]:
        """Press the empty fingers on each other; stop if the pads show a part.

        Returns while they press: the outcome, the measurement or None, and why it is None.
        """
        layout, n_seen = self.hand.layout, 0

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            nonlocal n_seen
            collect(cycle, frames)
            if frames and 0.0 < cycle.setpoint_n < _LOOKS_UP_TO_N:
                n_seen += 1
                if n_seen % _LOOK_FRAMES == 0 and shows_part(
                    collector.grasp(), layout.gripping_pads
                ):
                    self.hand.end_ramp()

        most_n = min(_ZERO_FORCE_N, BORNE_SHARE * self.hand.largest_ramp_n)
        outcome = self.hand.press_pads_together(
            ForceRamp.linear(most_n, rate_n_s=_ZERO_RATE_N_S), watch
        )
        if part_between(outcome):
            return outcome, None, ""
        try:
            return outcome, self._zeroed(collector), ""
        except ValueError as error:
            return outcome, None, f"{error}; measure again"

    def _zeroed(self, collector: GraspCollector, alone: Sequence[TimeSpan] = ()) -> ZeroMeasurement:
        """Return the measurement by the frames so far; ``alone``: when one finger moved alone."""
        return measure_zero(
            collector.grasp(),
            self.hand.layout.gripping_pads,
            step_m=sum(opening_steps_m(self.config.gripper_settings, self.config.linkage)),
            alone=collector.during(alone),
        )

    def _note_each_drive(self) -> None:
        """Save and note the drive characteristic of each servo after a start or a self-zero."""
        report = self.keep_drives()
        for servo in self.config.gripper_settings.servos:
            drive = report.drives.get(servo.servo_id)
            if drive is not None:
                self.journal.note("servo drive", drive_text(servo, drive))
