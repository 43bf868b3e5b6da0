"""Self-test of the bus watchdog: it must stop each motor when the host falls silent.

Register 98 alone is no proof: with some firmware it reads -1 and the motor turns on (330 size,
ROBOTIS forum 4814). So the empty, open fingers move slowly over a short way. The host stays silent
until the watchdog must have tripped, and the positions are compared.
"""

from collections.abc import Sequence

from gripper.clock import Clock
from gripper.errors import FingerBlocked, LimitExceeded, WatchdogUnproven
from gripper.mechanics.impact import closing_current_max_a
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import ServoGoal
from gripper.servos.group import Servos
from gripper.values.state import ServoFeedback

_FASTEST_RAD_S = 0.1
"""Largest Profile Velocity (register 112) of the test motion in rad/s."""
_SILENT_RAD = 0.0096
"""Way in rad within ``watchdog_s``, which sets the speed: 6 pulses, 0.6 mm of a finger with links
of 60 mm. A long watchdog time makes the motion slower, not longer."""
_FORCE_N = 1.0
"""Grip force in N that the current of the test motion allows beyond friction."""
_START_RAD = 0.04
"""Way in rad of the goal in which the motors overcome friction and reach the speed."""
_FEED_S = 0.02
"""Time in s between two readings, which feed the watchdog, until then."""
_WAY_SHARE = 3.0
"""Remaining time of the motion without a trip, in multiples of ``watchdog_s``."""
_SILENT_SHARE, _SILENT_MORE_S = 1.5, 0.02
"""Silence of the host, in multiples of ``watchdog_s``, plus a unit of the watchdog in s."""
_REST_RAD = 0.015
"""Way in rad of a motor without a trip in the time of observation after the stop."""
_FARTHEST_SHARE, _FARTHEST_MORE_PULSES = 1.5, 4
"""Longest way until the trip, in multiples of that in ``watchdog_s``, and in addition in pulses."""
_LEAST_PULSES = 3
"""Way in pulses that counts as motion, and least remaining way to the goal."""
_STILL_PULSES = 2
"""Way in pulses that counts as rest: noise of the encoder."""
_LONGEST_RAD = 0.2
"""Longest way in rad of the test motion: 12 mm of a finger with links of 60 mm."""


