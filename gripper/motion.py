"""Step of control for the loop: moving to an opening."""

from collections.abc import Sequence

from gripper.errors import ServoFault
from gripper.kinematics import Linkage, Transmission
from gripper.limits import OPENING_MARGIN_RAD, ServoGoal
from gripper.motion_current import motion_current_a
from gripper.registers import RAD_PER_PULSE
from gripper.runner import Action, Moment
from gripper.settings import GripperSettings
from gripper.state import GripperState

_REACHED_RAD = 2.0 * RAD_PER_PULSE
_OVERRUN_RAD = 0.6 * OPENING_MARGIN_RAD
_PATIENCE_S = 2.0
_OPENING_FORCE_N = 3.0
_AGAINST_REST = 1.4


class MoveTo:
    """Moves all servos evenly to an opening; the goal runs a little beyond against friction.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the start.
    aperture_m
        Opening to reach in m.
    paths
        Transmissions at the start.
    now_s
        Monotonic time in s.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        paths: Sequence[Transmission],
        *,
        aperture_m: float,
        now_s: float,
    ) -> None:
        self._start_rad = [servo.angle_rad for servo in state.servos]
        self._target_rad = linkage.angles_rad(aperture_m)
        travel_m = max(abs(aperture_m - state.aperture_m), 1e-3)
        opening = aperture_m >= state.aperture_m
        speed_m_s = settings.open_speed_m_s if opening else settings.approach_speed_m_s
        force_n = _OPENING_FORCE_N if opening else settings.approach_force_n
        self._current_a = min(
            _AGAINST_REST * motion_current_a(settings, paths, force_n), settings.current_max_a
        )
        self._share_per_s = speed_m_s / travel_m
        self._share = 0.0
        self._aperture_m = aperture_m
        self._deadline_s = now_s + travel_m / speed_m_s + _PATIENCE_S

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; ServoFault when a finger does not arrive in time."""
        self._share = min(1.0, self._share + self._share_per_s * moment.dt_s)
        goals = []
        arrived = True
        for servo, start_rad, target_rad in zip(
            moment.state.servos, self._start_rad, self._target_rad, strict=True
        ):
            sign = 1.0 if target_rad >= start_rad else -1.0
            there = sign * (target_rad - servo.angle_rad) <= _REACHED_RAD
            arrived = arrived and there
            end_rad = target_rad + sign * _OVERRUN_RAD
            angle_rad = (
                servo.angle_rad if there else start_rad + self._share * (end_rad - start_rad)
            )
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=self._current_a))
        if not arrived and moment.now_s > self._deadline_s:
            slowest = max(
                zip(moment.state.servos, self._target_rad, strict=True),
                key=lambda pair: abs(pair[1] - pair[0].angle_rad),
            )[0]
            raise ServoFault(
                slowest.servo_id,
                0,
                f"its finger is stuck: the gripper stands at "
                f"{moment.state.aperture_m * 1e3:.1f} mm on its way to "
                f"{self._aperture_m * 1e3:.1f} mm",
            )
        return Action(goals=goals, done=arrived)
