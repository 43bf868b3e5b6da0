"""Stop goals: what holds a part when a motion is ended."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from gripper.servos.goal_limits import ServoGoal
from gripper.servos.stop_goals import frozen


def goals(angle_rad: float, current_a: float) -> list[ServoGoal]:
    return [ServoGoal(angle_rad=angle_rad, current_a=current_a)]


@pytest.mark.parametrize(
    ("last", "kept"),
    [
        ((0.40, 0.3), (0.40, 0.2)),  # closes: without the crest
        ((0.60, 0.1), (0.50, 0.2)),  # opens, as a force that falls does: it stays where it is
    ],
)
def test_a_frozen_finger_never_opens(last: tuple[float, float], kept: tuple[float, float]) -> None:
    state = cast(Any, SimpleNamespace(servos=(SimpleNamespace(angle_rad=0.5),)))
    assert frozen(goals(*last), goals(0.40, 0.2), state) == goals(*kept)
