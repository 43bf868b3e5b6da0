"""`tactile-cell serve` as a process: its line, its notes, and its end with the part held."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from tests.cell.interfaces.conftest import LIMIT_S, until

PROGRAM = "from cell.interfaces.cli import main; main()"
SMALL = "tactile:\n  tare_frames: 25\nserve:\n  lease_timeout_s: 20\n"
CALLBACK = "positioner:\n  kind: callback\n"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Return what starts the program on the small simulated cell: the process and its line."""
    made: list[subprocess.Popen[str]] = []

    def run(*options: str, config: str = "") -> tuple[subprocess.Popen[str], dict[str, Any]]:
        (tmp_path / "cell.yaml").write_text(SMALL + config)
        command = [sys.executable, "-c", PROGRAM, "serve", "-c", "cell.yaml", *options]
        process = subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        made.append(process)
        assert process.stdout is not None
        return process, json.loads(process.stdout.readline() or "{}")

    yield run
    for process in made:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_program_ends_in_order_while_a_job_waits_and_clients_are_connected(
    start: Callable[..., Any], number: signal.Signals
) -> None:
    process, line = start("--modbus", "0", "--xml-rpc", "0", "--http", "0", config=CALLBACK)
    assert set(line) == {"listen", "modbus_port", "xmlrpc_port", "http_port", "token"}
    with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
        lease = cell.acquire("robot")
        assert cell.grip(lease, 3.0) == 1
        until(lambda: cell.job_state(1) == 4 or cell.pose_seq() or cell.alive(lease))
        if seq := cell.pose_seq():
            cell.pose_reached(lease, seq, True)
        until(lambda: cell.alive(lease) or cell.job_state(1) == 4)
        assert cell.holding()
        process.send_signal(number)
        assert process.wait(LIMIT_S) == 0
    assert process.communicate()[1].splitlines()[1:] == []


def test_a_model_taught_over_a_link_is_saved_and_loaded(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    process, line = start("--modbus", "0", "--xml-rpc", "0", "--save", "parts.npz")
    with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
        lease = cell.acquire("robot")
        for label in ("ball", "box"):
            job = cell.teach(lease, label, 3)
            until(lambda job=job: cell.alive(lease) or cell.job_state(job) == 4)
        until((tmp_path / "parts.npz").exists)
        process.send_signal(signal.SIGTERM)
        assert process.wait(LIMIT_S) == 0
    _, line = start("--modbus", "0", "--xml-rpc", "0", "--model", "parts.npz")
    with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
        lease = cell.acquire("robot")
        job = cell.identify(lease, 1, 0.0, False)
        until(lambda: cell.alive(lease) or cell.job_state(job) >= 4)
        assert cell.job_state(job) == 4


def test_other_addresses_need_an_allow_list_and_get_a_warning(start: Callable[..., Any]) -> None:
    process, line = start("--listen", "0.0.0.0", "--modbus", "0", "--xml-rpc", "0")
    assert line == {}
    assert process.wait(LIMIT_S) == 2
    assert "serve.allow is empty" in process.communicate()[1]
    options = ("--listen", "0.0.0.0", "--allow", "192.0.2.7", "--modbus", "0", "--xml-rpc", "0")
    process, line = start(*options)
    assert line["listen"] == "0.0.0.0"
    process.send_signal(signal.SIGTERM)
    process.wait(LIMIT_S)
    assert "authenticate nobody" in process.communicate()[1]
