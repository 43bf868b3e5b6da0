"""The simulated cell as the config describes it."""

import numpy as np
import pytest

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.errors import ConfigError, PositionerError
from cell.simulation import (
    InProcessPlacer,
    simulated_objects,
    simulator_settings,
)
from simulator.cell import SimulatedCell
from simulator.servo.gearing import GEARINGS
from simulator.servo.mechanics import RackLinkage
from tests.cell.conftest import small_config

RACK = {"kind": "rack_pinion", "pinion_radius_mm": 8.0, "offset_mm": 10.0}


def test_settings_follow_the_config() -> None:
    settings = simulator_settings(
        small_config(
            seed=5,
            tactile__node_id=9,
            tactile__serial_number=77,
            tactile__bitrate=500000,
            tactile__layout="pinch",
            gripper__servos=[{"id": 4, "model": "XL330-M288", "direction": -1}],
            gripper__linkage=RACK,
            simulator__noise="none",
            simulator__noise_level=0.5,
        )
    )
    (servo,) = settings.servos
    assert (servo.servo_id, servo.model.name, servo.mount.direction) == (4, "XL330-M288", -1)
    assert isinstance(settings.linkage, RackLinkage)
    unit = settings.unit
    assert (unit.node_id, unit.serial_number, unit.bitrate) == (9, 77, 500_000)
    assert settings.layout.n_taxels == 156
    assert (settings.noise.kind, settings.noise.level, settings.seed) == ("none", 0.5, 5)
    assert set(settings.objects) == {"ball", "box"}


def test_the_servos_differ_as_the_config_says() -> None:
    keys = {"gearing": "ideal", "friction": [1.5, 1.0], "kt": [0.8, 1.1]}
    config = changed_config(
        CellConfig(), {f"simulator.servos.{key}": value for key, value in keys.items()}
    )
    with SimulatedCell(simulator_settings(config)) as cell:
        first, second = cell.devices.mechanics.motors
    assert first.gearing is GEARINGS["ideal"]
    assert (first.friction_factor, second.friction_factor) == (1.5, 1.0)
    assert (first.kt_factor, second.kt_factor) == (0.8, 1.1)
    for name in GEARINGS:
        changed_config(CellConfig(), {"simulator.servos.gearing": name})


def test_the_servos_of_the_default_cell_are_neither_the_catalogues_nor_alike() -> None:
    with SimulatedCell(simulator_settings(CellConfig())) as cell:
        first, second = cell.devices.mechanics.motors
    model = first.model
    for figures in (
        (model.kt_nm_a, first.kt_nm_a, second.kt_nm_a),
        (model.friction_nm, first.friction_nm(), second.friction_nm()),
        (model.rotor_inertia_kg_m2, first.inertia_kg_m2, second.inertia_kg_m2),
    ):
        assert len(set(figures)) == 3


def test_the_built_in_objects_are_those_of_the_paper() -> None:
    assert set(simulated_objects(CellConfig())) == {"oval", "cylinder", "box", "ball", "dumbbell"}


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("simulator.objects", [{"label": "x", "shape": "blob"}], "simulator.objects: x: unkn"),
        ("simulator.objects", [{"label": "x", "shape": "mesh:file=none.stl"}], "objects: x: "),
        ("gripper.aperture_open_mm", 300.0, "gripper.aperture_open_mm is beyond gripper.linkage"),
        ("gripper.linkage", {"kind": "parallel_linkage", "offset_mm": -100.0}, "linkage"),
        ("simulator.faults", ["servo3.off"], "simulator: fault servo3.off: this cell has 2 servos"),
        (
            "tactile.calibration",
            {"kind": "linear", "force_per_count_n": 0.05},
            "is 1.2 N on a pad at rest under tactile.calibration, gripper.contact_force_n is 0.6 N",
        ),
    ],
)
def test_a_cell_that_cannot_be_is_a_config_error(key, value, complaint) -> None:
    with pytest.raises(ConfigError) as caught:
        simulator_settings(small_config(**{key: value}))
    assert complaint in str(caught.value)


def test_an_object_comes_to_rest_and_a_box_on_a_face() -> None:
    with SimulatedCell(simulator_settings(small_config())) as cell:
        placer = InProcessPlacer(cell)
        assert placer.place("ball", Pose(x_m=1e-3, roll_rad=0.5)).x_m == 1e-3
        reached = placer.place("box", Pose(roll_rad=0.2))
        assert reached.roll_rad % (np.pi / 2) == pytest.approx(0.0, abs=1e-9)
        with pytest.raises(PositionerError, match="dice cannot be placed"):
            placer.place("dice", Pose())
