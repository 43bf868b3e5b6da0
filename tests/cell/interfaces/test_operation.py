"""A cell as a service: `install`, sd_notify, `/healthz`, `/metrics`, `support`, and `serve`."""

import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from stat import S_IROTH
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock
from xmlrpc.client import ServerProxy
from zipfile import ZipFile

import pytest
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from ruamel.yaml import YAML
from typer.main import get_command
from typer.testing import CliRunner

from cell.config.file import changed_config, config_text, load_config, parse_config
from cell.config.model import CellConfig
from cell.control.part import Part
from cell.control.states import Command
from cell.control.zeroing import Zeroing
from cell.interfaces.access import view_token
from cell.interfaces.cli import terminal
from cell.interfaces.cli.app import app
from cell.interfaces.cli.commands import serve as serving
from cell.interfaces.cli.commands.serve import ServiceManager
from cell.interfaces.cli.commands.service import (
    REMOVED,
    RULES_FILE,
    UNIT_FILE,
    closed_to_service,
    service_may,
    system_files,
)
from cell.interfaces.opening import open_interfaces
from cell.recording.reader import RecordedMessages
from cell.service.history import Totals
from cell.service.service import RELEASE_KEY
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import GripperError
from recognition.recognizer import UNKNOWN
from tactile.errors import HeartbeatLost
from tests import ROOT, blocks, commands
from tests.cell.cells import REAL, MakeBench, call, once, small_config
from tests.cell.interfaces.hosts import Client
from tests.cell.served import GRASP, Served
from tests.faults.campaign import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.hil.supervisor import read_unit
from tests.waiting import LIMIT_S, until

PAGE = ROOT / "docs/how-to/run-as-a-service.md"
WRITTEN = {
    "etc/udev/rules.d/99-tactile-cell.rules",
    "etc/sysusers.d/tactile-cell.conf",
    "etc/systemd/system/tactile-cell.service",
}


def files_in(folder: Path) -> set[str]:
    return {str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_file()}


# -- the files ---------------------------------------------------------------------------------


def test_what_the_page_types_prints_writes_and_packs(tmp_path, monkeypatch) -> None:
    page = PAGE.read_text("utf-8")
    printing, applied, support = commands("how-to/run-as-a-service.md")
    image = tmp_path / "image"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text("gripper: {port: simulated}")
    monkeypatch.setattr("cell.interfaces.cli.commands.service.load_model", lambda *_: None)
    printed = call(*printing, "--root", image)
    assert f"--save {tmp_path}/parts.model.npz" in printed
    assert not image.exists()
    for name in WRITTEN:
        assert f"/{name}" in printed
        assert f"`/{name}`" in page
    call(*applied, "--root", image, answers="y\ny\ny\n")
    assert files_in(image) == WRITTEN
    for name in WRITTEN:
        assert (image / name).read_text().strip() in printed
    assert call(*applied, "--root", image).count("already up to date") == 3
    call(*support)
    assert (tmp_path / "bundle.zip").exists()


def test_each_file_is_asked_for_and_the_end_of_the_input_is_a_no(tmp_path) -> None:
    call("service", "install", "--apply", "--root", tmp_path, answers="n\ny\n")
    assert files_in(tmp_path) == {"etc/sysusers.d/tactile-cell.conf"}


