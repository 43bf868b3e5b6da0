import math

import pytest

from cell.config.sequence import (
    LinearRampConfig,
    SCurveRampConfig,
    SequenceConfig,
    StaircaseRampConfig,
    ramp_from_config,
)
from cell.control.plan import GraspStep, Pose, plan


def distinct_poses(steps: tuple[GraspStep, ...]) -> int:
    return len({step.pose for step in steps})


def test_random_plan_stays_in_its_ranges_and_repeats_with_its_seed() -> None:
    config = SequenceConfig()
    steps = plan(config, 200, seed=3)
    assert steps == plan(config, 200, seed=3)
    assert steps != plan(config, 200, seed=4)
    for step in steps:
        assert abs(step.pose.x_m) <= 2e-3
        assert abs(step.pose.y_m) <= 2e-3
        assert 0.0 <= step.pose.rotation_rad <= 2 * math.pi
        assert 2.0 <= step.force_n <= 8.0
    assert distinct_poses(steps) == 200


def test_grid_visits_each_point_once_before_it_repeats() -> None:
    config = SequenceConfig(
        kind="grid", x_mm=(-1.0, 1.0), y_mm=(0.0, 0.0), roll_deg=(0.0, 0.0), force_n=(4.0, 4.0)
    )
    steps = plan(config, 18, seed=0)
    assert distinct_poses(steps) == 9
    assert steps[:9] == steps[9:]
    assert {step.pose.x_m for step in steps} == {-1e-3, 0.0, 1e-3}


def test_list_is_taken_in_order_and_anew() -> None:
    config = SequenceConfig(
        kind="list",
        poses=({"x_mm": 1.0, "force_n": 3.0}, {"rotation_deg": 90.0}),  # type: ignore[arg-type]
    )
    steps = plan(config, 3, seed=0)
    assert steps[0].pose == Pose(x_m=1e-3)
    assert steps[0].force_n == 3.0
    assert steps[1].pose.rotation_rad == pytest.approx(math.pi / 2)
    assert steps[2] == steps[0]


def test_empty_plan_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        plan(SequenceConfig(), 0, seed=0)


def test_pose_refuses_what_is_not_finite_and_reads_well() -> None:
    with pytest.raises(ValueError, match="x_m"):
        Pose(x_m=math.nan)
    assert str(Pose(x_m=1e-3, rotation_rad=math.pi)).startswith(
        "x +1.0 mm, y +0.0 mm, rotation 180"
    )


@pytest.mark.parametrize(
    "config",
    [LinearRampConfig(), StaircaseRampConfig(kind="staircase"), SCurveRampConfig(kind="s_curve")],
)
def test_ramps_of_the_config_end_at_the_wanted_force(config) -> None:
    ramp = ramp_from_config(config, 5.0)
    assert ramp.final_n == 5.0
    assert ramp.setpoint_n(ramp.duration_s) == pytest.approx(5.0)
