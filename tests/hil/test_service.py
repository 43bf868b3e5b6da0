"""The cell as a service: processes are killed in a grasp, and a supervisor starts them again."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from cell.config.file import parse_config
from cell.service.service import RELEASE_KEY
from pytest_tactile_cell.process import CellProcess
from tests.cell.conftest import Taught, small_config, taught  # noqa: F401  a fixture
from tests.hil.program import CONFIG, LIMIT_S, PROGRAM, child_of, done, first
from tests.marks import LONG
from tests.waiting import until

pytestmark = pytest.mark.real_time

GRIPPED_N = 1.5
"""Force in N at which a process is killed, on the way up."""
KEPT_N = 0.6
"""Least force in N with which a part counts as held."""
LOOP_GONE, PART_IN_GRIP = 508, 506


class Service:
    """The service of a unit, and what its supervisor has reported."""

    def __init__(self, unit: Path, port: int) -> None:
        command = [sys.executable, "-m", "tests.hil.supervisor", str(unit)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.cell: Any = ServerProxy(f"http://127.0.0.1:{port}")
        self.events: list[dict[str, Any]] = []
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        self.events.extend(json.loads(line) for line in self.process.stdout)

    @property
    def pid(self) -> int:
        return [one["pid"] for one in self.events if one["event"] == "started"][-1]

    def sent(self, text: str, since: int = 0) -> bool:
        """Whether a text was sent after so many events."""
        return any(one.get("text") == text for one in self.events[since:])


@pytest.fixture(scope="module")
def simulator(free_machine: None) -> Iterator[CellProcess]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    serve = f"serve: {{lease_timeout_s: 30.0, modbus_port: null, xmlrpc_port: {port}}}\n"
    config = parse_config(CONFIG + serve, source="test")
    objects = {"simulator": small_config().simulator}
    one = CellProcess(config.model_copy(update=objects))
    first(one.pid)
    yield one
    one.end()


@pytest.fixture(scope="module")
def service(
    simulator: CellProcess,
    taught: Taught,  # noqa: F811
    tmp_path_factory: Any,
) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("service")
    install = (*PROGRAM, "service", "install", "--apply", "--root", folder,
               "-c", simulator.config_path, "--model", taught.result.model)  # fmt: skip
    subprocess.run(install, input="n\nn\ny\n", text=True, check=True, stdout=subprocess.DEVNULL)
    unit = folder / "etc/systemd/system/tactile-cell.service"
    config = parse_config(simulator.config_path.read_text(), source="test")
    found = Service(unit, config.serve.xmlrpc_port or 0)
    until(lambda: found.sent("READY=1"))
    with found.process, found.cell:
        yield found
        found.process.terminate()
        assert found.process.wait(LIMIT_S) == 0
        found.reader.join(LIMIT_S)
    assert found.events[-1] == {"event": "ended", "code": 0}


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "killed",
    ["main", "both", "hand", LONG("ended")],
)
def test_a_part_outlasts_the_processes_that_hold_it(service, simulator, killed) -> None:
    cell = service.cell
    lease = cell.acquire("before")
    assert cell.teach(lease, "box", 5) > 0
    simulator.wait_for_grip(GRIPPED_N)
    main = service.pid
    hand = child_of(main)
    for pid in {"main": [main], "hand": [hand], "both": [hand, main], "ended": [main]}[killed]:
        os.kill(pid, signal.SIGTERM if killed == "ended" else signal.SIGKILL)
    forces_n, since = [], len(service.events)

    def reported() -> bool:
        forces_n.append(simulator.grip_n())
        number = LOOP_GONE if killed == "hand" else PART_IN_GRIP
        return service.sent(f"STATUS=ABORTED, a part is held, fault {number}", since)

    until(reported)
    assert (service.pid == main) == (killed == "hand")
    assert min(forces_n) > KEPT_N
    assert (cell.state(), cell.holding()) == (9, True)
    if killed != "hand":
        lease = cell.acquire("after")
    assert done(cell, lease, cell.clear(lease)) == 4
    assert simulator.grip_n() > KEPT_N
    assert done(cell, lease, cell.release(lease, RELEASE_KEY)) == 4
    assert simulator.grip_n() == 0.0
    assert done(cell, lease, cell.reset(lease)) == 4
    assert cell.give_up(lease) == 0
