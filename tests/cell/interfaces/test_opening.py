"""Opening the interfaces: what keeps one from it, and what is warned of."""

import os
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from cell.control.plan import Pose
from cell.errors import CellError, ConfigError
from cell.interfaces.cli.commands.serve import report_until
from cell.interfaces.opening import open_interfaces, warnings
from tests.waiting import LIMIT_S


def test_interfaces_that_cannot_be_opened_say_why(serve, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no interface is open"), open_interfaces(serve().service):
        pass
    with pytest.raises(CellError, match=r"cannot read token or secret .*missing"):
        serve("http", serve__token_file=str(tmp_path / "missing"))
    os.mkfifo(tmp_path / "pipe")
    keys = {"secret_file": "modbus", "token_file": "http", "tls_key": "http"}
    for key, interface in keys.items():
        files = {"serve__tls_certificate": str(tmp_path / "missing")} if key == "tls_key" else {}
        with pytest.raises(ConfigError, match="pipe: not a plain file"):
            serve(interface, **files, **{f"serve__{key}": str(tmp_path / "pipe")})
    (tmp_path / "bad").write_bytes(b"\xff" * 20)
    with pytest.raises(ConfigError, match="needs ASCII characters"):
        serve("xmlrpc", serve__secret_file=str(tmp_path / "bad"))
    (tmp_path / "long").write_text("x" * 65)
    with pytest.raises(ConfigError, match="at most 64 characters"):
        serve("modbus", serve__secret_file=str(tmp_path / "long"))
    (tmp_path / "short").write_text("short")
    with pytest.raises(ConfigError, match="at least 16 characters"):
        serve("http", serve__token_file=str(tmp_path / "short"))


def test_an_address_for_others_is_warned_of(serve) -> None:
    assert warnings(serve("modbus", "xmlrpc", "http").service) == ()
    others = {"serve__listen": "0.0.0.0", "serve__allow": ["192.0.2.1"]}
    modbus, http = warnings(serve(serve__modbus_port=0, serve__http_port=0, **others).service)
    assert "Modbus and XML-RPC authenticate nobody: any program on 192.0.2.1" in modbus
    assert "without TLS" in http
    assert warnings(serve(**others).service) == ()


@pytest.mark.parametrize("interface", ["modbus", "xmlrpc", "http"])
def test_a_taken_port_names_the_key_that_sets_another(serve, interface: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port, key = taken.getsockname()[1], f"serve__{interface}_port"
        ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
        served = serve(**ports | {key: port})
        complaint = f"127.0.0.1:{port} .*set serve.{interface}_port to another port"
        with pytest.raises(CellError, match=complaint), open_interfaces(served.service):
            pass


@pytest.mark.parametrize("interface", ["modbus", "xmlrpc", "http"])
def test_an_interface_that_dies_is_a_problem_of_the_service(serve, interface: str) -> None:
    service = serve("modbus", "xmlrpc", "http").service
    assert service.problem == ""
    (works,) = (one for name, one in service._watched.items() if f".{interface}_port" in name)
    server = works.__self__
    if interface == "modbus":
        server._loop.call_soon_threadsafe(server._over.set)
    else:
        server._server.should_exit = True
    server._thread.join(LIMIT_S)
    assert service.problem.startswith(f"the interface of serve.{interface}_port has ended")


def test_a_program_with_a_problem_stops_its_job_and_feeds_no_watchdog(serve, capsys) -> None:
    served = serve("modbus")
    lease = served.service.lease.acquire("host")
    served.plugin.pause()
    served.service.start(lease, {"task": "identify"})
    reports: list[tuple[str, bool]] = []
    manager = SimpleNamespace(report=lambda text, *, working: reports.append((text, working)))
    turns = iter([True, True, False, False, True])

    def wait(_time_s: float) -> bool:
        """Have a cell that works in some turns."""
        served.plugin.working = next(turns, None)
        return served.plugin.working is None

    report_until(SimpleNamespace(wait=wait), served.service, manager)  # type: ignore[arg-type]
    assert [working for _, working in reports] == [True, True, False, False, True]
    assert reports[2][0].startswith("the thread of the cell hangs")
    assert "stopped because the thread of the cell hangs" in served.ended().error
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("the thread of the cell hangs") == 1


def test_a_host_may_take_its_time_for_a_pose(serve) -> None:
    served = serve()
    served.plugin.working = False  # the thread of the cell waits for the host
    assert served.service.problem
    reached = served.ask_pose(Pose())
    assert served.service.problem == ""
    served.service.pose_reached(served.service.lease.acquire("host"), 1)
    assert reached.result(LIMIT_S) is True
