"""Damage by name on both lines between simulated cell and program, and what a job makes of it.

A job under damage ends with the right label or with an error of the named class; the grip is kept.
"""

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cell.build import build_cell
from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.errors import PartInGrip
from cell.interfaces.plugin.plugin import (
    IdentifyGoal,
    Job,
    JobFailed,
    TactileCellPlugin,
    TeachGoal,
)
from cell.pytest_plugin.process import CellProcess
from gripper.errors import (
    BusCorrupt,
    BusTimeout,
    BusUnreliable,
    ForceSensorStale,
    GripperError,
    LimitExceeded,
    ServoFault,
)
from tactile.errors import LinkFault, TactileError

_RELAY = Path(__file__).parent / "relay.py"
_SEED = "7"
CONFIG = """
tactile: {tare_frames: 15, sync_period_ms: 50.0, force_period_ms: 10}
gripper: {loop_rate_hz: 100.0, approach_speed_mm_s: 20.0, force_stale_ms: 300.0}
sequence:
  x_mm: [0, 0]
  y_mm: [0, 0]
  force_n: [4, 4]
  max_grasps: 1
  ramp: {kind: linear, rate_n_s: 6.0, hold_s: 0.3}
"""
"""Half the rate: other tests may take turns on the same processors."""
LABELS = ("box", "cylinder")
TRIES = 4
"""Jobs after which a machine counts as too slow: each ended before the damage began."""
JOB_S = 60.0
"""Longest time in s of a job, whatever the machine does meanwhile."""
GRIPPED_N, LEAST_SHARE = 1.0, 0.5
"""Force in N at which damage begins, and the share of the force at an error that must be left."""

SERVO_ERRORS = (BusTimeout, BusCorrupt, BusUnreliable)
CAN_ERRORS = (LinkFault, ForceSensorStale)
SLOW_ERRORS = (*SERVO_ERRORS, *CAN_ERRORS, LimitExceeded)
"""What a machine that is too slow for a real-time cell ends a job with: it is tried again."""


