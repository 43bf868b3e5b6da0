"""The simulated cell as a process: who may serve in a folder."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.config.file import changed_config, load_config
from cell.config.tactile import link_settings
from cell.errors import CellError
from cell.interfaces.cli.app import app
from cell.runtime import simulate
from simulator.settings import SimulatorSettings
from tests.cell.conftest import small_config
from tests.faults.scenarios import CHANGES

FOUND = {
    "servo_port": "servos",
    "can_interface": "slcan",
    "can_channel": "can",
    "axes_can_channel": "drives",
    "axes_ports": {"roll": "wrist"},
    "board_ports": ["board0", "board1"],
    "positioner_socket": "socket",
}
"""Ports of a simulated cell that is served."""


def test_a_folder_serves_one_simulated_cell_at_a_time(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "sim"
    served: list[Path] = []

    def serve_here() -> None:
        simulate.serve_simulated_cell(small_config(), folder=folder, announce=lambda _line: None)

    def serve(_settings: Any, announce: Any, *, folder: Path, **_options: Any) -> None:
        served.append(folder)
        announce(FOUND)
        if len(served) == 1:
            with pytest.raises(CellError, match="choose another folder with --out"):
                serve_here()

    monkeypatch.setattr(simulate, "serve", serve)
    serve_here()
    serve_here()
    assert served == [folder, folder]
    positioner = load_config(folder / "cell.yaml").positioner
    assert (positioner.kind, positioner.socket) == ("simulated", "socket")


def test_a_client_gets_the_axes_at_their_ports_and_more_patience(tmp_path, monkeypatch) -> None:
    config = changed_config(small_config(simulator__faults=["unit.stuck@9s"]), CHANGES)
    announced: list[dict[str, Any]] = []

    def serve(settings: SimulatorSettings, announce: Any, **_options: Any) -> None:
        assert list(settings.axes) == ["x", "rotation", "roll"]
        announce(FOUND)

    monkeypatch.setattr(simulate, "serve", serve)
    simulate.serve_simulated_cell(config, folder=tmp_path, announce=announced.append)
    client = load_config(Path(announced[0]["config"]))
    link = link_settings(client.tactile)
    assert (link.force_timeout_s, link.heartbeat_s) == (0.2, 0.4)
    positioner = client.positioner
    assert (positioner.kind, positioner.ports) == ("axes", ("slcan", "wrist"))
    assert (positioner.can.channel, positioner.socket) == ("drives", "socket")
    assert positioner.can.heartbeat_loss_ms == 400.0
    assert [axis.bus_loss_ms for axis in positioner.axes if axis.kind == "dynamixel"] == [400.0]
    assert client.brings_objects
    assert (client.gripper.port, client.simulator.faults, client.simulated) == ("servos", (), False)
    assert (client.tactile.interface, client.tactile.channel) == ("slcan", "can")
    assert client.tactile.tare_frames == config.tactile.tare_frames


def test_a_client_gets_the_boards_of_its_sensor_at_their_ports() -> None:
    preset = load_config(Path(__file__).parents[3] / "config" / "flexitac.yaml")
    config = simulate.client_config(preset, FOUND)
    assert config.tactile.serial_ports == ("board0", "board1")
    assert not config.simulated


@pytest.mark.long
def test_a_person_without_hardware_moves_the_fingers_from_a_second_terminal(cell_process) -> None:
    cell = cell_process(small_config(gripper__aperture_open_mm=30.0))
    ask = ["simulate", "--out", str(Path(cell.positioner_socket).parent), "--ask"]
    for request, replied in (
        ("open finger 0", "finger 0 59.1 mm from the middle, finger 1 15.0 mm"),
        ("help", "disconnect servo N"),
        ("open finger 7", "`help` lists all commands"),
        ("press finger0.none", "there is no pad 'finger0.none'; there are finger0.inner"),
    ):
        ended = CliRunner().invoke(app, [*ask, request])
        assert replied in f"{ended.output} {ended.exception}"
    shown = CliRunner().invoke(app, [*ask, "-"], input="dance\nclose\n")
    assert "'dance' is not a command" in shown.stderr
    assert shown.stdout.startswith("hands> hands> finger 0 0.0 mm from the middle")
