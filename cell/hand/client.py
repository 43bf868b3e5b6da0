"""The client of a hand in its own process; `cell.hand.server` is the other end."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import wraps
from inspect import signature
from multiprocessing.connection import Connection
from typing import Any, Concatenate, NoReturn, ParamSpec, TypeVar

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.errors import HandLost
from cell.fault_catalogue import error_text
from cell.hand.interface import Hand, LatestValues, OnPeriod
from cell.hand.messages import (
    Boot,
    EndRamp,
    HandFault,
    HandMessage,
    HandPeriod,
    HandReply,
    HandRequest,
    LiveUpdate,
    Ready,
)
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.errors import GripperError, copy_fingers
from gripper.force.ramp import ForceRamp, check_ramp, largest_ramp_n
from gripper.values.state import GripperPhase
from tactile.errors import TactileError

P = ParamSpec("P")
T = TypeVar("T")

_BOOT_S = 60.0
"""Longest time in s until a process has loaded its libraries and opened both ports."""
_SILENCE_S = 5.0
"""Longest time in s without a message of the process while the loop runs. Commands without the loop
may take longer, up to the config's time-outs."""
_END_S = 5.0
"""Longest time in s for a process to end before it is killed."""


class LoopProcess:
    """One process of the force loop, from its start to its end.

    It is a new process (exec, no fork): it shares no lock, thread or interpreter with the program,
    and does not import the program's main module. Raises gripper.errors.PortLost or
    tactile.errors.LinkFault if a port or bus cannot be opened, and HandLost if the process does not
    start. The ports of the config are real; ``partial`` is as in `cell.hand.local.open_hand`.
    """

    def __init__(self, config: CellConfig, *, partial: bool = False) -> None:
        self.lost: HandLost | None = None
        """Why the process can no longer be used; None while it can."""
        self._watchdog_ms = config.gripper.watchdog_ms
        # A signal handler may interrupt the holder and call `stop` in the same thread.
        self._stopping = threading.RLock()
        ours, theirs = socket.socketpair()
        stop_fd, self._stop_fd = os.pipe()
        os.set_blocking(self._stop_fd, False)
        self._connection = Connection(ours.detach())
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from cell.hand.server import main; "
            f"main({theirs.fileno()}, {stop_fd}, {os.getpid()})"
        )
        # Ctrl-C is for the program only: the process inherits this signal mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, "tactile-cell-force-loop"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), stop_fd),
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
        except BaseException:
            os.close(self._stop_fd)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
            os.close(stop_fd)
        try:
            self.send(Boot(config=config, partial=partial))
            event = self.next(_BOOT_S)
            if isinstance(event, HandFault):
                raise event.error
            if not isinstance(event, Ready):
                self.lose(f"sent {type(event).__name__} instead of Ready")
        except BaseException:
            self.close()
            raise
        self.ready: Ready = event
        """Its first message."""

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def stop(self) -> None:
        """Stop the running command; safe from any thread and in signal handlers."""
        # A full pipe already has stop requests; a broken or closed pipe has no process to stop.
        with self._stopping, suppress(OSError):
            os.write(self._stop_fd, b"s")

    def send(self, message: HandRequest | EndRamp | Boot) -> None:
        """Send a message. Raises HandLost if the process is gone."""
        self.check()
        try:
            self._connection.send(message)
        except OSError:
            self._lose_gone()

    def next(self, patience_s: float) -> HandMessage:
        """Wait for the next event; silence for ``patience_s`` s means that the process is lost."""
        self.check()
        if not self._connection.poll(patience_s):
            self.lose(f"has sent nothing for {patience_s:g} s")
        try:
            event: HandMessage = self._connection.recv()
        except (EOFError, OSError):
            self._lose_gone()
        except BaseException:
            # Half a message may have been read: the rest cannot be decoded.
            self.abandon(HandLost("the connection to the force loop was cut by an interruption"))
            raise
        return event

    def waiting(self) -> bool:
        """Whether `next` would return or raise at once."""
        self.check()
        return self._connection.poll(0.0)

    def check(self) -> None:
        """Raise HandLost if the process can no longer be used."""
        if self.lost is not None:
            raise self.lost

    def abandon(self, lost: HandLost) -> None:
        """Mark the process as lost and end it; a held part stays held."""
        self.lost = lost
        self.close()

    def close(self) -> None:
        """End the process and wait for its end; kill it if it does not end."""
        if not self._connection.closed:
            self._connection.close()
        # Another file may get the number of a closed descriptor at once: `stop` must not see it.
        with self._stopping:
            stop_fd, self._stop_fd = self._stop_fd, -1
            if stop_fd >= 0:
                os.close(stop_fd)
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def lose(self, what: str) -> NoReturn:
        """Latch the loss of the process, and raise it with its effect on a held part."""
        lost = HandLost(
            f"the process of the force loop (pid {self.pid}) {what}; a part may still be gripped. "
            f"The servos' bus watchdog acts after {self._watchdog_ms:g} ms, unless the part was "
            f"carried. Look at the part, then clear the fault: a new process starts and moves "
            f"nothing"
        )
        # A process that hangs would not end by itself.
        self._process.kill()
        self.abandon(lost)
        raise lost

    def _lose_gone(self) -> NoReturn:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        code = self._process.returncode
        if code is None:
            self.lose("closed its connection but has not ended")
        if code < 0:
            names = {member.value: member.name for member in signal.Signals}
            self.lose(f"was ended by {names.get(-code, f'signal {-code}')}")
        self.lose(f"has ended with exit code {code}")


