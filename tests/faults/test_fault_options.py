"""Faults from config and command line: into the simulated cell, never beside real ports."""

import json
from pathlib import Path
from typing import Any

import pytest

from cell.build import build_cell
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.errors import ConfigError
from cell.interfaces.cli import main
from cell.jobs import simulate as simulating
from simulator.faults.injector import VOCABULARY
from simulator.settings import SimulatorSettings
from tactile.errors import BusOff

REAL = Path(__file__).parents[2] / "config" / "paper-gripper.yaml"
SMALL = """
tactile: {tare_frames: 10}
gripper: {aperture_open_mm: 16.0}
sequence: {force_n: [3, 3], ramp: {kind: linear, rate_n_s: 10, hold_s: 0.1}}
simulator: {objects: [{label: ball, shape: "sphere:diameter=9.5mm"}]%s}
"""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["tactile-cell", *(str(a) for a in arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return int(ended.value.code or 0), " ".join((said.out + said.err).split())

    return call


def small(tmp_path: Path, faults: str = "") -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(SMALL % faults)
    return path


def test_a_fault_of_the_config_happens(tmp_path: Path) -> None:
    path = small(tmp_path, ', faults: ["can.off@250ms"]')
    cell = build_cell(load_config(path))
    with pytest.raises(BusOff):
        cell.controller.start()
    assert cell.controller.fault
    cell.close()


def test_what_is_no_fault_is_refused_with_the_key(tmp_path: Path) -> None:
    for text, complaint in [
        ("can.lost", r"simulator: there is no fault 'can.lost'; there are can.loss"),
        ("servo3.off", "simulator: fault servo3.off: this cell has 2 servos"),
        ("taxels.saturated=10", "simulator: taxels.saturated: pads are 0 to 9"),
    ]:
        config = load_config(small(tmp_path, f', faults: ["{text}"]'))
        with pytest.raises(ConfigError, match=complaint):
            build_cell(config)


def test_faults_beside_real_ports_are_refused_by_the_config(tmp_path: Path) -> None:
    path = tmp_path / "real.yaml"
    path.write_text(REAL.read_text() + "simulator: {faults: [can.off]}\n")
    with pytest.raises(ConfigError, match="faults are for the simulated cell, and this one has"):
        load_config(path)


@pytest.mark.parametrize(
    "command",
    [
        ("run", "--object", "ball"),
        ("teach", "ball", "--output", "set.npz"),
        ("identify", "--model", "model.npz"),
    ],
)
def test_a_fault_on_real_ports_is_wrong_use(run: Any, command: tuple[str, ...]) -> None:
    code, said = run(*command, "--config", REAL, "--fault", "can.off")
    assert code == 2
    assert "--fault can.off is for the simulated cell" in said


def test_a_fault_is_no_part_of_recorded_grasps_or_drawings(run: Any, tmp_path: Path) -> None:
    code, said = run("identify", tmp_path / "a.npz", "-m", "model.npz", "--fault", "can.off")
    assert (code, "recorded grasps are what they are" in said) == (2, True)
    output = ("--output", tmp_path / "set.npz")
    code, said = run("teach", "x", *output, "--shape", "sphere:diameter=9mm", "--fault", "can.off")
    assert (code, "a drawing has no faults" in said) == (2, True)


def test_a_job_with_a_fault_ends_with_the_grip_kept(run: Any, tmp_path: Path) -> None:
    code, said = run(
        *("teach", "ball", "--output", tmp_path / "set.npz", "--grasps", 1),
        *("--config", small(tmp_path), "--out", tmp_path, "--fault", "servos.off@contact+0.3s"),
    )
    assert code == 1
    assert "a part may still be gripped" in said
    assert "the grip is kept" not in said
    assert not (tmp_path / "set.npz").exists()


def test_a_wrong_fault_on_the_command_line_is_wrong_use(run: Any, tmp_path: Path) -> None:
    code, said = run("run", "--config", small(tmp_path), "--out", tmp_path, "--fault", "can.lost")
    assert (code, "there is no fault 'can.lost'" in said) == (2, True)
    code, said = run("simulate", "--fault", "can.loss=7")
    assert (code, "takes share, 0 to 1" in said) == (2, True)
    code, said = run("simulate", "--fault", "taxels.saturated=400")
    assert (code, "pads are 0 to 9" in said) == (2, True)


def test_all_faults_are_listed(run: Any) -> None:
    code, said = run("simulate", "--list-faults")
    assert code == 0
    for entry in VOCABULARY.values():
        assert f"{entry.name} {entry.kind.value} {entry.meaning}" in said


def test_simulate_serves_its_faults_and_its_clients_get_none(
    monkeypatch: pytest.MonkeyPatch, run: Any, tmp_path: Path
) -> None:
    served: list[SimulatorSettings] = []

    def serve(settings: SimulatorSettings, announce: Any, *, folder: Path, **_: Any) -> None:
        served.append(settings)
        ports = {"servo_port": "/dev/pts/0", "can_interface": "slcan", "can_channel": "/dev/pts/1"}
        announce(ports | {"positioner_socket": str(folder / "positioner.sock")})

    monkeypatch.setattr(simulating, "serve", serve)
    path = small(tmp_path, ', faults: ["unit.stuck@9s"]')
    code, said = run(
        *("simulate", "--config", path, "--out", tmp_path, "--fault", "can.loss=0.05@2s")
    )
    assert code == 0
    assert served[0].faults == ("unit.stuck@9s", "can.loss=0.05@2s")
    client = load_config(Path(json.loads(said.partition(" cell: ")[0])["config"]))
    assert client.simulator.faults == ()
    assert not client.simulated
    assert CellConfig().simulator.faults == ()
