"""The simulated cell as a process in real time: terminals and a socket for its clients."""

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from simulator.boards.site import SerialBoard
from simulator.can.slcan import SlcanAdapter
from simulator.devices import CellDevices
from simulator.faults.injector import FaultInjector
from simulator.realtime.requests import CellRequests, PositionerServer
from simulator.realtime.terminals import BoardPty, SerialPty
from simulator.servo.bus import SerialDevice
from simulator.servo.wrist import SimulatedWrist
from simulator.settings import SimulatorSettings
from simulator.world.world import STEP_S

PIECE_S = 0.02
"""Longest time in s that the world advances before clients are served again."""
FORGIVEN_S = 0.25
"""Longest stall in s that is made up; a longer stall is skipped."""
POWERED_BEFORE_S = 0.1
"""Power-on time in s before clients can connect: the devices have booted by then."""

Announce = Callable[[dict[str, Any]], None]


class RealTimeCell:
    """World, devices and endpoints of a cell in real time; its owner has the loop and the clock.

    Parameters
    ----------
    folder
        Folder for the links to the terminals, and for the socket.
    """

    def __init__(self, settings: SimulatorSettings, folder: Path, now_s: float) -> None:
        self.devices = CellDevices(settings, start_s=now_s - POWERED_BEFORE_S)
        self.devices.world.skip_to(now_s)
        self._world_s = now_s
        lines: dict[str, SerialDevice] = {
            "servos": self.devices.servo_bus,
            "can": SlcanAdapter(self.devices.can),
        }
        if self.devices.axes_can is not None:
            lines["axes-can"] = SlcanAdapter(self.devices.axes_can)
        for moves, axis in self.devices.axes.items():
            if isinstance(axis, SimulatedWrist):
                lines[f"axis-{moves}"] = axis.bus
        lines |= {f"board{finger}": board for finger, board in enumerate(self.devices.boards)}
        self._ptys: dict[str, SerialPty] = {}
        with ExitStack() as opened:
            for name, device in lines.items():
                kind = BoardPty if isinstance(device, SerialBoard) else SerialPty
                self._ptys[name] = kind(device, folder / name)
                opened.callback(self._ptys[name].close)
            self.injector = FaultInjector(self.devices, now_s - POWERED_BEFORE_S)
            requests = CellRequests(self.devices, self.injector)
            self._server = PositionerServer(folder / "positioner.sock", requests)
            opened.callback(self._server.close)
            self.step(now_s, [])
            for text in settings.faults:
                self.injector.inject(text)
            self._close = opened.pop_all().close

    def announcement(self) -> dict[str, Any]:
        """Return addresses and settings for clients; plain values for JSON."""
        settings = self.devices.settings
        paths = {name: pty.path for name, pty in self._ptys.items()}
        return {
            "servo_port": paths["servos"],
            "servo_baud_rate": settings.servo_baud_rate,
            "servo_ids": [servo.servo_id for servo in settings.servos],
            "can_interface": "slcan",
            "can_channel": paths["can"],
            "can_bitrate": settings.unit.bitrate,
            "node_id": settings.unit.node_id,
            "axes_can_channel": paths.get("axes-can"),
            "axes_ports": {
                moves: paths[f"axis-{moves}"] for moves in settings.axes if f"axis-{moves}" in paths
            },
            "board_ports": [paths[f"board{n}"] for n in range(len(self.devices.boards))],
            "positioner_socket": str(self._server.path),
            "pid": os.getpid(),
            "config": None,
        }

    def descriptors(self) -> list[int]:
        """Return the descriptors whose input wakes the cell."""
        ptys = [pty.fileno() for pty in self._ptys.values() if pty.plugged_in]
        return [*ptys, *self._server.filenos()]

    def step(self, now_s: float, readable: list[int]) -> float:
        """Advance the time and serve the clients; return the latest time of the next call in s.

        Parameters
        ----------
        readable
            Items of `descriptors` with input.
        """
        if now_s - self._world_s > FORGIVEN_S:
            self._world_s = now_s - PIECE_S
            self.devices.world.skip_to(self._world_s)
        self._world_s = min(now_s, self._world_s + PIECE_S)
        # First the bytes that clients sent while this process did not run: they came before now.
        due_s = [pty.poll(now_s) for pty in self._ptys.values()]
        self.devices.advance_to(self._world_s)
        self.injector.advance(self._world_s)
        self._server.poll(readable)
        return min([self._world_s + STEP_S, *(due for due in due_s if due is not None)])

    def close(self) -> None:
        """Remove terminals, links and socket; a second call has no effect."""
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def serve(
    settings: SimulatorSettings,
    announce: Announce,
    *,
    folder: Path,
    until_parent_ends: bool = False,
) -> None:
    """Run a simulated cell until SIGTERM or SIGINT, in the main thread of a separate process.

    Raises EndpointError if terminals or socket cannot be made.

    Parameters
    ----------
    announce
        Called once, when clients can connect, with plain values for JSON: ``servo_port``,
        ``servo_baud_rate``, ``servo_ids``, ``can_interface``, ``can_channel``, ``can_bitrate``,
        ``node_id``, ``axes_can_channel`` (None without drives), ``axes_ports`` (of wrists, by what
        they move), ``board_ports`` (of sensor boards, by finger), ``positioner_socket``, ``pid``,
        and ``config``, which is None here.
    folder
        Folder for the links to the terminals, and for the socket.
    until_parent_ends
        Also end when the parent process ends.
    """
    parent = os.getppid()
    stop: list[int] = []
    with ExitStack() as stack:
        for number in (signal.SIGTERM, signal.SIGINT):
            before = signal.signal(number, lambda received, _frame: stop.append(received))
            stack.callback(signal.signal, number, before)
        cell = stack.enter_context(RealTimeCell(settings, folder, time.monotonic()))
        announce(cell.announcement())
        due_s = time.monotonic()
        while not stop:
            timeout_s = max(0.0, due_s - time.monotonic())
            readable, _, _ = select.select(cell.descriptors(), [], [], timeout_s)
            if until_parent_ends and os.getppid() != parent:
                return
            due_s = cell.step(time.monotonic(), readable)
