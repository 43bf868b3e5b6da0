"""Rows 33 and 34, and 31 where it takes processes: signals, kills, a host that hogs its lock."""

import atexit
import contextlib
import gc
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import campaign_config
from cell.build import build_cell
from cell.cli.running import running_cell
from cell.config import CellConfig
from cell.config_file import load_config
from cell.errors import CellError, CellStateError
from cell.pose import Pose
from cell.pytest_plugin.process import CellProcess
from cell.recording import read_recording
from cell.sequence import GraspStep
from gripper.bus import ServoBus
from gripper.errors import GripperError
from gripper.port import SerialStream
from gripper.registers import BUS_WATCHDOG

LIMIT_S = 30.0
GRIPPED_N = 1.0
KEPT_N = 0.6
SIGNAL_LIMIT_S = 0.5
HOG_S = 0.5
_ATTEMPTS = 5
_PRIORITY = 60
"""Of the simulated cell: above the force loop, whose devices answer whatever the host does."""
_TRIPPED = -1
_WATCHDOG_MARGIN_S = 0.06
_INTERRUPTED = (1, 130, -signal.SIGALRM)
"""Exit codes: after the first signal, by the second, or cut off because closing took too long."""
_PROGRAM = (sys.executable, "-P", "-c", "from cell.cli import main; main()")
_MIDDLE = "import subprocess, sys; subprocess.Popen(sys.argv[1:], start_new_session=True).wait()"
_HOST = """
import sys
from cell.plugin import TactileCellPlugin
plugin = TactileCellPlugin(sys.argv[1])
plugin.start({"task": "teach", "label": "box", "grasps": 50})
sys.stdin.readline()
raise RuntimeError("the host's own error")
"""
"""A host program that ends by an error of its own while a job runs, and closes nothing."""
_STEP = GraspStep(pose=Pose(), force_n=4.0)


@cache
def _simulator() -> CellProcess:
    """Return the simulated cell of all rows: its process ends with this one."""
    config = campaign_config(
        gripper__loop_rate_hz=100.0,
        gripper__approach_speed_mm_s=30.0,
        gripper__watchdog_ms=500.0,
        gripper__force_stale_ms=400.0,
        gripper__bus_loss_ms=500.0,
        tactile__sync_period_ms=50.0,
        sequence__x_mm=[0, 0],
        sequence__y_mm=[0, 0],
        sequence__force_n=[4, 5],
    )
    process = CellProcess(config)
    _hurry(process.pid)
    atexit.register(process.end)
    return process


