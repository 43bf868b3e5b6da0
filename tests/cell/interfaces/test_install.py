"""`install`: what it prints, writes and removes; the unit in systemd's own eyes; sd_notify."""

import re
import shlex
import shutil
import socket
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from typer.main import get_command
from typer.testing import CliRunner, Result

from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.interfaces.cli.app import app
from cell.interfaces.cli.service_manager import ServiceManager
from cell.interfaces.cli.system_files import UNIT_FILE, closed_to_others, system_files
from tests import ROOT
from tests.cell.conftest import REAL, small_config
from tests.faults.scenarios.axes import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.hil.supervisor import read_unit

PAGE = ROOT / "docs/how-to/run-as-a-service.md"
WRITTEN = {
    "etc/udev/rules.d/99-tactile-cell.rules",
    "etc/sysusers.d/tactile-cell.conf",
    "etc/systemd/system/tactile-cell.service",
}


def call(*arguments: object, answers: str = "") -> Result:
    result = CliRunner().invoke(app, [str(one) for one in arguments], input=answers)
    assert result.exit_code == 0, result.output
    return result


def files_in(folder: Path) -> set[str]:
    return {str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_file()}


# -- the files ---------------------------------------------------------------------------------


def test_what_the_page_types_prints_writes_removes_and_packs(tmp_path, monkeypatch) -> None:
    page = PAGE.read_text("utf-8")
    commands = [
        shlex.split(line.partition("tactile-cell ")[2])
        for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
        for line in block.splitlines()
    ]
    shown, applied, removed, support = commands
    image = tmp_path / "image"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text("")
    printed = call(*shown, "--root", image).output
    assert not image.exists()
    for name in WRITTEN:
        assert f"/{name}" in printed
        assert f"`/{name}`" in page
    call(*applied, "--root", image, answers="y\ny\ny\n")
    assert files_in(image) == WRITTEN
    for name in WRITTEN:
        assert (image / name).read_text().strip() in printed
    again = call(*applied, "--root", image).output
    assert again.count("already up to date") == 3
    call(*removed, "--root", image, answers="y\ny\ny\n")
    assert files_in(image) == set()
    call(*support)
    assert (tmp_path / "bundle.zip").exists()


def test_each_file_is_asked_for_and_the_end_of_the_input_is_a_no(tmp_path) -> None:
    for way, answers in (("--apply", "n\ny\n"), ("--remove", "n\n")):
        call("install", way, "--root", tmp_path, answers=answers)
        assert files_in(tmp_path) == {"etc/sysusers.d/tactile-cell.conf"}
    both = CliRunner().invoke(app, ["install", "--apply", "--remove"])
    assert both.exit_code == 2


def with_axes(can: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a real cell with drives on a CAN bus, and a wrist on a serial port."""
    axes = [X_AXIS, ROTATION_AXIS, WRIST | {"port": "/dev/ttyUSB4"}]
    return REAL | CHANGES | {"positioner": {"kind": "axes", "can": can, "axes": axes}}


def unit_of(config: CellConfig, file: Path | None = None, *options: str) -> str:
    (text,) = (one.text for one in system_files(config, file, options) if one.path == UNIT_FILE)
    return text


def test_systemd_verifies_the_unit(tmp_path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not there; apt-get install systemd brings it")
    path = tmp_path / "tactile-cell.service"
    model = ("--model", "/srv/100% parts;$HOME.npz")
    path.write_text(unit_of(small_config(**REAL), tmp_path / "a cell.yaml", *model))
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


def test_the_unit_serves_the_config_and_brings_the_can_up(tmp_path) -> None:
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


def test_what_the_service_user_cannot_read_is_named(tmp_path) -> None:
    config = tmp_path / "home" / "cell.yaml"
    config.parent.mkdir(0o755)
    config.write_text("")
    tmp_path.chmod(0o755)
    assert closed_to_others(config) in (None, *tmp_path.parents)
    config.chmod(0o640)
    config.parent.chmod(0o750)
    assert closed_to_others(config) in (config.parent, *tmp_path.parents)
    found = call("install", "-c", config).stderr
    assert "no interface is open: set serve.http_port" in found
    assert f"{config}: the user tactile-cell cannot read /" in found


# -- udev --------------------------------------------------------------------------------------


def test_the_rules_name_each_serial_port_of_the_cell_and_keep_modem_manager_away(
    monkeypatch,
) -> None:
    chip = {"ID_VENDOR_ID": "1a86", "ID_MODEL_ID": "7523"}
    monkeypatch.setattr(
        "cell.interfaces.cli.system_files.usb_identity",
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
        config = small_config(
            **with_axes({"interface": "slcan", "channel": "/dev/ttyACM3"}) | changes
        )
        rules = system_files(config, None)[0].text
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
    found = []
    while True:
        try:
            found.append(link.recv(4096).decode())
        except BlockingIOError:
            return found


def test_the_watchdog_is_fed_only_while_the_cell_works(notify) -> None:
    name, link = notify
    manager = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "30000000"})
    manager.ready()
    manager.report("IDLE", working=False)
    assert received(link) == ["READY=1", "STATUS=IDLE"]
    manager.report("IDLE", working=True)
    manager.report("IDLE", working=True)  # at once: the watchdog needs no more
    manager.report("ABORTED, a part is held, fault 506", working=True)
    manager.stopping()
    assert received(link) == [
        "WATCHDOG=1",
        "STATUS=ABORTED, a part is held, fault 506",
        "STOPPING=1",
    ]


def test_a_watchdog_of_another_process_and_a_manager_that_is_gone_are_left_alone(
    notify, tmp_path
) -> None:
    name, link = notify
    other = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    ServiceManager(other).report("IDLE", working=True)
    assert received(link) == ["STATUS=IDLE"]
    ServiceManager({}).ready()
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "gone")}).ready()


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
    snippets = re.findall(r"```yaml\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert parse_config(snippets[0], source="page").serve.token_file == "/etc/tactile-cell/token"
    assert YAML(typ="safe", pure=True).load(snippets[1])["scrape_configs"][0]["authorization"]
