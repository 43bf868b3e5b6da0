"""Motions with a person: shown while they run, and stopped when the person leaves."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from cell.commissioning.bench import Bench
from cell.commissioning.engine import LIVE_CALL_S, Dialog, StepFailed, WizardAborted
from cell.config.model import CellConfig
from cell.control.self_zero import homing_offsets
from cell.hand.build import make_hand
from cell.hand.client import HandProcess
from cell.hand.connections import HandConnections
from cell.hand.interface import Hand
from gripper.clock import Clock
from gripper.errors import GraspStopped
from gripper.values.servo_checks import VerificationReport
from gripper.values.state import Cycle, GripperPhase
from tactile.can.bus import MissingBus
from tactile.source import TactileFrame

_TICK_S = 0.08
"""Time in s of grip control between two checks of the person's answer."""


Period = tuple[Cycle, Sequence[TactileFrame]]
"""One period of the force loop and the tactile frames that came in it."""


@dataclass(slots=True)
class WatchedHand:
    """A started hand, and the watch of its commands: a person sees each motion and may stop it."""

    hand: Hand
    dialog: Dialog
    clock: Clock
    left: WizardAborted | None = field(default=None, init=False)
    """The error of the person who left, or None."""
    periods: list[Period] = field(default_factory=list, init=False)
    """Periods of all motions so far."""
    homing: dict[int, int] = field(default_factory=dict, init=False)
    """Homing offset of each servo, by its ID."""
    _due_s: float = field(default=0.0, init=False)

    def __call__(self, cycle: Cycle, frames: Sequence[TactileFrame] = ()) -> None:
        """Keep one period of the loop, and show it if the last shown one is old enough."""
        self.periods.append((cycle, frames))
        if self.left is not None or cycle.t_s < self._due_s:
            return
        self._due_s = cycle.t_s + LIVE_CALL_S
        force = "" if cycle.force is None else f"{min(cycle.force.force_n):.2f} N, "
        try:
            self.dialog.live("grip", f"{force}opening {1e3 * cycle.state.aperture_m:.1f} mm")
        except WizardAborted as left:
            self.left = left
            self.hand.request_stop()

    def hold(self, force_n: float, duration_s: float) -> list[Period]:
        """Hold the part with a force in N for a time in s, and return the periods of it."""
        begun = len(self.periods)
        self.hand.hold_at(force_n, duration_s, self)
        return self.periods[begun:]

    def ask(self, key: str, text: str) -> None:
        """Ask for an action by hand; watchdog and held part are looked after meanwhile."""
        self.dialog.confirm(key, text, watch=self._look_after)

    def _look_after(self) -> str:
        """Feed the watchdog, and control a held part, for a while; return the phase as text."""
        end_s = self.clock.monotonic() + _TICK_S
        while self.clock.monotonic() < end_s:
            self.hand.tick()
            self.clock.sleep(self.hand.period_s)
        return f"fingers: {self.hand.phase.value.replace('_', ' ')}"


@contextmanager
def watched_hand(bench: Bench, config: CellConfig, dialog: Dialog) -> Iterator[WatchedHand]:
    """Open and start the hand of a config on the bench's lines.

    A person who leaves stops the fingers. At the end the torque goes off if nothing is held; a held
    part stays held, with a message to the person who leaves. Raises PortLost, LinkFault or HandLost
    if a line cannot be opened.
    """
    hand = _opened(bench, config)
    motion = WatchedHand(hand, dialog, bench.clock)
    try:
        motion.homing = homing_offsets(_start_free(hand, dialog))
        yield motion
        if motion.left is not None:
            raise motion.left
    except (WizardAborted, GraspStopped, StepFailed) as error:
        left = error if isinstance(error, WizardAborted) else motion.left
        if left is None:
            raise
        if hand.phase in (GripperPhase.OFF, GripperPhase.IDLE):
            raise left from None
        raise WizardAborted(
            f"{left}. The fingers keep their grip: take hold of the part and run `tactile-cell "
            "commission` again; it first asks to open them"
        ) from None
    finally:
        try:
            hand.shutdown()
        finally:
            hand.close()


def _opened(bench: Bench, config: CellConfig) -> Hand:
    gripper, tactile = config.gripper, config.tactile
    if bench.clock is time and config.loop.own_process:
        return HandProcess(config)
    lines = HandConnections(
        lambda: bench.lines.open_servos(gripper.port, gripper.baud_rate),
        lambda: (
            MissingBus()
            if not tactile.sensor.on_can
            else bench.lines.open_can(tactile.interface, tactile.channel, tactile.bitrate)
        ),
        open_boards=bench.board_openers(tactile),
    )
    return make_hand(config, lines, clock=bench.clock)


def _start_free(hand: Hand, dialog: Dialog) -> VerificationReport:
    """Verify the servos; first open fingers that have torque from an earlier run.

    They may hold a part: the person confirms it.
    """
    report = hand.start()
    if hand.phase is GripperPhase.HELD_AFTER_FAULT:
        dialog.confirm(
            "fingers.held",
            "The servos have torque from an earlier run: a part may be held. Take hold of it; the "
            "fingers open when you confirm.",
        )
        hand.release()
        report = hand.start()
    return report
