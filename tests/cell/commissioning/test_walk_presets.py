"""The whole wizard on the gripper presets, as they come out of the box, with each sensor."""

from dataclasses import replace
from pathlib import Path

import pytest

from cell.checks.findings import Verdict
from cell.commissioning.bench import Bench
from cell.commissioning.engine import CONFIG_NAME, Engine
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.simulation import simulator_settings
from simulator.cell import SimulatedCell
from tests.cell.commissioning.hands import Person
from tests.cell.commissioning.script import SimulatedLines
from tests.cell.commissioning.test_walk import EXCHANGED, brisk_steps

pytestmark = pytest.mark.long

CONFIGS = Path(__file__).parents[3] / "config"


def with_sensor(preset: str, sensor: str) -> CellConfig:
    """Return a gripper preset with the pads of another preset, or those of the default cell."""
    pads = CellConfig() if sensor == "unit" else load_config(CONFIGS / f"{sensor}.yaml")
    return load_config(CONFIGS / f"{preset}.yaml").model_copy(update={"tactile": pads.tactile})


@pytest.mark.parametrize("sensor", ["flexitac", "uskin", "unit"])
@pytest.mark.parametrize("preset", ["rh-p12-rn", "open-parallel-gripper"])
def test_a_gripper_preset_is_brought_up_from_the_box(preset, sensor, tmp_path) -> None:
    base = with_sensor(preset, sensor)
    settings = replace(
        simulator_settings(base), faults=("servo1.factory",), mounts=(), aperture_m=0.016
    )
    given = {"gripper.port": "/dev/ttyUSB0"}
    ports: tuple[str, ...] = ("/dev/ttyUSB0",)
    if sensor == "flexitac":
        ports = (*ports, "/dev/ttyACM1", "/dev/ttyACM0")
    else:
        given |= {"tactile.interface": "socketcan", "tactile.channel": "can0"}
    if sensor == "uskin":
        settings = replace(settings, mounts=EXCHANGED)
    with SimulatedCell(settings) as cell:
        person = Person(
            cell,
            {r"Does it drive both fingers": ("", "1"), r"With which force may it be": ("", "8")},
        )
        bench = Bench(tmp_path, SimulatedLines(cell, ports), given=given, base=base)
        Engine(brisk_steps(), bench).run(person.script)
        (servo,) = cell.devices.servo_bus.servos
        assert servo.core.registers.get("torque_enable") == 0
    found = person.script.findings
    assert {key: one.lines for key, one in found.items() if one.status is Verdict.FAIL} == {}
    config = load_config(tmp_path / CONFIG_NAME)
    (wanted,), (now,) = base.gripper.servos, config.gripper.servos
    assert (now.model, now.direction) == (wanted.model, wanted.direction)
    four = found["first_force"].values["asked_held_peak_n"][-1]
    assert person.pressed_n == pytest.approx(four[1], abs=1.0)
