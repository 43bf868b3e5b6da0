"""Stop goals: goals that end a motion or lower the force of the fingers.

Pure functions of the last goals and the last feedback. `gripper.servos.group.Servos` writes
their results. A result never has more current than the last goals, except for a step that opens.
"""

from collections.abc import Sequence
from dataclasses import replace

from gripper.mechanics.kinematics import Linkage, motion_currents_a, transmissions
from gripper.servos.goal_limits import ServoGoal, closing_margin_rad
from gripper.settings import GripperSettings
from gripper.values.state import ServoFeedback

OPENED_M = 0.0005
"""Opening in m by which `OverForce.OPEN` opens, in one step. [chosen]"""


def frozen(last: Sequence[ServoGoal], state: ServoFeedback) -> list[ServoGoal]:
    """Return the goals that keep the present force: the last ones without a push.

    A goal that opens would let the part go. That finger is held at its present position, and
    position control uses as much of the current as it needs.
    """
    return [
        replace(goal.kept, angle_rad=min(goal.kept.angle_rad, servo.angle_rad))
        for goal, servo in zip(last, state.servos, strict=True)
    ]


def for_hours(goals: Sequence[ServoGoal], settings: GripperSettings) -> list[ServoGoal]:
    """Return goals with at most the currents that the servos bear for hours."""
    models = (one.servo_model for one in settings.servos)
    return [
        replace(goal, current_a=min(goal.current_a, model.holding_a))
        for goal, model in zip(goals, models, strict=True)
    ]


def holding_position(
    last: Sequence[ServoGoal], state: ServoFeedback, share: float
) -> list[ServoGoal]:
    """Return goals at the present positions, with a share of the frozen currents.

    No finger pushes on, and none yields by more than position control of the servos does.
    """
    return [
        replace(goal, angle_rad=servo.angle_rad, current_a=share * goal.current_a)
        for goal, servo in zip(frozen(last, state), state.servos, strict=True)
    ]


def lowered(
    first: Sequence[ServoGoal],
    last: Sequence[ServoGoal],
    share: float,
    state: ServoFeedback,
    settings: GripperSettings,
) -> list[ServoGoal]:
    """Return goals with a share of the first currents; below 0 they drive the fingers open.

    The last goals may brake: then their currents are less than the share, and they stay.
    """
    if share >= 0.0:
        return [
            replace(goal, current_a=min(share * goal.current_a, now.kept.current_a))
            for goal, now in zip(first, last, strict=True)
        ]
    models = (one.servo_model for one in settings.servos)
    return [
        replace(
            goal,
            angle_rad=servo.angle_rad + closing_margin_rad(model, -share * goal.current_a),
            current_a=-share * goal.current_a,
        )
        for goal, servo, model in zip(first, state.servos, models, strict=True)
    ]


def opened_a_step(
    state: ServoFeedback, settings: GripperSettings, linkage: Linkage
) -> list[ServoGoal]:
    """Return goals that open by `OPENED_M` from the present positions."""
    paths = transmissions(settings, linkage, state.angles_rad)
    currents_a = motion_currents_a(settings, paths, settings.approach_force_n)
    return [
        ServoGoal(
            angle_rad=angle_rad
            + OPENED_M / (len(state.servos) * linkage.opening_per_rad_m(angle_rad)),
            current_a=current_a,
        )
        for angle_rad, current_a in zip(state.angles_rad, currents_a, strict=True)
    ]
