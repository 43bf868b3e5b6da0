"""Stop goals: what holds a part when a motion is ended."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gripper.servos.goal_limits import ServoGoal
from gripper.servos.stop_goals import frozen


def goals(angle_rad: float, current_a: float) -> list[ServoGoal]:
    return [ServoGoal(angle_rad=angle_rad, current_a=current_a)]


@pytest.mark.parametrize(("last_rad", "kept_rad"), [(0.40, 0.40), (0.60, 0.50)])
def test_a_frozen_finger_never_opens(last_rad: float, kept_rad: float) -> None:
    state = cast(Any, SimpleNamespace(servos=(SimpleNamespace(angle_rad=0.5),)))
    assert frozen(goals(last_rad, 0.3), state) == goals(kept_rad, 0.3)


def test_a_push_does_not_stay_on_a_frozen_finger() -> None:
    state = cast(Any, SimpleNamespace(servos=(SimpleNamespace(angle_rad=0.5),)))
    (rest,) = goals(0.40, 0.2)
    for pushes in goals(0.40, 0.6) + goals(0.60, 0.1):
        assert frozen([replace(pushes, rest=rest)], state) == [rest]
