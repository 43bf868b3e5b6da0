"""The simulated cell as a process in real time: terminals and a socket for its clients."""

import os
import select
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Self

from simulator.can.slcan import SlcanAdapter
from simulator.devices import CellDevices
from simulator.errors import EndpointError
from simulator.faults.injector import FaultInjector
from simulator.realtime.requests import CellRequests
from simulator.realtime.socket_server import PositionerServer
from simulator.realtime.terminals import BoardPty, SerialPty
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
        self._ptys: list[SerialPty] = []
        with ExitStack() as opened:

            def keep(pty: SerialPty) -> SerialPty:
                opened.callback(pty.close)
                self._ptys.append(pty)
                return pty

            self._servo_pty = keep(SerialPty(self.devices.servo_bus, folder / "servos"))
            self._can_pty = keep(SerialPty(SlcanAdapter(self.devices.can), folder / "can"))
            self._axes_can_pty: SerialPty | None = None
            if self.devices.axes_can is not None:
                adapter = SlcanAdapter(self.devices.axes_can)
                self._axes_can_pty = keep(SerialPty(adapter, folder / "axes-can"))
            self._axes_ptys = {
                moves: keep(SerialPty(axis.bus, folder / f"axis-{moves}"))
                for moves, axis in self.devices.axes.items()
                if isinstance(axis, SimulatedWrist)
            }
            self._board_ptys = [
                keep(BoardPty(board, folder / f"board{finger}"))
                for finger, board in enumerate(self.devices.boards)
            ]
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
        return {
            "servo_port": self._servo_pty.path,
            "servo_baud_rate": settings.servo_baud_rate,
            "servo_ids": [servo.servo_id for servo in settings.servos],
            "can_interface": "slcan",
            "can_channel": self._can_pty.path,
            "can_bitrate": settings.unit.bitrate,
            "node_id": settings.unit.node_id,
            "axes_can_channel": None if self._axes_can_pty is None else self._axes_can_pty.path,
            "axes_ports": {moves: pty.path for moves, pty in self._axes_ptys.items()},
            "board_ports": [pty.path for pty in self._board_ptys],
            "positioner_socket": str(self._server.path),
            "pid": os.getpid(),
            "config": None,
        }

    def descriptors(self) -> list[int]:
        """Return the descriptors whose input wakes the cell."""
        ptys = [pty.fileno() for pty in self._ptys if pty.plugged_in]
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
        due_s = [pty.poll(now_s) for pty in self._ptys]
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
    folder: Path | None = None,
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
        Folder for the links to the terminals, and for the socket; by default a temporary folder,
        which is removed at the end.
    until_parent_ends
        Also end when the parent process ends.
    """
    parent = os.getppid()
    with ExitStack() as stack:
        stop = stack.enter_context(_signals())
        place = stack.enter_context(_folder(folder))
        cell = stack.enter_context(RealTimeCell(settings, place, time.monotonic()))
        announce(cell.announcement())
        due_s = time.monotonic()
        while not stop:
            timeout_s = max(0.0, due_s - time.monotonic())
            readable, _, _ = select.select(cell.descriptors(), [], [], timeout_s)
            if until_parent_ends and os.getppid() != parent:
                return
            due_s = cell.step(time.monotonic(), readable)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect SIGTERM and SIGINT in a list; restore the handlers at the end."""
    received: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _folder(wanted: Path | None) -> Iterator[Path]:
    """Give the folder for links and socket; a temporary one is removed at the end."""
    if wanted is not None:
        try:
            wanted.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EndpointError(f"the folder {wanted} cannot be made: {error}") from error
        yield wanted
        return
    with tempfile.TemporaryDirectory(prefix="tactile-cell-") as temporary:
        yield Path(temporary)
