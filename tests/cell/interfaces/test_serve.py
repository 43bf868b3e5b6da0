"""`tactile-cell serve` as a process: its line, its notes, and its end with the part held."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest
from typer.testing import CliRunner

from cell.config.model import CellConfig
from cell.control.states import Command
from cell.interfaces.access import view_token
from cell.interfaces.cli.app import app
from cell.interfaces.cli.commands import serve as serving
from cell.jobs.taught_cache import MODEL_FILE, cached_model, keep_model
from cell.learning.model import load_model
from cell.service.service import RELEASE_KEY
from tests import ROOT
from tests.cell.conftest import once
from tests.cell.interfaces.hosts import Client
from tests.waiting import LIMIT_S, until

PROGRAM = "from cell.interfaces.cli import main; main()"
SMALL = "tactile:\n  tare_frames: 25\nserve:\n  lease_timeout_s: 20\n"
CALLBACK = "positioner:\n  kind: callback\n"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Return what starts the program on the small simulated cell: the process and its line."""
    made: list[subprocess.Popen[str]] = []

    def run(
        *options: str, config: str | None = "", **streams: Any
    ) -> tuple[subprocess.Popen[str], dict[str, Any]]:
        if config is not None:
            (tmp_path / "cell.yaml").write_text(SMALL + config)
            options += ("-c", "cell.yaml")
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "serve", "--speed", "0", *options],
            cwd=tmp_path,
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams,
            text=True,
        )
        made.append(process)
        return process, json.loads((process.stdout and process.stdout.readline()) or "{}")

    yield run
    for process in made:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> list[str]:
    """End the program in order; return the lines of its standard error."""
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=LIMIT_S)[1]
    assert process.returncode == 0
    return said.splitlines()


def page(line: dict[str, Any]) -> str:
    """Return what is printed of the page where no terminal is, by the line of all addresses."""
    where = "on a terminal only; serve.token_file sets one"
    return f"page: http://127.0.0.1:{line['http_port']}/ (its token: {where})"


def test_the_program_ends_in_order_while_a_job_waits_and_clients_are_connected(
    start, tmp_path
) -> None:
    ports = ("--modbus", "0", "--xml-rpc", "0", "--http", "0")
    process, line = start(*ports, config=CALLBACK)
    assert set(line) == {
        *("listen", "modbus_port", "xmlrpc_port", "http_port", "token", "view_token")
    }
    with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
        lease = cell.acquire("robot")
        assert cell.grip(lease, 3.0) == 1
        until(lambda: cell.job_state(1) == 4 or cell.pose_seq() or cell.alive(lease))
        if seq := cell.pose_seq():
            cell.pose_reached(lease, seq, True)
        until(lambda: cell.alive(lease) or cell.job_state(1) == 4)
        assert cell.holding()
        said = ended(process)
    assert said[1:] == [page(line)]