def _hurry(pid: int) -> None:
    """Let all threads of a process go before others, where the machine permits it."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(_PRIORITY))


def _config() -> CellConfig:
    return load_config(_simulator().config_path)


def _let_go() -> None:
    """Bring the cell back to open fingers, as an operator would; a busy machine may need more."""
    for attempt in range(_ATTEMPTS):
        cell = build_cell(_config())
        try:
            cell.controller.release_held()
            return
        except GripperError:
            if attempt + 1 == _ATTEMPTS:
                raise
        finally:
            cell.close()


@dataclass(kw_only=True)
class _Client:
    """The program with a part in its grip, in a process and session of its own.

    Attributes
    ----------
    process
        What was started: the program, or its parent.
    pid
        The program.
    folder
        Where its recording is.
    """

    process: "subprocess.Popen[bytes]"
    pid: int
    folder: Path

    def recording(self) -> Any:
        """Read what it recorded."""
        (path,) = self.folder.glob("out/teach-*/recording.mcap")
        return read_recording(path)


@contextlib.contextmanager
def _gripping(*, middle: bool = False, host: bool = False) -> Iterator[_Client]:
    """Start a client that teaches, and wait until it presses; afterwards the part is let go.

    It is the program, below another process where ``middle``, or else a host program.
    """
    simulator = _simulator()
    if simulator.grip_n() > 0.0:
        raise CellError("the part of the row before is still gripped")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            *_PROGRAM,
            *("teach", "box", "-n", "50", "-c", str(simulator.config_path)),
            *("-o", str(folder / "d.npz"), "--out", str(folder / "out")),
        ]
        if host:
            command = [sys.executable, "-P", "-c", _HOST, str(simulator.config_path)]
        process = subprocess.Popen(
            [sys.executable, "-c", _MIDDLE, *command] if middle else command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        pid = process.pid
        try:
            _wait_for_grip(process)
            pid = _child_of(process.pid) if middle else process.pid
            yield _Client(process=process, pid=pid, folder=folder)
        finally:
            for group in {process.pid, pid}:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(group, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdin, process.stderr):
                if pipe is not None:
                    pipe.close()
            _let_go()


def _wait_for_grip(process: "subprocess.Popen[bytes]") -> None:
    end_s = time.monotonic() + LIMIT_S
    while _simulator().grip_n() < GRIPPED_N:
        if process.poll() is not None or time.monotonic() > end_s:
            process.kill()
            assert process.stderr is not None
            raise CellError(f"nothing was gripped: {process.stderr.read().decode()[-300:]}")
        threading.Event().wait(0.02)


def _child_of(pid: int) -> int:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii")
    return int(text.split()[0])


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def _wait_for_end(pid: int) -> float:
    """Wait until a process has ended and return the monotonic time of it in s."""
    end_s = time.monotonic() + LIMIT_S
    while _alive(pid):
        if time.monotonic() > end_s:
            raise CellError(f"process {pid} does not end")
        threading.Event().wait(0.005)
    return time.monotonic()


def _held(client: _Client, began_s: float, told: str) -> Observed:
    """Say whether a client has held: part gripped, recording closed, the reason in it."""
    grip_n = _simulator().grip_n()
    recording = client.recording()
    held = [event for event in recording.events if event["kind"] == "held"]
    whole = recording.complete and bool(held) and grip_n > KEPT_N
    return Observed(
        reaction="HOLD" if whole else "LOST",
        detected_after_s=held[0]["t_s"] - began_s if held else None,
        outcome=f"{told}; the grip is kept ({grip_n:.1f} N), the recording is closed",
    )


# -- 31: somebody holds the interpreter's lock -------------------------------------------------


def _hogged() -> Observed:
    """Hold the interpreter's lock of the host program again and again while it grasps."""
    cell = build_cell(_config())
    try:
        cell.controller.start()
        cell.controller.present("box")
        over = threading.Event()

        def hog() -> None:
            while not over.is_set():
                sum(range(int(HOG_S * 4e7)))
                gc.collect()

        thread = threading.Thread(target=hog)
        before = cell.health()["loop"]
        thread.start()
        try:
            record = cell.controller.grasp(_STEP)
        finally:
            over.set()
            thread.join()
        loop = cell.health()["loop"]
        gap_s = max(
            after.t_s - cycle.t_s
            for cycle, after in zip(record.cycles, record.cycles[1:], strict=False)
        )
        return Observed(
            reaction="NOTHING",
            detected_after_s=None,
            outcome=f"the loop has its own process: {len(record.cycles)} periods, all delivered, "
            f"longest {1e3 * gap_s:.0f} ms, {loop['late'] - before['late']} late",
        )
    finally:
        cell.close()


# -- 33: signals -----------------------------------------------------------------------------


def _signal_in_virtual_time(number: signal.Signals) -> Observed:
    """Send this process a signal while a command presses a part, in virtual time."""
    config = campaign_config()
    with tempfile.TemporaryDirectory() as name:
        sent: list[float] = []
        try:
            with running_cell(config, Path(name)) as cell:
                simulated = cell.simulated
                assert simulated is not None

                def look(now_s: float) -> None:
                    if not sent and min(simulated.world.contact_force_n()) > GRIPPED_N:
                        sent.append(now_s)
                        signal.raise_signal(number)

                simulated.clock.on_advance.append(look)
                cell.controller.present("ball")
                cell.controller.grasp(_STEP)
        except CellError as error:
            told = str(error).partition(" Recording so far")[0]
            recording = read_recording(Path(name) / "recording.mcap")
            held = [event for event in recording.events if event["kind"] == "held"]
            grip_n = min(simulated.world.contact_force_n())
            whole = recording.complete and held and grip_n > KEPT_N
            return Observed(
                reaction="HOLD" if whole else "LOST",
                detected_after_s=held[0]["t_s"] - sent[0] if held else None,
                outcome=f"{told} ({grip_n:.1f} N); the recording is closed, exit code 1",
            )
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="it went on")


def _second_signal() -> Observed:
    with _gripping() as client:
        client.process.send_signal(signal.SIGINT)
        client.process.send_signal(signal.SIGTERM)
        began_s = time.monotonic()
        ended_s = _wait_for_end(client.pid)
        grip_n = _simulator().grip_n()
        code = client.process.wait()
        kept = grip_n > KEPT_N and code in _INTERRUPTED
        return Observed(
            reaction="HOLD" if kept else "LOST",
            detected_after_s=ended_s - began_s,
            outcome=f"exit code {code}; the grip is kept ({grip_n:.1f} N)",
        )


def _parent_dies() -> Observed:
    with _gripping(middle=True) as client:
        client.process.kill()
        began_s = time.monotonic()
        _wait_for_end(client.pid)
        return _held(client, began_s, "the orphan stops its sequence and ends")