def with_axes(can: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a real cell with drives on a CAN bus, and a wrist on a serial port."""
    axes = [X_AXIS, ROTATION_AXIS, WRIST | {"port": "/dev/ttyUSB4"}]
    return REAL | CHANGES | {"positioner": {"kind": "axes", "can": can, "axes": axes}}


def unit_of(config: CellConfig, file: Path | None = None, *options: str) -> str:
    return system_files(config, file, options)[UNIT_FILE]


def test_systemd_verifies_the_unit(tmp_path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not there; apt-get install systemd brings it")
    path = tmp_path / "tactile-cell.service"
    model = ("--model", "/srv/100% parts;$HOME.npz")
    own = {"recording__directory": "/srv/1 & 50%", "serve__http_port": 80}
    path.write_text(text := unit_of(small_config(**REAL | own), tmp_path / "a cell.yaml", *model))
    assert '\nReadWritePaths="-/srv/1 & 50%%"\nAmbientCapabilities=CAP_NET_BIND' in text
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_no_setting_of_the_unit_lets_the_grip_go() -> None:
    unit = read_unit(unit_of(small_config()))
    # `mixed` sends SIGKILL to the force loop when the main process dies.
    assert unit["KillMode"] == "control-group"
    assert unit["KillSignal"] == unit["WatchdogSignal"] == "SIGTERM"
    assert unit["OOMPolicy"] == "continue"
    assert int(unit["TimeoutStopSec"]) > 30  # the time that a service has to close
    assert (unit["Type"], unit["NotifyAccess"]) == ("notify", "main")
    assert unit["StartLimitIntervalSec"] == "0"


def test_the_unit_serves_the_config_and_brings_the_can_up(tmp_path, monkeypatch) -> None:
    active = tmp_path / "current"  # a link to the active version stays one
    active.symlink_to(Path(sys.executable).parent)
    monkeypatch.setattr(sys, "argv", [str(active / "tactile-cell")])
    assert read_unit(unit_of(small_config()))["ExecStart"].startswith(f"{active}/tactile-cell ")
    config = small_config(**REAL, recording__directory="/srv/recordings")
    text = unit_of(config, tmp_path / "cell.yaml", "--model", "/srv/100% parts;$HOME.npz")
    unit = read_unit(text)
    assert unit["ExecStart"].endswith(
        f' serve --model "/srv/100%% parts;$$HOME.npz" --out /srv/recordings --config '
        f"{tmp_path}/cell.yaml"
    )
    assert unit["ReadWritePaths"] == "-/srv/recordings"
    assert text.count("link set can0 type can bitrate 1000000") == 1
    drives = {"interface": "socketcan", "channel": "can1", "bitrate": 500_000}
    text = unit_of(small_config(**with_axes(drives)))
    assert "link set can1 type can bitrate 500000" in text
    assert "ExecStartPre" not in unit_of(small_config())


def test_what_the_service_user_cannot_read_is_named(tmp_path, monkeypatch) -> None:
    config = tmp_path / "home" / "cell.yaml"
    config.parent.mkdir(0o755)
    token = tmp_path / "token"
    token.write_text(32 * "t")
    token.chmod(0o600)
    config.write_text(
        f"gripper: {{port: simulated}}\nserve: {{token_file: {token}, secret_file: no-secret}}\n"
        "recording: {directory: /nowhere}\npositioner: {kind: operator}"
    )
    tmp_path.chmod(0o755)
    assert closed_to_service(config) in (None, *tmp_path.parents)
    config.chmod(0o640)
    config.parent.chmod(0o750)
    assert closed_to_service(config) in (config.parent, *tmp_path.parents)
    for mode in (0o640, 0o604):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "group", lambda _: "tactile-cell")
            config.chmod(mode)
            assert service_may(config, S_IROTH) == (mode == 0o640)
    asked = ["service", "install", "-c", str(config)]
    warned = CliRunner().invoke(app, asked).stderr
    assert "no interface is open: set serve.http_port" in warned
    assert f"{config}: the user tactile-cell cannot read /" in warned
    assert f"{token}: the user tactile-cell cannot read /" in warned
    assert "chgrp tactile-cell /" in warned
    assert "/var/lib/tactile-cell/no-secret is missing: the service reads it there" in warned
    assert "positioner.kind is operator, and a service has no terminal" in warned
    assert "cannot write /nowhere (recording.directory): install -d -o tactile-cell" in warned
    # As pathlib does for a group without a name, for example of an image or a network drive.
    monkeypatch.setattr(Path, "group", Mock(side_effect=KeyError("gid not found: 54321")))
    assert CliRunner().invoke(app, asked).stderr == warned


# -- udev --------------------------------------------------------------------------------------


def test_the_rules_name_each_serial_port_and_keep_modem_manager_away(monkeypatch) -> None:
    chip = {"ID_VENDOR_ID": "1a86", "ID_MODEL_ID": "7523"}
    monkeypatch.setattr(
        "cell.interfaces.cli.commands.service.usb_identity",
        lambda port: None if port == "/dev/ttyACM3" else chip | {"DEVPATH": f"*-{port[-1]}/*"},
    )
    boards = {"kind": "flexitac", "ports": ("/dev/ttyUSB1", "/dev/ttyUSB2")}
    for changes, lines in (
        (
            {"tactile.layout": "flexitac_12x32", "tactile.sensor": boards},
            {"sensor0": 1, "sensor1": 2},
        ),
        ({"tactile.interface": "slcan", "tactile.channel": "/dev/ttyUSB1"}, {"can": 1}),
    ):
        axes = with_axes({"interface": "slcan", "channel": "/dev/ttyACM3"})
        rules = system_files(small_config(**axes | changes), None)[RULES_FILE]
        for role, number in (lines | {"servos": 0, "roll": 4}).items():
            assert f'ENV{{DEVPATH}}=="*-{number}/*", SYMLINK+="tactile-cell/{role}"' in rules
        modem = 'ATTR{idProduct}=="7523", ENV{ID_MM_DEVICE_IGNORE}="1"'
        assert rules.count(modem) == 2 + len(lines)
        assert "# positioner.can.channel: /dev/ttyACM3 is no connected USB adapter" in rules
        assert 'ATTR{latency_timer}="1"' in rules
        assert 'ENV{SYSTEMD_WANTS}=""' in rules  # of brltty


# -- sd_notify ---------------------------------------------------------------------------------


@pytest.fixture(params=["path", "abstract"])
def notify(request: Any, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    """A notify socket, and its address as systemd hands it on."""
    name = str(tmp_path / "n") if request.param == "path" else f"@tactile-cell-{tmp_path}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(name.replace("@", "\0"))
        link.setblocking(False)
        yield name, link


def received(link: socket.socket) -> list[str]:
    messages = []
    while True:
        try:
            messages.append(link.recv(4096).decode())
        except BlockingIOError:
            return messages


def test_the_watchdog_is_fed_only_while_the_cell_works(notify) -> None:
    name, link = notify
    manager = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "30000000"})
    manager.send("READY=1")
    manager.report("IDLE", working=False)
    assert received(link) == ["READY=1", "STATUS=IDLE"]
    manager.report("IDLE", working=True)
    manager.report("IDLE", working=True)  # at once: the watchdog needs no more
    manager.report("ABORTED, a part may be held, fault 506", working=True)
    manager.send("STOPPING=1")
    assert received(link) == [
        "WATCHDOG=1",
        "STATUS=ABORTED, a part may be held, fault 506",
        "STOPPING=1",
    ]


def test_a_watchdog_of_another_process_and_a_manager_that_is_gone_are_left_alone(
    notify, tmp_path
) -> None:
    name, link = notify
    other = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    ServiceManager(other).report("IDLE", working=True)
    assert received(link) == ["STATUS=IDLE"]
    ServiceManager({}).send("READY=1")
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "gone")}).send("READY=1")


# -- the container -----------------------------------------------------------------------------


def test_containers_are_unprivileged_and_their_commands_are_ours() -> None:
    compose = YAML(typ="safe", pure=True).load(ROOT / "compose.yaml")
    image = (ROOT / "Containerfile").read_text()
    assert re.findall(r"^USER (\S+)", image, re.MULTILINE) == ["10001"]
    assert all(re.search(r":\d+\.\d+\.\d+-", line) for line in re.findall(r"FROM (.*)", image))
    command: Any = get_command(app)
    for service in compose["services"].values():
        assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
        assert "privileged" not in service
        name, *options = service["command"]
        given = command.commands[name].make_context(name, list(options)).params
        assert given["http_port"] == 8080
        # What a terminal of a container shows is in its log.
        assert (given["token_file"], "tty" in service) == ("/run/secrets/token", False)
    assert compose["services"]["real"]["ulimits"] == {"rtprio": 99, "memlock": -1}
    simulated = dict(zip(*[iter(compose["services"]["simulated"]["command"][1:])] * 2, strict=True))
    changed_config(
        load_config(None),
        {"serve.listen": simulated["--listen"], "serve.allow": [simulated["--allow"]]},
    )
    sources = set(re.findall(r"^COPY (\w+) \w+$", image, re.MULTILINE))
    ignored = (ROOT / ".containerignore").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert sources == {*project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"], "config"}
    assert all(f"!{one}\n" in ignored for one in sources)


def test_the_snippets_of_the_page_are_read() -> None:
    snippets = blocks("how-to/run-as-a-service.md", "yaml")
    assert parse_config(snippets[0], source="page").serve.token_file == "/etc/tactile-cell/token"
    assert YAML(typ="safe", pure=True).load(snippets[1])["scrape_configs"][0]["authorization"]


# -- `/healthz` and `/metrics`: a scrape, read by Prometheus' own parser ---------------------------


DASHBOARD = ROOT / "docs/examples/grafana-dashboard.json"


def scraped(client: Client, token: str) -> tuple[int, str]:
    status, body, _ = client.send("GET", "/metrics", token=token)
    return status, body.decode() if isinstance(body, bytes) else str(body)


def values_of(text: str) -> dict[str, float]:
    """Return each sample of a scrape, its labels in braces."""
    return {
        sample.name + "".join(f"{{{value}}}" for value in sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.mark.slow
def test_a_scrape_counts_parts_faults_and_links(connect, monkeypatch) -> None:
    served, client = connect(cell={})
    lease = client.post("/api/lease", name="host")["lease"]
    amperes = {"coulomb_a": 0.1, "breakaway_a": 0.2, "rising_a_nm": 0.6, "falling_a_nm": 0.4}
    drive = DriveCharacteristic(**amperes, kt_nm_a=1.6, measured_s=1.0)
    monkeypatch.setattr(Zeroing, "drives", {1: drive, 2: drive})
    goal = {"task": "sort", "parts": 1, "feed": ["box"], "max_grasps": 1}
    client.post("/api/jobs", lease=lease, goal=goal)
    assert served.ended().error == ""
    status, text = scraped(client, served.interfaces["view_token"])
    assert status == 200
    samples = values_of(text)
    counted = {"parts_total{box}{named}": 1, "cycle_seconds_count": 1, "fault": 0, "state": 4}
    assert {name: samples[f"tactile_cell_{name}"] for name in counted} == counted
    for name, least, most in (
        ("cycle_seconds_sum", 0.5, 60),
        ("force_error_newtons_count", 1, 10),
        ("frames_total", 50, 1e5),
        ("servo_temperature_celsius{1}", 10, 80),
    ):
        assert least <= samples[f"tactile_cell_{name}"] <= most, name
    for way in ("rising", "falling"):
        name = f"tactile_cell_servo_amperes_per_newton_metre{{{way}}}{{1}}"
        assert samples[name] == amperes[f"{way}_a_nm"]
    # Each metric of the dashboard is in the scrape; a fault may not be there yet.
    dashboard = json.loads(DASHBOARD.read_text())
    used = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"tactile_cell_\w+", target["expr"])
    }
    there = {name.partition("{")[0] for name in samples} | {"tactile_cell_faults_total"}
    assert len(used) > 20
    assert used <= there
    documented = re.findall(r"`(tactile_cell_\w+)`", PAGE.read_text("utf-8"))
    ends = re.compile(r"(_total|_bucket|_count|_sum|_created)$")
    assert {ends.sub("", name) for name in documented} == {ends.sub("", name) for name in there}
    served.plugin.simulate({"inject": "servo1.off"})
    client.post("/api/jobs", lease=lease, goal={"task": "grip", "force_n": 3.0})
    number = served.ended().fault_number
    samples = values_of(scraped(client, client.token)[1])
    assert samples[f"tactile_cell_faults_total{{{number}}}"] == 1
    assert samples["tactile_cell_fault"] == number


def test_each_result_of_a_part_is_counted() -> None:
    totals = Totals()
    grasps = SimpleNamespace(records=(GRASP, GRASP))
    for label, rejected in (("ball", False), ("ball", True), (UNKNOWN, True)):
        totals.add(Part(label=label, rejected=rejected, seconds=70.0), grasps)
    totals.add(Part(seconds=70.0), None)
    assert dict(totals.parts) == {
        ("ball", "named"): 1,
        ("ball", "rejected"): 1,
        (UNKNOWN, "unknown"): 1,
        ("", "missed"): 1,
    }
    assert totals.cycles_s == {"_count": 3, "_sum": 210.0}
    assert totals.force_errors_n == {"_count": 6, "_sum": pytest.approx(0.6)}


def test_metrics_need_a_token_and_health_does_not(connect) -> None:
    served, client = connect()
    assert scraped(client, "wrong")[0] == 401
    well = {"working": True, "problem": "", "state": "IDLE", "fault_number": 0, "holding": False}
    assert client.ask("GET", "/healthz", token=None) == (200, well)
    served.plugin.fail(HeartbeatLost("no heartbeat"))
    status, health = client.ask("GET", "/healthz", token=None)
    assert (status, health["state"], health["fault_number"]) == (200, "ABORTED", 305)
    served.plugin.working = False
    status, health = client.ask("GET", "/healthz", token=None)
    assert (status, health["problem"].split(";")[0]) == (503, "the thread of the cell hangs")


# -- The support bundle: what is in it, and that no secret is --------------------------------------


TOKEN, SECRET, PRINTED = "a-token-of-the-cell-1", "a-secret-of-the-cell-2", "printed-at-a-start-3"
SECRETS = (TOKEN, SECRET, PRINTED, view_token(TOKEN), view_token(SECRET))
JOURNAL = f"""#!/bin/sh
echo "page: http://cell:8080/#token={PRINTED}"
echo '{{"token": "{PRINTED}", "xmlrpc_port": 5021}}'
echo "somebody typed {TOKEN} and {view_token(SECRET)}"
echo "Authorization: Bearer {PRINTED}"
"""


@pytest.fixture
def cell(serve: Any, make_bench: MakeBench, tmp_path: Path, monkeypatch: Any) -> Served:
    """A service with secrets, a recording with a fault, a journal with tokens, and its config."""
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "secret").write_text(SECRET)
    (tmp_path / "journalctl").write_text(JOURNAL)
    (tmp_path / "journalctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / "out/run-1").mkdir(parents=True)
    bench = make_bench(folder=tmp_path / "out/run-1").ready()
    bench.simulated.inject("servo1.off")
    with pytest.raises(GripperError):
        bench.grasp()
    bench.cell.close()
    served: Served = serve(
        "http",
        serve__token_file=str(tmp_path / "token"),
        serve__secret_file=str(tmp_path / "secret"),
        recording__directory=str(tmp_path / "out"),
    )
    port = served.interfaces["http_port"]
    config = changed_config(served.service.config, {"serve.http_port": port})
    (tmp_path / "cell.yaml").write_text(f"# the password is {TOKEN}\n{config_text(config)}")
    return served


def packed(folder: Path) -> dict[str, bytes]:
    """Return the members of a new bundle."""
    file = folder / "bundle.zip"
    printed = call("service", "support", file, "-c", folder / "cell.yaml")
    with ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    assert all(name in printed for name in members)
    return members


def test_no_secret_of_a_cell_is_in_its_bundle(
    cell: Served, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")  # it must not get the token
    Client(cell.interfaces).post("/api/lease", name=f"host with {SECRET}")
    members = packed(tmp_path)
    recording = tmp_path / "recording.mcap"
    recording.write_bytes(members["recording.mcap"])
    unpacked = b"".join(data for _, _, data in RecordedMessages(recording))
    for name, content in (*members.items(), ("recording", unpacked)):
        for secret in SECRETS:
            assert secret.encode() not in content, name
    config = parse_config(members["config.yaml"].decode(), source="bundle")
    assert (config.serve.token_file, config.serve.secret_file) == (REMOVED, REMOVED)
    assert config.recording.directory == str(tmp_path / "out")
    assert b"xmlrpc_port" in members["journal.txt"]
    assert json.loads(members["health.txt"])["working"] is True
    assert "tactile-cell" in json.loads(members["versions.json"])["packages"]
    assert b"host with removed" in members["state.txt"]


@pytest.mark.usefixtures("cell")
def test_without_a_service_the_bundle_says_so(tmp_path: Path, monkeypatch: Any) -> None:
    config = parse_config((tmp_path / "cell.yaml").read_text(), source="cell")
    silent = changed_config(config, {"serve.http_port": 1, "serve.token_file": ""})
    (tmp_path / "cell.yaml").write_text(config_text(silent))
    monkeypatch.setattr("cell.interfaces.cli.commands.service.RECORDING_BYTES", 1000)
    members = packed(tmp_path)
    assert members["health.txt"].startswith(b"the service did not answer: ")
    assert "recording.mcap" not in members
    assert b"more than 1000 bytes" in members["recording.txt"]
    monkeypatch.setattr(os, "access", lambda name, _: not str(name).endswith(".mcap"))
    assert b"no permission to read it" in packed(tmp_path)["recording.txt"]
    nothing = changed_config(silent, {"serve.http_port": None})
    (tmp_path / "cell.yaml").write_text(config_text(nothing))
    assert b"serve.http_port is not set" in packed(tmp_path)["health.txt"]


# -- `tactile-cell serve`: its line, its notes, and its end with the part held ---------------------


PORTS = ("--modbus", "0", "--xml-rpc", "0", "--http", "0")
SMALL = """
gripper: {{port: simulated}}
self_zero: {zero}
tactile: {{tare_frames: 25}}
positioner: {{kind: {kind}}}
serve: {{lease_timeout_s: 20}}
"""


@pytest.fixture
def run_serve(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Any]:
    """Return what runs `serve` to its end, with what happens while it is open; it may signal."""

    def run(meanwhile: Callable[..., object], *options: object, **values: str) -> Any:
        monkeypatch.setattr(serving, "report_until", meanwhile)
        (tmp_path / "cell.yaml").write_text(SMALL.format(**values))
        words = ["serve", "-c", tmp_path / "cell.yaml", *PORTS, *options]
        ended = CliRunner().invoke(app, [*map(str, words)])
        assert ended.exit_code == 0, ended.output
        return ended

    return run


def test_serve_ends_in_order_while_a_job_waits_and_clients_listen(run_serve, tmp_path) -> None:
    (tmp_path / "token").write_text(TOKEN)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    services = []

    def meanwhile(over: threading.Event, service: Any, _manager: Any) -> None:
        with ServerProxy(f"http://127.0.0.1:{port}") as cell:
            assert cell.grip(cell.acquire("robot"), 3.0) == 1
            until(cell.pose_seq)
            os.kill(os.getpid(), signal.SIGTERM)
            assert over.wait(LIMIT_S)
            services.append(service)

    options = ("--xml-rpc", port, "--token-file", tmp_path / "token")
    ended = run_serve(meanwhile, *options, zero="on_demand", kind="callback")
    plugin = services[0].plugin
    assert (plugin.job().outcome, plugin.status().state) == ("CANCELED", "STOPPED")
    line = json.loads(ended.stdout)
    assert set(line) == {"listen", "modbus_port", "xmlrpc_port", "http_port"}
    where = f"page: http://127.0.0.1:{line['http_port']}/ (its token is in {tmp_path / 'token'})"
    assert where in ended.stderr.replace("\n", " ")
    assert TOKEN not in ended.output


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["self-zero of the start", "ramp of a job"])
def test_a_signal_first_stops_the_motion(meddle, run_serve, moment) -> None:
    pressed_n: list[float] = []

    def arrange(made: Any) -> None:
        world = made.simulated.world

        def strike() -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            until(lambda: made.controller.life.interrupted)  # the cell's time stands meanwhile
            pressed_n.append(min(world.contact_force_n()))

        once(made.simulated.clock, lambda: min(world.contact_force_n()) > 2.0, strike)

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

    built = meddle(arrange)
    zero = "always" if moment == "self-zero of the start" else "on_demand"
    ended = run_serve(command, zero=zero, kind="simulated")
    assert "a part may be in the grip; to release it" in ended.stderr.replace("\n", " ")
    left_n = min(built[0].simulated.world.contact_force_n())
    assert 2.0 < pressed_n[0] < left_n + 0.8
    assert left_n < 4.0  # of 9 N


@pytest.mark.parametrize(("fault", "number"), [("servo1.off", 111), ("servo1.error=32", 109)])
def test_a_cell_with_a_fault_at_its_start_is_served_so_that_clients_can_clear_it(
    run_serve, tmp_path, fault, number
) -> None:
    seen = []

    def meanwhile(_over: threading.Event, service: Any, _manager: Any) -> None:
        seen.append(service.plugin.status())

    more = ("--fault", fault, "--out", tmp_path / "jobs")
    ended = run_serve(meanwhile, *more, zero="on_demand", kind="simulated")
    assert [*tmp_path.glob("jobs/serve-*/recording.mcap")]
    assert (seen[0].state, seen[0].fault_number) == ("ABORTED", number)
    assert "the cell is not ready: " in ended.stderr
    assert "modbus_port" in json.loads(ended.stdout)


def test_a_taken_port_ends_the_command_before_anything_moves(meddle, tmp_path) -> None:
    built = meddle(lambda _made: None)
    (tmp_path / "cell.yaml").write_text(SMALL.format(zero="always", kind="simulated"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = CliRunner().invoke(
            app, ["serve", "-c", str(tmp_path / "cell.yaml"), "--http", str(port)]
        )
    assert ended.exit_code == 1
    assert "serve.http_port" in str(ended.exception)
    assert built[0].controller.life.state == "STOPPED"
    assert not any(servo.torque_on for servo in built[0].simulated.devices.servo_bus.servos)
    assert built[0].simulated.clock.monotonic() < 0.2


def test_a_service_that_does_not_start_leaves_no_folder(tmp_path) -> None:
    (tmp_path / "cell.yaml").write_text(SMALL.format(zero="never", kind="operator"))
    asked = ["serve", "-c", str(tmp_path / "cell.yaml"), "--http", "0", "--out", str(tmp_path)]
    assert "no terminal to ask at" in str(CliRunner().invoke(app, asked).exception)
    (tmp_path / "cell.yaml").write_text(SMALL.format(zero="never", kind="simulated"))
    # The last object was forgotten, and its model removed.
    asked += ["--model", "m.npz", "--save", "m.npz", "--token-file", "nofile"]
    assert "nofile" in str(CliRunner().invoke(app, asked).exception)
    assert not [*tmp_path.glob("serve-*")]


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
    with open_interfaces(served.service) as interfaces:
        serving._announce(served.service, interfaces)
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