def first(pid: int) -> None:
    """Let a process go before others, where permitted: real hardware waits for nobody."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(40))


class Relay:
    """The process of `relay.py` between a program and the terminal of a device."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.port = self._said()

    def _said(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def order(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")
        if text == "hang_up":
            self._process.wait(5.0)
        else:
            assert self._said() == "yes"


@contextlib.contextmanager
def relay_on(line: str, port: str) -> Iterator[Relay]:
    """Put a relay on a line, ``servos`` or ``can``; it has a terminal of its own, `Relay.port`."""
    process = subprocess.Popen(
        [sys.executable, str(_RELAY), line, port, _SEED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    try:
        first(process.pid)
        yield Relay(process)
    finally:
        process.kill()
        process.communicate()


@dataclass(frozen=True, slots=True)
class Damage:
    """A kind of damage on one line and what has to become of a job."""

    line: str
    """``servos`` or ``can``."""
    order: str
    """For the relay, see `relay.py`."""
    errors: tuple[type[Exception], ...]
    """Classes of the error that may end the job."""
    fatal: bool = False
    """Whether an error has to end it."""
    contact: bool = True
    """Whether it begins at the contact; else with the job."""

    @property
    def name(self) -> str:
        """Line and order, to find it by."""
        return "-".join((self.line, *self.order.split(), "" if self.contact else "always")).strip(
            "-"
        )


# fmt: off
SERVOS = (
    *(Damage("servos", order, SERVO_ERRORS, contact=False) for order in (
        "flip 0.01", "drop 0.01", "repeat 0.05", "cut 0.01", "lose_byte 0.01", "insert_byte 0.01",
        "foreign 0.3", "delay 0.0005", "split 16", "chatter 0.03 sentence", "chatter 0.01 burst")),
    *(Damage("servos", order, SERVO_ERRORS, fatal=True) for order in (
        "flip 1", "drop 1", "cut 1", "lose_byte 1", "insert_byte 1", "lag", "delay 0.03",
        "noise 0.001 byte", "noise 0.01 burst", "noise 0.03 sentence", "instead 0.03 sentence")),
    *(Damage("servos", order, SERVO_ERRORS) for order in (
        "repeat_late 0.0095", "repeat 1", "foreign 1", "swap 0.2", "split 1", "merge 0.05",
        "flip 0.3", "drop 0.3", "chatter 0.001 byte", "chatter 0.0002 burst")),
)
CAN = (
    *(Damage("can", order, CAN_ERRORS, contact=False) for order in (
        "flip 0.0005", "drop 0.0005", "repeat 0.05", "cut 0.0005", "lose_byte 0.0005",
        "insert_byte 0.0005", "foreign 0.01", "delay 0.002", "split 64", "swap 0.05")),
    *(Damage("can", order, CAN_ERRORS, fatal=True) for order in (
        "flip 1", "drop 1", "cut 1", "lose_byte 1", "delay 0.5", "noise 0.001 byte",
        "noise 0.03 sentence")),
    *(Damage("can", order, CAN_ERRORS) for order in (
        "lag", "repeat 1", "repeat_late 0.049", "foreign 1", "swap 1", "split 4", "merge 0.1",
        "flip 0.05", "drop 0.05", "chatter 0.001 byte", "chatter 0.03 sentence")),
)
# fmt: on
DAMAGES = (*SERVOS, *CAN)
SMALL = (
    "servos-flip-0.01-always",
    "servos-lag",
    "servos-noise-0.001-byte",
    "can-flip-1",
    "can-drop-0.0005-always",
)
"""Those that the tests in real time run; `make damage` runs all, about 5 s each."""


class Broken(AssertionError):
    """A job under damage has become what none may."""


@dataclass(frozen=True, slots=True)
class Found:
    """What has become of a job: its label or its error, the true force at its end, and its time."""

    label: str
    error: Exception | None
    grip_n: float
    seconds: float

    def __str__(self) -> str:
        text = self.label or f"{type(self.error).__name__}: {str(self.error)[:160]}"
        return f"{text} ({self.grip_n:.1f} N, {self.seconds:.1f} s)"


class Bench:
    """A simulated cell in a process of its own, a relay on each line, and a plugin beyond them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._undo = contextlib.ExitStack()
        self._plugin: TactileCellPlugin | None = None

    def __enter__(self) -> "Bench":
        with contextlib.ExitStack() as undo:
            undo.callback(self.drop_plugin)
            model = self._folder / "model.npz"
            base = changed_config(
                parse_config(CONFIG, source="tests"),
                {"recording.directory": str(self._folder / "out")},
            )
            teach(base, model)
            self._model = model
            self.simulator = CellProcess(base)
            undo.callback(self.simulator.end)
            first(self.simulator.pid)
            self.relays = {
                line: undo.enter_context(relay_on(line, port))
                for line, port in (
                    ("servos", self.simulator.servo_port),
                    ("can", self.simulator.can_channel),
                )
            }
            self.config = changed_config(
                load_config(self.simulator.config_path),
                {
                    "gripper.port": self.relays["servos"].port,
                    "tactile.channel": self.relays["can"].port,
                },
            )
            self._undo = undo.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def run(self, damage: Damage) -> Found:
        """Identify the box under damage. Raises Broken where something becomes what none may."""
        for _ in range(TRIES):
            found = self._identify(damage)
            if found is not None:
                return found
        raise Broken(f"{damage.name}: {TRIES} jobs ended with the error of something else")

    def _identify(self, damage: Damage) -> Found | None:
        """Run one job; None where the machine was too slow for it, with or before the damage."""
        plugin = self._ready()
        relay = self.relays[damage.line]
        began_s = time.monotonic()
        if not damage.contact:
            relay.order(damage.order)
        try:
            job = plugin.start(IdentifyGoal(present=LABELS[0]))
            begun = not damage.contact or self._wait_for_grip(plugin, job)
            if begun and damage.contact:
                relay.order(damage.order)
            try:
                answer = plugin.result(job, JOB_S)
            except JobFailed as failed:
                found = Found(
                    "", _cause(failed), self.simulator.grip_n(), time.monotonic() - began_s
                )
                if isinstance(found.error, damage.errors) and begun:
                    self._check_grip(damage, found)
                    return found
                if isinstance(found.error, SLOW_ERRORS):
                    return None
                raise Broken(f"{damage.name}: {found}") from found.error
            # Few grasps have taught it: the name may be UNKNOWN, the likeliest not another one.
            likeliest = max(LABELS, key=lambda label: answer.probabilities[label])
            found = Found(likeliest, None, self.simulator.grip_n(), time.monotonic() - began_s)
            if found.label != LABELS[0] or damage.fatal:
                raise Broken(f"{damage.name}: the label {found.label!r} was given")
            return found
        finally:
            relay.order("pass")
            if plugin.state() != "IDLE":
                self._let_go(plugin)

    def _wait_for_grip(self, plugin: TactileCellPlugin, job: Job) -> bool:
        """Wait until the box is gripped; False where the job ends before."""
        while self.simulator.grip_n() < GRIPPED_N:
            if plugin.feedback(job).outcome.terminal:
                return False
            threading.Event().wait(0.01)
        return True

    def _check_grip(self, damage: Damage, found: Found) -> None:
        """Raise Broken where the part was let go."""
        # Fingers that were stopped on their way hold nothing, or half.
        on_their_way = any("the fingers " in note for note in getattr(found.error, "__notes__", ()))
        if not damage.contact or on_their_way:
            return
        threading.Event().wait(0.5)
        later_n = self.simulator.grip_n()
        if min(found.grip_n, later_n) < LEAST_SHARE * GRIPPED_N:
            raise Broken(f"{damage.name}: {later_n:.2f} N are left; {found}") from found.error

    def _ready(self) -> TactileCellPlugin:
        """Return a plugin that waits for a job; a start that ended is repeated."""
        for left in reversed(range(TRIES)):
            if self._plugin is not None:
                break
            try:
                self._plugin = TactileCellPlugin(self.config, model=self._model)
                if self._plugin.state() != "IDLE" and left:
                    self._let_go(self._plugin)
            except (*SLOW_ERRORS, PartInGrip):
                if not left:
                    raise
                # What it had begun to open is opened.
                cell = build_cell(self.config, folder=self._folder)
                with contextlib.closing(cell), contextlib.suppress(*SLOW_ERRORS):
                    cell.controller.release_held()
        assert self._plugin is not None
        return self._plugin

    def _let_go(self, plugin: TactileCellPlugin) -> None:
        """Acknowledge the fault and release on purpose; the next job has a plugin of its own.

        A machine that is too slow for the release is a fault again, to be acknowledged as the one
        before.
        """
        try:
            for left in reversed(range(TRIES)):
                try:
                    plugin.clear(JOB_S, reboot=left == 0)
                    plugin.release(JOB_S)
                    break
                except (*SLOW_ERRORS, ServoFault):
                    if not left:
                        raise
        finally:
            self.drop_plugin()
        if self.simulator.grip_n() > 0.0:
            raise Broken("the part was not let go on purpose")

    def drop_plugin(self) -> None:
        """Give the ports back."""
        plugin, self._plugin = self._plugin, None
        if plugin is not None:
            with contextlib.suppress(GripperError, TactileError):
                plugin.close()


def teach(config: CellConfig, model: Path) -> None:
    """Teach the labels in virtual time, and save the model."""
    with TactileCellPlugin(config) as plugin:
        for label in LABELS:
            plugin.result(plugin.start(TeachGoal(label=label, grasps=6)), JOB_S)
        plugin.save(model)


def _cause(failed: JobFailed) -> Exception:
    cause = failed.__cause__
    return cause if isinstance(cause, Exception) else failed