def _host_ends() -> Observed:
    with _gripping(host=True) as client:
        loop = _child_of(client.pid)
        assert client.process.stdin is not None
        client.process.stdin.close()
        _wait_for_end(client.pid)
        began_s = time.monotonic()
        after_s = _wait_for_end(loop) - began_s
        grip_n = _simulator().grip_n()
        return Observed(
            reaction="HOLD" if grip_n > KEPT_N else "LOST",
            detected_after_s=after_s,
            outcome="nothing was closed; the process of the force loop freezes the goals and ends; "
            f"the grip is kept ({grip_n:.1f} N)",
        )


# -- 34: SIGKILL -----------------------------------------------------------------------------


def _host_killed() -> Observed:
    """Kill the program; the process of its force loop is left, and ends by itself."""
    with _gripping() as client:
        loop = _child_of(client.pid)
        os.kill(client.pid, signal.SIGKILL)
        began_s = time.monotonic()
        after_s = _wait_for_end(loop) - began_s
        grip_n = _simulator().grip_n()
        return Observed(
            reaction="HOLD" if grip_n > KEPT_N else "LOST",
            detected_after_s=after_s,
            outcome="the process of the force loop freezes the goals, disarms the watchdog and "
            f"ends; the grip is kept ({grip_n:.1f} N)",
        )


def _all_killed() -> Observed:
    """Kill program and loop at once, as a loss of power does; then start again."""
    config = _config()
    with _gripping() as client:
        os.killpg(client.pid, signal.SIGKILL)
        wait_s = 1e-3 * config.gripper.watchdog_ms + _WATCHDOG_MARGIN_S
        threading.Event().wait(wait_s)
        if not _tripped(config):
            return Observed(
                reaction="NOTHING", detected_after_s=None, outcome="no watchdog has tripped"
            )
        before = _simulator().ask(state=True)
        cell = build_cell(config)
        try:
            cell.controller.start()
            told = "the restart moved"
        except CellStateError as error:
            told = str(error)
        state = cell.controller.state.value
        cell.close()
        after = _simulator().ask(state=True)
        still = abs(after["aperture_m"] - before["aperture_m"]) < 2e-4
        refused = "nothing was moved" in told and state == "ABORTED" and still
        return Observed(
            reaction="HOLD" if refused else "MOVED",
            detected_after_s=wait_s,
            outcome=f"the watchdogs of both servos have tripped; restart: {state}, {told} "
            f"({min(after['contact_force_n']):.1f} N)",
        )


def _tripped(config: CellConfig) -> bool:
    stream = SerialStream(config.gripper.port, config.gripper.baud_rate)
    try:
        bus = ServoBus(stream, baudrate=config.gripper.baud_rate, clock=time, period_s=0.05)
        return all(bus.read(servo.id, BUS_WATCHDOG) == _TRIPPED for servo in config.gripper.servos)
    finally:
        stream.close()


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=31,
        variant="interpreter lock hogged",
        fault=f"a thread of the host program holds Python's lock for {HOG_S:g} s and collects "
        "garbage, again and again",
        injected="sum() over a long range and gc.collect() beside a grasp, real time",
        reaction="NOTHING",
        limit_s=None,
        run=_hogged,
        real_time=True,
    ),
    *(
        FaultRow(
            row=33,
            variant=number.name,
            fault=f"{number.name} in the ramp",
            injected="a signal to the command that grasps",
            reaction="HOLD",
            limit_s=0.02,
            run=lambda number=number: _signal_in_virtual_time(number),
        )
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    ),
    FaultRow(
        row=33,
        variant="second signal",
        fault="a second signal follows at once: the program ends",
        injected="SIGINT and SIGTERM, real time",
        reaction="HOLD",
        limit_s=SIGNAL_LIMIT_S,
        run=_second_signal,
        real_time=True,
    ),
    FaultRow(
        row=33,
        variant="parent dies",
        fault="the process that started the program dies",
        injected="SIGKILL to the parent, real time",
        reaction="HOLD",
        limit_s=SIGNAL_LIMIT_S,
        run=_parent_dies,
        real_time=True,
    ),
    FaultRow(
        row=33,
        variant="uncaught error",
        fault="a host program ends by an error of its own mid-job and closes nothing",
        injected="an exception in the main thread, real time",
        reaction="HOLD",
        limit_s=SIGNAL_LIMIT_S,
        run=_host_ends,
        real_time=True,
    ),
    FaultRow(
        row=34,
        variant="host program killed",
        fault="the program is killed in the ramp; its force loop is left",
        injected="SIGKILL, real time",
        reaction="HOLD",
        limit_s=SIGNAL_LIMIT_S,
        run=_host_killed,
        real_time=True,
    ),
    FaultRow(
        row=34,
        variant="all killed",
        fault="program and force loop are killed at once, as by a loss of power; then a restart",
        injected="SIGKILL to both, real time",
        reaction="HOLD",
        limit_s=0.6,
        run=_all_killed,
        real_time=True,
    ),
)
