"""The tables of what hosts read and call, and a pose as URScript has it."""

import math

import numpy as np
import pytest

from cell.control.plan import Pose
from cell.interfaces.host_calls import COMMANDS
from cell.interfaces.host_values import VALUES, ur_pose


def test_no_two_values_or_commands_share_a_place_at_an_interface() -> None:
    numbers = [number for one in COMMANDS for number in one.numbers]
    methods, registers = (
        [getattr(one, column) for one in VALUES if getattr(one, column)]
        for column in ("method", "register")
    )
    for places in ([*methods, *(one.name for one in COMMANDS)], registers, numbers):
        assert len(places) == len(set(places))
    # Registers and commands of their own making.
    assert not set(registers) & {0, 1, 2, 5, 6, 7, 17, 18, 19, 20, 25, 26, 27, *range(32, 96)}
    assert not set(numbers) & {4, 40, 41}


@pytest.mark.parametrize(
    ("rotation", "roll"), [(0.0, 0.0), (0.4, 0.0), (0.0, -2.0), (3.0, 1.0), (-3.1, 3.1)]
)
def test_a_rotation_vector_rolls_first_then_turns(rotation: float, roll: float) -> None:
    found = ur_pose(Pose(x_m=0.001, y_m=-0.002, rotation_rad=rotation, roll_rad=roll))
    assert (found["x"], found["y"], found["z"]) == (0.001, -0.002, 0.0)
    vector = np.array([found["rx"], found["ry"], found["rz"]])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle else vector
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    c, s, cr, sr = math.cos(rotation), math.sin(rotation), math.cos(roll), math.sin(roll)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    np.testing.assert_allclose(turned, about_z @ about_x, atol=1e-12)