def _remote(method: Callable[Concatenate[Any, P], T]) -> Callable[Concatenate[Any, P], T]:
    """Return a method that calls the same method of `Hand` in the process."""
    named = signature(method)

    @wraps(method)
    def call(self: Any, /, *given: P.args, **options: P.kwargs) -> T:
        arguments = named.bind(self, *given, **options).arguments
        del arguments["self"]
        answer: T = self._call(method, arguments.pop("watch", None), **arguments)
        return answer

    return call


_AT_REST = (GripperPhase.OFF, GripperPhase.IDLE)
"""Phases in which nothing is held: a process that is lost in one of them leaves no part."""


class HandProcess:
    """Implements `cell.hand.interface.Hand` with a process that owns both ports and runs the loop.

    If the process ends or is silent for too long, calls raise `HandLost` until `clear_fault` starts
    a new one. The end of this program, or `close`, ends the process; a held part stays held.

    Parameters
    ----------
    config
        The cell; its ports are real.
    partial
        As `cell.hand.local.open_hand`.

    Raises
    ------
    As `LoopProcess`.
    """

    own_process = True

    def __init__(self, config: CellConfig, *, partial: bool = False) -> None:
        self._config = config
        self.layout = layout_from_config(config.tactile)
        self.period_s = 1.0 / config.gripper.loop_rate_hz
        self._mechanics = config.mechanics
        self._silence_s = _SILENCE_S
        self._answer_s = 2.0 * _SILENCE_S + 4.0 * config.tactile.startup_timeout_s
        self._number = 0
        self._phase = GripperPhase.OFF
        self._earlier_part = False
        """Whether a lost process may have left a part that its successor has not looked for."""
        self._loop = LoopProcess(config, partial=partial)
        self.statistics = self._loop.ready.statistics
        """Counters as of the last command."""
        self.latest = LatestValues()
        """As in `Hand`: values of the process that `tick` or a command has received."""
        self._heard_s = self._ticked_s = time.monotonic()

    # -- what is known here --------------------------------------------------------------------

    @property
    def phase(self) -> GripperPhase:
        """Last phase of the gripper; after a loss of the process, whether a part may be held.

        It may be until a new process has read the servos.
        """
        lost = self._loop.lost is not None and self._phase not in _AT_REST
        return GripperPhase.HELD_AFTER_FAULT if lost or self._earlier_part else self._phase

    @property
    def notes(self) -> tuple[str, ...]:
        """Real-time settings that the system refused to the process."""
        return self._loop.ready.notes

    @property
    def missing(self) -> tuple[str, ...]:
        """Lines that the process could not open; see `Hand`."""
        return self._loop.ready.missing

    # -- commands ------------------------------------------------------------------------------

    start = _remote(Hand.start)
    start_sensor = _remote(Hand.start_sensor)
    open = _remote(Hand.open)
    tare = _remote(Hand.tare)
    grasp = _remote(Hand.grasp)
    press_pads_together = _remote(Hand.press_pads_together)
    measure_load = _remote(Hand.measure_load)
    measure_friction = _remote(Hand.measure_friction)
    hold_at = _remote(Hand.hold_at)
    squeeze = _remote(Hand.squeeze)
    release = _remote(Hand.release)
    conditions = _remote(Hand.conditions)
    inspect = _remote(Hand.inspect)
    read_sensor = _remote(Hand.read_sensor)
    keep_grip = _remote(Hand.keep_grip)

    def read_drives(self) -> DriveReport:
        """Return the characteristics of the servos' drives; see `Hand`."""
        report = self._call(Hand.read_drives)
        self._know(report.drives)
        return report

    def use_drives(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics; see `Hand`."""
        self._call(Hand.use_drives, drives=drives)
        self._know(drives)

    def _know(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Check ramps with the same values as the process."""
        for servo_id, drive in drives.items():
            self._mechanics.drives.put(servo_id, drive)

    def stop_sensor(self) -> None:
        """End the tactile link; without the process it has ended already."""
        if self._loop.lost is None:
            self._call(Hand.stop_sensor)

    @property
    def largest_ramp_n(self) -> float:
        """Largest force in N of a ramp; see `Hand`."""
        return largest_ramp_n(self._mechanics)

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Refuse a ramp beyond the limits; see `Hand`."""
        check_ramp(ramp, self._mechanics)

    def end_ramp(self) -> None:
        """End the running ramp at its present force; see `Hand`."""
        self._loop.send(EndRamp(number=self._number))

    def tick(self) -> None:
        """Raise faults since the last command; the process ticks by itself.

        Also raises HandLost if the process is silent for too long.
        """
        now_s = time.monotonic()
        if now_s - self._ticked_s > 0.5 * self._silence_s:
            # Both processes may have been paused together.
            self._heard_s = now_s
        self._ticked_s = now_s
        while self._loop.waiting():
            self._heard_s = now_s
            self._next(0.0)
        if now_s - self._heard_s > self._silence_s:
            self._loop.lose(f"has sent nothing for {now_s - self._heard_s:.1f} s")

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault; replace a lost process by a new one, which moves nothing."""
        if self._loop.lost is not None:
            self._earlier_part = self.phase not in _AT_REST
            # What is missing of the lines is no hindrance to let go.
            self._loop = LoopProcess(self._config, partial=True)
            self._heard_s = time.monotonic()
        self._call(Hand.clear_fault, reboot=reboot)
        self._earlier_part = False

    def request_stop(self) -> None:
        """Stop the running command with GraspStopped."""
        self._loop.stop()

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state; see `Hand`.

        Raises HandLost if the process died unnoticed.
        """
        problem = ""
        if self._loop.lost is None:
            try:
                self._call(Hand.shutdown)
            except (GripperError, TactileError) as error:
                problem = error_text(error)
        return problem

    def close(self) -> None:
        """End the process and wait for its end; a held part stays held."""
        self._loop.close()

    # -- inside --------------------------------------------------------------------------------

    def _call(self, method: Callable[..., T], watch: OnPeriod | None = None, **arguments: Any) -> T:
        """Run a command in the process; an error in this program stops it and is raised at its end.

        A shutdown runs even if a fault waits to be raised.
        """
        if method is not Hand.shutdown:
            self.tick()
        self._number += 1
        request = HandRequest(number=self._number, method=method.__name__, arguments=arguments)
        self._loop.send(request)
        quick = request.watched or method in (Hand.shutdown, Hand.read_drives)
        patience_s = self._silence_s if quick else self._answer_s
        failure: BaseException | None = None
        while True:
            try:
                event = self._next(patience_s)
                if isinstance(event, HandPeriod) and watch is not None and failure is None:
                    watch(event.cycle, event.frames)
            except HandLost:
                raise
            except BaseException as error:
                if failure is not None or self._loop.lost is not None:
                    raise
                failure = error
                self.request_stop()
                continue
            if isinstance(event, HandReply) and event.number == self._number:
                break
        self._heard_s = time.monotonic()
        self._phase, self.statistics = event.phase, event.statistics
        if failure is not None:
            if event.error is not None:
                # Only the process that moves the fingers has measured their positions.
                copy_fingers(event.error, failure)
            raise failure
        if event.error is not None:
            raise event.error
        value: T = event.value
        return value

    def _next(self, patience_s: float) -> HandMessage:
        """Wait for the next event and store its values of the hand.

        A fault that is not of a command is raised; a HandLost means the loss of the process.
        """
        event = self._loop.next(patience_s)
        if isinstance(event, HandPeriod):
            for frame in event.frames:
                frame.counts.setflags(write=False)
            self._phase = event.cycle.phase
            self.latest = self.latest.then(event.cycle, event.cycle.force, event.frames)
        elif isinstance(event, LiveUpdate):
            if event.latest.frame is not None:
                event.latest.frame.counts.setflags(write=False)
            self.latest = event.latest
        elif isinstance(event, HandFault):
            self._phase = event.phase
            if isinstance(event.error, HandLost):
                self._loop.abandon(event.error)
            raise event.error
        return event
