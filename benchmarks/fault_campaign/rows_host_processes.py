"""Rows 33 and 34, and 31 where it takes processes: signals, kills, a host that hogs its lock."""

import gc
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.fault_campaign.host_processes import (
    GRIPPED_N,
    KEPT_N,
    Client,
    child_of,
    client_config,
    gripping,
    held_by,
    simulator,
    wait_for_end,
)
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import campaign_config
from cell.build import build_cell
from cell.cli.running import running_cell
from cell.config import CellConfig
from cell.errors import CellError, CellStateError
from cell.pose import Pose
from cell.recording import read_recording
from cell.sequence import GraspStep
from gripper.bus import ServoBus
from gripper.port import SerialStream
from gripper.registers import BUS_WATCHDOG

SIGNAL_LIMIT_S = 0.5
HOG_S = 0.5
_HOGS = 4
_TRIPPED = -1
_WATCHDOG_MARGIN_S = 0.06
_INTERRUPTED = (1, 130, -signal.SIGALRM)
"""Exit codes: after the first signal, by the second, or cut off because closing took too long."""
_STEP = GraspStep(pose=Pose(), force_n=4.0)


# -- 31: somebody holds the interpreter's lock -------------------------------------------------


def _hogged() -> Observed:
    """Hold the interpreter's lock of the host program again and again while it grasps."""
    cell = build_cell(client_config())
    try:
        cell.controller.start()
        cell.controller.present("box")
        over = threading.Event()

        def hog() -> None:
            for _ in range(_HOGS):
                if over.is_set():
                    return
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
    with gripping() as client:
        client.process.send_signal(signal.SIGINT)
        client.process.send_signal(signal.SIGTERM)
        began_s = time.monotonic()
        ended_s = wait_for_end(client.pid)
        grip_n = simulator().grip_n()
        code = client.process.wait()
        kept = grip_n > KEPT_N and code in _INTERRUPTED
        return Observed(
            reaction="HOLD" if kept else "LOST",
            detected_after_s=ended_s - began_s,
            outcome=f"exit code {code}; the grip is kept ({grip_n:.1f} N)",
        )


def _parent_dies() -> Observed:
    with gripping(middle=True) as client:
        client.process.kill()
        began_s = time.monotonic()
        wait_for_end(client.pid)
        return held_by(client, began_s, "the orphan stops its sequence and ends")


def _loop_left_alone(client: Client, ends: Callable[[], None], told: str) -> Observed:
    """End a program; the process of its force loop is left, and ends by itself."""
    loop = child_of(client.pid)
    ends()
    began_s = time.monotonic()
    after_s = wait_for_end(loop) - began_s
    grip_n = simulator().grip_n()
    return Observed(
        reaction="HOLD" if grip_n > KEPT_N else "LOST",
        detected_after_s=after_s,
        outcome=f"{told}; the grip is kept ({grip_n:.1f} N)",
    )


def _host_ends() -> Observed:
    with gripping(host=True) as client:

        def ends() -> None:
            assert client.process.stdin is not None
            client.process.stdin.close()
            wait_for_end(client.pid)

        return _loop_left_alone(
            client,
            ends,
            "nothing was closed; the process of the force loop freezes the goals and ends",
        )


# -- 34: SIGKILL -----------------------------------------------------------------------------


def _host_killed() -> Observed:
    with gripping() as client:
        return _loop_left_alone(
            client,
            lambda: os.kill(client.pid, signal.SIGKILL),
            "the process of the force loop freezes the goals, disarms the watchdog and ends",
        )


def _all_killed() -> Observed:
    """Kill program and loop at once, as a loss of power does; then start again."""
    config = client_config()
    with gripping() as client:
        os.killpg(client.pid, signal.SIGKILL)
        wait_s = 1e-3 * config.gripper.watchdog_ms + _WATCHDOG_MARGIN_S
        threading.Event().wait(wait_s)
        if not _tripped(config):
            return Observed(
                reaction="NOTHING", detected_after_s=None, outcome="no watchdog has tripped"
            )
        before = simulator().ask(state=True)
        cell = build_cell(config)
        try:
            cell.controller.start()
            told = "the restart moved"
        except CellStateError as error:
            told = str(error)
        state = cell.controller.state.value
        cell.close()
        after = simulator().ask(state=True)
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
        "garbage, four times",
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