def prove_watchdog(servos: Servos, clock: Clock) -> None:
    """Let the watchdog trip during a slow motion of the empty, open fingers.

    The torque is on and the watchdog armed before and after it. The motion is a profile of 0.1
    rad/s, slower where the watchdog takes longer than 0.1 s. It lasts for its start and three times
    ``watchdog_s``. Raises WatchdogUnproven when a servo did not stop or did not trip, and
    FingerBlocked when they did, but something held the fingers. Raises LimitExceeded as
    `proof_travel_m` does.
    """
    mechanics, settings, begin = servos.mechanics, servos.settings, servos.read()
    speed_rad_s, goals_rad = _motion(mechanics, begin.angles_rad)
    paths = mechanics.transmissions(begin.angles_rad)
    # Friction at rest may be several times that of the model, or that measured in motion.
    currents_a = [
        max(current_a, min(path.most_boost * current_a, closing_current_max_a(settings, path)))
        for current_a, path in zip(mechanics.motion_currents_a(paths, _FORCE_N), paths, strict=True)
    ]
    goals = [
        ServoGoal(angle_rad=angle_rad, current_a=current_a, profile_rad_s=speed_rad_s)
        for angle_rad, current_a in zip(goals_rad, currents_a, strict=True)
    ]
    before = begin
    while before.t_s - begin.t_s < _START_RAD / speed_rad_s:
        # Friction delays the start of the motors: a finger that stands may then have more current.
        servos.goals.write(goals, before)
        clock.sleep(_FEED_S)
        before = servos.read()
    clock.sleep(_SILENT_SHARE * settings.watchdog_s + _SILENT_MORE_S)
    stopped = servos.read()
    clock.sleep(_REST_RAD / speed_rad_s)
    later = servos.read()
    tripped = [servos.has_tripped(servo.servo_id) for servo in settings.servos]
    servos.restart_watchdog(max(currents_a))
    farthest_rad = _FARTHEST_SHARE * speed_rad_s * settings.watchdog_s
    unproven, blocked = [], True
    for index, servo in enumerate(settings.servos):
        pulse_rad = servo.servo_model.rad_per_pulse
        moved = _pulses(before, stopped, index)
        farthest = round(farthest_rad / pulse_rad) + _FARTHEST_MORE_PULSES
        after = _pulses(stopped, later, index)
        left = round((later.servos[index].angle_rad - goals_rad[index]) / pulse_rad)
        stood = left >= _LEAST_PULSES and after <= _STILL_PULSES
        if not (tripped[index] and _LEAST_PULSES <= moved <= farthest and stood):
            blocked &= tripped[index] and moved < _LEAST_PULSES and stood
            unproven.append(
                f"servo {servo.servo_id}: register 98 "
                f"{'tripped' if tripped[index] else 'did not trip'}, {moved} pulses in the silence "
                f"({_LEAST_PULSES} to {farthest} expected), {after} after it, {left} short of its "
                f"goal"
            )
    details = "; ".join(unproven)
    if unproven and blocked:
        raise FingerBlocked(
            f"the fingers stood before the bus watchdog could be tested: {details}. Take out what "
            "lies between them, or free them, then clear the fault, release and start"
        )
    if unproven:
        raise WatchdogUnproven(
            f"the bus watchdog is not proven to stop the motors: {details}. Do not run this "
            "gripper unattended; update the firmware or replace the servo, or switch "
            "watchdog_self_test off to work attended"
        )


def proof_travel_m(mechanics: Mechanics, aperture_m: float) -> float:
    """Return the largest closing way of the test motion in m, from an opening in m.

    Raises LimitExceeded when the watchdog's time is too long, or the fingers are too closed, for a
    safe motion.
    """
    _, goals_rad = _motion(mechanics, mechanics.linkage.angles_rad(aperture_m))
    return aperture_m - mechanics.linkage.aperture_m(goals_rad)


def _motion(mechanics: Mechanics, angles_rad: Sequence[float]) -> tuple[float, list[float]]:
    """Return speed in rad/s and goal angles in rad of the test motion from these angles."""
    settings, linkage = mechanics.settings, mechanics.linkage
    unit_rad_s = max(servo.servo_model.velocity_unit_rad_s for servo in settings.servos)
    wanted_raw = round(_SILENT_RAD / settings.watchdog_s / unit_rad_s)
    speed_rad_s = min(max(wanted_raw, 1), int(_FASTEST_RAD_S / unit_rad_s)) * unit_rad_s
    way_rad = _START_RAD + _WAY_SHARE * settings.watchdog_s * speed_rad_s
    if way_rad > _LONGEST_RAD:
        raise LimitExceeded(
            f"the self-test of a watchdog of {settings.watchdog_s:g} s would move the fingers by "
            f"{way_rad:.2f} rad, at most {_LONGEST_RAD} rad are allowed: shorten "
            "gripper.watchdog_ms"
        )
    goals_rad = [angle_rad - way_rad for angle_rad in angles_rad]
    open_m, closed_m = linkage.aperture_m(angles_rad), linkage.aperture_m(goals_rad)
    if closed_m < settings.aperture_min_m:
        raise LimitExceeded(
            f"the opening is {open_m * 1e3:.1f} mm, the self-test of the watchdog closes the "
            f"fingers by {(open_m - closed_m) * 1e3:.1f} mm: open them further first "
            "(gripper.aperture_open_mm), or shorten gripper.watchdog_ms"
        )
    return speed_rad_s, goals_rad


def _pulses(first: ServoFeedback, second: ServoFeedback, index: int) -> int:
    return abs(second.servos[index].position_raw - first.servos[index].position_raw)
