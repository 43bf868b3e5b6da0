"""Faults from config and command line: into the simulated cell, never beside real ports."""

from pathlib import Path

import pytest

from cell.build import build_cell
from cell.config.file import load_config
from cell.errors import ConfigError
from simulator.faults.injector import VOCABULARY
from tactile.errors import BusOff
from tests.cell.conftest import call, small_config

REAL = Path(__file__).parents[3] / "config" / "paper-gripper.yaml"


def test_a_fault_of_the_config_happens() -> None:
    cell = build_cell(small_config(simulator__faults=["can.off@250ms"]))
    with pytest.raises(BusOff):
        cell.controller.start()
    assert cell.controller.fault
    cell.close()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("can.lost", r"simulator: there is no fault 'can.lost'; there are can.loss"),
        ("servo3.off", "simulator: fault servo3.off: this cell has 2 servos"),
        ("taxels.saturated=10", "simulator: pad 10: pads are 0 to 9"),
    ],
)
def test_what_is_no_fault_is_refused_with_the_key(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        build_cell(small_config(simulator__faults=[text]))


def test_faults_beside_real_ports_are_refused_by_the_config(tmp_path: Path) -> None:
    path = tmp_path / "real.yaml"
    path.write_text(REAL.read_text() + "simulator: {faults: [can.off]}\n")
    with pytest.raises(ConfigError, match="faults are for the simulated cell, and this one has"):
        load_config(path)


def test_all_faults_are_listed() -> None:
    listed = " ".join(call("simulate", "--list-faults").split())
    for entry in VOCABULARY.values():
        assert f"{entry.name} {entry.kind.value} {entry.meaning}" in listed
