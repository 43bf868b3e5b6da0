"""The whole wizard on simulated cells in virtual time: from the box to the first force."""

from dataclasses import replace
from pathlib import Path

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import CONFIG_NAME, Engine
from cell.commissioning.findings import Verdict
from cell.commissioning.walk import all_steps
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.simulation import simulator_settings
from docs.tools.transcript import TRANSCRIPT, transcript
from simulator.cell import SimulatedCell
from tactile.layout import PadMount
from tests.cell.commissioning.hands import Person, SimulatedLines

pytestmark = pytest.mark.long

EXCHANGED = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))


CONFIGS = Path(__file__).parents[3] / "config"


def with_sensor(preset: str, sensor: str) -> CellConfig:
    """Return a gripper preset with the pads of another preset, or those of the default cell."""
    pads = CellConfig() if sensor == "unit" else load_config(CONFIGS / f"{sensor}.yaml")
    return load_config(CONFIGS / f"{preset}.yaml").model_copy(update={"tactile": pads.tactile})


@pytest.mark.parametrize(
    ("preset", "sensor"),
    [("rh-p12-rn", "flexitac"), ("open-parallel-gripper", "uskin"), ("rh-p12-rn", "unit")],
)
def test_a_gripper_preset_is_brought_up_from_the_box(preset, sensor, tmp_path, monkeypatch) -> None:
    base = with_sensor(preset, sensor)
    # Boards have exchanged pads and another law than the preset.
    boards = sensor != "unit"
    settings = replace(
        simulator_settings(base),
        faults=("servo1.factory", *["taxels.force_gain=0.7"] * boards),
        mounts=EXCHANGED if sensor == "uskin" else (),
        aperture_m=0.016,
    )
    given = {"gripper.port": "/dev/ttyUSB0"}
    ports: tuple[str, ...] = ("/dev/ttyUSB0",)
    if sensor == "flexitac":
        ports = (*ports, "/dev/ttyACM1", "/dev/ttyACM0")
        by_path = "/dev/serial/by-path/usb-0:{}".format
        monkeypatch.setattr("cell.commissioning.unit.lasting_name", lambda port: by_path(port[-1]))
    else:
        given |= {"tactile.interface": "socketcan", "tactile.channel": "can0"}
    with SimulatedCell(settings) as cell:
        person = Person(cell, {r"With which force may it be": ("", "")})
        bench = Bench(tmp_path, SimulatedLines(cell, ports), given=given, base=base)
        Engine(all_steps(), bench).run(person.script)
        (servo,) = cell.devices.servo_bus.servos
        assert servo.registers.get("torque_enable") == 0
    findings = person.script.findings
    assert {key: one.lines for key, one in findings.items() if one.status is Verdict.FAIL} == {}
    config = load_config(tmp_path / CONFIG_NAME)
    (wanted,), (now,) = base.gripper.servos, config.gripper.servos
    assert (now.model, now.direction) == (wanted.model, wanted.direction)
    if boards:
        said = "\n".join(line for one in findings.values() for line in one.lines)
        mounts = tuple(PadMount(**mount.model_dump()) for mount in config.tactile.mounting)
        assert mounts == EXCHANGED
    if sensor == "flexitac":
        assert "named by their USB sockets: leave them" in said
        assert config.tactile.serial_ports == (by_path(1), by_path(0))
    four = findings["first_force"].values["asked_held_peak_n"][-1]
    assert person.pressed_n == pytest.approx(four[1], abs=1.0)


def test_the_tutorial_shows_what_is_printed() -> None:
    """A cell of wrong hardware, from the box to the first force."""
    _, shown = TRANSCRIPT.read_text("utf-8").split("\n", 1)
    assert transcript().split() == shown.split()
