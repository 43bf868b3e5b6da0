"""Values of a cell without a meaning, for tests that only pass them on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.hand.interface import HandStatistics
from gripper.dynamixel.bus import BusStatistics
from gripper.force.timing import Distribution, LoopStatistics
from gripper.mechanics.transmission import Drives
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.state import Cycle, GripperPhase, ServoFeedback, ServoState
from recognition.grasp import PadArray
from recognition.recognizer import Posterior
from recognition.shape.answer import ShapeAnswer, Thickness
from recognition.statistics.fusion import StopRule, decide, fuse
from tactile.source import FrameStatistics, SourceStatistics

_SERVO = ServoState(
    servo_id=1,
    angle_rad=0.123456789,
    next_rad_s=0.0,
    velocity_rad_s=-0.02,
    current_a=0.4,
    motor_a=0.4,
    position_raw=2048,
    temperature_c=31.0,
    voltage_v=12.1,
    supply_v=12.1,
    tick_ms=4711,
    limit_a=2.3,
    alert=False,
)


def command_of(controller: CellController, command: str) -> Any:
    """Return a command without arguments, of the controller or one of its parts."""
    owners = (controller, controller.life, controller.kept_part)
    return next(getattr(one, command) for one in owners if hasattr(one, command))


def make_servo(**changes: Any) -> ServoState:
    return replace(_SERVO, **changes)


def make_state(t_s: float = 1.0, **changes: Any) -> ServoFeedback:
    state = ServoFeedback(
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
    )
    return replace(cycle, **changes)


HAND_STATISTICS = HandStatistics(
    loop=LoopStatistics(cycles=5, lateness=Distribution(n=5, max_s=0.1)),
    servo_bus=BusStatistics(transactions=3),
    source=SourceStatistics(frames=FrameStatistics(complete=4)),
)


def make_identification(*posteriors: Posterior, **changes: Any) -> Identification:
    decision = decide(posteriors, StopRule(max_grasps=len(posteriors)))
    made = Identification(
        label=decision.label,
        decision=decision,
        posteriors=posteriors,
        fused=fuse(posteriors),
        records=(),
    )
    return replace(made, **changes)


def make_shape(
    kind: str, *sizes_mm: float, half_mm: float = 0.3, n_grasps: int = 1, **changes: Any
) -> ShapeAnswer:
    """Thicknesses with their intervals; the last one was met by so many grasps."""
    met = [
        Thickness(size_m=1e-3 * s, low_m=1e-3 * (s - half_mm), high_m=1e-3 * (s + half_mm))
        for s in sizes_mm
    ]
    met[-1] = replace(met[-1], n_grasps=n_grasps)
    main = met[-1] if n_grasps > 1 else met[0]
    answer = ShapeAnswer(
        kind=kind,
        probability={kind: 1.0},
        size_m=main.size_m,
        low_m=main.low_m,
        high_m=main.high_m,
        dimensions_m={},
        misfit=1.0,
        thicknesses=tuple(met),
    )
    return replace(answer, **changes)


def measured_drives(
    settings: GripperSettings, friction_sd: float = 0.1, load_sd: float = 0.02
) -> Drives:
    """Return drives with the figures of the catalogue as if they were measured."""
    sds = {"friction_sd": friction_sd, "load_sd": load_sd}
    return Drives(
        {servo.servo_id: replace(servo.drive, **sds, measured_s=1.0) for servo in settings.servos}
    )


def make_pads(
    shapes: Sequence[tuple[int, int]] = ((10, 6), (10, 6)),
    *,
    adc_max: int = 4095,
    pitch_m: float = 3e-3,
) -> PadArray:
    """Return pads of evenly spaced taxels, each around its centre."""
    places = [np.indices(one).reshape(2, -1).T - 0.5 * (np.array(one) - 1.0) for one in shapes]
    return PadArray(
        pad_shape=np.array(shapes),
        taxel_pad=np.repeat(np.arange(len(shapes)), [len(one) for one in places]),
        taxel_xy_m=np.concatenate(places) * pitch_m,
        adc_max=adc_max,
    )


def raising(error: BaseException) -> Callable[..., Any]:
    """Return a function that raises an error whatever it is given."""

    def fail(*_given: Any, **_named: Any) -> Any:
        raise error

    return fail
