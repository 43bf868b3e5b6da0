"""First force: empty fingers open, their watchdog is proven, then a soft part is pressed."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cell.commissioning.bench import Bench
from cell.commissioning.engine import (
    Dialog,
    Finding,
    Left,
    Number,
    Question,
    Verdict,
    Write,
    confirmation,
)
from cell.commissioning.figures import Figure, curves
from cell.commissioning.motion import WatchedMotion
from cell.commissioning.pads import WORSE
from cell.commissioning.unit import gripper_alone
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.config.sequence import force_ramp
from cell.errors import CellError
from cell.hand.build import make_hand
from cell.hand.client import HandProcess
from cell.hand.interface import Hand, Watch
from cell.hand.lines import Lines
from gripper.errors import GripperError
from gripper.force.by_current import cap_by_current_n
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper, open_gripper
from gripper.settings import largest_setpoint_n
from gripper.state import (
    Clock,
    Cycle,
    GraspOutcome,
    GraspResult,
    GripperPhase,
    ReleaseReport,
    VerificationReport,
)
from tactile.errors import TactileError
from tactile.frames.codec import TactileFrame

FIRST_FORCE_N = 1.0
"""Force in N of the first ramp: a part that it breaks is held by nothing."""
_HOLD_S = 0.5
"""Time in s for which each force is held and measured."""
_WRONG_N, _WRONG_SHARE = 0.2, 0.08
"""Difference of measured and asked force in N, or as a share if that is more, that is worth a word:
a cell's own ramps end within 0.2 N or 5 %."""
_EMPTY_SHARE = 0.5
"""Share of the contact force up to which pads of empty fingers may show force."""
MEET_FORCE_N = 8.0
"""Force in N with which the empty fingers press on each other: foam on foam is so stiff that a step
of the encoders, 0.18 mm, makes 4 N."""
_MEET_N_S = 10.0
"""Rise of that force in N/s."""
_MEET_MM = 1.5
"""Opening in mm, either way, at which the empty pads may meet: foam gives by 0.3 mm each, and a
zero is set by hand."""
_LAST_PERIODS = 20
"""Periods of the loop, 0.1 s, whose mean is the force at the end of a motion."""
_GAP_S = 0.1
"""Time in s without an asked force that parts two curves in the picture."""
_TICK_S = 0.08
"""Time in s for which the grip is controlled between two looks at the person's answer."""


