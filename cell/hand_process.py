"""The hand in a process of its own: this end asks, `cell.hand_main` carries out."""

import time
from typing import Any, NoReturn

from cell.config import CellConfig
from cell.errors import HandLost
from cell.hand import HandStatistics, Watch
from cell.hand_build import gripper_settings, make_linkage
from cell.hand_child import LoopProcess
from cell.hand_wire import (
    Answer,
    ClearFault,
    CloseSensor,
    Command,
    EndRamp,
    Fault,
    GraspUnder,
    Inspect,
    KeepGrip,
    Open,
    Progress,
    ReadSensor,
    Release,
    Request,
    Shutdown,
    Start,
    StartSensor,
    Tare,
    received_error,
)
from cell.layouts import layout_from_config
from gripper.errors import GripperError, copy_fingers
from gripper.ramp import ForceRamp
from gripper.ramp_limits import check_ramp
from gripper.state import GraspOutcome, GripperPhase
from gripper.verification import VerificationReport
from tactile.errors import TactileError
from tactile.layout import TaxelLayout
from tactile.link_settings import NodeIdentity
from tactile.reading import TactileReading

_AT_REST = (GripperPhase.OFF, GripperPhase.IDLE)


class HandProcess:
    """Implements `cell.hand.Hand` with a process that owns both ports and runs the loop.

    A process that ends, or that tells nothing for too long, is a `HandLost` from then on, until
    `clear_fault` starts another one. The end of this program, or `close`, ends the process; in
    each case it keeps a held part held.

    Parameters
    ----------
    config
        The cell; its ports are real.
    silence_s
        Longest time in s without a word of the process while the loop runs; what does not run
        the loop may take longer, as the config's time-outs say.

    Raises
    ------
    gripper.errors.PortLost, tactile.errors.LinkFault
        If a port or bus cannot be opened.
    HandLost
        If the process does not come up.
    """

    def __init__(self, config: CellConfig, *, silence_s: float = 5.0) -> None:
        self._config = config
        self._layout = layout_from_config(config.tactile)
        self._settings = gripper_settings(config)
        self._linkage = make_linkage(config)
        self._silence_s = silence_s
        self._answer_s = 2.0 * silence_s + 4.0 * config.tactile.startup_timeout_s
        self._number = 0
        self._phase = GripperPhase.OFF
        self._loop = LoopProcess(config)
        self._statistics = self._loop.ready.statistics
        self._heard_s = time.monotonic()

    # -- what is known here --------------------------------------------------------------------

    @property
    def layout(self) -> TaxelLayout:
        """The taxels."""
        return self._layout

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return 1.0 / self._config.gripper.loop_rate_hz

    @property
    def phase(self) -> GripperPhase:
        """What the gripper did last; of a process that is gone, whether a part may be held."""
        if self._loop.lost is not None and self._phase not in _AT_REST:
            return GripperPhase.HELD_AFTER_FAULT
        return self._phase

    @property
    def notes(self) -> tuple[str, ...]:
        """What the system has not granted to the process."""
        return self._loop.ready.notes

    @property
    def statistics(self) -> HandStatistics:
        """Counters as of the last command."""
        return self._statistics

    @property
    def pid(self) -> int:
        """Process id of the loop."""
        return self._loop.pid

    # -- commands ------------------------------------------------------------------------------

    def start(self) -> VerificationReport:
        """Verify the servos; see `Hand`."""
        report: VerificationReport = self._call(Start())
        return report

    def start_sensor(self) -> NodeIdentity:
        """Start the tactile link; see `Hand`."""
        identity: NodeIdentity = self._call(StartSensor())
        return identity

    def close_sensor(self) -> None:
        """End the tactile link; it has ended where the process is gone."""
        if self._loop.lost is None:
            self._call(CloseSensor())

    def open(self, watch: Watch) -> None:
        """Open the empty fingers; see `Hand`."""
        self._call(Open(), watch)

    def tare(self, n_frames: int) -> None:
        """Take the zero of the taxels; see `Hand`."""
        self._call(Tare(n_frames=n_frames))

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Refuse a ramp beyond the limits; see `Hand`."""
        check_ramp(ramp, self._settings, self._linkage)

    def grasp(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Close and follow the ramp; see `Hand`."""
        outcome: GraspOutcome = self._call(GraspUnder(ramp=ramp), watch)
        return outcome

    def end_ramp(self) -> None:
        """Let the running ramp end where it is; see `Hand`."""
        self._loop.send(EndRamp(number=self._number))

    def release(self, watch: Watch | None = None) -> None:
        """Let go; see `Hand`."""
        self._call(Release(), watch)

    def inspect(self) -> VerificationReport:
        """Compare the servos with the settings; reads only."""
        report: VerificationReport = self._call(Inspect())
        return report

    def read_sensor(self, timeout_s: float) -> TactileReading:
        """Wait for a new reading of the taxels."""
        reading: TactileReading = self._call(ReadSensor(timeout_s=timeout_s))
        return reading

    def tick(self) -> None:
        """Raise what went wrong since the last command; the process ticks by itself.

        Raises HandLost also where it has said nothing since an earlier look, too long ago.
        """
        now_s = time.monotonic()
        while self._loop.waiting():
            event = self._loop.next(0.0)
            self._heard_s = now_s
            if isinstance(event, Fault):
                self._raise(event)
        if now_s - self._heard_s > self._silence_s:
            self._loop.lose(f"has told nothing for {now_s - self._heard_s:.1f} s")

    def keep_grip(self) -> None:
        """Freeze in any state; see `Gripper.keep_grip`."""
        self._call(KeepGrip())

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault; where the process is gone, start another, which moves nothing."""
        if self._loop.lost is not None:
            self._loop = LoopProcess(self._config)
            self._heard_s = time.monotonic()
            return
        self._call(ClearFault(reboot=reboot))

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped."""
        self._loop.stop()

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state; see `Hand`.

        Raises HandLost if the process died unnoticed.
        """
        found = ""
        if self._loop.lost is None:
            try:
                self._call(Shutdown(), unasked=True)
            except (GripperError, TactileError) as error:
                found = f"{type(error).__name__}: {error}"
        return found

    def close(self) -> None:
        """End the process and wait for its end; a held part stays held."""
        self._loop.close()

    # -- inside --------------------------------------------------------------------------------

    def _call(self, command: Command, watch: Watch | None = None, *, unasked: bool = False) -> Any:
        """Have a command carried out; what goes wrong here stops it and is raised at its end.

        With ``unasked`` it is carried out although a fault waits to be told.
        """
        if not unasked:
            self.tick()
        self._number += 1
        self._loop.send(Request(number=self._number, command=command))
        runs_loop = isinstance(command, Open | GraspUnder | Release)
        patience_s = self._silence_s if runs_loop else self._answer_s
        failure: BaseException | None = None
        while True:
            try:
                event = self._loop.next(patience_s)
                if isinstance(event, Progress):
                    self._phase = event.cycle.phase
                    if watch is not None and failure is None:
                        watch(event.cycle, _read_only(event))
                elif isinstance(event, Fault):
                    self._raise(event)
            except HandLost:
                raise
            except BaseException as error:
                if failure is not None or self._loop.lost is not None:
                    raise
                failure = error
                self.request_stop()
                continue
            if isinstance(event, Answer) and event.number == self._number:
                break
        self._heard_s = time.monotonic()
        self._phase, self._statistics = event.phase, event.statistics
        if failure is not None:
            if event.error is not None:
                # The process that moves the fingers knows how it has left them.
                copy_fingers(received_error(event.error), failure)
            raise failure
        if event.error is not None:
            raise received_error(event.error)
        return event.value

    def _raise(self, fault: Fault) -> NoReturn:
        """Raise a fault that came by itself; one that says that the process ends is its loss."""
        self._phase = fault.phase
        error = received_error(fault.error)
        if isinstance(error, HandLost):
            self._loop.abandon(error)
        raise error


def _read_only(event: Progress) -> tuple[Any, ...]:
    for frame in event.frames:
        frame.counts.setflags(write=False)
    return event.frames
