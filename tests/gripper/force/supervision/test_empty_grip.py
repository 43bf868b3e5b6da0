"""A grasp that ended without a part: which frames and samples confirm it."""

import pytest

from gripper.errors import GripContradicted
from gripper.force.loop import Moment
from gripper.force.supervision.empty_grip import EmptyGrip
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from tests.gripper.force.grips import LINKAGE, STATE

LAG_S, PERIOD_S, FRAME_S = 0.02, 0.005, 0.02
MECHANICS = Mechanics(GripperSettings(), LINKAGE)
"""0.6 N are a contact, so 0.3 N on both pads are a load."""


def periods(*samples_n: float, frame_n: float | None = 0.0) -> list[bool]:
    """Return whether each period confirmed an empty grip, with a sample in each; all 0 N later."""
    empty = EmptyGrip(MECHANICS, STATE, stiffness_n_m=None, approached=True, ran=True)
    done: list[bool] = []
    for i in range(1, 20):
        t_s = STATE.t_s + PERIOD_S * i
        force_n = samples_n[i - 1] if i <= len(samples_n) else 0.0
        scanned_s = STATE.t_s + FRAME_S * (i // 4) - LAG_S
        frame = {} if frame_n is None else {"frame_s": scanned_s, "frame_n": (frame_n, frame_n)}
        sample = ForceSample(t_s=t_s, force_n=(force_n, force_n), lag_s=LAG_S, **frame)
        done.append(empty.step(Moment(now_s=t_s, dt_s=PERIOD_S, state=STATE, sample=sample)).done)
    return done


def test_three_frames_after_the_stop_confirm_that_nothing_is_held() -> None:
    assert periods().index(True) == 15, "80 ms after the stop"
    assert periods(frame_n=None).index(True) == 0, "a sensor whose samples come from frames"


def test_a_load_measured_before_the_stop_is_waited_for() -> None:
    assert periods(2.0, 2.0, 2.0, frame_n=None).index(True) == 3


@pytest.mark.parametrize(
    ("samples_n", "frame_n", "says"),
    [
        ((0.0,) * 19, 0.5, r"samples show 0\.00 and 0\.00 N, the frames 0\.50 and 0\.50 N, more"),
        ((0.5,) * 19, 0.0, r"samples show 0\.50 and 0\.50 N, the frames 0\.00 and 0\.00 N, more"),
        ((0.5,) * 19, None, r"samples show 0\.50 and 0\.50 N, more than 0\.30 N on both pads"),
    ],
)
def test_a_load_on_both_pads_contradicts_an_empty_grip(samples_n, frame_n, says) -> None:
    with pytest.raises(GripContradicted, match=says):
        periods(*samples_n, frame_n=frame_n)