class Fingers(Protocol):
    """What a first grasp commands: a hand with pads, or a gripper by itself."""

    @property
    def phase(self) -> GripperPhase:
        """What the gripper is doing."""
        ...

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves."""
        ...

    def open(self, watch: Watch) -> None:
        """Open the empty fingers."""
        ...

    def grasp(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Close until the part is touched, follow the ramp."""
        ...

    def carry(self, force_n: float, duration_s: float, watch: Watch) -> None:
        """Hold the part with a force for a time, and control it on between commands."""
        ...

    def squeeze(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Follow a further ramp in the same grip."""
        ...

    def release(self, watch: Watch | None = None) -> ReleaseReport:
        """Let go."""
        ...

    def tick(self) -> None:
        """Look after the grip between commands."""
        ...

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos."""
        ...

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped."""
        ...


class GripperAlone:
    """Implements `Fingers` with a gripper whose force is known by the motors' current."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper

    @property
    def phase(self) -> GripperPhase:
        """What the gripper is doing."""
        return self._gripper.state

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves."""
        return self._gripper.start()

    def open(self, watch: Watch) -> None:
        """Open the empty fingers."""
        self._gripper.open(observer=lambda cycle: watch(cycle, ()))

    def grasp(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Close until the part is touched, follow the ramp."""
        return self._gripper.grasp(ramp, observer=lambda cycle: watch(cycle, ()))

    def carry(self, force_n: float, duration_s: float, watch: Watch) -> None:
        """Hold the part with a force for a time, and control it on between commands."""
        self._gripper.carry(force_n, duration_s, lambda cycle: watch(cycle, ()))

    def squeeze(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Follow a further ramp in the same grip."""
        return self._gripper.squeeze(ramp, lambda cycle: watch(cycle, ()))

    def release(self, watch: Watch | None = None) -> ReleaseReport:
        """Let go."""
        return self._gripper.release()

    def tick(self) -> None:
        """Look after the grip between commands."""
        self._gripper.tick()

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos."""
        self._gripper.clear_fault(reboot=reboot)

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped."""
        self._gripper.request_stop()


@contextmanager
def bench_hand(bench: Bench, config: CellConfig) -> Iterator[Hand]:
    """Open the hand of a config on the bench's lines.

    At the end the torque goes off where nothing is held; what is held stays held.

    Raises
    ------
    PortLost, LinkFault, HandLost
        If a line cannot be opened.
    """
    gripper, tactile = config.gripper, config.tactile
    hand: Hand
    if bench.clock is time and config.loop.own_process:
        hand = HandProcess(config)
    else:
        lines = Lines(
            lambda: bench.lines.open_servos(gripper.port, gripper.baud_rate),
            lambda: bench.lines.open_can(tactile.interface, tactile.channel, tactile.bitrate),
        )
        hand = make_hand(config, lines)
    try:
        yield hand
    finally:
        try:
            hand.shutdown()
        finally:
            hand.close()


@contextmanager
def _alone(bench: Bench, config: CellConfig) -> Iterator[GripperAlone]:
    """Open the gripper of a config without its control unit."""
    stream = bench.lines.open_servos(config.gripper.port, config.gripper.baud_rate)
    gripper = open_gripper(
        stream, config.gripper_settings, config.linkage, baud_rate=config.gripper.baud_rate
    )
    try:
        yield GripperAlone(gripper)
    finally:
        gripper.close()
        gripper.bus.close()


def start_free(fingers: Fingers, dialog: Dialog) -> None:
    """Verify the servos; fingers that an earlier run left with torque are opened first.

    They may hold a part: the person confirms it.
    """
    fingers.start()
    if fingers.phase is GripperPhase.HELD_AFTER_FAULT:
        dialog.ask(
            confirmation(
                "fingers.held",
                "The servos have torque from before: a part may be held. Take hold of it; the "
                "fingers open when you confirm.",
            )
        )
        fingers.release()
        fingers.start()


@contextmanager
def told_if_held(fingers: Fingers) -> Iterator[None]:
    """Say on the way out, where the person leaves, that the fingers still hold what they hold."""
    try:
        yield
    except Left as left:
        if fingers.phase in (GripperPhase.OFF, GripperPhase.IDLE):
            raise
        raise Left(
            f"{left}. The fingers keep their grip: take hold of the part and run `tactile-cell "
            "commission` again, it asks to open them first"
        ) from None


def look_after(fingers: Fingers, clock: Clock, period_s: float) -> str:
    """Feed the watchdog, and control what is held, for a while; returns the phase as text."""
    end_s = clock.monotonic() + _TICK_S
    while clock.monotonic() < end_s:
        fingers.tick()
        clock.sleep(period_s)
    return f"fingers: {fingers.phase.value.replace('_', ' ')}"


@dataclass(slots=True)
class Course:
    """Course of the force over a trial."""

    t_s: list[float] = field(default_factory=list)
    asked_n: list[float] = field(default_factory=list)
    first_n: list[float] = field(default_factory=list)
    second_n: list[float] = field(default_factory=list)
    """Time in s, force asked for, and measured on finger 0 and 1, in N; NaN without a sample."""

    def watch(self, cycle: Cycle, _frames: Sequence[TactileFrame]) -> None:
        """Take one period of the loop."""
        if cycle.setpoint_n <= 0.0:
            return
        nan = float("nan")
        if self.t_s and cycle.t_s - self.t_s[-1] > _GAP_S:
            # No line goes from one motion to the next.
            self.t_s.append(cycle.t_s)
            self.asked_n.append(nan)
            self.first_n.append(nan)
            self.second_n.append(nan)
        first_n, second_n = (nan, nan) if cycle.force is None else cycle.force.force_n
        self.t_s.append(cycle.t_s)
        self.asked_n.append(cycle.setpoint_n)
        self.first_n.append(first_n)
        self.second_n.append(second_n)

    def last_n(self, since: int) -> tuple[float, float]:
        """Return the force on finger 0 and 1 in N in the last periods, of those since one."""
        means = [
            float(np.nanmean(values[since:][-_LAST_PERIODS:]))
            for values in (self.first_n, self.second_n)
        ]
        return round(means[0], 3), round(means[1], 3)

    @property
    def grip_n(self) -> list[float]:
        """Mean of both fingers in N."""
        return [0.5 * (a + b) for a, b in zip(self.first_n, self.second_n, strict=True)]

    def held_n(self, since: int) -> tuple[float, float]:
        """Return mean and largest measured grip force in N from a period on."""
        known = [force_n for force_n in self.grip_n[since:] if np.isfinite(force_n)]
        return (float(np.mean(known)), max(known)) if known else (0.0, 0.0)

    def figure(self, cap_n: float) -> Figure:
        """Return the picture of asked and measured force over time."""
        begin_s = self.t_s[0] if self.t_s else 0.0
        return curves(
            "Force asked for and measured",
            [t_s - begin_s for t_s in self.t_s],
            {
                "asked": self.asked_n,
                "measured": self.grip_n,
                "finger 0": self.first_n,
                "finger 1": self.second_n,
            },
            x_label="time / s",
            y_label="force / N",
            limits={"cap": cap_n},
        )


@dataclass(frozen=True, slots=True)
class FirstForceStep:
    """Makes the first grasp: empty fingers, watchdog, 1 N, then the cap."""

    key: str = "first_force"
    title: str = "First force"
    purpose: str = (
        "The empty fingers open and prove direction and zero; their bus watchdog has to stop them "
        "when this program falls silent; then they press a soft part with 1 N, and with as much as "
        "you allow, and, empty again, each other. Measured and asked force are compared. Keep your "
        "hands away while they move."
    )
    needs: tuple[str, ...] = ("fingers", "unit", "pads_law", "link_quality")
    undo: str = "nothing is written; the torque goes off at the end"

    def run(self, bench: Bench, dialog: Dialog) -> Finding:
        """Carry it out; see `Step.run`."""
        lines: list[str] = []
        course = Course()
        try:
            config = changed_config(bench.config, {"gripper.watchdog_self_test": True})
            alone = gripper_alone(bench)
            cap_n = config.gripper.force_max_n
            if alone:
                cap_n = cap_by_current_n(config.gripper_settings, config.linkage)
            most_n = _asked(dialog, round(largest_setpoint_n(cap_n), 1))
            dialog.approve(_motions(config, most_n, alone=alone))
            dialog.ask(
                confirmation(
                    "first_force.empty",
                    "Take everything out of the fingers, and your hands away from them.",
                )
            )
            trial = _Trial(config, dialog, bench.clock, course, lines, most_n=most_n, cap_n=cap_n)
            if alone:
                with _alone(bench, config) as fingers:
                    return trial.run(fingers)
            with bench_hand(bench, config) as hand:
                return trial.run(hand, hand)
        except (CellError, GripperError, TactileError) as error:
            if isinstance(error, Left):
                raise
            figures = {"force": course.figure(cap_n)} if course.t_s else {}
            return Finding(
                status=Verdict.FAIL,
                lines=(*lines, f"{type(error).__name__}: {error}"),
                figures=figures,
            )


def _asked(dialog: Dialog, limit_n: float) -> float:
    """Return how hard the soft part may be pressed in N."""
    answer = dialog.ask(
        Question(
            key="first_force.most",
            text="Choose a soft part of 10 to 20 mm, as a piece of foam or rubber. With which "
            f"force may it be pressed? {limit_n:g} N is what the cap of the config allows.",
            number=Number(lowest=FIRST_FORCE_N, highest=limit_n, unit="N"),
            default=limit_n,
        )
    )
    return float(answer)


def meets(config: CellConfig) -> bool:
    """Return whether the empty fingers may be pressed on each other."""
    return config.gripper.pads_meet and config.gripper.ramp_force_max_n >= MEET_FORCE_N


def _motions(config: CellConfig, most_n: float, *, alone: bool) -> list[Write]:
    gripper = config.gripper
    limp = "the torque goes off at the end of the step; who leaves stops the fingers where they are"
    opened = f"{gripper.aperture_open_mm:g} mm open"
    motions = [
        (
            "open, empty, at the least current that moves them",
            "where they stand",
            opened,
            limp,
        ),
        (
            "close by some mm until their bus watchdog stops them",
            opened,
            "at most 12 mm less, then open again",
            limp,
        ),
        (
            "grasp the soft part",
            "0 N",
            f"{FIRST_FORCE_N:g} N, then {most_n:g} N; never above {gripper.force_max_n:g} N",
            "they open when you confirm it; a part that is held stays held where you leave",
        ),
    ]
    if meets(config) and not alone:
        after = f"pad on pad with {MEET_FORCE_N:g} N, then open again"
        motions.append(("close, empty, until the pads meet", opened, after, limp))
    return [
        Write(where="both fingers", what=what, before=before, after=after, undo=undo)
        for what, before, after, undo in motions
    ]


class _Trial:
    """One run of the step on open lines."""

    def __init__(
        self,
        config: CellConfig,
        dialog: Dialog,
        clock: Clock,
        course: Course,
        lines: list[str],
        *,
        most_n: float,
        cap_n: float,
    ) -> None:
        self._config = config
        self._dialog = dialog
        self._clock = clock
        self._course = course
        self._lines = lines
        self._most_n = most_n
        self._cap_n = cap_n
        self._first_n = max(FIRST_FORCE_N, 1.5 * config.gripper.contact_force_n)
        self._status = Verdict.PASS
        self._values: dict[str, object] = {}
        self._watch: Watch = course.watch

    def run(self, fingers: Fingers, hand: Hand | None = None) -> Finding:
        """Open, prove, grasp, release; the hand is given where there are pads."""
        with (
            told_if_held(fingers),
            WatchedMotion(self._dialog, fingers.request_stop) as motion,
        ):
            self._watch = motion.also(self._course.watch)
            return self._run(fingers, hand)

    def _run(self, fingers: Fingers, hand: Hand | None) -> Finding:
        start_free(fingers, self._dialog)
        if hand is not None:
            hand.start_sensor()
        self._open(fingers)
        self._lines.append(
            "The empty fingers opened as direction, zero and linkage say, and the bus watchdog "
            "stopped them when this program fell silent."
        )
        if hand is not None and not self._empty(hand):
            return self._finding(Verdict.FAIL)
        self._dialog.ask(
            confirmation(
                "first_force.part",
                "Hold the soft part between the pads, and keep it there until the fingers hold it.",
            ),
            watch=lambda: self._looked_after(fingers),
        )
        if not self._grasp(fingers):
            return self._finding(Verdict.FAIL)
        if hand is not None and meets(self._config):
            self._meet(hand)
        return self._finding(self._status)

    def _open(self, fingers: Fingers) -> None:
        """Open the empty fingers; where that fails their torque may go off at the end."""
        try:
            fingers.open(self._watch)
        except GripperError:
            with suppress(GripperError):
                fingers.clear_fault(reboot=False)
            raise

    def _empty(self, hand: Hand) -> bool:
        """Take the zero, and return whether the pads of the open fingers show no force."""
        hand.tare(self._config.tactile.tare_frames)
        first_n, second_n = hand.read_sensor(timeout_s=1.0).finger_force_n
        limit_n = _EMPTY_SHARE * self._config.gripper.contact_force_n
        self._values["empty_n"] = [round(first_n, 4), round(second_n, 4)]
        self._lines.append(
            f"Empty fingers: the pads show {first_n:.2f} and {second_n:.2f} N after a new zero."
        )
        if max(first_n, second_n) <= limit_n:
            return True
        self._lines.append(
            f"More than {limit_n:.2f} N: something touches a pad, or its zero drifts. Clear the "
            "pads, let the unit warm up for ten minutes, and run the step again."
        )
        return False

    def _meet(self, hand: Hand) -> None:
        """Close the empty fingers onto each other: the zero of the opening, and pad against pad."""
        self._dialog.ask(
            confirmation(
                "first_force.empty_again",
                "Take the part away, and your hands: the empty fingers press on each other next.",
            ),
            watch=lambda: self._looked_after(hand),
        )
        begun = len(self._course.t_s)
        outcome = hand.meet(ForceRamp.linear(MEET_FORCE_N, _MEET_N_S, hold_s=_HOLD_S), self._watch)
        first_n, second_n = self._course.last_n(since=begun)
        hand.release(self._watch)
        opening_mm = 1e3 * outcome.final_aperture_m
        self._values |= {"meet_mm": round(opening_mm, 3), "meet_n": [first_n, second_n]}
        self._lines.append(
            f"The empty fingers met at an opening of {opening_mm:+.2f} mm, with {first_n:.2f} and "
            f"{second_n:.2f} N."
        )
        if abs(opening_mm) > _MEET_MM:
            self._status = max(self._status, Verdict.WARN, key=WORSE.index)
            self._lines.append(
                "The zero of the opening is off: close the fingers by hand again with "
                "`tactile-cell commission --redo fingers`."
            )

    def _grasp(self, fingers: Fingers) -> bool:
        """Press the soft part and let it go; returns whether it was held."""
        ramp = self._config.sequence.ramp
        first_n = self._first_n
        forces_n = [first_n] + ([self._most_n] if self._most_n > first_n else [])
        measured, begun = [], False
        for force_n in forces_n:
            follow = fingers.squeeze if begun else fingers.grasp
            outcome = follow(force_ramp(ramp, force_n), self._watch)
            if outcome.result in (GraspResult.NO_CONTACT, GraspResult.PART_LOST):
                self._lines.append(
                    f"The fingers hold nothing ({outcome.result.value}): hold the part in the "
                    "middle between the pads, and run the step again."
                )
                return False
            begun = True
            since = len(self._course.t_s)
            fingers.carry(force_n, _HOLD_S, self._watch)
            held_n, peak_n = self._course.held_n(since)
            measured.append([force_n, round(held_n, 3), round(peak_n, 3)])
            self._judge(force_n, held_n, outcome)
        fingers.carry(first_n, 0.0, self._watch)
        peak_n = max((n for n in self._course.grip_n if np.isfinite(n)), default=0.0)
        self._values |= {"asked_held_peak_n": measured, "peak_n": round(peak_n, 3)}
        if peak_n > self._cap_n + _WRONG_N:
            self._status = Verdict.FAIL
            self._lines.append(
                f"The force reached {peak_n:.2f} N, above the cap of {self._cap_n:g} N: lower "
                "gripper.contact.approach_force_n, or gripper.approach_speed_mm_s, and run the "
                "step again."
            )
        self._dialog.ask(
            confirmation(
                "first_force.release",
                "Take hold of the part; the fingers open when you confirm.",
            ),
            watch=lambda: self._looked_after(fingers),
        )
        fingers.release()
        return True

    def _judge(self, asked_n: float, held_n: float, outcome: GraspOutcome) -> None:
        """Say how a force was reached and held."""
        self._lines.append(
            f"{asked_n:g} N asked: {held_n:.2f} N held, overshoot {outcome.overshoot_n:.2f} N, "
            f"opening {1e3 * outcome.final_aperture_m:.2f} mm."
        )
        if outcome.result is GraspResult.FORCE_NOT_REACHED:
            self._status = max(self._status, Verdict.WARN, key=WORSE.index)
            self._lines.append(
                "That force was not reached: raise gripper.current_max_a where servos and parts "
                "allow it, or ask for less."
            )
        elif abs(held_n - asked_n) > max(_WRONG_N, _WRONG_SHARE * asked_n):
            self._status = max(self._status, Verdict.WARN, key=WORSE.index)
            self._lines.append(
                f"That is {held_n - asked_n:+.2f} N off: check the law of the pads (`tactile-cell "
                "commission --redo pads_law`), and the linkage for friction."
            )

    def _looked_after(self, fingers: Fingers) -> str:
        return look_after(fingers, self._clock, 1.0 / self._config.gripper.loop_rate_hz)

    def _finding(self, status: Verdict) -> Finding:
        figures = {"force": self._course.figure(self._cap_n)} if self._course.t_s else {}
        return Finding(
            status=status, lines=tuple(self._lines), values=self._values, figures=figures
        )
