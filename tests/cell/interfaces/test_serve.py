"""`tactile-cell serve` as a process: its line, its notes, and its end with the part held."""

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from typing import Any
from xmlrpc.client import ServerProxy

import pytest
from rich.console import Console
from typer.testing import CliRunner

from cell.control.states import Command
from cell.interfaces.access import view_token
from cell.interfaces.cli import terminal
from cell.interfaces.cli.app import app
from cell.interfaces.cli.commands import serve as serving
from cell.service.service import RELEASE_KEY
from tests.cell.conftest import once
from tests.waiting import LIMIT_S, until

PROGRAM = (sys.executable, "-c", "from cell.interfaces.cli import main; main()")
PORTS = ("--modbus", "0", "--xml-rpc", "0", "--http", "0")
TOKEN = "a-token-of-the-cell-1"
SMALL = """
self_zero: {zero}
tactile: {{tare_frames: 25}}
positioner: {{kind: {kind}}}
serve: {{lease_timeout_s: 20}}
"""


@pytest.mark.slow
def test_the_program_ends_in_order_while_a_job_waits_and_clients_are_connected(tmp_path) -> None:
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "cell.yaml").write_text(SMALL.format(zero="on_demand", kind="callback"))
    options = ("serve", "--speed", "0", "-c", "cell.yaml", *PORTS, "--token-file", "token")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*PROGRAM, *options], cwd=tmp_path, text=True, **pipes) as process:
        try:
            line = json.loads(process.stdout.readline())
            assert set(line) == {"listen", "modbus_port", "xmlrpc_port", "http_port"}
            with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
                lease = cell.acquire("robot")
                assert cell.grip(lease, 3.0) == 1
                until(lambda: cell.pose_seq() or cell.alive(lease))
                process.send_signal(signal.SIGTERM)
                said = process.communicate(timeout=LIMIT_S)[1]
        finally:
            process.kill()
    assert process.returncode == 0
    assert f"page: http://127.0.0.1:{line['http_port']}/ (its token: token)\n" in said
    assert TOKEN not in said


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["self-zero of the start", "ramp of a job"])
def test_a_signal_first_stops_the_motion(meddle, monkeypatch, tmp_path, moment) -> None:
    starts = moment == "self-zero of the start"
    zero = "always" if starts else "on_demand"
    (tmp_path / "cell.yaml").write_text(SMALL.format(zero=zero, kind="simulated"))
    pressed_n: list[float] = []

    def arrange(made: Any) -> None:
        def strike() -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            until(lambda: made.controller.life.interrupted)  # the cell's time stands meanwhile
            pressed_n.append(min(made.simulated.world.contact_force_n()))

        once(
            made.simulated.clock, lambda: min(made.simulated.world.contact_force_n()) > 2.0, strike
        )

    def command(over: threading.Event, service: Any, _manager: Any) -> None:
        lease = service.lease.acquire("host")
        service.start(lease, {"task": "grip", "force_n": 9.0, "present": "ball"})
        assert over.wait(LIMIT_S)
        until(lambda: service.plugin.job().outcome_number >= 4)
        assert service.plugin.job().outcome == "CANCELED"
        # What a client asks for meanwhile moves nothing.
        service.command(lease, Command.RELEASE, key=RELEASE_KEY)
        until(lambda: service.plugin.job().outcome_number >= 4)
        assert service.plugin.job().outcome == "CANCELED"

    monkeypatch.setattr(serving, "report_until", command)
    built = meddle(arrange)
    ended = CliRunner().invoke(app, ["serve", "-c", str(tmp_path / "cell.yaml"), *PORTS])
    assert ended.exit_code == 0, ended.output
    left_n = min(built[0].simulated.world.contact_force_n())
    assert 2.0 < pressed_n[0] < left_n + 0.8
    assert left_n < 4.0  # of 9 N


@pytest.mark.parametrize("file", [False, True])
def test_a_terminal_alone_shows_the_tokens_of_the_page(
    serve, tmp_path, monkeypatch, capsys, file
) -> None:
    (tmp_path / "token").write_text(TOKEN)
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, highlight=False)
    for module in (terminal, serving):
        monkeypatch.setattr(module, "err", console)
    served = serve(serve__http_port=0, serve__token_file=str(tmp_path / "token") * file)
    with serving._announced_interfaces(served.service):
        line = json.loads(capsys.readouterr().out)
    tokens = re.findall(rf"http://127.0.0.1:{line['http_port']}/#token=(\S+)", screen.getvalue())
    assert tokens[1] == view_token(tokens[0])
    assert set(line) == {"listen", "http_port"}
    assert (tokens[0] == TOKEN) is file


def test_the_page_takes_any_port_where_its_own_is_taken(monkeypatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr(serving, "_PAGE_PORT", taken.getsockname()[1])
        assert serving.free_page_port("127.0.0.1") == 0
    assert serving.free_page_port("127.0.0.1") == serving._PAGE_PORT


def test_without_its_extra_there_is_no_page_but_a_note(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert serving.free_page_port("127.0.0.1") is None
    assert "no page: uvicorn missing" in capsys.readouterr().err


def test_the_first_start_teaches_under_a_lease(serve) -> None:
    served = serve()
    service, commanders, plain_start = served.service, [], served.service.start

    def start(lease: int, goal: Any) -> int:
        commanders.append(service.snapshot().commander)
        return plain_start(lease, goal)

    service.start = start
    serving._teach_first(service, threading.Event())
    asked = [(goal.label, goal.grasps) for goal in served.plugin.asked]
    assert asked == [(label, serving._FIRST_GRASPS) for label in ("ball", "box")]
    assert (commanders, service.snapshot().commander) == (["first start"] * 2, "")


@pytest.mark.parametrize("why", ["the lease is taken", "the program ends"])
def test_a_first_start_teaches_no_more_than_it_may(serve, monkeypatch, capsys, why) -> None:
    monkeypatch.setattr(serving, "SIGNAL_LOOK_S", 0.0)
    served, over = serve(), threading.Event()
    service = served.service
    served.plugin.pause()
    plain_alive = service.lease.alive

    def alive(lease: int) -> None:
        service.lease.alive = plain_alive
        service.lease.acquire("operator", take=True)
        service.lease.alive(lease)

    if "lease" in why:
        service.lease.alive = alive
    else:
        over.set()
    serving._teach_first(service, over)
    assert len(served.plugin.asked) <= 1
    assert ("not all objects were taught" in capsys.readouterr().err) is ("lease" in why)
