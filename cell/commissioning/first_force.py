"""First force: empty fingers open, their watchdog is proven, then a soft part is pressed.

The motions are shown while they run, and stop when the person leaves.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from math import floor

import numpy as np
from numpy.typing import NDArray

from cell.commissioning.bench import Bench
from cell.commissioning.engine import LIVE_CALL_S, RESUME, Dialog, Step, StepFailed, WizardAborted
from cell.commissioning.findings import Notes, ProposedChange, commission_command
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.zeroing import drive_text, homing_offsets, part_between, stored_zeros
from cell.hand.client import HandProcess
from cell.hand.interface import Hand
from cell.hand.local import open_hand
from gripper.errors import FeedbackImplausible, GripperError
from gripper.force.ramp import ForceRamp
from gripper.servos.watchdog_proof import proof_travel_m
from gripper.settings import largest_setpoint_n
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.state import Cycle, GripperPhase
from tactile.source import TactileFrame

FIRST_FORCE_N = 1.0
"""Force in N of the first ramp, small enough for every part."""
_HOLD_S = 0.5
"""Time in s for which each force is held and measured."""
_WRONG_N, _WRONG_SHARE = 0.3, 0.1
"""Least reported difference of measured force and set-point in N, or as a share if that is more; a
cell's own ramps end within 0.3 N or 10 %."""
_EMPTY_SHARE = 0.5
"""Largest force that pads of empty fingers may show, as a share of the contact force."""
MEET_FORCE_N = 8.0
"""Force in N with which the empty fingers press on each other: foam on foam is so stiff that a step
of the encoders, 0.18 mm, makes 4 N."""
_MEET_N_S = 10.0
"""Rise of that force in N/s."""
_MEET_MM = 1.5
"""Opening in mm, positive or negative, at which the empty pads may meet: each foam yields by 0.3
mm, and a zero is set by hand."""
_LOSS_SHARE = 1e-3
"""Least reported share of lost answers or messages: a good line loses none."""
_LAST_PERIODS = 20
"""Periods of the loop, 0.1 s, whose mean is the force at the end of a motion."""


_LEFT = (WizardAborted, KeyboardInterrupt)
"""Errors of a person who leaves."""
_KEPT = "The fingers keep their grip: take hold of the part; the step first asks to open them"
_TICK_S = 0.08
"""Time in s of grip control between two checks of the person's answer."""


def _forces_n(periods: Sequence[Cycle]) -> NDArray[np.float64]:
    """Return the measured force of finger 0 and 1 in N of each period with a set-point.

    (n, 2) float64, NaN without a sample.
    """
    none = (np.nan, np.nan)
    pressed = [cycle for cycle in periods if cycle.setpoint_n > 0.0]
    rows = [none if cycle.force is None else cycle.force.force_n for cycle in pressed]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _grip_n(periods: Sequence[Cycle]) -> NDArray[np.float64]:
    """Return the mean measured force of both fingers in N; 0 without samples."""
    grip_n = _forces_n(periods).mean(axis=1)
    finite_n = grip_n[np.isfinite(grip_n)]
    return finite_n if finite_n.size else np.zeros(1)


