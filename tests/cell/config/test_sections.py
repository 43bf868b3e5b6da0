"""Sections of the config: gripper, pads and axes; what reaches them, and what is refused."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.config.section import Declared
from cell.config.tactile import (
    PadConfig,
    PadsConfig,
    TactileConfig,
    layout_from_config,
    layout_from_pads,
)
from cell.control.records import pad_array
from cell.errors import ConfigError
from gripper.settings import ForceLoopSettings, GripperSettings, OverForce
from recognition.grasp import PadArray
from tactile.layout import paper_layout, pinch_layout
from tests.cell.conftest import plain_pads
from tests.faults.scenarios.axes import CHANGES, ROTATION_AXIS, WRIST, X_AXIS


def declared(section: BaseModel, path: str) -> Iterator[tuple[str, FieldInfo, Declared]]:
    """Return each key below a path that stands for a setting of the gripper."""
    for name, key in type(section).model_fields.items():
        value, here = getattr(section, name), f"{path}.{name}"
        if isinstance(value, BaseModel):
            yield from declared(value, here)
        yield from ((here, key, link) for link in key.metadata if isinstance(link, Declared))


KEYS = [*declared(CellConfig().gripper, "gripper"), *declared(CellConfig().loop, "loop")]


def of_gripper(config: CellConfig, link: Declared) -> Any:
    settings = config.gripper_settings
    return getattr(settings.force_loop if link.owner is ForceLoopSettings else settings, link.name)


@pytest.mark.parametrize(("path", "key", "link"), KEYS, ids=[path for path, _, _ in KEYS])
def test_a_key_has_the_default_of_its_setting_and_reaches_it(path, key, link) -> None:
    plain = link.owner()
    assert of_gripper(CellConfig(), link) == pytest.approx(getattr(plain, link.name))
    other = key.default + 1 if isinstance(key.default, int) else 0.98 * key.default
    changed = changed_config(CellConfig(), {path: other})
    assert of_gripper(changed, link) == pytest.approx(other * link.unit)


def test_the_channel_of_an_adapter_may_be_its_number() -> None:
    assert parse_config("tactile: {channel: 0}", source="test").tactile.channel == "0"
    with pytest.raises(ConfigError, match=r"tactile\.channel"):
        parse_config("tactile: {channel: true}", source="test")


def test_keys_without_a_number_reach_the_gripper() -> None:
    changes = {
        "gripper.over_force.reaction": "limp",
        "gripper.servo_care.corrected_registers": ["operating_mode"],
    }
    settings = changed_config(CellConfig(), changes).gripper_settings
    assert settings.over_force is OverForce.LIMP
    assert settings.corrected_registers == {"operating_mode"}
    plain, own = CellConfig().gripper_settings, GripperSettings()
    assert plain.over_force is own.over_force
    assert plain.corrected_registers == own.corrected_registers


def pad(finger: Any, face: Any = "inner", rows: int = 4, columns: int = 3) -> PadConfig:
    return PadConfig(
        finger=finger, face=face, rows=rows, columns=columns, pitch_x_mm=2.0, pitch_y_mm=3.0
    )


def spelled(*pads: PadConfig, adc_max: int = 1023) -> TactileConfig:
    return TactileConfig(layout=PadsConfig(name="own", pads=pads, adc_max=adc_max))


def test_own_pads_become_a_layout() -> None:
    layout = layout_from_config(spelled(pad(0), pad(0, "tip", 2, 2), pad(1, rows=5)))
    assert layout.name == "own"
    assert layout.n_taxels == 12 + 4 + 15
    assert layout.pad_shape.tolist() == [[4, 3], [2, 2], [5, 3]]
    assert layout.gripping_pads == (0, 2)
    assert (layout.adc_max, layout.sample_bits) == (1023, 16)
    steps_m = np.diff(layout.taxel_xy_m[:4], axis=0)
    np.testing.assert_allclose(np.abs(steps_m[0]), [0.0, 3e-3], atol=1e-12)
    assert layout_from_config(spelled(pad(0), pad(1), adc_max=255)).sample_bits == 8


@pytest.mark.parametrize(
    "pads", [(pad(0), pad(0)), (pad(0), pad(0, "tip")), (pad(0, "tip"), pad(1))]
)
def test_pads_that_make_no_gripper_are_a_config_error(pads: tuple[PadConfig, ...]) -> None:
    with pytest.raises(ConfigError, match=r"tactile\.layout: layout own"):
        layout_from_config(spelled(*pads))


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout()])
def test_recorded_pads_give_a_layout_that_carries_their_frames(layout: Any) -> None:
    made = layout_from_pads(pad_array(layout))
    assert made.n_taxels == layout.n_taxels
    assert made.pad_shape.tolist() == layout.pad_shape.tolist()
    assert (made.adc_max, made.sample_bits) == (layout.adc_max, layout.sample_bits)
    assert made.gripping_pads == layout.gripping_pads
    pitches_m = [(one.pitch_x_m, one.pitch_y_m) for one in layout.pads]
    np.testing.assert_allclose([(one.pitch_x_m, one.pitch_y_m) for one in made.pads], pitches_m)


def recorded(*shapes: tuple[int, int]) -> PadArray:
    return plain_pads(*shapes, pitch_m=2.5e-3, adc_max=100)


@pytest.mark.parametrize("n_pads", [1, 3, 5])
def test_an_odd_number_of_recorded_pads_is_refused(n_pads: int) -> None:
    with pytest.raises(ConfigError, match=f"have {n_pads} pads; two fingers need an even number"):
        layout_from_pads(recorded(*[(3, 2)] * n_pads))


def test_more_pads_than_a_finger_has_faces_and_single_taxels_are_carried() -> None:
    layout = layout_from_pads(recorded(*[(1, 1)] * 16))
    assert layout.n_pads == 16
    assert layout.gripping_pads == (0, 8)
    assert layout.pads[0].pitch_x_m == 1e-3


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
