"""Plugins and services on small simulated cells; a service has a clock of its own, and doors."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.interfaces.plugin.plugin import TactileCellPlugin
from cell.interfaces.service.service import JobView, Service
from cell.interfaces.service.serving import open_doors, open_service
from gripper.state import GripperPhase
from tests.fuzz.harness import Clock

LIMIT_S = 60.0
"""Patience of the tests: a condition that is not met by then fails."""
LEASE_S = 60.0
"""Time-out of leases: only the clock of the test lets it pass."""


def until(true: Callable[[], Any]) -> Any:
    """Wait for a condition and return it."""
    end_s = time.monotonic() + LIMIT_S
    while not (found := true()):
        assert time.monotonic() < end_s
        threading.Event().wait(0.005)
    return found


def ended(link: socket.socket) -> bool:
    """Send one more byte of a request; whether the door has closed the connection."""
    try:
        link.sendall(b"x")
        link.setblocking(False)
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@dataclass
class Served:
    """A service, its doors, and what only the simulator can tell of it."""

    service: Service
    clock: Clock
    doors: dict[str, Any] = field(default_factory=dict)
    _going_on: threading.Event = field(default_factory=threading.Event)
    _paused: threading.Event = field(default_factory=threading.Event)

    @property
    def simulated(self) -> Any:
        return self.service._plugin._cell.simulated

    @property
    def grip_n(self) -> float:
        """Force on the pad that carries less."""
        return min(self.simulated.world.contact_force_n())

    @property
    def state(self) -> str:
        return self.service.status().state

    def pause_while_pressing(self) -> None:
        """Have the next grasp stand still in its ramp, until `go_on`."""
        gripper = self.service._plugin._cell.controller.gripper
        self._paused.clear()
        self._going_on.clear()

        def look(_now_s: float) -> None:
            if gripper.state is GripperPhase.RAMPING and self.grip_n > 1.0:
                self.simulated.clock.on_advance.remove(look)
                self._paused.set()
                assert self._going_on.wait(LIMIT_S)

        self.simulated.clock.on_advance.append(look)

    def paused(self) -> None:
        assert self._paused.wait(LIMIT_S)

    def go_on(self) -> None:
        self._going_on.set()

    def ended(self, number: int | None = None) -> JobView:
        """Wait for the end of a job and return it."""
        return until(lambda: (job := self.service.job(number)).outcome_number >= 4 and job)

    def carry(self, seconds: float = 0.05) -> None:
        """Let the cell's time pass while nothing runs, supervised as in real time."""
        plugin = self.service._plugin
        end_s = self.simulated.clock.monotonic() + seconds
        while self.simulated.clock.monotonic() < end_s:
            self.simulated.clock.sleep(0.005)
            plugin._worker.supervise()

    def pass_lease(self) -> None:
        """Let the time of the lease pass."""
        self.clock.now_s += LEASE_S + 1.0
        self.service.look()


@pytest.fixture
def serve(make_config: Callable[..., CellConfig], taught: Any) -> Iterator[Callable[..., Served]]:
    """Return the maker of services; ``doors`` opens them, ``options`` are those of `Service`."""
    with ExitStack() as undo:

        def make(*doors: str, options: dict[str, Any] | None = None, **changes: Any) -> Served:
            ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
            ports |= {f"serve__{name}_port": 0 for name in doors}
            wanted = {"serve__lease_timeout_s": LEASE_S, **ports, **changes}
            clock = Clock()
            given = {"model": taught.result.model, "clock": clock} | (options or {})
            service = open_service(make_config(**wanted), **given)
            undo.callback(service.close)
            served = Served(service, clock)
            undo.callback(served.go_on)
            if doors:
                served.doors = undo.enter_context(open_doors(service))
            return served

        yield make


@pytest.fixture
def make_plugin(make_config: Callable[..., CellConfig]) -> Iterator[Callable[..., Any]]:
    """Return the maker of plugins on small simulated cells."""
    made: list[Any] = []

    def make(config: CellConfig | None = None, **options: Any) -> Any:
        made.append(TactileCellPlugin(config or make_config(), **options))
        return made[-1]

    yield make
    for plugin in made:
        plugin.close(LIMIT_S)


@pytest.fixture
def plugin(make_plugin: Callable[..., Any], taught: Any) -> Any:
    """A plugin that knows ball and box."""
    return make_plugin(model=taught.result.model)


def grip_n(plugin: Any) -> float:
    return min(plugin._cell.simulated.world.contact_force_n())
