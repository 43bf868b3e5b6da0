"""The axes of a config: what fits together, and what is refused with its key."""

from pathlib import Path
from typing import Any

import pytest

from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.errors import ConfigError
from tests.faults.scenarios.axes import CHANGES, ROTATION_AXIS, WRIST, X_AXIS

EXAMPLE = Path(__file__).parents[3] / "config" / "two-axes-and-wrist.yaml"
REAL = {"gripper.port": "/dev/ttyUSB0", "tactile.interface": "socketcan", "tactile.channel": "can0"}
TURN = WRIST | {"port": "/dev/ttyUSB1"}


def positioner(*axes: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"positioner": {"kind": "axes", "axes": list(axes)} | more}


def test_the_example_has_two_drives_and_a_wrist() -> None:
    config = load_config(EXAMPLE)
    assert [axis.moves for axis in config.positioner.axes] == ["x", "rotation", "roll"]
    assert [axis.kind for axis in config.positioner.axes] == ["cia402", "cia402", "dynamixel"]
    assert config.brings_objects


def test_a_cell_on_real_ports_has_its_axes_there_too() -> None:
    changes = CHANGES | REAL
    real = positioner(
        X_AXIS,
        ROTATION_AXIS,
        WRIST | {"port": "/dev/ttyUSB1"},
        can={"interface": "socketcan", "channel": "can0"},
    )
    config = changed_config(CellConfig(), changes | real)
    assert not config.brings_objects
    assert config.positioner.ports == ("socketcan", "/dev/ttyUSB1")


X, TURNED, ONLY = X_AXIS, ROTATION_AXIS, "list positioner.axes if positioner.kind is axes, and only"
ON_CAN1 = {"interface": "socketcan", "channel": "can1"}
ASKED = {"sequence.kind": "list", "sequence.poses": [{"y_mm": 1.0}]}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (positioner(), ONLY),
        ({"positioner": {"kind": "operator", "axes": [X]}}, ONLY),
        (positioner(X, X | {"node_id": 3}), "move x, x: list one axis for each part"),
        (positioner(X, TURNED | {"node_id": 11}), r"node-IDs \[11, 11\]: give each drive its own"),
        (positioner(X | {"low": 6.0}), "axis x has the limits 6 to 6; low must be below high"),
        (positioner(X | {"increments": 0.0}), "axis x has 0 increments per mm"),
        (positioner(X | {"increments": 9e8}), "limits that fit into 32 bits"),
        (positioner(WRIST | {"high": 351.0}), "more than one turn of its servo"),
        (positioner(X), r"sequence.rotation_deg asks for 0 to 90; no axis moves it: write"),
        (
            positioner(X | {"high": 1.0}, TURNED, WRIST),
            "sequence.x_mm asks for -2 to 2; its axis goes from -6 to 1",
        ),
        (ASKED, "sequence.y_mm asks for 1 to 1; no axis moves it"),
        (
            positioner(X, TURNED, WRIST, can={"interface": "slcan"}),
            "an axis of the positioner is on 'slcan', gripper.port is 'simulated'",
        ),
        (REAL, "an axis of the positioner is on 'simulated', gripper.port is '/dev/ttyUSB0'"),
        (
            REAL | positioner(X, TURNED, WRIST | {"port": "/dev/ttyUSB0"}, can=ON_CAN1),
            "'/dev/ttyUSB0', the port of the fingers",
        ),
        (REAL | positioner(TURN, TURN | {"moves": "x", "high": 90.0}), "give each servo its own"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        changed_config(CellConfig(), CHANGES | changes)
