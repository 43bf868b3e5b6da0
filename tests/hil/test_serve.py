"""`tactile-cell serve` on real ports: its end and its death leave the part held."""

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from cell.service.service import RELEASE_KEY
from tests.hil import program
from tests.hil.program import CONFIG, LIMIT_S, done, first

pytestmark = pytest.mark.real_time

SERVE = "serve: {lease_timeout_s: 30.0, modbus_port: 0, xmlrpc_port: 0}\n"


class Program:
    """A program that prints one JSON line when it is ready."""

    def __init__(self, *arguments: object) -> None:
        self.process = program.start(*arguments)
        first(self.process.pid)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.communicate()
        self.line: dict[str, Any] = json.loads(line)

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        self.process.communicate(timeout=LIMIT_S)
        return self.process.returncode


@pytest.fixture
def start(free_machine: None) -> Iterator[Callable[..., Program]]:
    """Return what starts a program; all are ended."""
    made: list[Program] = []

    def run(*arguments: object) -> Program:
        made.append(Program(*arguments))
        return made[-1]

    yield run
    for one in reversed(made):
        if one.process.poll() is None:
            assert one.end(signal.SIGTERM) == 0


@pytest.mark.timeout(300)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_part_is_held_when_the_service_ends_and_is_let_go_on_purpose_by_the_next(
    start: Any, tmp_path: Path, number: signal.Signals
) -> None:
    (tmp_path / "cell.yaml").write_text(CONFIG + SERVE)
    simulated = start("simulate", "-c", tmp_path / "cell.yaml", "--out", tmp_path / "cell")
    service = start("serve", "-c", simulated.line["config"])
    with ServerProxy(f"http://127.0.0.1:{service.line['xmlrpc_port']}") as cell:
        lease = cell.acquire("first")
        assert done(cell, lease, cell.grip(lease, 3.0)) == 4, cell.fault_text()
        assert (cell.state(), cell.holding()) == (17, True)
        assert service.end(number) == (0 if number is signal.SIGTERM else -signal.SIGKILL)
    # The process of the force loop may need a moment to give the ports back.
    service = start_again(start, simulated.line["config"])
    with ServerProxy(f"http://127.0.0.1:{service.line['xmlrpc_port']}") as cell:
        assert (cell.state(), cell.fault_number(), cell.holding()) == (9, 506, True)
        lease = cell.acquire("second")
        assert done(cell, lease, cell.clear(lease)) == 4
        assert done(cell, lease, cell.release(lease, RELEASE_KEY)) == 4
        assert done(cell, lease, cell.reset(lease)) == 4
        assert (cell.state(), cell.holding()) == (4, False)


def start_again(start: Any, config: str) -> Program:
    """Start the service as soon as the ports are free."""
    end_s = time.monotonic() + LIMIT_S
    while True:
        try:
            return start("serve", "-c", config)
        except json.JSONDecodeError:
            assert time.monotonic() < end_s
            threading.Event().wait(0.2)