def press_first(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Open the empty fingers, stop them by their bus watchdog, and press a soft part.

    Opening proves direction and zero. The watchdog must stop the fingers when this program is
    silent. Then they press the part with 1 N, with the force that you allow and, empty again, each
    other. Measured force and set-point are compared. Keep your hands away while they move.
    """
    proves = _proves_watchdog(bench.config)
    config = changed_config(bench.config, {"gripper.watchdog_self_test": proves})
    cap_n = config.gripper.force_max_n
    limit_n = floor(10.0 * largest_setpoint_n(cap_n)) / 10.0
    with _watched_hand(bench, config, dialog, notes) as trial:
        trial.let_go()
        most_n = dialog.number(
            "first_force.most",
            "Choose a soft part of 10 to 20 mm, for example a piece of foam or rubber. With which "
            f"force may it be pressed? The cap of the config allows {limit_n:g} N.",
            (FIRST_FORCE_N, limit_n, "N"),
            min(limit_n, max(config.sequence.forces_n)),
        )
        dialog.approve(_motions(config, most_n))
        text = "Take everything out of the fingers, and your hands away from them."
        dialog.confirm("first_force.empty", text)
        trial.run(most_n, cap_n)


FIRST_FORCE = Step(press_first, "first_force", "First force", needs=("fingers", "unit", "pads_law"))


def _proves_watchdog(config: CellConfig) -> bool:
    """Return whether the servos can make the slow motion of the watchdog's self-test."""
    return all(s.servo_model.profile_in_current_mode for s in config.gripper_settings.servos)


def meets(config: CellConfig) -> bool:
    """Return whether the empty fingers may be pressed on each other."""
    return config.gripper.pads_meet and config.largest_ramp_n >= MEET_FORCE_N


def _motions(config: CellConfig, most_n: float) -> list[ProposedChange]:
    gripper, settings = config.gripper, config.gripper_settings
    limp = "the torque goes off at the end of the step; if you leave, the fingers stop"
    held = "they open when you confirm it; a held part stays held if you leave"
    opened = f"{gripper.aperture_open_mm:g} mm open"
    motions = [
        ("open, empty, at the least current that moves them", "where they stand", opened, limp)
    ]
    if _proves_watchdog(config):
        travel_mm = 1e3 * proof_travel_m(config.mechanics, settings.aperture_open_m)
        after = f"at most {travel_mm:.1f} mm less, then open again"
        motions.append(("close until their bus watchdog stops them", opened, after, limp))
    after = f"{FIRST_FORCE_N:g} N, then {most_n:g} N; never above {gripper.force_max_n:g} N"
    motions.append(("grasp the soft part", "0 N", after, held))
    if meets(config):
        after = f"pad on pad with {MEET_FORCE_N:g} N, then open again"
        motions.append(("close, empty, until the pads meet", opened, after, limp))
    return [ProposedChange("both fingers", *motion) for motion in motions]


@dataclass(slots=True)
class _Trial:
    """One run of the step on open lines; a person sees each motion, and may stop it."""

    bench: Bench
    config: CellConfig
    dialog: Dialog
    notes: Notes
    hand: Hand
    periods: list[Cycle] = field(default_factory=list, init=False)
    """Periods of all motions so far."""
    homing: dict[int, int] = field(default_factory=dict, init=False)
    """Homing offset of each servo, by its ID."""
    _due_s: float = field(default=0.0, init=False)

    def let_go(self) -> None:
        """Open fingers that have torque from an earlier run, and may hold a part, if confirmed."""
        if any(condition.torque_on for condition in self.hand.conditions()):
            self.hand.start()
            self.dialog.confirm(
                "fingers.held",
                "The servos have torque from an earlier run: a part may be held. Take hold of it; "
                "the fingers open when you confirm.",
            )
            self.hand.release()

    def run(self, most_n: float, cap_n: float) -> None:
        self.homing = homing_offsets(self.hand.start())
        self.hand.start_sensor()
        self._open()
        self.notes.fact("The empty fingers opened as direction, zero and linkage predict.")
        if _proves_watchdog(self.config):
            self.notes.fact("The bus watchdog stopped them when this program was silent.")
        else:
            self.notes.warn(
                "Their bus watchdog is not proven, and some servos of the 330 size ignore it: stay "
                "at the cell while it works."
            )
        self._check_empty()
        self.ask(
            "first_force.part",
            "Hold the soft part between the pads, and keep it there until the fingers hold it.",
        )
        self._grasp(most_n, cap_n)
        if meets(self.config):
            self._meet()
        self._judge_lines()

    def _judge_lines(self) -> None:
        """Note what both lines have lost during the motions."""
        statistics = self.hand.statistics
        loop, servo_bus, source = statistics.loop, statistics.servo_bus, statistics.source
        frames, forces = source.frames, source.forces
        lost = frames.lost + frames.torn + frames.corrupt + forces.lost + source.malformed
        again = servo_bus.retries + servo_bus.corrupt
        self.notes.fact(
            f"Servos: {loop.cycles} periods, {loop.missed_reads} without an answer, {again} asked "
            f"again. Pads: {frames.complete} frames, {forces.received} force messages, {lost} lost."
        )
        if again + loop.missed_reads > _LOSS_SHARE * loop.cycles:
            self.notes.warn(
                "The servos' line loses answers: check its plugs, the ground between adapter and "
                "servos, and keep its cable away from the motors' supply. Or this machine is too "
                "busy: see loop.cpu and loop.priority."
            )
        if lost + source.error_frames > _LOSS_SHARE * (frames.complete + forces.received):
            self.notes.warn(
                "The line of the pads loses messages: check its plugs, on CAN both terminating "
                "resistors (60 Ohm between CAN_H and CAN_L, switched off), and the bus load."
            )

    def _open(self) -> None:
        """Open the empty fingers; if it fails or is left, their torque may go off at the end."""
        try:
            self.hand.open(self)
        except (GripperError, *_LEFT):
            with suppress(GripperError):
                self.hand.clear_fault(reboot=False)
            raise

    def _check_empty(self) -> None:
        """Take the zero; then check that the pads of the open fingers show no force."""
        self.hand.tare(self.config.tactile.tare_frames)
        first_n, second_n = self.hand.read_sensor(timeout_s=1.0).finger_force_n
        limit_n = _EMPTY_SHARE * self.config.gripper.contact_force_n
        self.notes.fact(
            f"Empty fingers: the pads show {first_n:.2f} and {second_n:.2f} N after a new zero."
        )
        if max(first_n, second_n) > limit_n:
            raise StepFailed(
                f"More than {limit_n:.2f} N: clear the pads, let the unit warm up for ten minutes, "
                "and run the step again."
            )

    def _meet(self) -> None:
        """Close the empty fingers onto each other: check the zero of the opening and both pads."""
        self.ask(
            "first_force.empty_again",
            "Take the part and your hands away: next the empty fingers press on each other.",
        )
        self.periods.clear()
        ramp = ForceRamp.linear(MEET_FORCE_N, _MEET_N_S, hold_s=_HOLD_S)
        outcome = self.hand.press_pads_together(ramp, self)
        if between := part_between(outcome):
            raise StepFailed(f"{between}. It is held: take hold of it, then `--redo first_force`.")
        last_n = _forces_n(self.periods)[-_LAST_PERIODS:]
        self.hand.measure_load(self)
        first_n, second_n = np.nanmean(last_n, axis=0)
        self.hand.release(self)
        self.hand.measure_friction(self)
        self._keep_drives()
        opening_mm = 1e3 * outcome.final_aperture_m
        self.notes.values["meet_mm"] = round(opening_mm, 3)
        self.notes.fact(
            f"The empty fingers met at an opening of {opening_mm:+.2f} mm, with {first_n:.2f} and "
            f"{second_n:.2f} N."
        )
        if abs(opening_mm) > _MEET_MM:
            self.notes.warn(
                "The zero of the opening is wrong: close the fingers by hand again with "
                f"`{commission_command(self.bench.folder)} --redo fingers`."
            )

    def _keep_drives(self) -> None:
        """Keep what the motions have measured of the servos' drives."""
        config, notes = self.config, self.notes
        folder = None if config.simulated else self.bench.folder / config.recording.directory
        zeros = stored_zeros(config, folder)
        drives, remarks = self.hand.read_drives()
        zeros.keep_drives(drives, self.homing)
        notes.values["drives"] = {str(number): asdict(drive) for number, drive in drives.items()}
        for servo in config.gripper_settings.servos:
            if servo.servo_id in drives:
                text = drive_text(servo, drives[servo.servo_id])
                notes.fact(f"{text[0].upper()}{text[1:]}.")
        for text in (*remarks, *filter(None, (zeros.unkept, zeros.refused))):
            notes.warn(text)

    def _grasp(self, most_n: float, cap_n: float) -> None:
        """Press the soft part, and release it."""
        ramp = self.config.sequence.ramp
        first_n = max(FIRST_FORCE_N, 1.5 * self.config.gripper.contact_force_n)
        measured: list[list[float]] = []
        for force_n in dict.fromkeys((first_n, max(first_n, most_n))):
            follow = self.hand.squeeze if measured else self.hand.grasp
            outcome = follow(ramp.to(force_n), self)
            if outcome.result in (GraspResult.NO_CONTACT, GraspResult.PART_LOST):
                raise StepFailed(
                    f"The fingers hold nothing ({outcome.result.value}): hold the part in the "
                    "middle between the pads, and run the step again."
                )
            held_n = _grip_n(self.hold(force_n, _HOLD_S))
            measured.append([force_n, *(round(float(n), 3) for n in (held_n.mean(), held_n.max()))])
            self._judge(force_n, float(held_n.mean()), outcome)
        self.hold(first_n, 0.0)
        peak_n = float(_grip_n(self.periods).max())
        self.notes.values["asked_held_peak_n"] = measured
        if peak_n > cap_n + _WRONG_N:
            self.notes.fail(
                f"The force reached {peak_n:.2f} N, above the cap of {cap_n:g} N: lower "
                "gripper.contact.approach_force_n, or gripper.approach_speed_mm_s, and run the "
                "step again."
            )
        text = "Take hold of the part; the fingers open when you confirm."
        self.ask("first_force.release", text)
        self.hand.release()

    def _judge(self, asked_n: float, held_n: float, outcome: GraspOutcome) -> None:
        """Note the quality of a held force."""
        self.notes.fact(
            f"{asked_n:g} N asked: {held_n:.2f} N held, overshoot {outcome.overshoot_n:.2f} N, "
            f"opening {1e3 * outcome.final_aperture_m:.2f} mm."
        )
        if outcome.result is GraspResult.FORCE_NOT_REACHED:
            self.notes.warn(
                f"{outcome.unreached}. If servos and parts allow more current, raise "
                "gripper.current_max_a; else take a thicker part, or ask for less."
            )
        elif abs(held_n - asked_n) > max(_WRONG_N, _WRONG_SHARE * asked_n):
            self.notes.warn(
                f"That is {held_n - asked_n:+.2f} N off: check the law of the pads "
                f"(`{commission_command(self.bench.folder)} --redo pads_law`), and the linkage for "
                "friction."
            )

    def __call__(self, cycle: Cycle, _frames: Sequence[TactileFrame] = ()) -> None:
        """Keep one period of the loop, and show it if the last shown one is old enough."""
        self.periods.append(cycle)
        if cycle.t_s >= self._due_s:
            self._due_s = cycle.t_s + LIVE_CALL_S
            force = "" if cycle.force is None else f"{min(cycle.force.force_n):.2f} N, "
            self.dialog.live("grip", f"{force}opening {1e3 * cycle.state.aperture_m:.1f} mm")

    def hold(self, force_n: float, duration_s: float) -> list[Cycle]:
        """Hold the part with a force in N for a time in s, and return the periods of it."""
        begun = len(self.periods)
        self.hand.hold_at(force_n, duration_s, self)
        return self.periods[begun:]

    def ask(self, key: str, text: str) -> None:
        """Ask for an action by hand; watchdog and held part are looked after meanwhile."""
        self.dialog.confirm(key, text, watch=self._look_after)

    def _look_after(self) -> str:
        """Feed the watchdog, and control a held part, for a while; return the phase as text."""
        end_s = self.bench.clock.monotonic() + _TICK_S
        while self.bench.clock.monotonic() < end_s:
            self.hand.tick()
            self.bench.clock.sleep(self.hand.period_s)
        return f"fingers: {self.hand.phase.value.replace('_', ' ')}"


@contextmanager
def _watched_hand(
    bench: Bench, config: CellConfig, dialog: Dialog, notes: Notes
) -> Iterator[_Trial]:
    """Open the hand of a config on the bench's lines.

    A person who leaves stops the fingers. At the end the torque goes off if nothing is held; a held
    part stays held, with a message to the person who leaves. Raises PortLost, LinkFault or HandLost
    if a line cannot be opened.
    """
    if bench.clock is time and config.loop.own_process:
        hand: Hand = HandProcess(config)
    else:
        lines = bench.lines
        hand = open_hand(
            config, clock=lines.clock, open_serial=lines.open_serial, open_can=lines.open_can
        )
    trial = _Trial(bench, config, dialog, notes, hand)
    try:
        yield trial
    except BaseException as error:
        limp = isinstance(error, FeedbackImplausible)  # the torque is off then
        if limp or hand.phase in (GripperPhase.OFF, GripperPhase.IDLE):
            raise
        if not isinstance(error, _LEFT):
            notes.warn(_KEPT)
            raise
        raise WizardAborted(f"{str(error) or f'left. {RESUME}'}. {_KEPT}") from None
    finally:
        try:
            hand.shutdown()
        finally:
            hand.close()
