"""The cell as a service: processes are killed in a grasp, and a supervisor starts them again."""

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from cell.config.file import parse_config
from cell.service.service import RELEASE_KEY
from pytest_tactile_cell.process import CellProcess
from tests.cell.cells import small_config
from tests.cell.conftest import Taught, taught  # noqa: F401  a fixture
from tests.hil.program import CONFIG, LIMIT_S, PROGRAM, child_of, first
from tests.hil.supervisor import Supervisor
from tests.marks import LONG
from tests.waiting import until

pytestmark = pytest.mark.real_time

GRIPPED_N = 1.5
"""Force in N at which a process is killed, on the way up."""
HELD_N = 0.6
"""Least force in N with which a part counts as held."""
LOOP_GONE, PART_IN_GRIP = 508, 506


@pytest.fixture(scope="module")
def simulator(free_machine: None) -> Iterator[CellProcess]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    serve = f"serve: {{lease_timeout_s: 30.0, modbus_port: null, xmlrpc_port: {port}}}\n"
    config = parse_config(CONFIG + serve, source="test")
    one = CellProcess(config.model_copy(update={"simulator": small_config().simulator}))
    first(one.pid)
    yield one
    one.end()


@pytest.fixture(scope="module")
def service(
    simulator: CellProcess,
    taught: Taught,  # noqa: F811
    tmp_path_factory: Any,
) -> Iterator[Supervisor]:
    folder = tmp_path_factory.mktemp("service")
    model = shutil.copytree(taught.result.model.parent, folder / "taught") / "model.npz"
    install = (*PROGRAM, "service", "install", "--apply", "--root", folder,
               "-c", simulator.config_path, "--model", model)  # fmt: skip
    subprocess.run(install, input="n\nn\ny\n", text=True, check=True, stdout=subprocess.DEVNULL)
    supervisor = Supervisor(folder / "etc/systemd/system/tactile-cell.service", folder / "notify")
    supervisor.start()
    until(lambda: "READY=1" in supervisor.sent)
    yield supervisor
    assert supervisor.end(LIMIT_S) == 0


@pytest.fixture(scope="module")
def cell(simulator: CellProcess, service: Supervisor) -> Iterator[Any]:
    config = parse_config(simulator.config_path.read_text(), source="test")
    with ServerProxy(f"http://127.0.0.1:{config.serve.xmlrpc_port}") as proxy:
        yield proxy


def done(cell: Any, lease: int, job: int) -> int:
    """Wait for a job over XML-RPC and return how it ended."""
    assert job > 0, job
    until(lambda: cell.alive(lease) or cell.job_state(job) >= 4)
    return cell.job_state(job)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("killed", ["main", "both", "hand", LONG("ended")])
def test_a_part_outlasts_the_processes_that_hold_it(service, simulator, cell, killed) -> None:
    lease = cell.acquire("before")
    assert cell.teach(lease, "box", 5) > 0
    simulator.wait_for_grip(GRIPPED_N)
    main = service.main.pid
    hand = child_of(main)
    for pid in {"main": [main], "hand": [hand], "both": [hand, main], "ended": [main]}[killed]:
        os.kill(pid, signal.SIGTERM if killed == "ended" else signal.SIGKILL)
    forces_n, since = [], len(service.sent)

    def reported() -> bool:
        forces_n.append(simulator.grip_n())
        number = LOOP_GONE if killed == "hand" else PART_IN_GRIP
        return f"STATUS=ABORTED, a part may be held, fault {number}" in service.sent[since:]

    until(reported)
    assert (service.main.pid == main) == (killed == "hand")
    assert min(forces_n) > HELD_N
    assert (cell.state(), cell.holding()) == (9, True)
    if killed != "hand":
        lease = cell.acquire("after")
    assert done(cell, lease, cell.clear(lease)) == 4
    assert simulator.grip_n() > HELD_N
    assert done(cell, lease, cell.release(lease, RELEASE_KEY)) == 4
    assert simulator.grip_n() == 0.0
    assert done(cell, lease, cell.reset(lease)) == 4
    assert cell.give_up(lease) == 0