@pytest.mark.parametrize("moment", ["self-zero of the start", "ramp of a job"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_first_stops_the_motion(meddle, monkeypatch, tmp_path, moment, number) -> None:
    starts = moment == "self-zero of the start"
    (tmp_path / "cell.yaml").write_text(
        f"{SMALL}self_zero: {'always' if starts else 'on_demand'}\n"
    )
    pressed_n: list[float] = []

    def arrange(made: Any) -> None:
        def strike() -> None:
            os.kill(os.getpid(), number)
            until(lambda: made.controller.life.interrupted)  # the cell's time stands meanwhile
            pressed_n.append(min(made.simulated.world.contact_force_n()))

        once(
            made.simulated.clock, lambda: min(made.simulated.world.contact_force_n()) > 2.0, strike
        )

    def command(over: threading.Event, service: Any, _manager: Any) -> None:
        lease = service.lease.acquire("host")
        service.start(lease, {"task": "grip", "force_n": 9.0, "present": "ball"})
        assert over.wait(LIMIT_S)
        until(lambda: service.job().outcome_number >= 4)
        assert service.job().outcome == "CANCELED"
        # What a client asks for meanwhile moves nothing.
        service.command(lease, Command.RELEASE, key=RELEASE_KEY)
        until(lambda: service.job().outcome_number >= 4)
        assert service.job().outcome == "CANCELED"

    monkeypatch.setattr(serving, "report_until", command)
    built = meddle(arrange)
    options = ("-c", str(tmp_path / "cell.yaml"), "--modbus", "0", "--xml-rpc", "0", "--speed", "0")
    ended = CliRunner().invoke(app, ["serve", *options])
    assert ended.exit_code == 0, ended.output
    left_n = min(built[0].simulated.world.contact_force_n())
    assert 2.0 < pressed_n[0] < left_n + 0.5
    assert left_n < 4.0  # of 9 N


def test_a_token_that_stands_in_a_file_is_printed_nowhere(start, tmp_path) -> None:
    (tmp_path / "token").write_text("a-token-of-the-cell-1")
    ports = ("--modbus", "0", "--xml-rpc", "0", "--http", "0")
    process, line = start(*ports, config="  token_file: token\n")
    assert not {"token", "view_token"} & line.keys()
    said = ended(process)
    assert f"page: http://127.0.0.1:{line['http_port']}/ (its token: token)" in said
    assert "a-token" not in "".join(said)


@pytest.mark.parametrize("file", [False, True])
def test_a_terminal_shows_the_page_with_its_tokens(start, tmp_path, file: bool) -> None:
    (tmp_path / "token").write_text("a-token-of-the-cell-1")
    screen, terminal = os.openpty()
    config = "  token_file: token\n" if file else ""
    process, line = start("--http", "0", config=config, stderr=terminal)
    os.close(terminal)
    process.send_signal(signal.SIGTERM)
    said = b""
    with suppress(OSError):  # the end of a terminal
        while more := os.read(screen, 4096):
            said += more
    os.close(screen)
    token = "a-token-of-the-cell-1" if file else line["token"]
    for one in (token, view_token(token)):
        assert f"http://127.0.0.1:{line['http_port']}/#token={one}" in said.decode()


@pytest.mark.parametrize("stream", ["a program", "the journal"])
def test_a_line_in_the_journal_has_no_token(start, monkeypatch, stream: str) -> None:
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    ours, theirs = socket.socketpair()
    more = {} if stream == "a program" else {"stdout": theirs}
    process, line = start("--http", "0", **more)
    theirs.close()
    if stream == "the journal":
        with ours.makefile() as lines:
            line = json.loads(lines.readline())
    ours.close()
    assert ("token" in line, "view_token" in line) == (stream == "a program",) * 2
    assert page(line) in ended(process)


def test_a_model_is_loaded_and_saved_and_a_second_person_gets_a_link_and_a_warning(
    start, taught, tmp_path
) -> None:
    text = (ROOT / "docs/how-to/watch-and-command-in-a-browser.md").read_text("utf-8")
    (typed,) = re.findall(r"tactile-cell serve (--listen .*)", text)
    ports = ("--http", "0", "--modbus", "0", "--xml-rpc", "0")
    model = ("--model", str(taught.result.model), "--save", "parts.npz")
    process, line = start(*typed.split(), *ports, *model)
    assert line["listen"] == "0.0.0.0"
    address = Client(line | {"token": line["view_token"]}).get("/api/access")["address"]
    with ServerProxy(f"http://127.0.0.1:{line['xmlrpc_port']}") as cell:
        lease = cell.acquire("robot")
        job = cell.teach(lease, "ball", 1)
        until(lambda: cell.alive(lease) or cell.job_state(job) == 4)
        assert load_model(tmp_path / "parts.npz").labels == ("ball", "box")
        said = ended(process)
    assert f"page: {address.partition('#')[0]} (its token: on a terminal only" in " ".join(said)
    assert not re.search(r"0\.0\.0\.0|127\.0\.0\.1", address)
    assert "authenticate nobody" in " ".join(said)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the user's cache, empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def copied(model: Path) -> Callable[[Path], None]:
    """Return what writes a model with its training set into a folder, as a run does."""

    def write(folder: Path) -> None:
        shutil.copyfile(model, folder / MODEL_FILE)
        shutil.copyfile(model.with_name("model.grasps.npz"), folder / "model.grasps.npz")

    return write


def test_without_a_config_the_taught_cell_is_there_with_its_page(start, cache, taught) -> None:
    keep_model(CellConfig(), copied(taught.result.model))
    process, line = start("--modbus", "0", "--xml-rpc", "0", config=None)
    assert 8080 <= line["http_port"] < 8180
    assert Client(line).get("/api/info")["labels"] == ["ball", "box"]
    assert ended(process)[1:] == [page(line)]


def test_the_page_takes_the_next_port_where_its_own_is_taken(monkeypatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr(serving, "_PAGE_PORT", taken.getsockname()[1])
        found = serving.free_page_port("127.0.0.1")
        assert found > taken.getsockname()[1]


def test_without_its_extra_there_is_no_page_but_a_note(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert serving.free_page_port("127.0.0.1") is None
    assert "no page: uvicorn missing" in capsys.readouterr().err


def test_the_first_start_teaches_under_a_lease_and_keeps_the_model(serve, cache, taught) -> None:
    served = serve()
    service, write = served.service, copied(taught.result.model)
    served.plugin.save = lambda path: write(path.parent)
    commanders, plain_start = [], service.start

    def start(lease: int, goal: Any) -> int:
        commanders.append(service.snapshot().commander)
        return plain_start(lease, goal)

    service.start = start
    serving._teach_first(service, service.config, threading.Event())
    assert [(goal.label, goal.grasps) for goal in served.plugin.asked] == [
        ("ball", serving._FIRST_GRASPS),
        ("box", serving._FIRST_GRASPS),
    ]
    assert commanders == ["first start", "first start"]
    assert service.snapshot().commander == ""
    assert cached_model(service.config) is not None


def test_what_is_taught_with_faults_injected_is_not_kept(serve, cache) -> None:
    served = serve()
    served.plugin.save = lambda _path: pytest.fail("nothing is to be kept")
    arguments = (served.service, served.service.config, threading.Event())
    serving._teach_first(*arguments, keep=False)
    assert len(served.plugin.asked) == 2


def test_a_first_start_whose_lease_is_taken_keeps_nothing(
    serve, cache, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(serving, "SIGNAL_LOOK_S", 0.0)
    served = serve()
    service = served.service
    served.plugin.pause()
    plain_alive = service.lease.alive

    def alive(lease: int) -> None:
        service.lease.alive = plain_alive
        service.lease.acquire("operator", take=True)
        service.lease.alive(lease)

    service.lease.alive = alive
    served.plugin.save = lambda _path: pytest.fail("nothing is to be kept")
    serving._teach_first(service, service.config, threading.Event())
    assert "not all objects were taught" in capsys.readouterr().err
    assert cached_model(service.config) is None
    assert service.snapshot().commander == "operator"


def test_a_first_start_that_is_to_end_ends_at_once(serve, cache) -> None:
    served, over = serve(), threading.Event()
    served.plugin.pause()
    over.set()
    serving._teach_first(served.service, served.service.config, over)
    assert len(served.plugin.asked) == 1
    assert cached_model(served.service.config) is None
