"""Values of a gripper and a link without a meaning, for tests that only pass them on."""

from dataclasses import replace
from typing import Any

from gripper.state import Cycle, ForceSample, GripperPhase, GripperState, ServoState
from tactile.frames.assembler import FrameStatistics
from tactile.unit.settings import LinkStatistics

_SERVO = ServoState(
    servo_id=1,
    angle_rad=0.123456789,
    velocity_rad_s=-0.02,
    current_a=0.4,
    position_raw=2048,
    temperature_c=31.0,
    voltage_v=12.1,
    tick_ms=4711,
    alert=False,
)


def make_servo(**changes: Any) -> ServoState:
    return replace(_SERVO, **changes)


def make_state(t_s: float = 1.0, **changes: Any) -> GripperState:
    state = GripperState(
        t_s=t_s,
        aperture_m=0.0234,
        aperture_velocity_m_s=-0.001,
        current_a=0.4,
        force_from_current_n=3.9,
        temperature_c=31.0,
        voltage_v=12.1,
        servos=(_SERVO, replace(_SERVO, servo_id=2)),
    )
    return replace(state, **changes)


def make_cycle(t_s: float = 1.0, **changes: Any) -> Cycle:
    cycle = Cycle(
        t_s=t_s,
        phase=GripperPhase.RAMPING,
        state=make_state(t_s),
        force=ForceSample(t_s=t_s - 0.004, force_n=(3.9, 4.1)),
        setpoint_n=4.0,
        goal_current_a=0.41,
        level=1,
    )
    return replace(cycle, **changes)


def make_link_statistics(**changes: Any) -> LinkStatistics:
    counts = dict.fromkeys(("syncs", "late_syncs", "foreign", "malformed", "error_frames"), 0)
    values: dict[str, Any] = {"frames": FrameStatistics(), "recent_loss_rate": 0.0, **counts}
    return LinkStatistics(**(values | changes))
