"""Services with interfaces, on a stub and a virtual clock, and plugins on simulated cells."""

import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.interfaces.access import ACCEPTED_AT_ONCE
from cell.interfaces.opening import open_interfaces
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import Job
from cell.service.service import Service, open_service
from tests.cell.conftest import quick_config, small_config
from tests.cell.stub_plugin import GRIP_N, StubPlugin
from tests.fuzz.harness import Clock
from tests.waiting import LIMIT_S, until

LEASE_S = 60.0
"""Time-out of leases: only the clock of the test lets it pass."""


def pause(number: int) -> None:
    """Let the interface accept the connections before each 15th one.

    A connection that finds no room in the queue waits for a second.
    """
    if number % (ACCEPTED_AT_ONCE - 1) == 0:
        threading.Event().wait(0.02)


def ended(link: socket.socket) -> bool:
    """Send one more byte of a request; whether the interface has closed the connection."""
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
    """A service and its interfaces, on a stub or on a plugin with a simulated cell."""

    service: Service
    clock: Clock
    interfaces: dict[str, Any] = field(default_factory=dict)

    @property
    def plugin(self) -> Any:
        return self.service.plugin

    @property
    def grip_n(self) -> float:
        """Force on the pad that carries less."""
        if isinstance(self.plugin, StubPlugin):
            return GRIP_N if self.plugin.status().holding else 0.0
        return grip_n(self.plugin)

    @property
    def state(self) -> str:
        return self.plugin.status().state

    def ended(self, number: int | None = None) -> Job:
        """Wait for the end of a job and return it."""
        return until(lambda: (job := self.plugin.job(number)).outcome_number >= 4 and job)

    def pass_lease(self) -> None:
        """Let the time of the lease pass."""
        self.clock.now_s += LEASE_S + 1.0
        self.service.lease.has(0)

    def ask_pose(self, pose: Pose) -> Future[Pose | bool]:
        """Wait for the host at a pose, as the thread of a cell does; return what it answers."""
        thread = ThreadPoolExecutor(1)
        found = thread.submit(self.service._poses.move, pose)
        thread.shutdown(wait=False)
        until(lambda: self.service.snapshot().pose)
        return found


@contextmanager
def serving(
    *interfaces: str, cell: dict[str, Any] | None = None, note: Any = print, **changes: Any
) -> Iterator[Served]:
    """Open a service as `serve` does; ``changes`` are those of the config."""
    ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
    ports |= {f"serve__{name}_port": 0 for name in interfaces}
    config = small_config(**{"serve__lease_timeout_s": LEASE_S, **ports, **changes})
    clock = Clock()
    if cell is None:
        service = Service(StubPlugin(config.serve.objects), config, note=note, clock=clock)
    else:
        service = open_service(config, clock=clock, **cell)
    with closing(service):
        served = Served(service, clock)
        with open_interfaces(service) if interfaces else nullcontext({}) as served.interfaces:
            yield served


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """The event loop of tests that are coroutines."""
    return "asyncio"


@pytest.fixture
def serve(request: pytest.FixtureRequest) -> Iterator[Callable[..., Served]]:
    """Return the maker of services; ``interfaces`` opens them.

    Each stands on a stub, or with ``cell``, options of the plugin, on a simulated cell that was
    taught.
    """
    with ExitStack() as undo:

        def make(*interfaces: str, cell: dict[str, Any] | None = None, **more: Any) -> Served:
            if cell is not None:
                cell = {"model": request.getfixturevalue("taught").result.model} | cell
            return undo.enter_context(serving(*interfaces, cell=cell, **more))

        yield make


@pytest.fixture
def tls(tmp_path: Path) -> dict[str, str]:
    """Options of a service that name a certificate of 127.0.0.1 and its key."""
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "cert.pem")
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=cell", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", key, "-out", certificate],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("openssl is not there to make a certificate")
    return {"serve__tls_certificate": certificate, "serve__tls_key": key}


@pytest.fixture
def make_plugin() -> Iterator[Callable[..., Any]]:
    """Return the maker of plugins on simulated cells: small ones with a model, else quick ones."""
    made: list[Any] = []

    def make(config: CellConfig | None = None, **options: Any) -> Any:
        usual = small_config if options.get("model") else quick_config
        made.append(TactileCellPlugin(config or usual(), **options))
        return made[-1]

    yield make
    for plugin in made:
        plugin.close(LIMIT_S)


@pytest.fixture
def plugin(make_plugin: Any, taught: Any) -> Any:
    """A plugin that knows ball and box."""
    return make_plugin(model=taught.result.model)


def done(plugin: Any, goal: Any) -> Any:
    """Run a job of a plugin to its end and return what it gives."""
    return plugin.result(plugin.start(goal), LIMIT_S)


def grip_n(plugin: Any) -> float:
    return min(plugin.cell.simulated.world.contact_force_n())
